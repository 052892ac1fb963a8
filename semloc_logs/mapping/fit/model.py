"""What is wrong between poses and range data: a few hypotheses, fitted to registered pairs.

Clouds of a pair were registered with each other, which gives their motion as the range data show
it; the poses give another. A clock offset, a wrong mounting (rotation, lever arm) and a wrong scale
each leave a trace of their own in the difference, as in the calibration of hand and eye (Tsai and
Lenz, A new technique for fully autonomous and efficient 3D robotics hand/eye calibration, 1989; for
time offsets Furgale et al., Unified temporal and spatial calibration, 2013).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64, I64, Bools
from semloc_logs.numerics.transforms import inverse

# session_T_base (n, 4, 4) at stamps (n,), and which are known (n,)
PosesAt = Callable[[I64], tuple[F64, Bools]]

CLOCK = 0  # positions of the parameters
ROTATION = slice(1, 4)
LEVER = slice(4, 7)
SCALE = 7
PARAMETERS = 8

LONGEST_OFFSET = 3.0  # s; stamps that are farther off are found by their log times
OFFSET_STEP = 0.1  # s, of the search for a clock offset
PRIOR = np.array([3.0, *[1.5] * 3, *[5.0] * 3, 1.0])  # standard deviations: s, rad, m, log
STEPS = np.array([0.01, *[1e-3] * 3, *[1e-3] * 3, 1e-3])  # of the numeric derivatives
OUTLIER = 4.0  # standard deviations; pairs beyond count less and less (Cauchy)
ITERATIONS = 8
LEAST_AGREEMENT = 2.0  # of the median ratio of lengths, in median deviations of the pairs from it
MEDIAN_OF_6 = 5.348  # of chi squared with six degrees of freedom
# the covariances of pairs allow for poor odometry; good pairs scatter by a tenth of it. As many
# pairs as these are taken to scatter as expected, beside the real ones
EXPECTED_PAIRS = 3


class Fault(Enum):
    """A hypothesis, and the parameters that it leaves free."""

    CLOCK = "clock"
    ROTATION = "rotation"
    LEVER = "lever"
    SCALE = "scale"

    @property
    def columns(self) -> I64:
        """Its parameters."""
        return np.array(_COLUMNS[self.value], np.int64)


_ALL = range(PARAMETERS)
_COLUMNS = {"clock": [CLOCK], "rotation": _ALL[ROTATION], "lever": _ALL[LEVER], "scale": [SCALE]}


@dataclass(frozen=True, eq=False)
class Pairs:
    """Registered pairs of clouds of one stream.

    ``stamps_ns`` (n, 2) of target and source; ``measured`` (n, 4, 4) their ``target_T_source`` by
    the range data, in the base frame as the mounting gives it; ``covariance`` (n, 6, 6) of it,
    translation (m) and rotation (rad).
    """

    stamps_ns: I64
    measured: F64
    covariance: F64

    @cached_property
    def _whiten(self) -> F64:
        """Matrices (n, 6, 6) that turn differences into standard deviations."""
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.covariance)))

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def some(self, rows: I64) -> Pairs:
        """The pairs ``rows`` alone."""
        return Pairs(self.stamps_ns[rows], self.measured[rows], self.covariance[rows])

    @cached_property
    def _motions(self) -> dict[int, tuple[F64, Bools]]:
        return {}

    def motion(self, poses_at: PosesAt, shift_ns: int) -> tuple[F64, Bools]:
        """``target_T_source`` (n, 4, 4) by the poses at shifted stamps, and which are known (n,).

        Few shifts are tried many times, so they are kept; ``poses_at`` is always the same.
        """
        if shift_ns not in self._motions:
            poses, known = self.poses(poses_at, shift_ns)
            self._motions[shift_ns] = inverse(poses[:, 0]) @ poses[:, 1], known
        return self._motions[shift_ns]

    def poses(self, poses_at: PosesAt, shift_ns: int = 0) -> tuple[F64, Bools]:
        """``session_T_base`` (n, 2, 4, 4) of target and source, and where both are known (n,)."""
        poses, known = poses_at((self.stamps_ns + shift_ns).ravel())
        return poses.reshape(-1, 2, 4, 4), np.asarray(known.reshape(-1, 2).all(1))

    def residuals(self, predicted: F64) -> F64:
        """Differences (n, 6) to ``predicted`` (n, 4, 4), in standard deviations."""
        off = difference(self.measured, predicted)
        return np.asarray(np.einsum("nij,nj->ni", self._whiten, off))

    def squares(self, predicted: F64) -> F64:
        """Squared Mahalanobis distances (n,) to ``predicted`` (n, 4, 4)."""
        return np.asarray((self.residuals(predicted) ** 2).sum(1))


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Parameters with the ``free`` ones fitted, their covariance (8, 8), zero for the others.

    ``cost`` is robust, half of chi squared for few outliers; ``squares`` (n,) are the squared
    Mahalanobis distances of the pairs, nan where a pose is unknown.
    """

    parameters: F64
    free: I64
    covariance: F64
    cost: float
    squares: F64

    def sigma(self, column: int) -> float:
        """Standard deviation of a parameter."""
        return float(np.sqrt(max(self.covariance[column, column], 0.0)))


