"""Maps of a database and of queries in level frames: what the systems on points describe.

The world is level, and so is a query's frame: the axes of its odometry, with the origin in the
base at the last view. A pose of a query in the world is a turn about z and a shift.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from semloc_logs.arrays import F64
from semloc_logs.experiments.system import Query, View
from semloc_logs.numerics.local_shape import shape
from semloc_logs.numerics.transforms import apply
from semloc_logs.settings import Resolved
from semloc_logs.voxels.grid import BlockMap, Fuser

NORMAL_NEIGHBOURS = 20  # nearest points that make a normal


@dataclass(eq=False)
class LevelMap:
    """Fused ``blocks`` of views, and ``seen_from`` (m, 3), where sensors were, metres."""

    blocks: BlockMap
    voxel_size: float
    seen_from: F64

    @cached_property
    def points(self) -> F64:
        """Centres (n, 3) of the occupied voxels, metres."""
        return np.asarray((self.blocks.occupied()[0] + 0.5) * self.voxel_size, np.float64)

    @cached_property
    def normals(self) -> F64:
        """Unit normals (n, 3) of the points, towards the sensor nearest to each (supplement 1)."""
        return oriented_normals(self.points, self.seen_from)


def oriented_normals(points: F64, seen_from: F64) -> F64:
    """Unit normals (n, 3) of ``points`` (n, 3) on the side of the nearest of ``seen_from``."""
    if not len(points):
        return np.zeros((0, 3))
    normals = shape(points, NORMAL_NEIGHBOURS).normal.astype(np.float64)
    nearest = cKDTree(seen_from).query(points, workers=1)[1]
    towards = np.einsum("ij,ij->i", normals, seen_from[nearest] - points)
    return normals * np.where(towards < 0, -1.0, 1.0)[:, None]


def database_map(views: Iterable[View], settings: Resolved) -> LevelMap:
    """The map of all views in the world; one view is in memory at a time."""
    return _fused(((view, view.world_T_base) for view in views), settings, np.inf)


def view_map(view: View, settings: Resolved) -> LevelMap:
    """The map of one view of the database in the world, as large as a query's."""
    return _fused([(view, view.world_T_base)], settings, settings.query.radius)


def query_map(query: Query, settings: Resolved) -> tuple[LevelMap, F64]:
    """The map of a query in its frame, within ``query.radius`` of the sensor, and ``query_T_base``
    (4, 4) of its last view.
    """
    poses = query_poses(query.views)
    return _fused(zip(query.views, poses, strict=True), settings, settings.query.radius), poses[-1]


def query_poses(views: Sequence[View]) -> list[F64]:
    """``query_T_base`` (4, 4) of the views of a query, by odometry."""
    origin = views[-1].odom_T_base[:3, 3]
    out = []
    for view in views:
        pose = view.odom_T_base.copy()
        pose[:3, 3] -= origin
        out.append(pose)
    return out


def level_points(views: Sequence[View]) -> tuple[F64, F64]:
    """Points (n, 3) of a query's views in its frame, and ``query_T_base`` (4, 4) of the last."""
    poses = query_poses(views)
    clouds = [apply(pose, view.points) for pose, view in zip(poses, views, strict=True)]
    return np.concatenate(clouds), poses[-1]


def _fused(views: Iterable[tuple[View, F64]], settings: Resolved, radius: float) -> LevelMap:
    fuser = Fuser(settings.fusion)
    seen_from = []
    for view, pose in views:
        for origin, rows in _by_origin(view):
            points = view.points[rows]
            label = view.label[rows]
            off = points - origin.astype(np.float32)
            is_inside = np.einsum("ij,ij->i", off, off) < radius**2
            fuser.add(points[is_inside], label[is_inside], origin, None, pose)
            seen_from.append(pose[:3, :3] @ origin + pose[:3, 3])
    return LevelMap(
        fuser.finish(),
        settings.fusion.voxel_size,
        np.stack(seen_from) if seen_from else np.zeros((0, 3)),
    )


def _by_origin(view: View) -> list[tuple[F64, NDArray[np.int64]]]:
    """The origins of a view's rays, and the rows of the points seen from each."""
    origin = np.asarray(view.origin, np.float64)
    if origin.ndim == 1:
        return [(origin, np.arange(len(view.points)))]
    origins, number = np.unique(origin, axis=0, return_inverse=True)
    return [(o, np.flatnonzero(number.reshape(-1) == k)) for k, o in enumerate(origins)]
