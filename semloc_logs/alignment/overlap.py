"""How well query voxels lie on a target map under a transform: the fast half of verification (paper
3.5).

A map becomes a dense grid of bit masks: bit c is set where a voxel of coarse class c lies in the
cell or beside it, so a look-up says at once whether a query voxel is aligned to within a cell, and
another bit whether it contradicts free space. There are no coarser grids: they know nothing of
contradictions, and lost places in halls that a few hundred look-ups in the finest grid find.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.numerics.bits import lowest_bit
from semloc_logs.numerics.transforms import inverse, yaw_transform
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE, BlockMap
from semloc_logs.voxels.keys import BLOCK, unpack

FREE_BIT = 128  # observed free and nothing occupied beside it
ANY_BIT = 64  # occupied, unlabelled included
# cells that a search may shift by; a grid is padded by twice as many, so that no look-up leaves it
REACH = 4
HALF_DIAGONAL = float(np.sqrt(0.75))  # of a cell, in cells
CUBE = 4  # cells: what is observed is looked for by cubes, whose cells are the bits of a number
FOUR_UNOBSERVED = np.uint32(UNOBSERVED_STATE * 0x01010101)
LOW_BITS = np.uint64(0x7F7F7F7F)
GATHER = np.uint64(0x10204080)
CHUNK = 128  # voxels counted before a sum is given up
STRUCTURE_SHARE = 0.75  # of the score; the ground has the rest, to hold the height

U8 = NDArray[np.uint8]
F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """``mask`` (x, y, z) uint8; cell (0, 0, 0) has its corner at ``corner`` (3,) metres and edge
    ``cell`` metres.
    """

    mask: U8
    corner: F64
    cell: float


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Query voxels: ``centres`` (n, 3) metres and class ``bits`` (n,); the first ``structure`` of
    them are structure, the rest ground.
    """

    centres: F64
    bits: U8
    structure: int

    def first(self, count: int) -> Evidence:
        """About ``count`` of the voxels: the first of the structure and of the ground."""
        solid = min(self.structure, int(STRUCTURE_SHARE * count))
        ground = min(len(self.bits) - self.structure, count - int(STRUCTURE_SHARE * count))
        picked = np.r_[0:solid, self.structure : self.structure + ground]
        return Evidence(self.centres[picked], self.bits[picked], solid)


def class_bits(state: U8, coarse: U8) -> U8:
    """Bit mask of voxel states: 1 << coarse class, ``ANY_BIT`` with it, 0 where not occupied.
    ``coarse`` (256,) maps classes to 0..5.
    """
    table = np.zeros(256, np.uint8)
    for label in range(256):
        if label not in (FREE_STATE, UNOBSERVED_STATE):
            table[label] = ANY_BIT | (1 << coarse[label] if coarse[label] < 6 else 0)
    return table[state]


def build_level(blocks: BlockMap, voxel_size: float, coarse: U8) -> Level:
    """The masks of a map, with a margin that a search cannot leave."""
    low, high = blocks.bounds()
    margin = 2 * REACH
    mask = np.zeros(tuple((high - low + 2 * margin).tolist()), np.uint8)
    at = unpack(blocks.keys).astype(np.int64) * BLOCK - low + margin
    _fill(mask, at, blocks.state, class_bits(np.arange(256, dtype=np.uint8), coarse))
    return Level(mask, (low - margin).astype(float) * voxel_size, voxel_size)


@njit(cache=True, nogil=True)
def _fill(mask: U8, at: NDArray[np.int64], state: U8, bits: U8) -> None:
    """Bits of the occupied voxels of blocks (n,) with their corner ``at`` (n, 3), in their cells
    and the 26 beside; then free cells.
    """
    for want_free in (False, True):
        for n in range(len(at)):
            for m in range(state.shape[1]):
                value = state[n, m]
                x = at[n, 0] + m // BLOCK**2
                y = at[n, 1] + m // BLOCK % BLOCK
                z = at[n, 2] + m % BLOCK
                if not want_free and bits[value]:
                    for dx in range(-1, 2):
                        for dy in range(-1, 2):
                            for dz in range(-1, 2):
                                mask[x + dx, y + dy, z + dz] |= bits[value]
                elif want_free and value == FREE_STATE and mask[x, y, z] == 0:
                    mask[x, y, z] = FREE_BIT


