"""Poses that stand still while the sensor moves: odometry never filled in, or frozen."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from semloc_logs.frames import F32
from semloc_logs.numerics.transforms import Array, apply

_EVERY = 4  # clouds; a vehicle is not looked at more often
_KEPT, _COMPARED = 20_000, 500  # points of the first cloud, and of each that is compared with it
# m, between poses that stand still
_STILL = 0.02
# a cloud has moved when it lies so many times as far from the first one as half of the first lies
# from its other half, and so far (m)
_TIMES, _MARGIN = 1.5, 0.1
# of its points' distances: along a street most surfaces slide over themselves, and a fifth may be
# traffic
_QUANTILE = 0.8
_FEWEST = 100  # points of a cloud that tells anything
_LEAST = 4  # clouds that tell whether the sensor moved


@dataclass(slots=True)
class Stop:
    """Clouds while the poses stood still: the first one, and how far others lie from it.

    ``pose`` is session_T_base, ``first`` (n, 3) are points in the base frame.
    """

    pose: Array
    first: F32
    start_ns: int
    end_ns: int
    seen: int = 1
    tree: cKDTree | None = None
    noise: float = 0.0
    distances: list[float] = field(default_factory=list)

    def compare(self, points: Array) -> None:
        """Take a later cloud (n, 3), in the session frame."""
        if self.tree is None:
            first = apply(self.pose, self.first)
            self.tree = cKDTree(first)
            self.noise = _distance(cKDTree(first[::2]), first[1::2])
        self.distances.append(_distance(self.tree, points))

    @property
    def shift(self) -> float:
        """Distance (m) of moved clouds from the first; 0 unless at least half of them moved."""
        least = _TIMES * self.noise + _MARGIN
        moved = [d for d in self.distances if d > least]
        return max(moved) if 2 * len(moved) >= max(len(self.distances), _LEAST) else 0.0


class Standstill:
    """Compares clouds while the poses do not move with the first one of them."""

    def __init__(self) -> None:
        self._stop: Stop | None = None
        self._worst: Stop | None = None

    @property
    def worst(self) -> Stop | None:
        """The stop in which the surroundings moved most; None where they never did."""
        stops = [s for s in (self._worst, self._stop) if s is not None and s.shift > 0]
        return max(stops, key=lambda stop: stop.shift, default=None)

    @property
    def shift(self) -> float:
        """How far (m) the surroundings moved in it."""
        return 0.0 if self.worst is None else self.worst.shift

    def add(self, points: F32, session_T_base: Array, stamp_ns: int) -> None:
        """Takes the points (n, 3) of a cloud in the base frame.

        Clouds of one time have one pose, which tells nothing: a clock may stand still.
        """
        stop = self._stop
        if len(points) < _FEWEST or (stop is not None and stamp_ns == stop.end_ns):
            return
        is_still = stop is not None and _is_still(stop.pose, session_T_base)
        if stop is None or not is_still:
            self._worst = self.worst
            first = _some(points, _KEPT).copy()
            self._stop = Stop(np.array(session_T_base), first, stamp_ns, stamp_ns)
            return
        stop.seen += 1
        stop.end_ns = stamp_ns
        if stop.seen % _EVERY == 2:
            stop.compare(apply(session_T_base, _some(points, _COMPARED)))


def _is_still(pose: Array, other: Array) -> bool:
    return bool(np.abs(other[:3] - pose[:3]).max() < _STILL)


def _distance(tree: cKDTree, points: Array) -> float:
    distances, _ = tree.query(points)
    return float(np.quantile(distances, _QUANTILE))


def _some(points: F32, count: int) -> F32:
    return points[:: max(1, len(points) // count)]
