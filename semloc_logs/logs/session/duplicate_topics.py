"""One LIDAR published twice, as measured and filtered: found by equal points, not by names."""

from __future__ import annotations

from collections import deque

import numpy as np
from scipy.spatial import cKDTree

from semloc_logs.arrays import F32
from semloc_logs.logs.problems import Problem, ProblemKind

_REMEMBERED = 4  # clouds of all topics that a new one is compared with
_TRIES = 8  # comparisons of two topics before they count as two sensors
_SAMPLE = 300  # points of the smaller cloud that are looked up in the other
_FEWEST = 10  # points of a cloud that can be compared
# m; two sensors do not measure the same point so closely, a filter passes it on unchanged
_SAME = 2e-3
_SHARE = 0.2  # of the points are the same; a voxel filter moves the points of full cells
_NEAR_NS = 500_000_000


class DuplicateTopics:
    """Topics that repeat the points of another; the one whose clouds come first is the original."""

    def __init__(self) -> None:
        self.original: dict[str, str] = {}
        self._newest: deque[tuple[str, int, F32]] = deque(maxlen=_REMEMBERED)
        self._tries: dict[tuple[str, str], int] = {}

    def is_duplicate(self, topic: str, stamp_ns: int, points: F32) -> bool:
        """Whether ``topic`` repeats another, by its newest ``points`` (n, 3) in the base frame."""
        if topic in self.original:
            return True
        for other, other_stamp_ns, other_points in self._newest:
            if other == topic or abs(other_stamp_ns - stamp_ns) > _NEAR_NS:
                continue
            pair = (min(topic, other), max(topic, other))
            self._tries[pair] = self._tries.get(pair, 0) + 1
            if self._tries[pair] <= _TRIES and _shares_points(points, other_points):
                self.original[topic] = other
                return True
        self._newest.append((topic, stamp_ns, points))
        return False

    def problems(self) -> list[Problem]:
        """The topics that were left out; nothing is lost by that."""
        return [
            Problem(
                topic,
                ProblemKind.ROLE,
                f"{topic} repeats points of {original}, as the output of a filter does: it is left "
                f"out; --topic lidar={topic} uses it instead.",
                lost=False,
            )
            for topic, original in sorted(self.original.items())
        ]


def _shares_points(a: F32, b: F32) -> bool:
    few, many = (a, b) if len(a) <= len(b) else (b, a)
    if len(few) < _FEWEST:
        return False
    sample = few[:: max(1, len(few) // _SAMPLE)]
    distance, _ = cKDTree(many).query(sample, distance_upper_bound=_SAME)
    return float(np.mean(np.isfinite(distance))) > _SHARE
