"""Masks of a target's cells: the classes of all voxels that may be closest to a point in a cell.

A query voxel is aligned where the observed target voxel closest to it is occupied, of its class,
and nearer than kappa. Which voxel is closest depends on where in its cell a point lies only beside
borders, so one look-up of a mask often tells it, and always gives a bound.

An observed voxel whose six neighbours are observed is not the closest to any point outside of it:
one of these is. So only voxels beside unobserved ones, the *border*, are looked at.

Masks are made when a cube of cells is looked at first: numbers of a palette of masks, one byte a
cell of a dense grid, whose memory is used where something was looked up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from semloc_logs.alignment.tau import CUBE, closest_in_cube, cube_offsets
from semloc_logs.arrays import F64, I32, I64, U8, U32, U64
from semloc_logs.labels.space import UNLABELLED
from semloc_logs.numerics.bits import lowest_bit
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE, BlockMap
from semloc_logs.voxels.keys import BLOCK, unpack

CLASSES = 29  # class ids that have bits of their own; the paper has 19
UNLABELLED_BIT = 29
NOT_ALIGNED = np.uint32(1 << 31)  # free space, or nothing within kappa
ANYTHING = np.uint32(0xFFFFFFFF)
NOT_MADE, ANY_MASK = 0, 1  # numbers of the palette
PALETTE = 256
# voxels of the grid around the blocks, so that look-ups seldom leave it; whole cubes
MARGIN = (96, 96, 48)
HALF_DIAGONAL = float(np.sqrt(0.75))  # of a cell, in cells
CUBES = BLOCK // CUBE  # along the edge of a block
# of a map, in the order of its fields
Arrays = tuple[I32, I64, U8, U64, U32, U8, I64, U32, float]
Grid = tuple[I32, I64, U8]  # the first three of them
Borders = tuple[I32, I64, U8, U64]  # the first four; handing on all of them takes longer
Around = tuple[I64, U64, U32, F64]  # cubes: places, border, bits, squares of least distances
Offsets = tuple[I64, F64]  # of cubes, and the squares of their least distances


def class_bit(label: U8) -> U32:
    """The bit of each class: one of ``CLASSES``, or of unlabelled voxels."""
    number = np.where(label == UNLABELLED, UNLABELLED_BIT, label).astype(np.uint32)
    if (number > UNLABELLED_BIT).any() or ((label >= CLASSES) & (label != UNLABELLED)).any():
        raise ValueError(f"classes are below {CLASSES}")
    return np.uint32(1) << number


@dataclass(frozen=True, slots=True, eq=False)
class OverlapMap:
    """A target's voxels by blocks, and the masks of its cells.

    ``number`` (x, y, z) is the row of each block from block ``first`` (3,) on, -1 without one;
    ``state`` (rows, 4096) has voxel states, ``border`` (rows, 64) which cells of each cube are
    observed beside unobserved ones, ``present`` (rows, 64) the bits of their states. ``mask`` (x,
    y, z), from voxel ``low`` (3,) on, has numbers of the ``palette``, made when needed. Points
    farther than ``reach`` voxels from all observed ones are not aligned.
    """

    number: I32
    first: I64
    state: U8
    border: U64
    present: U32
    mask: U8
    low: I64
    palette: U32
    reach: float

    @property
    def arrays(self) -> Arrays:
        """All of it, for compiled functions."""
        return (
            self.number,
            self.first,
            self.state,
            self.border,
            self.present,
            self.mask,
            self.low,
            self.palette,
            self.reach,
        )

    @property
    def offsets(self) -> Offsets:
        """The cubes that may hold the closest voxel to a point of the cube at the origin."""
        return cube_offsets(self.reach + 2)


def overlap_map(target: BlockMap, reach: float, *, free: bool = True) -> OverlapMap:
    """The map of a target, for a kappa of ``reach`` voxels; without ``free``, occupied voxels alone
    may be closest.
    """
    blocks = unpack(target.keys).astype(np.int64)
    beside = int(np.ceil((reach + 2) / BLOCK))
    first = blocks.min(0) - beside if len(blocks) else np.zeros(3, np.int64)
    last = blocks.max(0) + beside if len(blocks) else np.zeros(3, np.int64)
    number = np.full(tuple((last - first + 1).tolist()), -1, np.int32)
    side = range(-beside, beside + 1)
    for dx in side:
        for dy in side:
            for dz in side:
                number[tuple((blocks - first + (dx, dy, dz)).T)] = -2
    number[tuple((blocks - first).T)] = np.arange(len(blocks))
    around = number == -2
    rows = len(blocks) + int(around.sum())
    number[around] = np.arange(len(blocks), rows)
    state = np.full((rows, BLOCK**3), UNOBSERVED_STATE, np.uint8)
    state[: len(blocks)] = target.state
    if not free:
        state[state == FREE_STATE] = UNOBSERVED_STATE
    border = np.zeros((rows, CUBES**3), np.uint64)
    present = np.zeros((rows, CUBES**3), np.uint32)
    _mark_border((number, first, state), blocks, border, present)
    palette = np.zeros(PALETTE, np.uint32)
    palette[ANY_MASK] = ANYTHING
    margin = np.array(MARGIN, np.int64)
    low = first * BLOCK - margin
    mask = np.zeros(tuple(((last + 1) * BLOCK + margin - low).tolist()), np.uint8)
    return OverlapMap(number, first, state, border, present, mask, low, palette, reach)


@njit(cache=True, nogil=True)
def _mark_border(grid: Grid, blocks: I64, border: U64, present: U32) -> None:
    """Fill the rows of ``blocks`` (n, 3) in ``border`` and ``present``."""
    state = grid[2]
    for row in range(len(blocks)):
        for m in range(BLOCK**3):
            if state[row, m] == UNOBSERVED_STATE:
                continue
            x = m >> 8
            y = (m >> 4) & 15
            z = m & 15
            if _is_border(
                grid,
                BLOCK * blocks[row, 0] + x,
                BLOCK * blocks[row, 1] + y,
                BLOCK * blocks[row, 2] + z,
            ):
                cube = ((x >> 2) * CUBES + (y >> 2)) * CUBES + (z >> 2)
                bit = ((x & 3) << 4) | ((y & 3) << 2) | (z & 3)
                border[row, cube] |= np.uint64(1) << np.uint64(bit)
                present[row, cube] |= bit_of(state[row, m])


@njit(cache=True, nogil=True)
def _is_border(grid: Grid, x: int, y: int, z: int) -> bool:
    """Whether one of the six neighbours of a voxel is unobserved."""
    return (
        state_at(grid, x - 1, y, z) == UNOBSERVED_STATE
        or state_at(grid, x + 1, y, z) == UNOBSERVED_STATE
        or state_at(grid, x, y - 1, z) == UNOBSERVED_STATE
        or state_at(grid, x, y + 1, z) == UNOBSERVED_STATE
        or state_at(grid, x, y, z - 1) == UNOBSERVED_STATE
        or state_at(grid, x, y, z + 1) == UNOBSERVED_STATE
    )


@njit(cache=True, nogil=True)
def _row_of(number: I32, first: I64, x: int, y: int, z: int) -> int:
    """The row of the block that voxel (x, y, z) lies in, -1 without one."""
    i = (x >> 4) - first[0]
    j = (y >> 4) - first[1]
    k = (z >> 4) - first[2]
    if (
        i < 0
        or j < 0
        or k < 0
        or i >= number.shape[0]
        or j >= number.shape[1]
        or k >= number.shape[2]
    ):
        return -1
    return int(number[i, j, k])


@njit(cache=True, nogil=True)
def _cell_of(x: int, y: int, z: int) -> int:
    """The place of a voxel in its block."""
    return ((x & 15) << 8) | ((y & 15) << 4) | (z & 15)


@njit(cache=True, nogil=True)
def _cube_of(x: int, y: int, z: int) -> int:
    """The number of the cube (x, y, z), in cubes, in its block."""
    return (((x & 3) << 2) | (y & 3)) << 2 | (z & 3)


@njit(cache=True, nogil=True)
def closest(
    borders: Borders, point: tuple[float, float, float], offsets: Offsets, bound: float
) -> tuple[float, int, int, int]:
    """Squared distance and voxel of the observed voxel whose centre is closest to ``point``.

    Only those nearer than ``bound`` (squared) count; without one the distance is ``bound``.
    """
    number, first, state, border = borders
    offset, least = offsets
    x = int(np.floor(point[0]))
    y = int(np.floor(point[1]))
    z = int(np.floor(point[2]))
    if state_at((number, first, state), x, y, z) != UNOBSERVED_STATE:
        # of the voxel that a point lies in the centre is the closest
        own = (point[0] - x - 0.5) ** 2 + (point[1] - y - 0.5) ** 2 + (point[2] - z - 0.5) ** 2
        return min(own, bound), x, y, z
    cx = x >> 2
    cy = y >> 2
    cz = z >> 2
    best = bound
    nearest = (0, 0, 0)
    for m in range(len(offset)):
        if least[m] >= best:
            break
        x = cx + offset[m, 0]
        y = cy + offset[m, 1]
        z = cz + offset[m, 2]
        row = _row_of(number, first, x << 2, y << 2, z << 2)
        if row < 0:
            continue
        cells = border[row, _cube_of(x, y, z)]
        if cells == 0:
            continue
        best, bit = closest_in_cube(cells, (x, y, z), point, best)
        if bit >= 0:
            nearest = (CUBE * x + (bit >> 4), CUBE * y + ((bit >> 2) & 3), CUBE * z + (bit & 3))
    return best, nearest[0], nearest[1], nearest[2]


@njit(cache=True, nogil=True)
def state_at(grid: Grid, x: int, y: int, z: int) -> int:
    number, first, state = grid
    row = _row_of(number, first, x, y, z)
    return int(state[row, _cell_of(x, y, z)]) if row >= 0 else UNOBSERVED_STATE


@njit(cache=True, nogil=True)
def bit_of(state: int) -> np.uint32:
    if state in (FREE_STATE, UNOBSERVED_STATE):
        return NOT_ALIGNED
    return np.uint32(1) << np.uint32(UNLABELLED_BIT if state == UNLABELLED else state)


@njit(cache=True, nogil=True)
def _make_masks(arrays: Arrays, cube: tuple[int, int, int], offsets: Offsets) -> None:
    """Make the masks of all cells of a ``cube``: the bits of all voxels that may be closest to a
    point in the cell.
    """
    number, first, state, _, _, mask, low, palette, reach = arrays
    x = CUBE * cube[0]
    y = CUBE * cube[1]
    z = CUBE * cube[2]
    grid = (number, first, state)
    is_near = _row_of(number, first, x, y, z) >= 0
    around = _cubes_around(arrays, cube, offsets, reach + HALF_DIAGONAL)
    for cell in range(CUBE**3):
        i = x + (cell >> 4)
        j = y + ((cell >> 2) & 3)
        k = z + (cell & 3)
        bits = NOT_ALIGNED
        if is_near:
            own = state_at(grid, i, j, k)
            if own != UNOBSERVED_STATE:
                bits = bit_of(own)
                if reach <= HALF_DIAGONAL:
                    bits |= NOT_ALIGNED
            elif len(around[0]):
                bits = _mask_of(grid, reach, (i, j, k), around)
        mask[i - low[0], j - low[1], k - low[2]] = _number_of(palette, bits)


@njit(cache=True, nogil=True)
def _cubes_around(
    arrays: Arrays, cube: tuple[int, int, int], offsets: Offsets, far: float
) -> Around:
    """The cubes with border cells that may lie within ``far`` of a cell's middle in ``cube``."""
    number, first, _, border, present, _, _, _, _ = arrays
    offset, least = offsets
    places = np.empty((len(offset), 3), np.int64)
    borders = np.empty(len(offset), np.uint64)
    presents = np.empty(len(offset), np.uint32)
    leasts = np.empty(len(offset))
    count = 0
    for m in range(len(offset)):
        if least[m] > far * far:
            break
        x = cube[0] + offset[m, 0]
        y = cube[1] + offset[m, 1]
        z = cube[2] + offset[m, 2]
        row = _row_of(number, first, x << 2, y << 2, z << 2)
        if row < 0:
            continue
        cells = border[row, _cube_of(x, y, z)]
        if cells:
            places[count, 0] = x
            places[count, 1] = y
            places[count, 2] = z
            borders[count] = cells
            presents[count] = present[row, _cube_of(x, y, z)]
            leasts[count] = least[m]
            count += 1
    return places[:count], borders[:count], presents[:count], leasts[:count]


