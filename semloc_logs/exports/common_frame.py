"""Sessions in the frame of `semloc optimize`, and on the earth where satellites place it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from semloc_logs.arrays import F64, I64
from semloc_logs.errors import WorkspaceError
from semloc_logs.logs.poses.navsat import LocalFrame
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import apply, inverse
from semloc_logs.numerics.utm import UtmZone
from semloc_logs.pose_graph.merged_map import keyframe_poses
from semloc_logs.pose_graph.optimized_tables import DATUM
from semloc_logs.tables.table import read_metadata
from semloc_logs.workspace import Workspace


def earth_frame(work: Workspace, session: SessionMap) -> LocalFrame | None:
    """East, north, up that the session's optimised poses are in; None where they are not."""
    path = work.optimized_trajectory(session.folder.name)
    datum = read_metadata(path).get(DATUM) if path.exists() else None
    return None if datum is None else LocalFrame(*datum)


@dataclass(eq=False)
class KeyframeMotion:
    """Points of a map where its keyframes are elsewhere: from ``map_T_base`` to ``placed_T_base``.

    Each point moves with the nearest keyframe.
    """

    map_T_base: F64
    placed_T_base: F64

    @cached_property
    def placed_T_map(self) -> F64:
        """By each keyframe (n, 4, 4)."""
        return np.asarray(self.placed_T_base @ inverse(self.map_T_base))

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.map_T_base[:, :3, 3])

    def points(self, points: F64) -> F64:
        """Points (n, 3) of the map, placed."""
        nearest: I64 = self._tree.query(points)[1]
        placed_T_map = self.placed_T_map[nearest]
        moved = np.einsum("nij,nj->ni", placed_T_map[:, :3, :3], points)
        return np.asarray(moved + placed_T_map[:, :3, 3])


@dataclass(eq=False)
class CommonFrame:
    """A session in the common frame, or with ``in_utm`` in UTM coordinates.

    Every point moves with a keyframe, as odometry drifts against that frame.
    """

    work: Workspace
    session: SessionMap
    in_utm: bool

    def __post_init__(self) -> None:
        name = self.session.folder.name
        if not self.session.posed or not self.work.optimized_trajectory(name).exists():
            raise WorkspaceError(
                f"Session {name} has no poses in a common frame: run 'semloc optimize"
                f" -w {self.work.path}' first."
            )
        if self.in_utm and self._local is None:
            raise WorkspaceError(
                f"Session {name} is not placed on the earth: neither it nor the sessions that"
                " closures connect with it have satellite fixes that tell the heading. Use"
                " --frame common."
            )

    @cached_property
    def _local(self) -> LocalFrame | None:
        return earth_frame(self.work, self.session)

    @property
    def zone(self) -> UtmZone | None:
        """The zone of the coordinates; None in a local frame."""
        return UtmZone.of(*self._local.datum[:2]) if self.in_utm and self._local else None

    @cached_property
    def _common_T_base(self) -> F64:
        return keyframe_poses(self.work, self.session)

    @cached_property
    def _motion(self) -> KeyframeMotion:
        return KeyframeMotion(self.session.map_T_base, self._common_T_base)

    @cached_property
    def positions(self) -> F64:
        """Of the keyframes (n, 3), metres."""
        return self._projected(self._common_T_base[:, :3, 3])

    def points_of(self, points: F64, keyframe: int) -> F64:
        """Points (n, 3) of the map that a keyframe measured."""
        return self._projected(apply(self._motion.placed_T_map[keyframe], points))

    def points(self, points: F64) -> F64:
        """Points (n, 3) of the map."""
        return self._projected(self._motion.points(points))

    def _projected(self, points: F64) -> F64:
        if self.zone is None or self._local is None:
            return points
        return self.zone.project(self._local.geodetic(points))
