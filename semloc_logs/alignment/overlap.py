"""How well query voxels lie on a target map under a transform: the fast half of verification (paper 3.5).

A map becomes a dense grid of bit masks: bit c is set where a voxel of coarse class c lies in the cell or beside it, so a look-up says
at once whether a query voxel is aligned to within a cell, and another bit whether it contradicts free space. There are no coarser
grids: they know nothing of contradictions, and lost places in halls that a few hundred look-ups in the finest grid find.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.geometry import inverse, yaw_transform
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE, BlockMap
from semloc_logs.voxels.keys import BLOCK, unpack

FREE_BIT = 128  # observed free and nothing occupied beside it
ANY_BIT = 64  # occupied, unlabelled included
REACH = 4  # cells that a search may shift by; a grid is padded by twice as many, so that no look-up leaves it
HALF_DIAGONAL = float(np.sqrt(0.75))  # of a cell, in cells
CUBE = 4  # cells: where nothing is observed is left out by cubes
FOUR_UNOBSERVED = UNOBSERVED_STATE * 0x01010101
CHUNK = 128  # voxels counted before a sum is given up
STRUCTURE_SHARE = 0.75  # of the score; the ground has the rest, to hold the height

U8 = NDArray[np.uint8]
F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """``mask`` (x, y, z) uint8; cell (0, 0, 0) has its corner at ``corner`` (3,) metres and edge ``cell`` metres."""

    mask: U8
    corner: F64
    cell: float


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Query voxels: ``centres`` (n, 3) metres and class ``bits`` (n,); the first ``structure`` of them are structure, the rest ground."""

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
    """Bit mask of voxel states: 1 << coarse class, ``ANY_BIT`` with it, 0 where not occupied. ``coarse`` (256,) maps classes to 0..5."""
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
    """Bits of the occupied voxels of blocks (n,) with their corner ``at`` (n, 3), in their cells and the 26 beside; then free cells."""
    for want_free in (False, True):
        for n in range(len(at)):
            for m in range(state.shape[1]):
                value = state[n, m]
                x, y, z = at[n, 0] + m // BLOCK**2, at[n, 1] + m // BLOCK % BLOCK, at[n, 2] + m % BLOCK
                if not want_free and bits[value]:
                    for dx in range(-1, 2):
                        for dy in range(-1, 2):
                            for dz in range(-1, 2):
                                mask[x + dx, y + dy, z + dz] |= bits[value]
                elif want_free and value == FREE_STATE and mask[x, y, z] == 0:
                    mask[x, y, z] = FREE_BIT


@njit(cache=True, nogil=True)
def _rotated(level: U8, corner: F64, cell: float, centres: F64, bits: U8, pose: F64, base: NDArray[np.int64], kept: U8) -> int:
    """Flat cells of the voxels under ``pose`` into ``base``, their bits into ``kept``; those outside whatever the shift are left out."""
    nx, ny, nz = level.shape
    c, s = np.cos(pose[0]), np.sin(pose[0])
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
def _add_hits(mask: U8, base: NDArray[np.int64], kept: U8, first: int, end: int, shift: int, lift: int, hits: NDArray[np.int64]) -> None:
    """Aligned voxels less those in free space, shifted by ``lift`` cells down, not at all, and up, added to ``hits`` (3,)."""
    down = same = up = 0
    a, b, c = shift - lift, shift, shift + lift
    for n in range(np.uint64(first), np.uint64(end)):
        at, bit = base[n], kept[n]
        # unsigned: numba would make sure of every index that it is not counted from the end
        below, here, above = mask[np.uint64(at + a)], mask[np.uint64(at + b)], mask[np.uint64(at + c)]
        down += int((below & bit) != 0) - int(below >= FREE_BIT)
        same += int((here & bit) != 0) - int(here >= FREE_BIT)
        up += int((above & bit) != 0) - int(above >= FREE_BIT)
    hits[0] += down
    hits[1] += same
    hits[2] += up


