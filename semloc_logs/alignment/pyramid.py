"""How well query voxels lie on a target map under a transform, at three resolutions: the fast half of verification (paper 3.5).

A level is a dense grid of bit masks: bit c is set where a voxel of coarse class c lies in the cell or beside it, so a look-up says
at once whether a query voxel is aligned to within a cell. Coarse levels forgive the 20 degree and 1.2 m steps of the word matches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.geometry import inverse, yaw_transform
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE, BlockMap

FACTORS = (1, 2, 4)
FREE_BIT = 128  # observed free and nothing occupied beside it (finest level only)
ANY_BIT = 64  # occupied, unlabelled included

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
    """Query voxels: ``centres`` (n, 3) metres, class ``bits`` (n,), ``weights`` (n,) that add up to one."""

    centres: F64
    bits: U8
    weights: F64


def _dilate(mask: U8) -> U8:
    out = mask.copy()
    for axis in range(3):
        grown = out.copy()
        a, b = [slice(None)] * 3, [slice(None)] * 3
        a[axis], b[axis] = slice(1, None), slice(None, -1)
        grown[tuple(a)] |= out[tuple(b)]
        grown[tuple(b)] |= out[tuple(a)]
        out = grown
    return out


def class_bits(state: U8, coarse: U8) -> U8:
    """Bit mask of voxel states: 1 << coarse class, ``ANY_BIT`` with it, 0 where not occupied. ``coarse`` (256,) maps classes to 0..5."""
    table = np.zeros(256, np.uint8)
    for label in range(256):
        if label not in (FREE_STATE, UNOBSERVED_STATE):
            table[label] = ANY_BIT | (1 << coarse[label] if coarse[label] < 6 else 0)
    return table[state]


def build_pyramid(blocks: BlockMap, voxel_size: float, coarse: U8) -> list[Level]:
    """Levels of 1, 2 and 4 voxels, finest first."""
    low, high = blocks.bounds()
    state = blocks.dense(low - 4, tuple((high - low + 8).tolist()))
    exact = class_bits(state, coarse)
    corner = (low - 4) * voxel_size
    levels = []
    for factor in FACTORS:
        n = np.array(exact.shape) // factor
        cut = exact[: n[0] * factor, : n[1] * factor, : n[2] * factor].reshape(n[0], factor, n[1], factor, n[2], factor)
        mask = _dilate(np.bitwise_or.reduce(cut, axis=(1, 3, 5)))
        if factor == 1:
            mask |= np.where((state == FREE_STATE) & (mask == 0), FREE_BIT, 0).astype(np.uint8)
        levels.append(Level(mask, corner.astype(float), voxel_size * factor))
    return levels


@njit(cache=True, nogil=True)
def _score(mask: U8, corner: F64, cell: float, centres: F64, bits: U8, weights: F64, c: float, s: float, t: F64) -> float:
    total = 0.0
    nx, ny, nz = mask.shape
    for n in range(len(centres)):
        x = int(np.floor((c * centres[n, 0] - s * centres[n, 1] + t[0] - corner[0]) / cell))
        y = int(np.floor((s * centres[n, 0] + c * centres[n, 1] + t[1] - corner[1]) / cell))
        z = int(np.floor((centres[n, 2] + t[2] - corner[2]) / cell))
        if 0 <= x < nx and 0 <= y < ny and 0 <= z < nz:
            found = mask[x, y, z]
            if found & bits[n]:
                total += weights[n]
            elif found & FREE_BIT:  # only the finest level knows
                total -= weights[n]
    return total


@njit(cache=True, nogil=True)
def _search(
    mask: U8, corner: F64, cell: float, centres: F64, bits: U8, weights: F64, start: F64, yaws: F64, steps: F64, lifts: F64
) -> tuple[float, F64]:
    """Best of all combinations of turns ``yaws``, shifts ``steps`` (both axes) and ``lifts`` around ``start`` (yaw, x, y, z)."""
    best, best_pose = -2.0, start.copy()
    t = np.empty(3)
    for dyaw in yaws:
        c, s = np.cos(start[0] + dyaw), np.sin(start[0] + dyaw)
        for dz in lifts:
            for dx in steps:
                for dy in steps:
                    t[0], t[1], t[2] = start[1] + dx, start[2] + dy, start[3] + dz
                    value = _score(mask, corner, cell, centres, bits, weights, c, s, t)
                    # among equals the one nearest the start, so that ties do not drift
                    value -= 1e-6 * (abs(dx) + abs(dy) + abs(dz) + abs(dyaw))
                    if value > best:
                        best = value
                        best_pose[0], best_pose[1], best_pose[2], best_pose[3] = start[0] + dyaw, t[0], t[1], t[2]
    return best, best_pose


def search(
    level: Level, evidence: Evidence, start: F64, yaws: Sequence[float], steps: Sequence[float], lifts: Sequence[float]
) -> tuple[float, F64]:
    """Best weighted share of aligned query voxels, less that of those in free space, near ``start``, and the pose that has it.

    Poses are (yaw, x, y, z) of ``target_T_query``.
    """
    e = evidence
    arrays = [np.asarray(a, float) for a in (start, yaws, steps, lifts)]
    value, pose = _search(level.mask, level.corner, level.cell, e.centres, e.bits, e.weights, *arrays)
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
    query: BlockMap, target: BlockMap, voxel_size: float, target_T_query: F64, kappa: float, coarse: U8 | None = None
) -> tuple[float, int]:
    """The paper's overlap ratio (3.5) and the number of aligned voxels.

    For each occupied query voxel the closest *observed* target voxel is taken; it counts as aligned when that one is occupied, of
    exactly the same class (of the same coarse class where ``coarse`` (256,) is given), and its centre is closer than ``kappa`` metres.
    """
    from scipy.spatial import cKDTree

    ijk, label = query.occupied()
    if not len(ijk) or not len(target.keys):
        return 0.0, 0
    centres = (ijk + 0.5) * voxel_size @ target_T_query[:3, :3].T + target_T_query[:3, 3]
    low = np.floor(centres.min(0) / voxel_size).astype(int) - int(kappa / voxel_size) - 1
    high = np.floor(centres.max(0) / voxel_size).astype(int) + int(kappa / voxel_size) + 2
    tl, th = target.bounds()
    low, high = np.maximum(low, tl), np.minimum(high, th)
    if (low >= high).any():
        return 0.0, 0
    state = target.dense(low, tuple((high - low).tolist()))
    cell = np.floor(centres / voxel_size).astype(int) - low
    inside = ((cell >= 0) & (cell < state.shape)).all(1)
    found = np.full(len(centres), UNOBSERVED_STATE, np.uint8)
    found[inside] = state[tuple(cell[inside].T)]  # the voxel that a centre lies in is the closest one, if it is observed
    rest = np.flatnonzero(found == UNOBSERVED_STATE)
    observed = np.argwhere(state != UNOBSERVED_STATE)
    if len(rest) and len(observed):
        # candidates: observed voxels beside unobserved ones are the only ones that can be closest to an unobserved place
        edge = observed[_beside_unobserved(state, observed)]
        distance, index = cKDTree((edge + low + 0.5) * voxel_size).query(centres[rest], distance_upper_bound=kappa)
        near = np.isfinite(distance)
        found[rest[near]] = state[tuple(edge[index[near]].T)]
    table = np.arange(256, dtype=np.uint8) if coarse is None else coarse
    hit = (found != UNOBSERVED_STATE) & (found != FREE_STATE)
    aligned = hit & (table[found] == table[label])
    return float(aligned.mean()), int(aligned.sum())


def _beside_unobserved(state: U8, observed: NDArray[np.int64]) -> NDArray[np.bool_]:
    padded = np.pad(state == UNOBSERVED_STATE, 1, constant_values=True)
    x, y, z = (observed + 1).T
    out = np.zeros(len(observed), bool)
    for dx, dy, dz in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)):
        out |= padded[x + dx, y + dy, z + dz]
    return out


def pose_matrix(pose: F64) -> F64:
    """``target_T_query`` of (yaw, x, y, z)."""
    return yaw_transform(float(pose[0]), pose[1:])


def yaw_between(a: F64, b: F64) -> float:
    """Absolute yaw difference of two near-level transforms, radians."""
    d = inverse(a) @ b
    return float(abs(np.arctan2(d[1, 0], d[0, 0])))