def pose_motion(pairs: Pairs, poses_at: PosesAt, parameters: F64) -> F64:
    """``target_T_source`` (n, 4, 4) as range data would show it, by the poses and ``parameters``.

    An offset of the clock explains nothing where it leads out of the poses: the motion is as it was
    there. nan where a pose is unknown without an offset, too.
    """
    shifted, is_reached = pairs.motion(poses_at, round(float(parameters[CLOCK]) * 1e9))
    unshifted, known = pairs.motion(poses_at, 0)
    motion = np.where(is_reached[:, None, None], shifted, unshifted)
    known = known | is_reached
    motion[:, :3, 3] *= np.exp(parameters[SCALE])
    mounting = np.eye(4)
    mounting[:3, :3] = Rotation.from_rotvec(parameters[ROTATION]).as_matrix()
    mounting[:3, 3] = parameters[LEVER]
    motion = inverse(mounting) @ motion @ mounting
    motion[~known] = np.nan
    return motion


def difference(measured: F64, predicted: F64) -> F64:
    """Translation (m) and rotation vector (rad) from ``measured`` to ``predicted``, (n, 6)."""
    known = np.isfinite(predicted[:, 0, 0])
    out = np.full((len(measured), 6), np.nan)
    step = inverse(measured[known]) @ predicted[known]
    out[known, :3] = step[:, :3, 3]
    out[known, 3:] = Rotation.from_matrix(step[:, :3, :3]).as_rotvec()
    return out


def fit(pairs: Pairs, poses_at: PosesAt, free: I64, start: F64) -> Estimate:
    """The ``free`` parameters that explain the pairs best, from ``start`` (8,) on."""

    def residuals(parameters: F64) -> F64:
        return pairs.residuals(pose_motion(pairs, poses_at, parameters))

    parameters = start.copy()
    best = cost_of(residuals(parameters)) + _prior(parameters, free)
    damping = 1e-3
    for _ in range(ITERATIONS if len(free) else 0):
        hessian, gradient = _equations(residuals, parameters, free)
        step = np.zeros(PARAMETERS)
        step[free] = -np.linalg.solve(hessian + damping * np.diag(np.diag(hessian)), gradient)
        cost = cost_of(residuals(parameters + step)) + _prior(parameters + step, free)
        if cost < best:
            is_small = best - cost < 1e-3
            parameters = parameters + step
            best = cost
            damping /= 10
            if is_small:
                break
        else:
            damping *= 100
    covariance = np.zeros((PARAMETERS, PARAMETERS))
    squares = np.asarray((residuals(parameters) ** 2).sum(1))
    if len(free):
        hessian, _ = _equations(residuals, parameters, free)
        covariance[np.ix_(free, free)] = scatter(squares) * np.linalg.inv(hessian)
    return Estimate(parameters, free, covariance, best, squares)


def scatter(squares: F64) -> float:
    """How many times the squared distances (n,) of pairs are as large as their covariances have it.

    Below 1 as far as the pairs show it: :data:`EXPECTED_PAIRS` more count as expected.
    """
    known = int(np.isfinite(squares).sum())
    if not known:
        return 1.0
    ratio = float(np.nanmedian(squares)) / MEDIAN_OF_6
    return max(ratio, (EXPECTED_PAIRS + known * ratio) / (EXPECTED_PAIRS + known))


def _equations(residuals: Callable[[F64], F64], parameters: F64, free: I64) -> tuple[F64, F64]:
    """Hessian (m, m) and gradient (m,) of the cost in the free parameters."""
    r = residuals(parameters)
    jacobian = np.empty((*r.shape, len(free)))
    for k, column in enumerate(free):
        step = np.zeros(PARAMETERS)
        step[column] = STEPS[column]
        ahead = residuals(parameters + step)
        behind = residuals(parameters - step)
        jacobian[..., k] = (ahead - behind) / (2 * STEPS[column])
    known = np.isfinite(jacobian).all((1, 2)) & np.isfinite(r).all(1)
    r = r[known]
    jacobian = jacobian[known]
    weight = 1.0 / (1.0 + (r**2).sum(1) / OUTLIER**2)
    hessian = np.einsum("n,nik,nil->kl", weight, jacobian, jacobian)
    gradient = np.einsum("n,nik,ni->k", weight, jacobian, r)
    prior = 1.0 / PRIOR[free] ** 2
    return hessian + np.diag(prior), gradient + prior * parameters[free]


