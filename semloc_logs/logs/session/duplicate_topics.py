"""One LIDAR published twice, as measured and filtered: found by points that are the same, whatever
the topics are called.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from scipy.spatial import cKDTree

from semloc_logs.frames import F32

_REMEMBERED = 4  # clouds of all topics that a new one is compared with
_TRIES = 8  # comparisons of two topics before they count as two sensors
_SAMPLE = 300
# m; two sensors do not measure the same point so closely, a filter passes it on unchanged
_SAME = 2e-3
_SHARE = 0.2  # of the points are the same; a voxel filter moves those of full cells
_NEAR_NS = 500_000_000


class Copies:
    """Which topics repeat the points of another; the one whose clouds come first is the original."""

    def __init__(self) -> None:
        self.original: dict[str, str] = {}
        self._newest: deque[tuple[str, int, F32]] = deque(maxlen=_REMEMBERED)
        self._tries: dict[tuple[str, str], int] = {}

    def is_copy(self, topic: str, stamp_ns: int, points: F32) -> bool:
        """Whether ``topic`` is known to be a copy, after a look at ``points`` (n, 3): a cloud of it
        in the base frame.
        """
        if topic in self.original:
            return True
        for other, stamp, theirs in self._newest:
            if other == topic or abs(stamp - stamp_ns) > _NEAR_NS:
                continue
            pair = (min(topic, other), max(topic, other))
            self._tries[pair] = self._tries.get(pair, 0) + 1
            if self._tries[pair] <= _TRIES and _shares_points(points, theirs):
                self.original[topic] = other
                return True
        self._newest.append((topic, stamp_ns, points))
        return False

    def sentences(self) -> list[str]:
        """What was left out, one sentence a topic."""
        return [
            f"{topic} repeats points of {original}, as a filter's output does: it is left out; --topic lidar={topic} uses it instead."
            for topic, original in sorted(self.original.items())
        ]


def _shares_points(a: F32, b: F32) -> bool:
    few, many = (a, b) if len(a) <= len(b) else (b, a)
    if len(few) < 10:
        return False
    distance, _ = cKDTree(many).query(
        few[:: max(1, len(few) // _SAMPLE)], distance_upper_bound=_SAME
    )
    return float(np.mean(np.isfinite(distance))) > _SHARE
