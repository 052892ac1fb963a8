"""Pairs of keyframes that are registered with each other, evenly spread over a drive."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64, I64
from semloc_logs.mapping.fit.model import MEDIAN_OF_6, Pairs, difference
from semloc_logs.mapping.fit.plane_cells import (
    Fit,
    PlaneCells,
    register,
    share_along,
    share_at,
)
from semloc_logs.mapping.keyframes import Collected
from semloc_logs.mapping.selection import thin
from semloc_logs.numerics.evenly import evenly
from semloc_logs.numerics.transforms import exp_se3, inverse, rotation_angle

# the second keyframe of a pair has moved so far (voxels), or turned so far (rad)
APART = 6.0
TURNED = 0.17
LONGEST_NS = 3_000_000_000  # between both; odometry of later ones has drifted apart
MOST_POINTS = 1500  # of a source
COARSE, FINE = 4.0, 2.0  # edge of the cells (voxels)
SPEEDS = (1.0, 0.6, 1.4)  # shares of the last speed
LITTLE = 0.9  # of the usual share of points on planes: something is wrong with the start
# a registration is better than another when so many times the points lie on planes
BETTER = 1.1
# standard deviations beside the registration's own: of an edge of a voxel, of the way between both
# (odometry drifts), and of the rotation (rad)
NOISE_VOXELS = 0.05
NOISE_WAY = 0.01
NOISE_ROTATION = 0.003
LOOKED_AT = 5  # keyframes that show the field of view
# mean of the unit directions of the points: 0 all around, with ground below about 0.3, 0.64 over a
# half circle, 0.9 for a camera
ONE_SIDE = 0.6
LEAST_RMS = 0.02  # voxels; distances to planes are not smaller
UNTOLD = 1e-4  # information along a direction that no plane fixes (1/m^2): 100 m, or any angle
KEPT = 128  # keyframes whose planes stay in memory, half a megabyte each at most
LEAST_SHARE = 0.02  # of the points on planes, for a registration
THERE_AND_BACK = 12  # pairs that show the noise of registration
CORRELATED = 12.0  # points of one surface share their error: as many count as one

# numbers of the target and the source of a pair -> where its registration starts (4, 4)
Start = Callable[[int, int], F64]


@dataclass(frozen=True, eq=False)
class SensorMounting:
    """Where a sensor is all the time: ``base_T_sensor`` (4, 4) of its ``frame``."""

    frame: str
    base_T_sensor: F64


@dataclass(frozen=True, eq=False)
class Clouds:
    """The keyframes of one stream: ``rows`` of ``collected``, ``voxel`` is the voxel size (m).

    ``span``: from the first to the last point of a sweep (s), 0 without times of points.
    ``time_offset``: what the settings add to the stamps already (s). ``mounted``: None where the
    sensor moves in the base frame, or has several frames.
    """

    collected: Collected
    rows: I64
    voxel: float
    span: float = 0.0
    time_offset: float = 0.0
    mounted: SensorMounting | None = None

    def stamps_ns(self) -> I64:
        """Their stamps (n,)."""
        return np.array([self.collected.headers[r].stamp_ns for r in self.rows], np.int64)

    def frames(self) -> set[str]:
        """The frames that they were measured in."""
        return {self.collected.headers[r].frame_id for r in self.rows}

    def points(self, number: int) -> F64:
        """Points (n, 3) of a keyframe in the base frame."""
        return self.collected.load(int(self.rows[number]))[0].astype(float)

    @cached_property
    def some_points(self) -> Callable[[int], F64]:
        """As :meth:`points`, thinned to what a registration moves; the last ones are kept."""
        return lru_cache(maxsize=KEPT)(self._thinned)

    @cached_property
    def planes(self) -> Callable[[int], tuple[PlaneCells, PlaneCells]]:
        """The planes of a keyframe, in coarse and in fine cells; the last ones are kept."""
        return lru_cache(maxsize=KEPT)(self._planes)

    def _planes(self, number: int) -> tuple[PlaneCells, PlaneCells]:
        points = self.points(number)
        coarse = PlaneCells.of(points, COARSE * self.voxel)
        return coarse, PlaneCells.of(points, FINE * self.voxel)

    def _thinned(self, number: int) -> F64:
        points = self.collected.load(int(self.rows[number]))[0]
        points = points[thin(points, self.voxel)]
        return points[:: max(1, len(points) // MOST_POINTS)].astype(float)

    @cached_property
    def rates(self) -> tuple[float, float]:
        """Speed (m/s) and turn rate (rad/s) that the drive reaches in a tenth of its steps."""
        stamps_ns = self.stamps_ns()
        speeds = []
        turn_rates = []
        for number in range(len(self.rows) - 1):
            seconds = (stamps_ns[number + 1] - stamps_ns[number]) * 1e-9
            if self.pose(number) is None or self.pose(number + 1) is None or seconds <= 0:
                continue
            moved = motion(self, number, number + 1)
            speeds.append(float(np.linalg.norm(moved[:3, 3])) / seconds)
            turn_rates.append(rotation_angle(moved[:3, :3]) / seconds)
        if not speeds:
            return 0.0, 0.0
        return float(np.quantile(speeds, 0.9)), float(np.quantile(turn_rates, 0.9))

    def mounting(self) -> F64:
        """The sensor (3,) in the base frame, as the log gives it."""
        origins = np.array([self.collected.origins[r] for r in self.rows], float)
        return np.asarray(np.median(origins, axis=0))

    def sees_one_side(self) -> bool:
        """Whether the sensor has a narrow field of view: its points lie on one side of it."""
        return float(np.linalg.norm(self._mean_direction)) > ONE_SIDE

    def view_direction(self) -> F64 | None:
        """Unit vector (3,) in the base frame where a narrow field of view points; else None."""
        if not self.sees_one_side():
            return None
        return np.asarray(self._mean_direction / np.linalg.norm(self._mean_direction))

    @cached_property
    def _mean_direction(self) -> F64:
        """Mean (3,) of the unit directions of the points, in the keyframe of the median one."""
        resultants = []
        for number in np.unique(np.linspace(0, len(self.rows) - 1, LOOKED_AT).astype(np.int64)):
            points, _, _ = self.collected.load(int(self.rows[number]))
            rays = points - self.collected.origins[int(self.rows[number])]
            lengths = np.linalg.norm(rays, axis=1)
            directions = rays[lengths > 0] / lengths[lengths > 0, None]
            resultants.append(directions.mean(0) if len(directions) else np.zeros(3))
        if not resultants:
            return np.zeros(3)
        lengths = np.linalg.norm(resultants, axis=1)
        return np.asarray(resultants[int(np.argsort(lengths)[len(lengths) // 2])])

    def pose(self, number: int) -> F64 | None:
        """``session_T_base`` (4, 4) as the poses of the log give it."""
        return self.collected.poses[int(self.rows[number])]


def choose(clouds: Clouds, most: int) -> list[tuple[int, int]]:
    """Numbers of the target and the source of at most so many pairs, evenly spread.

    The source is the first keyframe after the target that has moved or turned far enough.
    """
    stamps_ns = clouds.stamps_ns()
    chosen = []
    for target in range(len(clouds.rows) - 1):
        source = _partner(clouds, stamps_ns, target)
        if source is not None:
            chosen.append((target, source))
    if len(chosen) <= most:
        return chosen
    return [chosen[i] for i in evenly(len(chosen), most)]


def _partner(clouds: Clouds, stamps_ns: I64, target: int) -> int | None:
    from_pose = clouds.pose(target)
    if from_pose is None:
        return None
    last = None
    for source in range(target + 1, len(stamps_ns)):
        pose = clouds.pose(source)
        if pose is None or stamps_ns[source] - stamps_ns[target] > LONGEST_NS:
            break
        last = source
        moved = inverse(from_pose) @ pose
        is_apart = float(np.linalg.norm(moved[:3, 3])) >= APART * clouds.voxel
        if is_apart or rotation_angle(moved[:3, :3]) >= TURNED:
            break
    return last


@dataclass(frozen=True, slots=True, eq=False)
class Registered:
    """Registered ``pairs`` of the keyframes ``numbers`` (n, 2).

    ``share`` (n,) of the points lies on planes, ``given_share`` by the poses of the log.
    """

    pairs: Pairs
    numbers: I64
    share: F64
    given_share: F64


class Registrar:
    """Registers pairs of one stream."""

    def __init__(self, clouds: Clouds) -> None:
        self._clouds = clouds

    def fit(self, target: int, source: int, starts: list[F64]) -> Fit:
        """The best fit of the source from ``starts`` (4, 4); an earlier one where equal."""
        coarse, fine = self._clouds.planes(target)
        points = self._clouds.some_points(source)
        best: Fit | None = None
        for start in starts:
            moved = register(fine, points, register(coarse, points, start).target_T_source)
            if best is None or moved.share > BETTER * best.share:
                best = moved
        assert best is not None, "a registration needs a start"
        return best

    def shares(self, target: int, source: int, poses: Sequence[F64]) -> F64:
        """The share of the source's points that lies on planes at each of ``poses`` (4, 4)."""
        planes = self._clouds.planes(target)[1]
        points = self._clouds.some_points(source)
        return np.array([share_at(planes, points, pose) for pose in poses])

    def shares_along(self, target: int, source: int, poses: Sequence[F64], direction: F64) -> F64:
        """As :meth:`shares`, of what shows a motion along a unit ``direction`` (3,)."""
        planes = self._clouds.planes(target)[1]
        points = self._clouds.some_points(source)
        return np.array([share_along(planes, points, pose, direction) for pose in poses])


