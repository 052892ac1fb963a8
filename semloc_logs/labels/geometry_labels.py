"""Classes of a session from the geometry of its points, or none at all."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import U8
from semloc_logs.labels.camera_labels import PointLabels
from semloc_logs.labels.from_geometry import classify
from semloc_logs.labels.labeller import Labeller, unlabelled
from semloc_logs.labels.sweep_ground import GroundSurface


class GeometryLabels(Labeller):
    """Ground, construction, vegetation and poles by the shape of the surroundings."""

    source = "geometry"

    def labels(
        self,
        keyframe: int,
        points: NDArray[np.floating],
        origin: NDArray[np.floating],
        labels: PointLabels | None,
        scale: float,
        ground: GroundSurface | None = None,
    ) -> U8:
        return classify(points, origin, scale, ground)


class NoLabels(Labeller):
    """One class for everything."""

    source = "uniform"

    def labels(
        self,
        keyframe: int,
        points: NDArray[np.floating],
        origin: NDArray[np.floating],
        labels: PointLabels | None,
        scale: float,
        ground: GroundSurface | None = None,
    ) -> U8:
        return unlabelled(points)
