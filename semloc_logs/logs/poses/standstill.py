"""Poses that never move while the sensor does: odometry that was recorded but never filled in."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from semloc_logs.frames import F32
from semloc_logs.numerics.transforms import Array, apply

_EVERY = 4  # clouds; a vehicle is not looked at more often
_KEPT, _COMPARED = 4000, 500  # points of the first cloud, and of each that is compared with it
# a cloud has moved when it lies so many times as far from the first as the second did, and so far
# (m)
_TIMES, _MARGIN = 2.0, 0.1
# of its points' distances: along a street most surfaces slide over themselves, and a fifth may be
# traffic
_QUANTILE = 0.8


class Standstill:
    """Compares clouds with the first one, in the session frame, while the poses do not move."""

    def __init__(self) -> None:
        self._first: cKDTree | None = None
        self._noise: float | None = None
        self._seen = 0
        self._distances: list[float] = []

    @property
    def shift(self) -> float:
        """Distance (m) of moved clouds from the first; 0 unless at least half of them moved."""
        least = _TIMES * (self._noise or 0.0) + _MARGIN
        moved = [d for d in self._distances if d > least]
        return max(moved) if 2 * len(moved) >= max(len(self._distances), 4) else 0.0

    def add(self, points: F32, session_T_base: Array) -> None:
        """Takes the points (n, 3) of a cloud in the base frame."""
        self._seen += 1
        if self._first is None:
            self._first = cKDTree(apply(session_T_base, _some(points, _KEPT)))
        elif self._noise is None or self._seen % _EVERY == 0:
            distances, _ = self._first.query(apply(session_T_base, _some(points, _COMPARED)))
            distance = float(np.quantile(distances, _QUANTILE))
            if self._noise is None:
                self._noise = distance
            else:
                self._distances.append(distance)


def _some(points: F32, count: int) -> F32:
    return points[:: max(1, len(points) // count)]
