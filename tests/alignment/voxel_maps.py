"""Maps of voxels with known states, for tests of alignments."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semloc_logs.alignment.mask_grid import ANY_BIT, MaskGrid, build_mask_grid, class_bits
from semloc_logs.alignment.query_map import Evidence
from semloc_logs.arrays import U8
from semloc_logs.labels.space import cityscapes
from semloc_logs.numerics.transforms import apply, inverse
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE, BlockMap, empty_map
from semloc_logs.voxels.keys import BLOCK, pack

V = 0.5
Cell = tuple[int, ...]
COARSE = cityscapes().coarse


def block_map(cells: dict[Cell, int]) -> BlockMap:
    """A map with these voxel states."""
    blocks: dict[Cell, U8] = {}
    for ijk, value in cells.items():
        block = tuple(c // BLOCK for c in ijk)
        blocks.setdefault(block, np.full((BLOCK,) * 3, UNOBSERVED_STATE, np.uint8))[
            tuple(c % BLOCK for c in ijk)
        ] = value
    if not blocks:
        return empty_map()
    keys = pack(np.array(list(blocks)))
    state = np.stack(list(blocks.values())).reshape(-1, BLOCK**3)[np.argsort(keys)]
    occupied = (state != FREE_STATE) & (state != UNOBSERVED_STATE)
    nothing = np.zeros(0, np.int64)
    return BlockMap(
        np.sort(keys), np.where(occupied, 20, -20).astype(np.int8), state, nothing, nothing
    )


def mask_grid_of(blocks: BlockMap) -> MaskGrid:
    return build_mask_grid(blocks, blocks.occupied(), V, COARSE)


def random_cells(seed: int, n: int = 120, low: int = -9, high: int = 11) -> dict[Cell, int]:
    rng = np.random.default_rng(seed)
    states = np.array([0, 2, 2, 5, 8, 13, 255, 254, 254, 254])
    return {tuple(c): int(rng.choice(states)) for c in rng.integers(low, high, (n, 3)).tolist()}


def occupied(state: int) -> bool:
    return state not in (FREE_STATE, UNOBSERVED_STATE)


def town(seed: int = 0) -> dict[Cell, int]:
    """Ground, fronts, a pole, a bush: no symmetry."""
    cells: dict[Cell, int] = {}
    for x in range(-30, 31):
        for y in range(-30, 31):
            cells[(x, y, -4)] = 0 if abs(y) < 8 else 1
    for z in range(-3, 9):
        for x in range(-28, 12):
            cells[(x, 12, z)] = 2
        for y in range(-25, -10):
            cells[(17, y, z)] = 2
        cells[(6, -9, z)] = 5
        cells[(-14, -11, z)] = 5
        for x in range(-9, -1):
            cells[(x, -16 + x, z)] = 8
    return cells


def points_of(cells: dict[Cell, int]) -> NDArray[np.float64]:
    return (np.array([c for c, s in cells.items() if occupied(s)]) + 0.5) * V


def moved(cells: dict[Cell, int], T: NDArray[np.float64]) -> dict[Cell, int]:
    """The map seen from the query's frame: voxel centres by inverse(T), dense enough by two samples
    an axis.
    """
    out: dict[Cell, int] = {}
    back = inverse(T)
    for d in np.ndindex(2, 2, 2):
        centres = (np.array(list(cells)) + 0.25 + 0.5 * np.array(d)) * V
        for p, s in zip(apply(back, centres), cells.values(), strict=True):
            out[tuple(np.floor(p / V).astype(int).tolist())] = s
    return out


def evidence_of(cells: dict[Cell, int], structure: int) -> Evidence:
    """The first ``structure`` of these voxels are structure, the rest ground."""
    states = np.array(list(cells.values()), np.uint8)
    return Evidence(
        (np.array(list(cells)) + 0.5) * V,
        class_bits(states, COARSE) & np.uint8(ANY_BIT - 1),
        structure,
    )
