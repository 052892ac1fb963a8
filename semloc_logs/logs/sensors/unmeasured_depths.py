"""The one depth that some depth cameras give all pixels without a measurement.

It would be a wall that moves with the camera. REP 118 has NaN and infinity for such pixels, and 0
in whole numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semloc_logs.arrays import F32
from semloc_logs.logs.problems import ProblemKind, Problems

FEWEST = 10  # pictures that show it for sure; in the first ones a part of the scene may be left out
LEAST_SHARE = 0.05  # of the pixels have it
# of the pictures have it as their largest depth; a camera that moves sees no surface so long
MOSTLY = 0.8


@dataclass(slots=True)
class _Largest:
    """The largest depth of many pixels in most pictures: ``count`` of ``pictures``."""

    depth: float = 0.0
    count: int = 0
    pictures: int = 0

    def add(self, depth: float) -> None:
        self.pictures += 1
        if depth == self.depth:
            self.count += 1
        elif depth and 2 * self.count < self.pictures:
            self.depth = depth
            self.count = 1

    @property
    def is_limit(self) -> bool:
        """Whether pixels of this depth are taken to have no measurement."""
        return self.count >= MOSTLY * self.pictures


class UnmeasuredDepths:
    """The limits of the topics; ``problems`` name them."""

    def __init__(self) -> None:
        self.problems = Problems()
        self._largest: dict[str, _Largest] = {}

    def measured(self, topic: str, depth: F32, max_range: float) -> F32:
        """The next ``depth`` (h, w) of a topic in metres, 0 where it was not measured."""
        known = depth[np.isfinite(depth)]
        limit = float(known.max()) if len(known) else 0.0
        if limit > max_range:  # such pixels are left out anyway
            return depth
        is_limit = depth == limit
        share = float(is_limit.mean())
        largest = self._largest.setdefault(topic, _Largest())
        has_others = bool(((known > 0) & (known < limit)).any())
        if has_others:  # a picture of nothing else may be a wall
            largest.add(limit if share >= LEAST_SHARE else 0.0)
        elif largest.count < FEWEST:
            return depth
        if not largest.is_limit or limit != largest.depth:
            return depth
        if largest.count >= FEWEST:
            self._name(topic, limit)
        return np.where(is_limit, np.float32(0), depth)

    def _name(self, topic: str, limit: float) -> None:
        self.problems.add(
            f"{topic}: many pixels of nearly all pictures have the largest depth, {limit:.3f} m, "
            f"which moves with the camera: they are taken to have no measurement.",
            topic=topic,
            kind=ProblemKind.FRAME,
            lost=False,
        )