@njit(cache=True, nogil=True)
def _rotated(
    level: U8,
    corner: F64,
    cell: float,
    centres: F64,
    bits: U8,
    pose: F64,
    base: NDArray[np.int64],
    kept: U8,
) -> int:
    """Flat cells of the voxels under ``pose`` into ``base``, their bits into ``kept``; those
    outside whatever the shift are left out.
    """
    nx, ny, nz = level.shape
    c = np.cos(pose[0])
    s = np.sin(pose[0])
    count = 0
    for n in range(len(centres)):
        x = int(np.floor((c * centres[n, 0] - s * centres[n, 1] + pose[1] - corner[0]) / cell))
        y = int(np.floor((s * centres[n, 0] + c * centres[n, 1] + pose[2] - corner[1]) / cell))
        z = int(np.floor((centres[n, 2] + pose[3] - corner[2]) / cell))
        if REACH <= x < nx - REACH and REACH <= y < ny - REACH and REACH <= z < nz - REACH:
            base[count], kept[count] = (x * ny + y) * nz + z, bits[n]
            count += 1
    return count


@njit(cache=True, nogil=True)
def _add_hits(
    mask: U8,
    base: NDArray[np.int64],
    kept: U8,
    first: int,
    end: int,
    shift: int,
    lift: int,
    hits: NDArray[np.int64],
) -> None:
    """Aligned voxels less those in free space, shifted by ``lift`` cells down, not at all, and up,
    added to ``hits`` (3,).
    """
    down = same = up = 0
    a = shift - lift
    b = shift
    c = shift + lift
    for n in range(np.uint64(first), np.uint64(end)):
        at = base[n]
        bit = kept[n]
        # unsigned: numba would make sure of every index that it is not counted from the end
        below = mask[np.uint64(at + a)]
        here = mask[np.uint64(at + b)]
        above = mask[np.uint64(at + c)]
        down += int((below & bit) != 0) - int(below >= FREE_BIT)
        same += int((here & bit) != 0) - int(here >= FREE_BIT)
        up += int((above & bit) != 0) - int(above >= FREE_BIT)
    hits[0] += down
    hits[1] += same
    hits[2] += up


@njit(cache=True, nogil=True)
def _search(
    level: U8,
    corner: F64,
    cell: float,
    centres: F64,
    bits: U8,
    structure: int,
    shares: F64,
    start: F64,
    yaws: F64,
    step: int,
) -> tuple[float, F64]:
    mask = level.ravel()
    n = len(centres)
    ny = level.shape[1]
    nz = level.shape[2]
    weight = shares / np.array([max(structure, 1), max(n - structure, 1)])
    base = np.empty(n, np.int64)
    kept = np.empty(n, np.uint8)
    hits = np.empty(3, np.int64)
    best = -2.0
    best_pose = start.copy()
    pose = start.copy()
    for dyaw in yaws:
        pose[0] = start[0] + dyaw
        solid = _rotated(
            level, corner, cell, centres[:structure], bits[:structure], pose, base, kept
        )
        ground = _rotated(
            level,
            corner,
            cell,
            centres[structure:],
            bits[structure:],
            pose,
            base[solid:],
            kept[solid:],
        )
        for dx in range(-2 * step, 2 * step + 1, step):
            for dy in range(-2 * step, 2 * step + 1, step):
                shift = (dx * ny + dy) * nz
                hits[:] = 0
                done = 0
                while done < solid:
                    end = min(done + CHUNK, solid)
                    _add_hits(mask, base, kept, done, end, shift, step, hits)
                    done = end
                    if (hits.max() + solid - done) * weight[0] + ground * weight[1] <= best:
                        break  # all that is left cannot make it the best
                if done < solid:
                    continue
                upright = hits * weight[0]
                hits[:] = 0
                _add_hits(mask, base, kept, solid, solid + ground, shift, step, hits)
                for dz in range(-1, 2):
                    # among equals the one nearest the start, so that ties do not drift
                    value = (
                        upright[dz + 1]
                        + hits[dz + 1] * weight[1]
                        - 1e-6 * (abs(dx) + abs(dy) + abs(dz) + abs(dyaw))
                    )
                    if value > best:
                        best = value
                        best_pose[0], best_pose[1] = pose[0], start[1] + dx * cell
                        best_pose[2], best_pose[3] = (
                            start[2] + dy * cell,
                            start[3] + dz * step * cell,
                        )
    return best, best_pose