def cost_of(r: F64) -> float:
    """Cauchy's cost of residuals (n, 6); a pair without a pose costs as much as an outlier."""
    squares = np.where(np.isfinite(r).all(1), (np.nan_to_num(r) ** 2).sum(1), OUTLIER**2)
    return float(0.5 * OUTLIER**2 * np.log1p(squares / OUTLIER**2).sum())


def _prior(parameters: F64, free: I64) -> float:
    return float(0.5 * ((parameters[free] / PRIOR[free]) ** 2).sum())


def starts(pairs: Pairs, poses_at: PosesAt, fault: Fault, given: F64) -> list[F64]:
    """Parameters to begin the fit of a ``fault`` with: as ``given`` (8,), and a guess."""
    guess = given.copy()
    if fault is Fault.CLOCK:
        guess[CLOCK] = _best_offset(pairs, poses_at, given)
    elif fault is Fault.ROTATION:
        guess[ROTATION] = _best_rotation(pairs, poses_at, given)
    elif fault is Fault.SCALE:
        guess[SCALE] = _best_scale(pairs, poses_at, given)
    return [given] if np.array_equal(guess, given) else [given, guess]


def _best_offset(pairs: Pairs, poses_at: PosesAt, given: F64) -> float:
    offsets = np.arange(-LONGEST_OFFSET, LONGEST_OFFSET + 1e-9, OFFSET_STEP)
    costs = []
    for offset in offsets:
        parameters = given.copy()
        parameters[CLOCK] = offset
        costs.append(cost_of(pairs.residuals(pose_motion(pairs, poses_at, parameters))))
    return float(offsets[int(np.argmin(costs))])


def _best_rotation(pairs: Pairs, poses_at: PosesAt, given: F64) -> F64:
    """The cheapest rotation that takes axes to axes, or the one between all motions (Kabsch, 1976).

    Rotations of the second kind come from translations and rotation axes together.
    """
    predicted = pose_motion(pairs, poses_at, given)
    known = np.isfinite(predicted[:, 0, 0])
    if not known.any():
        return given[ROTATION]
    vectors = []
    for motion in (predicted[known], pairs.measured[known]):
        rotations = Rotation.from_matrix(motion[:, :3, :3]).as_rotvec()
        vectors.append(np.concatenate([motion[:, :3, 3], rotations]))
    a, b = vectors
    u, _, vt = np.linalg.svd(a.T @ b)
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    turns = [Rotation.from_matrix(turn), *Rotation.create_group("O")]
    best = given[ROTATION]
    least = np.inf
    for candidate in turns:
        parameters = given.copy()
        parameters[ROTATION] = (Rotation.from_rotvec(given[ROTATION]) * candidate).as_rotvec()
        cost = cost_of(pairs.residuals(pose_motion(pairs, poses_at, parameters)))
        if cost < least:
            least = cost
            best = parameters[ROTATION]
    return best


def _best_scale(pairs: Pairs, poses_at: PosesAt, given: F64) -> float:
    ratios = _log_ratios(pairs, pose_motion(pairs, poses_at, given))
    return float(given[SCALE] + np.median(ratios)) if len(ratios) else float(given[SCALE])


def agree_about_scale(pairs: Pairs, poses_at: PosesAt) -> bool:
    """Whether the pairs moved by about the same factor farther than the poses.

    Clouds that have little in common are pulled together, some more than others: a scale changes
    all alike.
    """
    ratios = _log_ratios(pairs, pose_motion(pairs, poses_at, np.zeros(PARAMETERS)))
    if not len(ratios):
        return False
    middle = float(np.median(ratios))
    return abs(middle) >= LEAST_AGREEMENT * float(np.median(np.abs(ratios - middle)))


def _log_ratios(pairs: Pairs, predicted: F64) -> F64:
    """Logarithms (m,) of measured by predicted distances, of pairs that moved far."""
    known = np.isfinite(predicted[:, 0, 0])
    lengths = np.linalg.norm(predicted[known, :3, 3], axis=1)
    measured = np.linalg.norm(pairs.measured[known, :3, 3], axis=1)
    moved = lengths > max(1e-3, 0.5 * float(np.median(lengths))) if len(lengths) else lengths > 0
    return np.asarray(np.log(np.maximum(measured[moved] / lengths[moved], 1e-3)))
