"""The paper's tau of very many hypotheses (3.5), equal to :mod:`semloc_logs.alignment.tau`.

The mask of a cell gives bounds of tau by one look-up of each voxel (:mod:`.cell_masks`); the
closest voxel itself is looked for in hypotheses whose upper bound is among the best, and there only
for voxels that the mask leaves open.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.alignment.cell_masks import (
    NOT_MADE,
    Arrays,
    Offsets,
    OverlapMap,
    bit_of,
    class_bit,
    closest,
    look_up,
    state_at,
)
from semloc_logs.arrays import F64, I32, I64, U8, U32

CHUNK = 512  # voxels counted between two checks whether a hypothesis can be among the best


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
                        look_up(
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
                    looked_up = look_up(
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
        # as look_up: a call for each point, with all arrays, takes as long as the rest
        p = x - low[0]
        q = y - low[1]
        r = z - low[2]
        if not (0 <= p < nx and 0 <= q < ny and 0 <= r < nz):
            continue
        if numbers[p, q, r] == NOT_MADE:
            look_up(arrays, x, y, z, offsets)
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
        best, x, y, z = closest(arrays[:4], point, offsets, reach * reach)
        if best < reach * reach and bit_of(state_at(arrays[:3], x, y, z)) == bits[i]:
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
        mask = look_up(arrays, x, y, z, offsets)
        if not mask & bits[i]:
            continue
        point = (points[i, 0], points[i, 1], points[i, 2])
        best, x, y, z = closest(arrays[:4], point, offsets, reach * reach)
        if best >= reach * reach or bit_of(state_at(arrays[:3], x, y, z)) != bits[i]:
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


def overlap(target: OverlapMap, query: Voxels, target_T_query: F64) -> float:
    """The ratio tau; the translation of the transform is in voxels."""
    if not len(query.bits):
        return 0.0
    points = query.turned(target_T_query[:3, :3], target_T_query[:3, 3])
    offsets = target.offsets
    return _count(target.arrays, points, query.bits, 0, offsets) / len(points)


def aligned_pairs(target: OverlapMap, query: Voxels, target_T_query: F64) -> tuple[F64, F64]:
    """Centres (k, 3) of the aligned voxels of the query, and of the target's closest to them.

    In voxels, each in its own map.
    """
    points = query.turned(target_T_query[:3, :3], target_T_query[:3, 3])
    offsets = target.offsets
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
    offsets = target.offsets
    needed = int(np.ceil(least * n - 1e-9))
    bounds = []
    for number, group in enumerate(groups):
        cells = np.floor(query.turned(group.rotation, group.part)).astype(np.int32)
        upper = _upper_bounds(target.arrays, cells, query.bits, group.whole, needed, offsets)
        bounds += [(-int(u), number, row) for row, u in enumerate(upper) if u >= needed]
    bounds.sort()
    overlaps: list[tuple[int, int, int]] = []
    for negative, number, row in bounds:
        if -negative < needed:
            break
        group = groups[number]
        points = query.turned(group.rotation, group.part + group.whole[row])
        aligned = _count(target.arrays, points, query.bits, needed, offsets)
        if aligned < 0:
            continue
        overlaps.append((-aligned, number, row))
        if len(overlaps) >= 2 * most or (len(overlaps) >= most and aligned > needed):
            overlaps = sorted(overlaps)[:most]
            # an equal one that comes later by number would not displace the last
            needed = max(needed, -overlaps[-1][0])
    return [Ranked(number, row, -a / n) for a, number, row in sorted(overlaps)[:most]]