def covariance_of(fit: Fit, voxel: float) -> F64:
    """Covariance (6, 6) of a registration and of the odometry that it is compared with."""
    sigma = max(fit.rms, LEAST_RMS * voxel)
    information = fit.information / (CORRELATED * sigma**2)
    way = float(np.linalg.norm(fit.target_T_source[:3, 3]))
    noise = NOISE_VOXELS * voxel + NOISE_WAY * way
    spread = np.diag([noise**2] * 3 + [NOISE_ROTATION**2] * 3)
    # where the scene does not tell, the pair counts nothing
    covariance = np.linalg.inv(information + UNTOLD * np.eye(6)) + spread
    return np.asarray(0.5 * (covariance + covariance.T))


def registered(
    clouds: Clouds, numbers: Sequence[tuple[int, int]], start: Start | None = None
) -> Registered:
    """The pairs ``numbers`` registered from the motion that the poses give.

    ``start`` gives another, which is preferred. Where few points lie on planes then, speeds about
    the one of the last pair that fitted are tried, too.
    """
    registrar = Registrar(clouds)
    stamps_ns = clouds.stamps_ns()
    fits = []
    given_shares = []
    for target, source in numbers:
        given = motion(clouds, target, source)
        starts = [given] if start is None else [start(target, source), given]
        fits.append(registrar.fit(target, source, starts))
        given_shares.append(float(registrar.shares(target, source, [given])[0]))
    usual = float(np.median([fit.share for fit in fits])) if fits else 0.0
    last: F64 | None = None
    for i, (target, source) in enumerate(numbers):
        seconds = (stamps_ns[source] - stamps_ns[target]) * 1e-9
        if seconds <= 0:  # clouds of two sensors
            continue
        if last is not None and fits[i].share < LITTLE * usual:
            speeds = [_moved(factor * last, seconds) for factor in SPEEDS]
            again = registrar.fit(target, source, speeds)
            if again.share > BETTER * fits[i].share:
                fits[i] = again
        if fits[i].share >= LITTLE * usual:
            last = _rate(fits[i].target_T_source, seconds)
    return _kept(clouds, numbers, fits, np.array(given_shares))


