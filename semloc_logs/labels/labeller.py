"""What gives the points of one session their classes: the base of all sources of labels."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import U8
from semloc_logs.frames import ImageFrame, PosedCloud
from semloc_logs.labels.camera_labels import PointLabels
from semloc_logs.labels.space import UNLABELLED
from semloc_logs.labels.sweep_ground import GroundSurface
from semloc_logs.logs.problems import Problem


class KeyframeView(NamedTuple):
    """A keyframe: level ``points`` (n, 3) in the map, seen from ``origin`` (3,).

    ``labels`` as from :meth:`Labeller.take`; ``is_posed``: whether its pose is known.
    """

    points: NDArray[np.floating]
    origin: NDArray[np.floating]
    labels: PointLabels | None
    is_posed: bool


class Labeller(ABC):
    """Gives the points of every keyframe their classes.

    During the pass over the log :meth:`take` each keyframe, with :attr:`on_image` and
    :attr:`images` for the session's pass; :meth:`conclude` after it; then get the :meth:`labels`.
    LogError and SettingsError when the source that the settings demand is not available.
    """

    @property
    @abstractmethod
    def source(self) -> str:
        """The name of the source, once the pass is over."""

    @property
    def images(self) -> tuple[str, ...]:
        """Topics of the pictures that labels come from."""
        return ()

    @property
    def on_image(self) -> Callable[[ImageFrame], None] | None:
        """The function for the pictures of the pass; None when none are needed."""
        return None

    @property
    def problems(self) -> list[Problem]:
        """What is wrong with the labels, or was assumed about them."""
        return []

    def take(self, cloud: PosedCloud, keep: NDArray[np.integer]) -> PointLabels | None:
        """Labels of ``cloud.points[keep]`` of the next keyframe, to be kept for :meth:`labels`."""
        return None

    def conclude(self, view: Callable[[int], KeyframeView], scale: float) -> None:
        """Settles what the labels are, after the last keyframe.

        ``view`` gives a keyframe by its number, ``scale`` is the voxel size over 0.30 m.
        """
        return

    @abstractmethod
    def labels(
        self,
        keyframe: int,
        points: NDArray[np.floating],
        origin: NDArray[np.floating],
        labels: PointLabels | None,
        scale: float,
        ground: GroundSurface | None = None,
    ) -> U8:
        """Classes (n,) of the level ``points`` (n, 3) of a keyframe seen from ``origin`` (3,).

        ``labels`` are from :meth:`take`. ``scale`` is the voxel size over 0.30 m; ``ground`` saves
        the search for the ground below the points.
        """

    def to_json(self) -> dict[str, Any]:
        """The source of the labels, for session.json."""
        return {"source": self.source, "spaces": {}}


def unlabelled(points: NDArray[Any]) -> U8:
    """No class for any of the points (n,)."""
    return np.full(len(points), UNLABELLED, np.uint8)