def search(
    level: Level, evidence: Evidence, start: F64, yaws: Sequence[float] | F64, step: int
) -> tuple[float, F64]:
    """Best weighted share of aligned query voxels, less that of those in free space, near
    ``start``, and the pose that has it.

    Tried are turns by ``yaws`` (rad), shifts of two ``step`` cells (1 or 2) to both sides along x
    and y and of one up and down. Poses are (yaw, x, y, z) of ``target_T_query``.
    """
    e = evidence
    arrays = np.asarray(start, float), np.asarray(yaws, float)
    shares = np.array([STRUCTURE_SHARE, 1 - STRUCTURE_SHARE])
    value, pose = _search(
        level.mask, level.corner, level.cell, e.centres, e.bits, e.structure, shares, *arrays, step
    )
    return float(value), pose


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


def look_up(level: Level, points: F64) -> U8:
    """Masks (n,) at ``points`` (n, 3) in the target's frame, 0 outside."""
    return np.asarray(
        _look_up(level.mask, level.corner, level.cell, np.ascontiguousarray(points, float))
    )


def tau(
    query: tuple[NDArray[np.int32], U8],
    target: BlockMap,
    voxel_size: float,
    target_T_query: F64,
    kappa: float,
    coarse: U8 | None = None,
) -> tuple[float, int]:
    """The paper's overlap ratio (3.5) and the number of aligned voxels.

    For each occupied voxel of the ``query``, given by coordinates (n, 3) and classes (n,), the
    closest *observed* target voxel is taken; it counts as aligned when that one is occupied, of
    exactly the same class (of the same coarse class where ``coarse`` (256,) is given), and its
    centre is closer than ``kappa`` metres.
    """
    ijk, label = query
    if not len(ijk) or not len(target.keys):
        return 0.0, 0
    reach = kappa / voxel_size
    points, low, high = _in_voxels(ijk, target_T_query[:3, :3], target_T_query[:3, 3] / voxel_size)
    first, last = target.bounds()
    low = np.maximum(np.floor(low - reach).astype(int), first)
    high = np.minimum(np.floor(high + reach + 1).astype(int), last)
    if (low >= high).any():
        return 0.0, 0
    margin = 2 * int(reach) + 4  # twice: for points beside the map, and for what is around them
    low = low - margin
    x, y, z = (-(-(high - low + margin) // CUBE) * CUBE).tolist()
    around = target.dense(low, (x, y, z))
    found = _closest_observed(around, _observed_cubes(around), points, low, *_cubes(reach), reach)
    table = np.arange(256, dtype=np.uint8) if coarse is None else coarse
    hit = (found != UNOBSERVED_STATE) & (found != FREE_STATE)
    aligned = int((hit & (table[found] == table[label])).sum())
    return aligned / len(found), aligned


@njit(cache=True, nogil=True)
def _in_voxels(ijk: NDArray[np.int32], R: F64, t: F64) -> tuple[F64, F64, F64]:
    """The centres of voxels (n, 3) after rotation ``R`` and a shift by ``t`` voxels, in voxels, and
    their least and greatest (3,).
    """
    out = np.empty((len(ijk), 3))
    low = np.full(3, np.inf)
    high = np.full(3, -np.inf)
    for n in range(len(ijk)):
        x = ijk[n, 0] + 0.5
        y = ijk[n, 1] + 0.5
        z = ijk[n, 2] + 0.5
        for k in range(3):
            p = R[k, 0] * x + R[k, 1] * y + R[k, 2] * z + t[k]
            out[n, k], low[k], high[k] = p, min(low[k], p), max(high[k], p)
    return out, low, high


@njit(cache=True, nogil=True)
def _observed_cubes(state: U8) -> NDArray[np.uint64]:
    """Which cells of each cube of ``CUBE`` cells of ``state`` (x, y, z) are observed: bit (4 i + j)
    4 + k is that of cell (i, j, k).
    """
    nx, ny, nz = state.shape
    out = np.zeros((nx // CUBE, ny // CUBE, nz // CUBE), np.uint64)
    fours = state.view(np.uint32)  # four cells at once, as many as a cube has above each other
    for x in range(nx):
        for y in range(ny):
            row = out[x // CUBE, y // CUBE]
            place = np.uint64(CUBE * (x % CUBE * CUBE + y % CUBE))
            for k in range(len(row)):
                different = np.uint64(fours[x, y, k] ^ FOUR_UNOBSERVED)
                if different:
                    # the highest bit of each byte that is not zero, then these four side by side
                    bytes_ = (
                        (((different & LOW_BITS) + LOW_BITS) | different)
                        & ~LOW_BITS
                        & np.uint64(0xFFFFFFFF)
                    )
                    row[k] |= (
                        ((bytes_ >> np.uint64(7)) * GATHER >> np.uint64(28)) & np.uint64(15)
                    ) << place
    return out


@lru_cache(maxsize=4)
def _cubes(reach: float) -> tuple[NDArray[np.int64], F64]:
    """Offsets (n, 3) of the cubes that may have a centre of a cell within ``reach`` cells of a
    point in the middle one, those that may be nearest first, and the squares (n,) of how near that
    is.
    """
    r = -(-(int(reach) + 2) // CUBE)
    side = np.arange(-r, r + 1)
    every = np.stack(np.meshgrid(side, side, side, indexing="ij"), -1).reshape(-1, 3)
    gap = np.maximum(CUBE * (np.abs(every) - 1) + 0.5, 0.0) * (every != 0)
    least = np.square(gap).sum(1)
    order = np.argsort(least, kind="stable")
    order = order[least[order] < reach**2]
    return every[order], least[order]


@njit(cache=True, nogil=True)
def _closest_observed(
    state: U8,
    cubes: NDArray[np.uint64],
    points: F64,
    low: NDArray[np.int64],
    offsets: NDArray[np.int64],
    least: F64,
    reach: float,
) -> U8:
    """State of the observed cell whose centre is closest to each of ``points`` (n, 3), in cells;
    unobserved where none is within reach.

    The grid begins at cell ``low`` (3,) and has a margin of twice ``reach`` and four cells on all
    sides; ``cubes`` are those of :func:`_observed_cubes`.
    """
    out = np.full(len(points), UNOBSERVED_STATE, np.uint8)
    margin = int(reach) + 1
    for n in range(len(points)):
        px = points[n, 0] - low[0]
        py = points[n, 1] - low[1]
        pz = points[n, 2] - low[2]
        i = int(np.floor(px))
        j = int(np.floor(py))
        k = int(np.floor(pz))
        if (
            min(i, j, k) < margin
            or i >= state.shape[0] - margin
            or j >= state.shape[1] - margin
            or k >= state.shape[2] - margin
        ):
            continue  # farther from the map than it may be
        if state[i, j, k] != UNOBSERVED_STATE and reach > HALF_DIAGONAL:
            # no other centre is as close as that of the cell a point lies in
            out[n] = state[i, j, k]
            continue
        best = reach**2
        for m in range(len(offsets)):
            if least[m] >= best:
                break
            x = i // CUBE + offsets[m, 0]
            y = j // CUBE + offsets[m, 1]
            z = k // CUBE + offsets[m, 2]
            if (
                x < 0
                or y < 0
                or z < 0
                or x >= cubes.shape[0]
                or y >= cubes.shape[1]
                or z >= cubes.shape[2]
            ):
                continue
            left = cubes[x, y, z]
            if left == 0:
                continue
            # from the point to the first centres of the cube
            ox = CUBE * x + 0.5 - px
            oy = CUBE * y + 0.5 - py
            oz = CUBE * z + 0.5 - pz
            ax = max(ox, -ox - CUBE + 1, 0.0)
            ay = max(oy, -oy - CUBE + 1, 0.0)
            az = max(oz, -oz - CUBE + 1, 0.0)
            if ax * ax + ay * ay + az * az >= best:
                continue
            while left:
                b = lowest_bit(left)
                left &= left - np.uint64(1)
                dx = ox + (b >> 4)
                dy = oy + ((b >> 2) & 3)
                dz = oz + (b & 3)
                d = dx * dx + dy * dy + dz * dz
                if d < best:
                    best = d
                    out[n] = state[
                        CUBE * x + (b >> 4), CUBE * y + ((b >> 2) & 3), CUBE * z + (b & 3)
                    ]
    return out


def pose_matrix(pose: F64) -> F64:
    """``target_T_query`` of (yaw, x, y, z)."""
    return yaw_transform(float(pose[0]), pose[1:])


def yaw_between(a: F64, b: F64) -> float:
    """Absolute yaw difference of two near-level transforms, radians."""
    d = inverse(a) @ b
    return float(abs(np.arctan2(d[1, 0], d[0, 0])))
