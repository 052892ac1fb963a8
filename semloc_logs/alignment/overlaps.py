"""The paper's tau of very many hypotheses (3.5), equal to :mod:`semloc_logs.alignment.tau`.

A query voxel is aligned where the observed target voxel closest to it is occupied, of its class,
and nearer than kappa. Which voxel is closest depends on where in its cell a point lies only beside
borders: for each cell a mask has the classes of all voxels that may be closest to a point in it. So
one look-up gives bounds of tau; the closest voxel itself is looked for in hypotheses whose upper
bound is among the best, and there only for voxels that the mask leaves open.

An observed voxel whose six neighbours are observed is not the closest to any point outside of it:
one of these is. So only voxels beside unobserved ones, the *border*, are looked at.

Masks are made when a cube of cells is looked at first: numbers of a palette of masks, one byte a
cell of a dense grid, whose memory is used where something was looked up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.alignment.tau import CUBE, closest_in_cube, cube_offsets
from semloc_logs.labels.space import UNLABELLED
from semloc_logs.numerics.bits import lowest_bit
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE, BlockMap
from semloc_logs.voxels.keys import BLOCK, unpack

U8 = NDArray[np.uint8]
U32 = NDArray[np.uint32]
U64 = NDArray[np.uint64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
F64 = NDArray[np.float64]
CLASSES = 29  # class ids that have bits of their own; the paper has 19
UNLABELLED_BIT = 29
NOT_ALIGNED = np.uint32(1 << 31)  # free space, or nothing within kappa
ANYTHING = np.uint32(0xFFFFFFFF)
NOT_MADE, ANY_MASK = 0, 1  # numbers of the palette
PALETTE = 256
# voxels of the grid around the blocks, so that look-ups seldom leave it; whole cubes
MARGIN = (96, 96, 48)
HALF_DIAGONAL = float(np.sqrt(0.75))  # of a cell, in cells
CHUNK = 512  # voxels counted between two checks whether a hypothesis can be among the best
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
                present[row, cube] |= _bit_of(state[row, m])


@njit(cache=True, nogil=True)
def _is_border(grid: Grid, x: int, y: int, z: int) -> bool:
    """Whether one of the six neighbours of a voxel is unobserved."""
    return (
        _state_at(grid, x - 1, y, z) == UNOBSERVED_STATE
        or _state_at(grid, x + 1, y, z) == UNOBSERVED_STATE
        or _state_at(grid, x, y - 1, z) == UNOBSERVED_STATE
        or _state_at(grid, x, y + 1, z) == UNOBSERVED_STATE
        or _state_at(grid, x, y, z - 1) == UNOBSERVED_STATE
        or _state_at(grid, x, y, z + 1) == UNOBSERVED_STATE
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
def _closest(
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
    if _state_at((number, first, state), x, y, z) != UNOBSERVED_STATE:
        # of the voxel that a point lies in the centre is the closest
        own = (point[0] - x - 0.5) ** 2 + (point[1] - y - 0.5) ** 2 + (point[2] - z - 0.5) ** 2
        return min(own, bound), x, y, z
    cx = x >> 2
    cy = y >> 2
    cz = z >> 2
    best = bound
    found = (0, 0, 0)
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
            found = (CUBE * x + (bit >> 4), CUBE * y + ((bit >> 2) & 3), CUBE * z + (bit & 3))
    return best, found[0], found[1], found[2]


@njit(cache=True, nogil=True)
def _state_at(grid: Grid, x: int, y: int, z: int) -> int:
    number, first, state = grid
    row = _row_of(number, first, x, y, z)
    return int(state[row, _cell_of(x, y, z)]) if row >= 0 else UNOBSERVED_STATE


@njit(cache=True, nogil=True)
def _bit_of(state: int) -> np.uint32:
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
            own = _state_at(grid, i, j, k)
            if own != UNOBSERVED_STATE:
                bits = _bit_of(own)
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
                mask |= _bit_of(_state_at(grid, i, j, k))
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
def _look_up(arrays: Arrays, x: int, y: int, z: int, offsets: Offsets) -> np.uint32:
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


@njit(cache=True, nogil=True)
def _upper_bounds(
    arrays: Arrays, cells: I32, bits: U32, shifts: I64, least: int, offsets: Offsets
) -> I64:
    """Of each of ``shifts`` (m, 3): how many of the voxels may be aligned, -1 below ``least``."""
    out = np.empty(len(shifts), np.int64)
    n = len(cells)
    mask = arrays[5]
    low = arrays[6]
    palette = arrays[7]
    cell_numbers = mask.ravel()
    sy = mask.shape[1]
    sz = mask.shape[2]
    flat = np.empty(n, np.int64)
    lowest = np.full(3, np.iinfo(np.int64).max)
    highest = np.full(3, np.iinfo(np.int64).min)
    for i in range(n):
        for axis in range(3):
            place = cells[i, axis] - low[axis]
            lowest[axis] = min(lowest[axis], place)
            highest[axis] = max(highest[axis], place)
        flat[i] = ((cells[i, 0] - low[0]) * sy + cells[i, 1] - low[1]) * sz + cells[i, 2] - low[2]
    for m in range(len(shifts)):
        shift = (shifts[m, 0] * sy + shifts[m, 1]) * sz + shifts[m, 2]
        inside = True
        for axis in range(3):
            inside &= lowest[axis] + shifts[m, axis] >= 0
            inside &= highest[axis] + shifts[m, axis] < mask.shape[axis]
        possible = 0
        done = 0
        while done < n:
            end = min(done + CHUNK, n)
            if inside:
                for i in range(np.uint64(done), np.uint64(end)):
                    place = np.uint64(flat[i] + shift)
                    number = cell_numbers[place]
                    if number == NOT_MADE:
                        _look_up(
                            arrays,
                            cells[i, 0] + shifts[m, 0],
                            cells[i, 1] + shifts[m, 1],
                            cells[i, 2] + shifts[m, 2],
                            offsets,
                        )
                        number = cell_numbers[place]
                    possible += (palette[number] & bits[i]) != 0
            else:
                for i in range(done, end):
                    looked_up = _look_up(
                        arrays,
                        cells[i, 0] + shifts[m, 0],
                        cells[i, 1] + shifts[m, 1],
                        cells[i, 2] + shifts[m, 2],
                        offsets,
                    )
                    possible += (looked_up & bits[i]) != 0
            done = end
            if possible + n - done < least:
                possible = -1
                break
        out[m] = possible
    return out


@njit(cache=True, nogil=True)
def _count(arrays: Arrays, points: F64, bits: U32, least: int, offsets: Offsets) -> int:
    """How many of ``points`` (n, 3), in voxels, are aligned; -1 below ``least``."""
    aligned = 0
    unclear = np.empty(len(points), np.int64)
    left = 0
    reach = arrays[8]
    numbers = arrays[5]
    low = arrays[6]
    palette = arrays[7]
    nx, ny, nz = numbers.shape
    for i in range(len(points)):
        x = int(np.floor(points[i, 0]))
        y = int(np.floor(points[i, 1]))
        z = int(np.floor(points[i, 2]))
        # as _look_up: a call for each point, with all arrays, takes as long as the rest
        p = x - low[0]
        q = y - low[1]
        r = z - low[2]
        if not (0 <= p < nx and 0 <= q < ny and 0 <= r < nz):
            continue
        if numbers[p, q, r] == NOT_MADE:
            _look_up(arrays, x, y, z, offsets)
        mask = palette[numbers[p, q, r]]
        if mask == bits[i]:
            aligned += 1
        elif mask & bits[i]:
            unclear[left] = i
            left += 1
    while left and aligned + left >= least:
        left -= 1
        i = unclear[left]
        point = (points[i, 0], points[i, 1], points[i, 2])
        best, x, y, z = _closest(arrays[:4], point, offsets, reach * reach)
        if best < reach * reach and _bit_of(_state_at(arrays[:3], x, y, z)) == bits[i]:
            aligned += 1
    return aligned if aligned + left >= least else -1


@njit(cache=True, nogil=True)
def _pairs(arrays: Arrays, points: F64, bits: U32, offsets: Offsets) -> tuple[I64, F64]:
    """The numbers (k,) of the aligned points, and the centres (k, 3) that they lie closest to."""
    rows = np.empty(len(points), np.int64)
    centres = np.empty((len(points), 3))
    count = 0
    reach = arrays[8]
    for i in range(len(points)):
        x = int(np.floor(points[i, 0]))
        y = int(np.floor(points[i, 1]))
        z = int(np.floor(points[i, 2]))
        mask = _look_up(arrays, x, y, z, offsets)
        if not mask & bits[i]:
            continue
        point = (points[i, 0], points[i, 1], points[i, 2])
        best, x, y, z = _closest(arrays[:4], point, offsets, reach * reach)
        if best >= reach * reach or _bit_of(_state_at(arrays[:3], x, y, z)) != bits[i]:
            continue
        rows[count] = i
        centres[count, 0] = x + 0.5
        centres[count, 1] = y + 0.5
        centres[count, 2] = z + 0.5
        count += 1
    return rows[:count], centres[:count]


@dataclass(frozen=True, slots=True, eq=False)
class Voxels:
    """Occupied voxels of a query: their ``centres`` (n, 3) in voxels and the ``bits`` (n,) of their
    classes. The first stand for all, and voxels that follow each other lie near each other.
    """

    centres: F64
    bits: U32

    def turned(self, rotation: F64, shift: F64) -> F64:
        """The centres (n, 3) under a rotation (3, 3) and a shift (3,) in voxels."""
        return np.asarray(self.centres @ rotation.T + shift)


def query_voxels(occupied: tuple[NDArray[np.int32], U8]) -> Voxels:
    """The occupied voxels of a map: coordinates (n, 3) and classes (n,)."""
    ijk, label = occupied
    order = np.lexsort(ijk.T[::-1])
    parts = -(-len(order) // CHUNK)
    order = np.concatenate([order[part::parts] for part in range(parts)]) if parts else order
    return Voxels(ijk[order].astype(np.float64) + 0.5, class_bit(label)[order])


def mask_of_cell(target: OverlapMap, cell: tuple[int, int, int]) -> int:
    """The bits of all voxels that may be closest to a point in the cell."""
    x, y, z = cell
    return int(_look_up(target.arrays, x, y, z, cube_offsets(target.reach + 2)))


def overlap(target: OverlapMap, query: Voxels, target_T_query: F64) -> float:
    """The ratio tau; the translation of the transform is in voxels."""
    if not len(query.bits):
        return 0.0
    points = query.turned(target_T_query[:3, :3], target_T_query[:3, 3])
    offsets = cube_offsets(target.reach + 2)
    return _count(target.arrays, points, query.bits, 0, offsets) / len(points)


def aligned_pairs(target: OverlapMap, query: Voxels, target_T_query: F64) -> tuple[F64, F64]:
    """Centres (k, 3) of the aligned voxels of the query, and of the target's closest to them.

    In voxels, each in its own map.
    """
    points = query.turned(target_T_query[:3, :3], target_T_query[:3, 3])
    offsets = cube_offsets(target.reach + 2)
    rows, centres = _pairs(target.arrays, points, query.bits, offsets)
    return query.centres[rows], centres


@dataclass(frozen=True, slots=True, eq=False)
class Shifts:
    """Hypotheses of one rotation (3, 3): ``whole`` shifts (m, 3) beside a common ``part`` (3,)."""

    rotation: F64
    part: F64
    whole: I64


@dataclass(frozen=True, slots=True)
class Ranked:
    """A hypothesis: number of its :class:`Shifts`, row among them, and tau."""

    group: int
    row: int
    tau: float


def best_overlaps(
    target: OverlapMap, query: Voxels, groups: list[Shifts], most: int, least: float
) -> list[Ranked]:
    """The ``most`` hypotheses of highest tau, of those with ``least`` or more, best first.

    Of equals the first are kept.
    """
    n = len(query.bits)
    if not n:
        return []
    offsets = cube_offsets(target.reach + 2)
    needed = int(np.ceil(least * n - 1e-9))
    bounds = []
    for number, group in enumerate(groups):
        cells = np.floor(query.turned(group.rotation, group.part)).astype(np.int32)
        upper = _upper_bounds(target.arrays, cells, query.bits, group.whole, needed, offsets)
        bounds += [(-int(u), number, row) for row, u in enumerate(upper) if u >= needed]
    bounds.sort()
    found: list[tuple[int, int, int]] = []
    for negative, number, row in bounds:
        if -negative < needed:
            break
        group = groups[number]
        points = query.turned(group.rotation, group.part + group.whole[row])
        aligned = _count(target.arrays, points, query.bits, needed, offsets)
        if aligned < 0:
            continue
        found.append((-aligned, number, row))
        if len(found) >= 2 * most or (len(found) >= most and aligned > needed):
            found = sorted(found)[:most]
            # an equal one that comes later by number would not displace the last
            needed = max(needed, -found[-1][0])
    return [Ranked(number, row, -a / n) for a, number, row in sorted(found)[:most]]