def noise(clouds: Clouds, registration: Registered) -> float:
    """How many times the squares of registrations are as large as their covariances have them; 1 at
    least.

    The sensor shows it without poses: some pairs are registered there and back, each time with the
    planes of the other cloud.
    """
    registrar = Registrar(clouds)
    rows = evenly(len(registration.pairs), THERE_AND_BACK)
    squares = []
    for row in rows.tolist():
        target, source = registration.numbers[row].tolist()
        there = registration.pairs.measured[row]
        back = inverse(registrar.fit(source, target, [inverse(there)]).target_T_source)
        off = difference(there[None], back[None])[0]
        squares.append(float(off @ np.linalg.solve(2 * registration.pairs.covariance[row], off)))
    return max(1.0, float(np.median(squares)) / MEDIAN_OF_6)


def _kept(
    clouds: Clouds, numbers: Sequence[tuple[int, int]], fits: Sequence[Fit], given_shares: F64
) -> Registered:
    """The pairs of which enough points lie on planes."""
    rows = [i for i, fit in enumerate(fits) if fit.share >= LEAST_SHARE]
    kept = np.array([numbers[i] for i in rows], np.int64).reshape(-1, 2)
    pairs = Pairs(
        clouds.stamps_ns()[kept],
        np.array([fits[i].target_T_source for i in rows]).reshape(-1, 4, 4),
        np.array([covariance_of(fits[i], clouds.voxel) for i in rows]).reshape(-1, 6, 6),
    )
    return Registered(pairs, kept, np.array([fits[i].share for i in rows]), given_shares[rows])


def _rate(motion: F64, seconds: float) -> F64:
    """Translation (m/s) and rotation vector (rad/s) of a motion, (6,)."""
    turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    return np.asarray(np.concatenate([motion[:3, 3], turn]) / seconds)


def _moved(rate: F64, seconds: float) -> F64:
    """The motion (4, 4) at a steady ``rate`` (6,)."""
    return exp_se3(rate[:3] * seconds, rate[3:] * seconds)


def motion(clouds: Clouds, target: int, source: int) -> F64:
    """``target_T_source`` (4, 4) by the poses of the log."""
    from_pose = clouds.pose(target)
    to_pose = clouds.pose(source)
    assert from_pose is not None, "a chosen pair has poses"
    assert to_pose is not None, "a chosen pair has poses"
    return inverse(from_pose) @ to_pose
