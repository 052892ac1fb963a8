"""Queries: which keyframes are queries, and the small map of each (paper 3, acc. of 4.4)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from semloc_logs.alignment.covariance import Stretch
from semloc_logs.alignment.query_map import Query
from semloc_logs.alignment.surface import thin_points
from semloc_logs.arrays import F64, I64
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import apply, inverse, rotation_angle
from semloc_logs.settings import Resolved
from semloc_logs.voxels.grid import Fuser

POINTS_A_VOXEL = 2  # of a query along each edge


def query_keyframes(session: SessionMap, settings: Resolved) -> list[int]:
    """The keyframes that are queries: every ``query.every`` metres or ``query.every_angle``.

    In a log without poses all of them are.
    """
    if not session.posed:
        return list(range(len(session.stamps_ns)))
    every = settings.query.every
    angle = settings.query.every_angle
    chosen: list[int] = []
    for i, pose in enumerate(session.map_T_base):
        if chosen:
            moved = inverse(session.map_T_base[chosen[-1]]) @ pose
            if np.linalg.norm(moved[:3, 3]) < every and rotation_angle(moved[:3, :3]) < angle:
                continue
        chosen.append(i)
    return chosen


def query_members(session: SessionMap, keyframe: int, settings: Resolved) -> list[int]:
    """The keyframes fused into a query: ``query.frames`` around it, or ``query.length`` of road.

    Poses may jump, between logs or where positions come back: keyframes beyond the query's radius
    are not part of the place.
    """
    n = len(session.stamps_ns)
    if not session.posed:
        return [keyframe]
    distance = np.abs(session.distance - session.distance[keyframe])
    if settings.query.length is not None:
        return np.flatnonzero(distance <= settings.query.length / 2).tolist()
    count = min(settings.query.frames, n)
    first = min(max(0, keyframe - count // 2), n - count)
    return [i for i in range(first, first + count) if distance[i] <= settings.query.radius]


def stretch(session: SessionMap, keyframe: int, members: Sequence[int] | I64) -> Stretch:
    """The road from ``keyframe`` to the ``members`` that a map is made from."""
    offsets = session.distance[np.asarray(members, np.int64)] - session.distance[keyframe]
    return Stretch.between(offsets, session.drift)


def build_query(session: SessionMap, keyframe: int, settings: Resolved) -> tuple[Query, F64]:
    """The query map in a level frame whose origin is the base at ``keyframe``.

    Returned with the level ``query_T_base`` (4, 4). The frame keeps the map's axes: only the origin
    moves, so voxels stay small numbers.
    """
    members = query_members(session, keyframe, settings)
    query_T_map = np.eye(4)
    query_T_map[:3, 3] = -session.map_T_base[keyframe][:3, 3]
    poses = query_T_map @ session.map_T_base
    radius = settings.query.radius
    fuser = Fuser(settings.fusion)
    clouds = []
    spreads = []
    for i in members:
        frame = session.keyframe(i).near(session.origins[i], radius)
        fuser.add(frame.points, frame.label, session.origins[i], frame.sigma, poses[i])
        clouds.append(apply(poses[i], frame.points))
        spreads.append(frame.spread(session.origins[i]) @ poses[i][:3, :3].T)
    v = settings.fusion.voxel_size
    points = np.concatenate(clouds)
    spread = np.concatenate(spreads)
    kept = thin_points(points, v / POINTS_A_VOXEL, spread)
    return Query(fuser.finish(), points[kept], v, spread[kept]), poses[keyframe]