@njit(cache=True, nogil=True)
def _search(
    level: U8, corner: F64, cell: float, centres: F64, bits: U8, structure: int, shares: F64, start: F64, yaws: F64, step: int
) -> tuple[float, F64]:
    mask, n = level.ravel(), len(centres)
    ny, nz = level.shape[1], level.shape[2]
    weight = shares / np.array([max(structure, 1), max(n - structure, 1)])
    base, kept, hits = np.empty(n, np.int64), np.empty(n, np.uint8), np.empty(3, np.int64)
    best, best_pose, pose = -2.0, start.copy(), start.copy()
    for dyaw in yaws:
        pose[0] = start[0] + dyaw
        solid = _rotated(level, corner, cell, centres[:structure], bits[:structure], pose, base, kept)
        ground = _rotated(level, corner, cell, centres[structure:], bits[structure:], pose, base[solid:], kept[solid:])
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
                    value = upright[dz + 1] + hits[dz + 1] * weight[1] - 1e-6 * (abs(dx) + abs(dy) + abs(dz) + abs(dyaw))
                    if value > best:
                        best = value
                        best_pose[0], best_pose[1] = pose[0], start[1] + dx * cell
                        best_pose[2], best_pose[3] = start[2] + dy * cell, start[3] + dz * step * cell
    return best, best_pose


def search(level: Level, evidence: Evidence, start: F64, yaws: Sequence[float] | F64, step: int) -> tuple[float, F64]:
    """Best weighted share of aligned query voxels, less that of those in free space, near ``start``, and the pose that has it.

    Tried are turns by ``yaws`` (rad), shifts of two ``step`` cells (1 or 2) to both sides along x and y and of one up and down. Poses
    are (yaw, x, y, z) of ``target_T_query``.
    """
    e = evidence
    arrays = np.asarray(start, float), np.asarray(yaws, float)
    shares = np.array([STRUCTURE_SHARE, 1 - STRUCTURE_SHARE])
    value, pose = _search(level.mask, level.corner, level.cell, e.centres, e.bits, e.structure, shares, *arrays, step)
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
    return np.asarray(_look_up(level.mask, level.corner, level.cell, np.ascontiguousarray(points, float)))


