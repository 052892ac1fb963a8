"""How far the poses of a session drift along its road."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from semloc_logs.arrays import F64

Axes = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Drift:
    """Standard deviations of the errors of poses, a metre of road.

    Along the axes of the base (m/m), and about them (rad/m). Over the tens of metres that a map of
    a place is made from, a wrong scale and a wrong turn rate grow with the road.
    """

    translation: Axes
    rotation: Axes

    @classmethod
    def of(cls, rates: F64) -> Drift:
        """From ``rates`` (6,): of the translation, and of the rotation."""
        x, y, z, roll, pitch, yaw = rates.tolist()
        return cls((x, y, z), (roll, pitch, yaw))

    @property
    def rates(self) -> F64:
        """Of the translation and of the rotation (6,)."""
        return np.array([*self.translation, *self.rotation])

    @property
    def percent(self) -> float:
        """The greatest part of the translation, in percent of the way."""
        return 100 * max(self.translation)

    def covariance(self, road: float) -> F64:
        """Covariance (6, 6) of a motion over ``road`` metres, in the axes of the base."""
        return np.diag((road * self.rates) ** 2)

    def to_json(self) -> dict[str, list[float]]:
        """For session.json."""
        return {
            "translation": [round(rate, 6) for rate in self.translation],
            "rotation": [round(rate, 7) for rate in self.rotation],
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Drift:
        """Of session.json."""
        return cls.of(np.array([*content["translation"], *content["rotation"]], float))


UNMEASURED = Drift((0.003,) * 3, (2e-4,) * 3)  # of good odometry of wheels, or of a LIDAR
