"""Queries: which keyframes are queries, and the small map of each (paper 3, acc. of 4.4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from semloc_logs.alignment.query_map import Query
from semloc_logs.alignment.surface import thin_points
from semloc_logs.errors import WorkspaceError
from semloc_logs.numerics.transforms import apply, inverse, rotation_angle
from semloc_logs.settings import Resolved
from semloc_logs.subvolumes.submap_descriptors import KNOWS_CLASSES
from semloc_logs.tables.table import read_json, read_table
from semloc_logs.voxels.grid import Fuser
from semloc_logs.voxels.store import Keyframe, poses_of, read_keyframe
from semloc_logs.workspace import SessionFolder

F64 = NDArray[np.float64]
CACHED_KEYFRAMES = 64  # in memory: a query of 20 m and the next one
POINTS_A_VOXEL = 2  # of a query along each edge


@dataclass(eq=False)
class SessionMap:
    """A fused session: its keyframes with their poses, and session.json."""

    folder: SessionFolder

    @cached_property
    def json(self) -> dict[str, Any]:
        return read_json(self.folder.session_json)

    @cached_property
    def frames(self) -> pa.Table:
        return read_table(self.folder.frames)

    @cached_property
    def map_T_base(self) -> F64:
        """Poses (n, 4, 4) of the keyframes."""
        return poses_of(self.frames)

    @cached_property
    def stamps_ns(self) -> NDArray[np.int64]:
        return np.asarray(self.frames["stamp_ns"].to_numpy())

    @cached_property
    def distance(self) -> F64:
        return np.asarray(self.frames["distance"].to_numpy())

    @cached_property
    def ground_z(self) -> F64:
        return np.asarray(self.frames["ground_z"].to_numpy())

    @cached_property
    def origins(self) -> F64:
        return np.stack([self.frames[f"origin_{c}"].to_numpy() for c in "xyz"], 1).astype(float)

    @cached_property
    def topics(self) -> NDArray[np.object_]:
        """The stream (n,) of each keyframe's points."""
        return np.array(self.frames["topic"].to_pylist(), object)

    @cached_property
    def views(self) -> F64:
        """The mean of each keyframe's near points (n, 3), metres in the map frame.

        Raises WorkspaceError when an earlier version fused the session.
        """
        self.check_version()
        at = np.stack([self.frames[f"view_{c}"].to_numpy() for c in "xyz"], 1).astype(float)
        return np.asarray(
            np.einsum("nij,nj->ni", self.map_T_base[:, :3, :3], at) + self.map_T_base[:, :3, 3]
        )

    @cached_property
    def keyframe(self) -> Callable[[int], Keyframe]:
        """Reads a keyframe; the last ones are cached, since neighbouring queries share them."""
        return lru_cache(maxsize=CACHED_KEYFRAMES)(partial(read_keyframe, self.folder.keyframes))

    @property
    def posed(self) -> bool:
        return bool(self.json["posed"])

    @property
    def label_source(self) -> str:
        return str(self.json["label_source"])

    def check_version(self) -> None:
        """Raises WorkspaceError when an earlier version fused the session."""
        if "view_x" not in self.frames.column_names:
            raise WorkspaceError(
                f"{self.folder.frames} is of an earlier version:"
                f" fuse session {self.folder.name} again with --overwrite."
            )

    @property
    def submaps(self) -> list[dict[str, Any]]:
        return list(self.json["submaps"])

    def road(self, submap: dict[str, Any]) -> F64:
        """Positions (m, 2) of a submap's keyframes in the map frame, metres."""
        return self.map_T_base[submap["first"] : submap["last"] + 1, :2, 3]

    @property
    def has_classes(self) -> bool:
        """Whether labels come from a log or a model: the semantic network understands them."""
        return self.json["label_source"] in KNOWS_CLASSES


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
