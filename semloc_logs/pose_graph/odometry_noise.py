"""How uncertain odometry is after a stretch of road: a random walk, so variances add up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.settings import ResolvedOptimize

REFERENCE_M = 100.0  # the settings give the drift after so much road
# noise of a single pose, so that keyframes of several sensors at one place are not one vertex
LEAST_M = 0.01
LEAST_RAD = 0.0005


@dataclass(frozen=True, slots=True)
class OdometryNoise:
    """``drift`` is the share of the road after 100 m, ``turn_rad`` the turn after 100 m."""

    drift: float
    turn_rad: float

    @classmethod
    def of(cls, settings: ResolvedOptimize) -> OdometryNoise:
        """As the settings give it."""
        return cls(settings.odometry_drift, float(np.radians(settings.odometry_turn_deg)))

    def turn_variance(self, road: F64) -> F64:
        """Of the direction about each axis after ``road`` metres (n,), rad^2."""
        return np.asarray(LEAST_RAD**2 + self.turn_rad**2 * road / REFERENCE_M)

    def position_variance(self, road: F64) -> F64:
        """Along each axis after ``road`` metres (n,), m^2.

        Steps add up, and the turn that grows on the way carries the end sideways: a third of its
        final variance over the whole length, as for any random walk.
        """
        steps = self.drift**2 * REFERENCE_M * road
        sideways = (self.turn_rad**2 * road / REFERENCE_M) * road**2 / 3.0
        return np.asarray(LEAST_M**2 + steps + sideways)