@njit(cache=True, nogil=True)
def _mask_of(grid: Grid, reach: float, cell: tuple[int, int, int], around: Around) -> np.uint32:
    """The bits of all voxels of the cubes ``around`` that may be closest to a point in the cell."""
    places, borders, presents, leasts = around
    far = reach + HALF_DIAGONAL
    x, y, z = cell
    middle = (x + 0.5, y + 0.5, z + 0.5)
    nearest = far * far
    for m in range(len(leasts)):
        if leasts[m] >= nearest:
            break
        place = (places[m, 0], places[m, 1], places[m, 2])
        nearest, _ = closest_in_cube(borders[m], place, middle, nearest)
    if nearest >= far * far:
        return NOT_ALIGNED
    away = np.sqrt(nearest)
    mask = NOT_ALIGNED if away + HALF_DIAGONAL >= reach else np.uint32(0)
    # a little more, for the rounding of points
    radius = min(away + 2 * HALF_DIAGONAL + 1e-6, far)
    for m in range(len(leasts)):
        if leasts[m] > radius * radius:
            break
        if presents[m] & ~mask == 0:
            continue
        border = borders[m]
        while border:
            bit = lowest_bit(border)
            border &= border - np.uint64(1)
            i = CUBE * places[m, 0] + (bit >> 4)
            j = CUBE * places[m, 1] + ((bit >> 2) & 3)
            k = CUBE * places[m, 2] + (bit & 3)
            if (i - x) ** 2 + (j - y) ** 2 + (k - z) ** 2 <= radius * radius:
                mask |= bit_of(state_at(grid, i, j, k))
    return mask


@njit(cache=True, nogil=True)
def _number_of(palette: U32, mask: np.uint32) -> int:
    """The number of ``mask`` in the palette, where it is entered; ``ANY_MASK`` in a full one."""
    for n in range(2, len(palette)):
        if palette[n] == mask:
            return n
        if palette[n] == 0:
            palette[n] = mask
            return n
    return ANY_MASK


@njit(cache=True, nogil=True)
def look_up(arrays: Arrays, x: int, y: int, z: int, offsets: Offsets) -> np.uint32:
    """The mask of a cell."""
    mask = arrays[5]
    i = x - arrays[6][0]
    j = y - arrays[6][1]
    k = z - arrays[6][2]
    if i < 0 or j < 0 or k < 0 or i >= mask.shape[0] or j >= mask.shape[1] or k >= mask.shape[2]:
        return NOT_ALIGNED
    if mask[i, j, k] == NOT_MADE:
        _make_masks(arrays, (x >> 2, y >> 2, z >> 2), offsets)
    return np.uint32(arrays[7][mask[i, j, k]])