def tau(
    query: tuple[NDArray[np.int32], U8], target: BlockMap, voxel_size: float, target_T_query: F64, kappa: float, coarse: U8 | None = None
) -> tuple[float, int]:
    """The paper's overlap ratio (3.5) and the number of aligned voxels.

    For each occupied voxel of the ``query``, given by coordinates (n, 3) and classes (n,), the closest *observed* target voxel is taken; it
    counts as aligned when that one is occupied, of exactly the same class (of the same coarse class where ``coarse`` (256,) is given), and
    its centre is closer than ``kappa`` metres.
    """
    ijk, label = query
    if not len(ijk) or not len(target.keys):
        return 0.0, 0
    reach = kappa / voxel_size
    centres = (ijk + 0.5) * voxel_size @ target_T_query[:3, :3].T + target_T_query[:3, 3]
    points = centres / voxel_size
    low, high = (np.floor(edge).astype(int) for edge in (points.min(0) - reach, points.max(0) + reach + 1))
    tl, th = target.bounds()
    low, high = np.maximum(low, tl), np.minimum(high, th)
    if (low >= high).any():
        return 0.0, 0
    margin = 2 * int(reach) + 4  # twice: for points beside the map, and for what is around them
    low = low - margin
    shape = high - low + margin
    around = target.dense(low, (int(shape[0]), int(shape[1]), int(-(-shape[2] // CUBE) * CUBE)))
    found = _closest_observed(around, _near_observed(around, int(reach) + 1), points - low, *_offsets(reach), reach)
    table = np.arange(256, dtype=np.uint8) if coarse is None else coarse
    hit = (found != UNOBSERVED_STATE) & (found != FREE_STATE)
    aligned = hit & (table[found] == table[label])
    return float(aligned.mean()), int(aligned.sum())


@njit(cache=True, nogil=True)
def _near_observed(state: U8, reach: int) -> NDArray[np.bool_]:
    """Whether there may be an observed cell within ``reach`` of the cells of each cube of ``CUBE`` cells."""
    nx, ny, nz = state.shape[0] // CUBE + 1, state.shape[1] // CUBE + 1, state.shape[2] // CUBE + 1
    near = np.zeros((nx, ny, nz), np.bool_)
    fours = state.view(np.uint32)  # four cells at once, as many as a cube has above each other
    for i in range(fours.shape[0]):
        for j in range(fours.shape[1]):
            for k in range(fours.shape[2]):
                if fours[i, j, k] != FOUR_UNOBSERVED:
                    near[i // CUBE, j // CUBE, k] = True
    r = -(-reach // CUBE)
    for axis in range(3):
        wide = near.copy()
        for i, j, k in np.argwhere(near):
            if axis == 0:
                wide[max(i - r, 0) : i + r + 1, j, k] = True
            elif axis == 1:
                wide[i, max(j - r, 0) : j + r + 1, k] = True
            else:
                wide[i, j, max(k - r, 0) : k + r + 1] = True
        near = wide
    return near


@lru_cache(maxsize=4)
def _offsets(reach: float) -> tuple[NDArray[np.int64], F64]:
    """Offsets (n, 3) of all cells whose centres may be within ``reach`` cells of a point in the middle one, nearest first; lengths (n,)."""
    side = np.arange(-int(reach) - 1, int(reach) + 2)
    all_of_them = np.stack(np.meshgrid(side, side, side, indexing="ij"), -1).reshape(-1, 3)
    length = np.linalg.norm(all_of_them, axis=1)
    order = np.argsort(length, kind="stable")
    order = order[length[order] < reach + HALF_DIAGONAL]
    return all_of_them[order], length[order]


@njit(cache=True, nogil=True)
def _closest_observed(state: U8, near: NDArray[np.bool_], points: F64, offsets: NDArray[np.int64], length: F64, reach: float) -> U8:
    """State of the observed cell whose centre is closest to each of ``points`` (n, 3), in cells; unobserved where none is within reach.

    The grid has a margin of twice ``reach`` and four cells on all sides; ``near`` is that of :func:`_near_observed`.
    """
    out = np.full(len(points), UNOBSERVED_STATE, np.uint8)
    nx, ny, nz = state.shape
    margin = int(reach) + 1
    flat = state.ravel()
    steps = (offsets[:, 0] * ny + offsets[:, 1]) * nz + offsets[:, 2]
    for n in range(len(points)):
        i, j, k = int(np.floor(points[n, 0])), int(np.floor(points[n, 1])), int(np.floor(points[n, 2]))
        if min(i, j, k) < margin or i >= nx - margin or j >= ny - margin or k >= nz - margin:
            continue  # farther from the map than it may be
        if not near[i // CUBE, j // CUBE, k // CUBE]:
            continue
        middle, best = (i * ny + j) * nz + k, reach
        here = flat[np.uint64(middle)]
        if here != UNOBSERVED_STATE and reach > HALF_DIAGONAL:
            out[n] = here  # no other centre is as close as that of the cell a point lies in
            continue
        fx, fy, fz = points[n, 0] - i - 0.5, points[n, 1] - j - 0.5, points[n, 2] - k - 0.5
        for m in range(len(steps)):
            if length[m] - HALF_DIAGONAL >= best:
                break
            value = flat[np.uint64(middle + steps[m])]
            if value != UNOBSERVED_STATE:
                d = np.sqrt((offsets[m, 0] - fx) ** 2 + (offsets[m, 1] - fy) ** 2 + (offsets[m, 2] - fz) ** 2)
                if d < best:
                    best = d
                    out[n] = value
    return out


def pose_matrix(pose: F64) -> F64:
    """``target_T_query`` of (yaw, x, y, z)."""
    return yaw_transform(float(pose[0]), pose[1:])


def yaw_between(a: F64, b: F64) -> float:
    """Absolute yaw difference of two near-level transforms, radians."""
    d = inverse(a) @ b
    return float(abs(np.arctan2(d[1, 0], d[0, 0])))
