"""Poses between those that are solved for: odometry from both neighbours, blended."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64
from semloc_logs.numerics.transforms import inverse


@dataclass(frozen=True, slots=True, eq=False)
class SolvedPoses:
    """Poses of a session that are known in another frame.

    ``place`` (k,), strictly ascending, tells where they lie in it, such as road or time;
    ``odometry`` (k, 4, 4) are they in the session's own frame, ``solved`` (k, 4, 4) in the other.
    """

    place: F64
    odometry: F64
    solved: F64

    def carried(self, place: F64, odometry: F64) -> F64:
        """Other poses ``odometry`` (n, 4, 4) of the session, in the frame of ``solved``.

        Each is carried from the solved pose before it and from the one after it; what either counts
        follows from ``place`` (n,). Beyond the ends the nearest one counts alone.
        """
        last = len(self.place) - 1
        after = np.clip(np.searchsorted(self.place, place), 0, last)
        before = np.clip(np.searchsorted(self.place, place, "right") - 1, 0, last)
        from_before = self._carried(before, odometry)
        from_after = self._carried(after, odometry)

        span = self.place[after] - self.place[before]
        share = np.where(span > 0, (place - self.place[before]) / np.where(span > 0, span, 1.0), 0)
        difference = Rotation.from_matrix(
            np.swapaxes(from_before[:, :3, :3], 1, 2) @ from_after[:, :3, :3]
        ).as_rotvec()
        out = from_before.copy()
        turn = Rotation.from_rotvec(share[:, None] * difference).as_matrix()
        out[:, :3, :3] = from_before[:, :3, :3] @ turn
        out[:, :3, 3] += share[:, None] * (from_after[:, :3, 3] - from_before[:, :3, 3])
        return out

    def _carried(self, rows: NDArray[np.int64], odometry: F64) -> F64:
        return np.asarray(self.solved[rows] @ inverse(self.odometry[rows]) @ odometry)
