"""A small cloud of the maps of several sessions, for viewers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from semloc_logs.arrays import F64, I64, U8
from semloc_logs.exports.map_points import SessionPoints
from semloc_logs.exports.point_formats import point_colours
from semloc_logs.logs.annotation.scene import Cloud
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import apply

MOST_POINTS = 100_000  # 1.7 MB of a log
MOST_SESSIONS = 8  # the first ones
COARSER = 1.5  # cells grow so much until there are few enough points


def map_cloud(placed: Sequence[tuple[SessionMap, F64]], frame_id: str) -> Cloud | None:
    """Voxels of sessions that lie in ``frame_id`` by transforms (4, 4); None without any.

    One voxel in a cell of two voxels, or of more where there are too many points.
    """
    thinned = ThinnedPoints()
    for session, frame_T_session in placed[:MOST_SESSIONS]:
        points = SessionPoints(session, "voxels", "session", None)
        thinned.cell = max(thinned.cell, 2.0 * points.voxel_size)
        for batch, label in points.batches():
            thinned.add(apply(frame_T_session, batch), label)
    if not len(thinned.label):
        return None
    colours = point_colours()[thinned.label]
    return Cloud(frame_id, thinned.points.astype(np.float32), colours, thinned.label)


class ThinnedPoints:
    """At most MOST_POINTS points: the first one in each ``cell`` (m)."""

    def __init__(self, cell: float = 0.0) -> None:
        self.points: F64 = np.zeros((0, 3))
        self.label: U8 = np.zeros(0, np.uint8)
        self.cell = cell

    def add(self, points: F64, label: U8) -> None:
        """More points (n, 3) with train ids (n,)."""
        self.points = np.concatenate([self.points, points])
        self.label = np.concatenate([self.label, label])
        self._keep(self._first())
        while len(self.label) > MOST_POINTS:
            self.cell *= COARSER
            self._keep(self._first())

    def _first(self) -> I64:
        cells = np.floor(self.points / self.cell)
        return np.sort(np.unique(cells, axis=0, return_index=True)[1])

    def _keep(self, rows: I64) -> None:
        self.points = self.points[rows]
        self.label = self.label[rows]
