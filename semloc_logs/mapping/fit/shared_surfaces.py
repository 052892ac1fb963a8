"""Whether the clouds of two range sensors of one vehicle lie on the same surfaces.

Each sensor fits the poses alone where its mounting is shifted, as along the way or in its height.
Where both see the same surfaces, clouds of both show how far their mountings differ.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.mapping.fit.findings import LEAST_PAIRS, LEAST_SIGMAS, NEAR_VOXELS, WRONG
from semloc_logs.mapping.fit.keyframe_pairs import (
    Clouds,
    Registered,
    Registrar,
    Start,
    motion,
    registered,
)
from semloc_logs.mapping.fit.model import (
    OUTLIER,
    PARAMETERS,
    PosesAt,
    difference,
    pose_motion,
    scatter,
)
from semloc_logs.mapping.fit.way import BETTER
from semloc_logs.numerics.evenly import evenly
from semloc_logs.numerics.transforms import exp_se3

PAIRS = 24
LONGEST_NS = 500_000_000  # between the clouds of a pair
SHARED = 0.15  # of the points of one lie on planes of the other
ROUNDS = 5  # of the weights of pairs that are off
# walls lie on themselves along a street: surfaces across show a shift, from nearby alone, so it is
# searched in these steps, up to so far (voxels), by so many pairs
STEP, FARTHEST, TRIED = 0.3, 10.0, 6
LEAST_SHOWN = np.array([0.01] * 3 + [0.002] * 3)  # m and rad, of a standard deviation
UNTURNED = np.zeros(3)  # rotation vector
MOST_STARTS = 8  # registrations, each from the offset of the one before


@dataclass(frozen=True, slots=True, eq=False)
class Offset:
    """How the mounting of a sensor has to move beside another one.

    By ``shift`` (3,) (m) and ``turn`` (3,) (rotation vector) in the base frame, 0 where it is not
    sure or does not matter; ``sigma`` (6,) are the standard deviations.
    """

    shift: F64
    turn: F64
    sigma: F64

    def without(self, direction: F64 | None, voxel: float) -> Offset:
        """The offset where ranges along a unit ``direction`` (3,) have a bias, as of a camera."""
        if direction is None:
            return self
        across = self.shift - (self.shift @ direction) * direction
        is_off = float(np.linalg.norm(across)) >= WRONG * voxel
        return replace(self, shift=self.shift if is_off else np.zeros(3))

    def __bool__(self) -> bool:
        return bool(self.shift.any() or self.turn.any())


NO_OFFSET = Offset(np.zeros(3), np.zeros(3), np.zeros(6))


def offset_between(clouds: Clouds, others: Clouds, poses_at: PosesAt) -> Offset:
    """How the mounting of ``others`` has to move beside the one of ``clouds``.

    Both are streams of one session. Nothing is known where they see few surfaces in common.
    """
    both, numbers = _pairs(clouds, others)
    if len(numbers) < LEAST_PAIRS:
        return NO_OFFSET
    registration = registered(both, numbers)
    if len(registration.pairs) < LEAST_PAIRS or float(np.median(registration.share)) < SHARED:
        return NO_OFFSET
    shift = _searched(both, registration)
    if shift.any():
        registration = registered(both, numbers, _start(both, np.r_[shift, np.zeros(3)]))
        if len(registration.pairs) < LEAST_PAIRS:
            return NO_OFFSET
    offset, sigma = _offset(registration, poses_at)
    for _ in range(MOST_STARTS):
        before = offset
        if not _is_sure(offset, sigma):
            break
        registration = registered(both, numbers, _start(both, offset))
        if len(registration.pairs) < LEAST_PAIRS:
            return NO_OFFSET
        offset, sigma = _offset(registration, poses_at)
        if (np.abs(offset - before) <= sigma).all():
            break
    known = np.where(np.abs(offset) >= LEAST_SIGMAS * sigma, offset, 0.0)
    shown = np.maximum(sigma, LEAST_SHOWN)
    distance = float(np.linalg.norm(known[:3])) / clouds.voxel
    turned = float(np.linalg.norm(known[3:])) * NEAR_VOXELS
    return Offset(
        known[:3] if distance >= WRONG else np.zeros(3),
        known[3:] if turned >= WRONG else np.zeros(3),
        shown,
    )


def _searched(both: Clouds, registration: Registered) -> F64:
    """A shift (3,) of the second clouds on the level that far more across it shows; else zeros."""
    registrar = Registrar(both)
    distances = np.arange(-FARTHEST, FARTHEST + STEP, STEP) * both.voxel
    best = np.zeros(3)
    most = 1.0
    for direction in np.eye(3)[:2]:
        shares = np.zeros(len(distances))
        usual = 1e-9
        for row in evenly(len(registration.pairs), TRIED).tolist():
            target, source = registration.numbers[row].tolist()
            measured = registration.pairs.measured[row]
            usual += float(registrar.shares_along(target, source, [measured], direction)[0])
            given = motion(both, target, source)
            tried = [given @ exp_se3(distance * direction, UNTURNED) for distance in distances]
            shares += registrar.shares_along(target, source, tried, direction)
        better = float(shares.max()) / usual
        if better > max(BETTER, most):
            most = better
            best = distances[int(np.argmax(shares))] * direction
    return best


def _is_sure(offset: F64, sigma: F64) -> bool:
    return bool((np.abs(offset) >= LEAST_SIGMAS * sigma).any())


def _start(both: Clouds, offset: F64) -> Start:
    """Registration starts where the second cloud is moved by ``offset`` (6,)."""
    moved = exp_se3(offset[:3], offset[3:])
    return lambda target, source: motion(both, target, source) @ moved


def _pairs(clouds: Clouds, others: Clouds) -> tuple[Clouds, list[tuple[int, int]]]:
    """The keyframes of both streams, and pairs of one of each at about the same time."""
    both = Clouds(clouds.collected, np.r_[clouds.rows, others.rows], clouds.voxel)
    count = len(clouds.rows)
    stamps_ns = clouds.stamps_ns()
    other_stamps_ns = others.stamps_ns()
    pairs = []
    for number in evenly(count, PAIRS).tolist():
        apart_ns = np.abs(other_stamps_ns - stamps_ns[number])
        other = int(np.argmin(apart_ns))
        is_known = clouds.pose(number) is not None and others.pose(other) is not None
        if is_known and apart_ns[other] <= LONGEST_NS:
            pairs.append((number, count + other))
    return both, pairs


def _offset(registration: Registered, poses_at: PosesAt) -> tuple[F64, F64]:
    """Translation (m) and rotation vector (rad) of the second clouds, (6,), and their deviations.

    The mean of the pairs, each weighted by its covariance; pairs far off count less and less.
    """
    predicted = pose_motion(registration.pairs, poses_at, np.zeros(PARAMETERS))
    offsets = -difference(registration.pairs.measured, predicted)
    known = np.isfinite(offsets).all(1)
    offsets = offsets[known]
    information = np.linalg.inv(registration.pairs.covariance[known])
    offset = np.median(offsets, axis=0)
    squares = np.zeros(len(offsets))
    hessian = information.sum(0)
    for _ in range(ROUNDS):
        rest = offsets - offset
        squares = np.einsum("ni,nij,nj->n", rest, information, rest)
        weighted = information / (1.0 + squares / OUTLIER**2)[:, None, None]
        hessian = weighted.sum(0)
        offset = np.linalg.solve(hessian, np.einsum("nij,nj->i", weighted, offsets))
    covariance = scatter(squares) * np.linalg.inv(hessian)
    return offset, np.sqrt(np.diag(covariance))
