"""The covariance of an alignment, from the information of its fit and what points cannot tell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semloc_logs.alignment.hypotheses import (
    ODOMETRY_DRIFT,
    SAME_PLACE_DEGREES,
    SAME_PLACE_VOXELS,
)
from semloc_logs.alignment.icp import Fit

F64 = NDArray[np.float64]
NORMAL_NOISE = np.radians(2.0)  # of tangent planes
LEAST_NOISE = 0.02  # m: of plane distances
UNKNOWN_NOISE = 1.0  # m: of a fit without points
# of the covariance, measured on simulated sweeps of six LIDARs from 0 to 40 m apart: neighbouring
# points share their errors, and the fewer points meet a surface the more of them do so by chance
LEAST_INFLATION = 2.0
INFLATION_OF_SHARE = 0.5
LEAST_SHARE = 0.05
UNCERTAIN_INFLATION = 12.0  # where ranges are uncertain: all points of a wall are off alike
# of the road that a query's and a target's keyframes come from: the mean of several drifts less
# than one of them
LOCAL_DRIFT = 0.003
LOCAL_TURN_DRIFT = 2e-4  # rad a metre
# standard deviations that uncertain ranges of a query, and of a target, may all be off by
RANGE_BIAS = 1.0
# share of the bias' variance that query and target have in common, and that cancels where both look
# the same way
COMMON_BIAS = 0.5
FLOOR = np.diag([1e-4] * 3 + [1e-6] * 3)  # 1 cm and 1 mrad


def stiffness(fit: Fit) -> float:
    """Least information about the position, the rotation being free.

    It is how many points hold the weakest direction.
    """
    H = fit.information
    if not np.isfinite(H).all() or np.linalg.matrix_rank(H) < 6:
        return 0.0
    reduced = H[:3, :3] - H[:3, 3:] @ np.linalg.solve(H[3:, 3:], H[3:, :3])
    return float(max(np.linalg.eigvalsh(reduced).min(), 0.0))


@dataclass(frozen=True, slots=True)
class Roads:
    """Metres of road that odometry bridges in an alignment; 0 for single sweeps.

    ``query`` and ``target``: that the keyframes of either side come from; ``between``: from the
    target's keyframe to the one that saw what the query sees.
    """

    query: float = 0.0
    target: float = 0.0
    between: float = 0.0

    @property
    def covariance(self) -> F64:
        """What drift adds (6, 6): square metres and square radians."""
        local = (self.query**2 + self.target**2) / 4
        position = (LOCAL_DRIFT**2 * local + (ODOMETRY_DRIFT * self.between) ** 2) / 3
        return np.diag([position] * 3 + [LOCAL_TURN_DRIFT**2 * local / 3] * 3)


def covariance_of(
    fit: Fit,
    map_T_query: F64,
    map_T_target: F64,
    voxel_size: float,
    roads: Roads = Roads(),
    *,
    uncertain: bool = False,
) -> F64:
    """Covariance (6, 6) of target_T_query in the target's axes (docs/reference/tables.md).

    What noisy normals alone would claim to know is taken off first. Where the points then hold
    nothing (along a corridor) the error is as large as the search lets it be: the bounds of the
    same place. Uncertain ranges may all be too long or too short, which no number of points
    averages out. Where keyframes along ``roads`` made the maps, their odometry drifts.
    ``uncertain``: whether the ranges of either side are.
    """
    share = max(fit.inliers, LEAST_SHARE)
    inflation = max(LEAST_INFLATION, INFLATION_OF_SHARE / share**2)
    about_centre = _about_centre(fit, voxel_size, UNCERTAIN_INFLATION if uncertain else inflation)

    # from the centre of the query to its base, and into the target's axes
    x, y, z = map_T_query[:3, 3] - fit.centre
    A = np.eye(6)
    A[:3, 3:] = -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turned = np.zeros((6, 6))
    turned[:3, :3] = turned[3:, 3:] = map_T_target[:3, :3].T

    C = turned @ A @ about_centre @ A.T @ turned.T + roads.covariance + FLOOR
    return np.asarray((C + C.T) / 2)


def _about_centre(fit: Fit, voxel_size: float, inflation: float) -> F64:
    """Covariance (6, 6) of left increments about the query's centre, in the map's axes."""
    noise = max(fit.rmse if np.isfinite(fit.rmse) else UNKNOWN_NOISE, LEAST_NOISE) ** 2 * inflation
    prior = np.diag(
        [1 / (SAME_PLACE_VOXELS * voxel_size) ** 2] * 3
        + [1 / np.radians(SAME_PLACE_DEGREES) ** 2] * 3
    )
    information, bias = _beyond_normal_noise(fit.information, fit.range_bias)
    covariance = np.asarray(np.linalg.inv(information / noise + prior))

    of_query, of_target = RANGE_BIAS * bias / noise @ covariance
    alone = np.sqrt(1 - COMMON_BIAS)
    common = np.sqrt(COMMON_BIAS)
    biases = np.stack([alone * of_query, alone * of_target, common * (of_query - of_target)])
    covariance += biases.T @ biases
    return covariance


def _beyond_normal_noise(information: F64, range_bias: F64) -> tuple[F64, F64]:
    """Information (6, 6) less what normals that are 2 degrees off would pretend, and the bias.

    It is taken off in axes scaled so that lengths and angles compare. Of ``range_bias`` (n, 6) the
    share in the remaining information is returned.
    """
    points = float(np.trace(information[:3, :3]))
    arms = float(np.trace(information[3:, 3:]))
    if points <= 0:
        return np.zeros((6, 6)), np.zeros_like(range_bias)
    scale = np.r_[1.0, 1.0, 1.0, np.full(3, max(np.sqrt(arms / points), 1e-6))]
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    kept = np.maximum(values - points * np.sin(NORMAL_NOISE) ** 2, 0.0)
    share = np.divide(kept, values, out=np.zeros(6), where=values > 0)
    remaining = (vectors * kept) @ vectors.T * np.outer(scale, scale)
    return np.asarray(remaining), range_bias / scale @ (vectors * share) @ vectors.T * scale
