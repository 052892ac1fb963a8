"""Starts of registration that faults make of the poses: other axes, units, clocks.

A fault such as another convention of axes or another clock makes a start from the poses exactly.
Registration from the motion that wrong poses give may end anywhere; from such a start it need not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from semloc_logs.mapping.fit.model import LONGEST_OFFSET, OFFSET_STEP, PosesAt
from semloc_logs.mapping.fit.pairs import Clouds, Registered, Registrar, Start, motion
from semloc_logs.numerics.transforms import inverse

F64 = NDArray[np.float64]

TRIED = 4  # pairs that show whether another start is better
# another start is better when so many times the points lie on planes as by the poses, and hardly
# less than where registration from the poses ended
BETTER_START = 1.15
AS_GOOD = 0.9


def better_start(
    clouds: Clouds, poses_at: PosesAt, found: Registered, squares: F64
) -> Start | None:
    """The start that brings far more points onto planes than the poses do.

    It is tried on the few pairs that contradict the poses most, by ``squares`` (n,), and on as many
    evenly spread.
    """
    worst = np.argsort(-squares, kind="stable")[:TRIED]
    evenly = np.linspace(0, len(squares) - 1, TRIED).round().astype(np.int64)
    rows = np.union1d(worst, evenly)
    starts = [*_of_motion(clouds), *_of_clocks(clouds, poses_at)]
    registrar = Registrar(clouds)
    shares = np.zeros(len(starts))
    for target, source in found.numbers[rows].tolist():
        motions = [start(target, source) for start in starts]
        shares += registrar.shares(target, source, motions)
    best = int(np.argmax(shares))
    by_poses = float(found.given_share[rows].sum())
    registered = float(found.share[rows].sum())
    is_better = shares[best] > max(BETTER_START * by_poses, AS_GOOD * registered, 1e-9)
    return starts[best] if is_better else None


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
