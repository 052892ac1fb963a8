"""A target map as a dense grid of bit masks, to look query voxels up in.

Bit c of a cell is set where a voxel of coarse class c lies in the cell or beside it, so one look-up
tells whether a query voxel is aligned to within a cell; another bit tells that it contradicts free
space. The finest grid is the only one: coarser ones know nothing of contradictions, and in halls
they lost places that a few hundred look-ups in the finest find.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.arrays import F64, I64, U8
from semloc_logs.numerics.bits import EACH_BYTE, bytes_set
from semloc_logs.voxels.grid import EIGHTS, FREE_STATE, UNOBSERVED_STATE, BlockMap
from semloc_logs.voxels.keys import BLOCK, unpack

FREE_BIT = 128  # observed free and nothing occupied beside it
ANY_BIT = 64  # occupied, unlabelled included
CLASS_BITS = 6  # of a mask
HIGHEST = np.uint64(FREE_BIT * EACH_BYTE)  # bit of each byte of a word
# cells that a search may shift by; a grid is padded by twice as many, so that no look-up leaves it,
# and blocks begin at whole eights
REACH = 4

Arrays = tuple[U8, F64, float]  # of a grid, in the order of its fields


@dataclass(frozen=True, slots=True, eq=False)
class MaskGrid:
    """``mask`` (x, y, z) uint8 of a map, in cells of ``cell`` metres.

    Cell (0, 0, 0) has its corner at ``corner`` (3,), metres in the map frame.
    """

    mask: U8
    corner: F64
    cell: float

    @property
    def arrays(self) -> Arrays:
        """All of it, for compiled functions."""
        return self.mask, self.corner, self.cell


def class_bits(state: U8, coarse: U8) -> U8:
    """Bit masks of voxel states: 1 << coarse class with ``ANY_BIT``; 0 where not occupied.

    ``coarse`` (256,) maps classes to 0..5, or to more for none.
    """
    table = np.zeros(256, np.uint8)
    for label in range(256):
        if label not in (FREE_STATE, UNOBSERVED_STATE):
            table[label] = ANY_BIT | (1 << coarse[label] if coarse[label] < CLASS_BITS else 0)
    return table[state]


def wanted_bits(state: U8, coarse: U8) -> U8:
    """Bits that a target cell must share with query voxels: the class, or anything occupied.

    The latter is for voxels of unknown class.
    """
    bits = class_bits(state, coarse)
    known = bits & (ANY_BIT - 1)
    return np.where(known, known, bits)


def build_mask_grid(
    blocks: BlockMap, occupied: tuple[NDArray[np.int32], U8], voxel_size: float, coarse: U8
) -> MaskGrid:
    """The masks of a map with its ``occupied`` voxels, and a margin that a search cannot leave."""
    low, high = blocks.bounds()
    margin = 2 * REACH
    mask = np.zeros(tuple((high - low + 2 * margin).tolist()), np.uint8)
    ijk, label = occupied
    _mark_occupied(mask, ijk - low + margin, class_bits(label, coarse))
    corners = unpack(blocks.keys).astype(np.int64) * BLOCK - low + margin
    _mark_free(mask, corners, np.ascontiguousarray(blocks.state))
    return MaskGrid(mask, (low - margin).astype(float) * voxel_size, voxel_size)


@njit(cache=True, nogil=True)
def _mark_occupied(mask: U8, cells: I64, bits: U8) -> None:
    """Set the ``bits`` (m,) of occupied ``cells`` (m, 3) in them and in the 26 beside."""
    flat = mask.ravel()
    _, ny, nz = mask.shape
    for m in range(len(cells)):
        x, y, z = cells[m]
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                middle = ((x + dx) * ny + y + dy) * nz + z
                # unsigned: numba would make sure of every index that it is not counted from the end
                flat[np.uint64(middle - 1)] |= bits[m]
                flat[np.uint64(middle)] |= bits[m]
                flat[np.uint64(middle + 1)] |= bits[m]


@njit(cache=True, nogil=True)
def _mark_free(mask: U8, corners: I64, state: U8) -> None:
    """Set the free bit of free cells that have none yet, eight along z at a time.

    Blocks (n,) have their corner cells at ``corners`` (n, 3); these lie at whole eights.
    """
    masks = mask.ravel().view(np.uint64)
    states = state.view(np.uint64)
    _, ny, nz = mask.shape
    for n in range(len(corners)):
        x, y, z = corners[n]
        for e in range(EIGHTS):
            is_free = ~bytes_set(states[n, e] ^ np.uint64(FREE_STATE * EACH_BYTE)) & HIGHEST
            if is_free:
                line = (x + e // (2 * BLOCK)) * ny + y + e // 2 % BLOCK
                eight = np.uint64((line * nz + z) // 8 + e % 2)
                masks[eight] |= is_free & ~bytes_set(masks[eight])


@njit(cache=True, nogil=True)
def _look_up(mask: U8, corner: F64, cell: float, points: F64) -> U8:
    out = np.zeros(len(points), np.uint8)
    for n in range(len(points)):
        x = int(np.floor((points[n, 0] - corner[0]) / cell))
        y = int(np.floor((points[n, 1] - corner[1]) / cell))
        z = int(np.floor((points[n, 2] - corner[2]) / cell))
        if 0 <= x < mask.shape[0] and 0 <= y < mask.shape[1] and 0 <= z < mask.shape[2]:
            out[n] = mask[x, y, z]
    return out


def look_up(grid: MaskGrid, points: F64) -> U8:
    """Masks (n,) at ``points`` (n, 3) in the target's frame, 0 outside."""
    return np.asarray(
        _look_up(grid.mask, grid.corner, grid.cell, np.ascontiguousarray(points, float))
    )
