"""Poses that stand still while the sensor moves: odometry never filled in, or frozen."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from semloc_logs.arrays import F32, F64
from semloc_logs.numerics.transforms import apply, rotation_angle

_EVERY = 4  # clouds; a vehicle is not looked at more often
_KEPT, _COMPARED = 20_000, 500  # points of the first cloud, and of each that is compared with it
# m, between poses that stand still
STILL = 0.02
# m, along one axis beside that: of positions in degrees the altitude is in metres
_LIFT = 0.3
_TURNED = 0.1  # rad; a sensor that has turned farther sees other surroundings
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
    """Clouds while the positions stood still, and how far they lie from an earlier one.

    ``position`` (3,) is where they stood. ``pose`` is session_T_base of the earlier one, ``first``
    (n, 3) are its points in the base frame; where the poses turn, it is replaced by a later one.
    ``shifts`` are distances (m) of clouds that have moved, 0 of others.
    """

    position: F64
    pose: F64
    first: F32
    start_ns: int
    end_ns: int
    seen: int = 1
    tree: cKDTree | None = None
    noise: float = 0.0
    shifts: list[float] = field(default_factory=list)

    def begin(self, pose: F64, points: F32) -> None:
        """Compare from now on with the points (n, 3) of another cloud, in the base frame."""
        self.pose = np.array(pose)
        self.first = _evenly_chosen(points, _KEPT).copy()
        self.tree = None

    def compare(self, points: F64) -> None:
        """Take a later cloud (n, 3), in the session frame."""
        if self.tree is None:
            first = apply(self.pose, self.first)
            self.tree = cKDTree(first)
            self.noise = _distance(cKDTree(first[::2]), first[1::2])
        distance = _distance(self.tree, points)
        self.shifts.append(distance if distance > _TIMES * self.noise + _MARGIN else 0.0)

    @property
    def shift(self) -> float:
        """Distance (m) of the farthest cloud that moved; 0 unless at least half of them moved."""
        moved = [shift for shift in self.shifts if shift > 0]
        return max(moved) if 2 * len(moved) >= max(len(self.shifts), _LEAST) else 0.0


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

    def add(self, points: F32, session_T_base: F64, stamp_ns: int) -> None:
        """Takes the points (n, 3) of a cloud in the base frame.

        Clouds of one time have one pose, which tells nothing: a clock may stand still.
        """
        stop = self._stop
        if len(points) < _FEWEST or (stop is not None and stamp_ns == stop.end_ns):
            return
        if stop is None or not _is_still(stop.position, session_T_base):
            self._worst = self.worst
            first = _evenly_chosen(points, _KEPT).copy()
            position = np.array(session_T_base[:3, 3])
            self._stop = Stop(
                position, np.array(session_T_base), first, start_ns=stamp_ns, end_ns=stamp_ns
            )
            return
        stop.seen += 1
        stop.end_ns = stamp_ns
        if rotation_angle(stop.pose[:3, :3].T @ session_T_base[:3, :3]) > _TURNED:
            stop.begin(session_T_base, points)
        elif stop.seen % _EVERY == 2:
            stop.compare(apply(session_T_base, _evenly_chosen(points, _COMPARED)))


def _is_still(position: F64, pose: F64) -> bool:
    way = np.sort(np.abs(pose[:3, 3] - position))
    return bool(way[1] < STILL and way[2] < _LIFT)


def _distance(tree: cKDTree, points: F64) -> float:
    distances, _ = tree.query(points)
    return float(np.quantile(distances, _QUANTILE))


def _evenly_chosen(points: F32, count: int) -> F32:
    return points[:: max(1, len(points) // count)]
