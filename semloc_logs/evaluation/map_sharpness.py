"""How sharp the common map of several sessions is, which needs no truth.

The share of cells that are planes, and how thick these are: the square root of the mean plane
variance (Razlaw et al., Evaluation of registration methods for sparse 3D laser scans, ECMR 2015).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.evenly import evenly
from semloc_logs.numerics.transforms import apply, interpolate
from semloc_logs.tables.table import read_metadata, read_table
from semloc_logs.voxels.store import poses_of
from semloc_logs.workspace import Workspace

# voxels: edge of a place, how far its points lie from its middle, and edge of a cell
PLACE, REACH, CELL = 66.0, 33.0, 3.0
MOST_PLACES = 48
MOST_SESSIONS = 8  # of a place
KEYFRAMES = 3  # of a session in a place
LEAST_POINTS = 20  # of a cell
THIN = 0.3  # a plane is thinner than this share of its width


@dataclass(frozen=True, slots=True)
class Sharpness:
    """In ``places`` where sessions meet.

    Share of the cells with points of two sessions that are ``planes``, and their mean thickness (m,
    one standard deviation). Before: every session as it was recorded, laid as a whole where the
    optimised one is; after: as it was optimised. None without cells or planes.
    """

    places: int
    planes_before: float | None
    planes_after: float | None
    thickness_before_m: float | None
    thickness_after_m: float | None


@dataclass(frozen=True, slots=True, eq=False)
class _Placed:
    """A session's keyframes in the ``frame`` that it shares, ``common_T_base`` (n, 4, 4)."""

    session: SessionMap
    frame: str
    before: F64
    after: F64


def map_sharpness(work: Workspace) -> Sharpness:
    """The sharpness of the map of all sessions that were optimised."""
    folders = [f for f in work.sessions() if work.optimized_trajectory(f.name).exists()]
    placed = [_placed(work, SessionMap(folder)) for folder in folders]
    if not placed:
        return Sharpness(0, None, None, None, None)
    voxel = float(read_metadata(folders[0].frames)["voxel_size"])
    edge = PLACE * voxel
    by_place: dict[tuple[str, int, int], list[_Placed]] = {}
    for part in placed:
        squares = np.unique(np.floor(part.after[:, :2, 3] / edge).astype(np.int64), axis=0)
        for x, y in squares.tolist():
            by_place.setdefault((part.frame, x, y), []).append(part)
    shared = sorted(key for key, parts in by_place.items() if len(parts) > 1)
    chosen = [shared[i] for i in evenly(len(shared), MOST_PLACES)]

    before: list[tuple[int, F64]] = []
    after: list[tuple[int, F64]] = []
    for frame, x, y in chosen:
        parts = by_place[frame, x, y]
        some = [parts[i] for i in evenly(len(parts), MOST_SESSIONS)]
        middle = (np.array([x, y]) + 0.5) * edge
        for maps, figures in zip(
            _points_near(some, middle, REACH * voxel), (before, after), strict=True
        ):
            figures.append(plane_figures(maps, CELL * voxel))
    planes_before, thickness_before_m = _pooled(before)
    planes_after, thickness_after_m = _pooled(after)
    return Sharpness(
        len(chosen), planes_before, planes_after, thickness_before_m, thickness_after_m
    )


def _placed(work: Workspace, session: SessionMap) -> _Placed:
    path = work.optimized_trajectory(session.folder.name)
    table = read_table(path)
    stamps_ns = np.asarray(table["stamp_ns"].to_numpy())
    after = interpolate(stamps_ns, poses_of(table), session.stamps_ns)
    before = rigidly_at(session.map_T_base, after)
    return _Placed(session, str(read_metadata(path)["frame"]), before, after)


def rigidly_at(poses: F64, wanted: F64) -> F64:
    """All ``poses`` (n, 4, 4) moved by one transform, in the mean to those ``wanted`` (n, 4, 4)."""
    u, _, vt = np.linalg.svd(np.einsum("nij,nkj->ik", wanted[:, :3, :3], poses[:, :3, :3]))
    move = np.eye(4)
    move[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    move[:3, 3] = np.mean(wanted[:, :3, 3] - poses[:, :3, 3] @ move[:3, :3].T, axis=0)
    return np.asarray(move @ poses)


def _points_near(
    parts: Sequence[_Placed], middle: F64, reach: float
) -> tuple[list[F64], list[F64]]:
    """Points (n, 3) of each session within ``reach`` (m) of ``middle`` (2,), before and after."""
    before: list[F64] = []
    after: list[F64] = []
    for part in parts:
        away = np.linalg.norm(part.after[:, :2, 3] - middle, axis=1)
        nearest = np.argsort(away, kind="stable")[:KEYFRAMES].tolist()
        for poses, maps in ((part.before, before), (part.after, after)):
            points = [apply(poses[k], part.session.keyframe(k).points) for k in nearest]
            inside = [p[np.linalg.norm(p[:, :2] - middle, axis=1) < reach] for p in points]
            maps.append(np.concatenate(inside))
    return before, after


def plane_figures(maps: Sequence[F64], edge: float) -> tuple[int, F64]:
    """How many cells of ``edge`` metres have points of two ``maps`` (n, 3), and the thickness (m,)
    of those that are planes.
    """
    points = np.concatenate(maps)
    if not len(points):
        return 0, np.zeros(0)
    owner = np.repeat(np.arange(len(maps)), [len(m) for m in maps])
    corner = np.floor(points / edge)
    i, j, k = (corner - corner.min(0)).astype(np.int64).T
    cells, cell = np.unique((i * (j.max() + 1) + j) * (k.max() + 1) + k, return_inverse=True)
    count = np.bincount(cell, minlength=len(cells))
    pairs = np.unique(cell * len(maps) + owner)
    owners = np.bincount(pairs // len(maps), minlength=len(cells))
    is_judged = (count >= LEAST_POINTS) & (owners > 1)

    # about the corner of the cell: sums of squares lose digits with the distance
    local = points - corner * edge
    sums = np.stack([np.bincount(cell, local[:, k], len(cells)) for k in range(3)], axis=1)
    residual = local - (sums / count[:, None])[cell]
    covariance = np.empty((len(cells), 3, 3))
    for i in range(3):
        for j in range(3):
            covariance[:, i, j] = (
                np.bincount(cell, residual[:, i] * residual[:, j], len(cells)) / count
            )
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance[is_judged]), 0.0))
    is_plane = spread[:, 0] < THIN * spread[:, 1]
    return int(is_judged.sum()), spread[is_plane, 0]


def _pooled(figures: Sequence[tuple[int, F64]]) -> tuple[float | None, float | None]:
    """The share of planes, and their thickness, root mean square."""
    cells = sum(count for count, _ in figures)
    thickness = np.concatenate([np.zeros(0), *(planes for _, planes in figures)])
    if not cells:
        return None, None
    mean = float(np.sqrt(np.mean(thickness**2))) if len(thickness) else None
    return len(thickness) / cells, mean
