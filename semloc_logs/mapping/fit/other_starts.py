"""Starts of registration that faults make of the poses: other axes, units, clocks.

A fault such as another convention of axes or another clock makes a start from the poses exactly.
Registration from the motion that wrong poses give may end anywhere; from such a start it need not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64, I64
from semloc_logs.mapping.fit.keyframe_pairs import Clouds, Registered, Registrar, Start, motion
from semloc_logs.mapping.fit.model import LONGEST_OFFSET, OFFSET_STEP, PosesAt
from semloc_logs.mapping.fit.readings import CONVENTIONS, otherwise_written, with_other_axes
from semloc_logs.numerics.evenly import evenly
from semloc_logs.numerics.transforms import inverse

TRIED = 4  # pairs that show whether another start is better
MOST_STARTS = 3  # other motions to start registration from
# a motion is better when so many times the points lie on planes as where registration ended
BETTER = 1.15
# another reading of the poses is better when they are so many times as many as by the poses, and
# hardly fewer than where registration ended, which may be a motion that the sensor cannot tell from
# the right one
BETTER_THAN_POSES, AS_GOOD = 1.15, 0.8


@dataclass(frozen=True, slots=True, eq=False)
class Doubted:
    """The pairs that show whether another start is better.

    They are few: the ones that contradict the poses most, and as many evenly spread. ``share`` and
    ``given_share`` are sums as in :class:`~semloc_logs.mapping.fit.keyframe_pairs.Registered`.
    """

    clouds: Clouds
    numbers: I64
    share: float
    given_share: float

    @staticmethod
    def of(clouds: Clouds, registration: Registered, squares: F64) -> Doubted:
        """Those of ``registration``, with their squared distances (n,) to the poses."""
        worst = np.argsort(-squares, kind="stable")[:TRIED]
        rows = np.union1d(worst, evenly(len(squares), TRIED))
        share, given_share = (
            float(s[rows].sum()) for s in (registration.share, registration.given_share)
        )
        return Doubted(clouds, registration.numbers[rows], share, given_share)

    def motions(self) -> list[Start]:
        """Other axes, units or none at all, where they bring far more points onto planes.

        The best one and the ones that are nearly as good: few beams draw the same rings on the
        ground in all clouds, which lie on themselves without any motion.
        """
        starts = _of_motion(self.clouds)
        shares = self._shares(starts)
        if shares.max() <= max(BETTER * self.share, 1e-9):
            return []
        order = np.argsort(-shares, kind="stable")[:MOST_STARTS]
        return [starts[i] for i in order if shares[i] > AS_GOOD * shares.max()]

    def other_poses(self, poses_at: PosesAt) -> Start | None:
        """The poses at other times, mirrored, inverted or written by another convention, where far
        more points lie on planes.
        """
        starts = [
            _of_inverted(self.clouds),
            *_of_conventions(self.clouds),
            *_of_clocks(self.clouds, poses_at),
            *_of_mirrors(self.clouds),
        ]
        shares = self._shares(starts)
        least = max(BETTER_THAN_POSES * self.given_share, AS_GOOD * self.share, 1e-9)
        return starts[int(np.argmax(shares))] if shares.max() > least else None

    def _shares(self, starts: list[Start]) -> F64:
        """The points on planes (n,) from each start, as shares summed over the pairs."""
        registrar = Registrar(self.clouds)
        shares = np.zeros(len(starts))
        for target, source in self.numbers.tolist():
            motions = [start(target, source) for start in starts]
            shares += registrar.shares(target, source, motions)
        return shares


def _of_motion(clouds: Clouds) -> list[Start]:
    """Motions that faults make of a given one: none, its inverse, other units, other axes."""

    def start(change: Callable[[F64], F64]) -> Start:
        return lambda target, source: change(motion(clouds, target, source))

    axes = Rotation.create_group("O").as_matrix()
    return [
        start(lambda _: np.eye(4)),
        start(inverse),
        *(start(_scaled(factor)) for factor in (0.1, 0.5, 2.0, 10.0)),
        *(start(_turned(rotation)) for rotation in axes if np.trace(rotation) < 2.9),
    ]


def _scaled(factor: float) -> Callable[[F64], F64]:
    def change(motion: F64) -> F64:
        out = motion.copy()
        out[:3, 3] *= factor
        return out

    return change


def _turned(rotation: F64) -> Callable[[F64], F64]:
    mounting = np.eye(4)
    mounting[:3, :3] = rotation
    return lambda motion: inverse(mounting) @ motion @ mounting


def _of_inverted(clouds: Clouds) -> Start:
    """The motion by poses that are of the fixed frame in the frame of the vehicle."""

    def start(target: int, source: int) -> F64:
        from_pose = clouds.pose(target)
        to_pose = clouds.pose(source)
        assert from_pose is not None, "a chosen pair has poses"
        assert to_pose is not None, "a chosen pair has poses"
        return np.asarray(from_pose @ inverse(to_pose))

    return start


def _of_conventions(clouds: Clouds) -> Iterator[Start]:
    """Motions by poses whose rotations or positions were written by another convention."""
    for number in range(CONVENTIONS):

        def start(target: int, source: int, number: int = number) -> F64:
            pair = np.array([clouds.pose(target), clouds.pose(source)])
            motions = [*otherwise_written(pair[None]), *with_other_axes(pair[None])]
            return np.asarray(motions[number][0][0])

        yield start


def _of_mirrors(clouds: Clouds) -> Iterator[Start]:
    """Motions of clouds with an axis that points the other way."""
    for axis in range(3):
        flip = np.diag([-1.0 if k == axis else 1.0 for k in range(4)])

        def start(target: int, source: int, flip: F64 = flip) -> F64:
            return np.asarray(flip @ motion(clouds, target, source) @ flip)

        yield start


def _of_clocks(clouds: Clouds, poses_at: PosesAt) -> Iterator[Start]:
    """Motions by the poses at other times; as given where a pose is unknown."""
    stamps_ns = clouds.stamps_ns()
    steps = round(LONGEST_OFFSET / OFFSET_STEP)
    for step in range(-steps, steps + 1):
        shift_ns = round(step * OFFSET_STEP * 1e9)

        def start(target: int, source: int, shift_ns: int = shift_ns) -> F64:
            poses, known = poses_at(stamps_ns[[target, source]] + shift_ns)
            if not known.all():
                return motion(clouds, target, source)
            return np.asarray(inverse(poses[0]) @ poses[1])

        if shift_ns:
            yield start
