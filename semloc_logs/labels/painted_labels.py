"""Classes of a session that its cameras paint onto the points: the base of such sources."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import U8, U32, Bools
from semloc_logs.frames import ImageFrame, PosedCloud
from semloc_logs.labels.camera_labels import Painted, Pictures, PointLabels
from semloc_logs.labels.from_geometry import classify
from semloc_logs.labels.labeller import Labeller, unlabelled
from semloc_logs.labels.space import SKY, THINGS, UNLABELLED, UNPAINTED
from semloc_logs.labels.sweep_ground import GroundSurface
from semloc_logs.logs.problems import Problem
from semloc_logs.settings import Labels


class PaintedLabels(Labeller):
    """Labels of ``pictures``, where there are some."""

    def __init__(self, settings: Labels, pictures: Pictures | None) -> None:
        self._settings = settings
        self._pictures = pictures

    @abstractmethod
    def classes(self, topic: str, ids: U32) -> U8:
        """Classes (n,) of the ``ids`` (n,) of the pictures of a topic."""

    @property
    def images(self) -> tuple[str, ...]:
        return self._pictures.topics if self._pictures else ()

    @property
    def on_image(self) -> Callable[[ImageFrame], None] | None:
        return self._pictures.take if self._pictures else None

    @property
    def problems(self) -> list[Problem]:
        """Pictures that cannot be used."""
        return [*self._pictures.problems] if self._pictures else []

    def take(self, cloud: PosedCloud, keep: NDArray[np.integer]) -> PointLabels | None:
        return None if self._pictures is None else self._pictures.labels(cloud, keep)

    def labels(
        self,
        keyframe: int,
        points: NDArray[np.floating],
        origin: NDArray[np.floating],
        labels: PointLabels | None,
        scale: float,
        ground: GroundSurface | None = None,
    ) -> U8:
        if labels is None:
            return unlabelled(points)
        out = self._classes_of_painted(labels)
        if self._settings.unseen == "geometry":
            unseen = labels["label"] == UNPAINTED
            out[unseen] = classify(points, origin, scale, ground)[unseen]
        return out

    def to_json(self) -> dict[str, Any]:
        """With the counts of painted points."""
        counts = {} if self._pictures is None else self._pictures.to_json()
        return super().to_json() | counts

    def _classes_of_painted(self, painted: Painted) -> U8:
        out = unlabelled(painted)
        for number, name in enumerate(self.images):
            own = of_camera(painted, number)
            out[own] = self.classes(name, painted["label"][own])
        out[out == SKY] = UNLABELLED  # sky gives no return
        # a car's class on things that are seen through its windows; a road has no windows, and is
        # always behind a nearer piece of itself
        out[painted["is_doubtful"] & np.isin(out, THINGS)] = UNLABELLED
        return out


def of_camera(painted: Painted, number: int) -> Bools:
    """Which points (n,) have their label from a camera."""
    return np.asarray((painted["camera"] == number) & (painted["label"] != UNPAINTED))
