"""The covariance of an alignment, from the information of its fit and what points cannot tell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semloc_logs.alignment.hypotheses import SAME_PLACE_DEGREES, SAME_PLACE_VOXELS
from semloc_logs.alignment.icp import Fit
from semloc_logs.arrays import F64
from semloc_logs.mapping.drift import UNMEASURED, Drift
from semloc_logs.numerics.transforms import inverse

NORMAL_NOISE = np.radians(2.0)  # of tangent planes
LEAST_NOISE = 0.02  # m: of plane distances
UNKNOWN_NOISE = 1.0  # m: of a fit without points
# of the covariance: neighbouring points share their errors, and the fewer points meet a surface the
# more of them do so by chance. How it grows from 0 to 40 m was measured on simulated sweeps, its
# size on real ones, which need twice as much
LEAST_INFLATION = 1.0
INFLATION_OF_SHARE = 0.25
LEAST_SHARE = 0.05
UNCERTAIN_INFLATION = 12.0  # where ranges are uncertain: all points of a wall are off alike
# of the variance of the road between a pose and the keyframes that its map is made from: their
# errors average, and those before and behind cancel. Measured in simulated drives
SPREAD_SHARE = 0.25
# standard deviations that uncertain ranges of a query, and of a target, may all be off by
RANGE_BIAS = 1.0
# share of the bias' variance that query and target have in common, and that cancels where both look
# the same way
COMMON_BIAS = 0.5
FLOOR = np.diag([1e-4] * 3 + [1e-6] * 3)  # 1 cm and 1 mrad: mountings and stamps of real sensors


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
class Stretch:
    """The road between a pose and the keyframes that its map is made from, and how poses drift.

    ``road`` in metres, as :meth:`between` has it; 0 for single sweeps.
    """

    road: float = 0.0
    drift: Drift = UNMEASURED

    @classmethod
    def between(cls, offsets: F64, drift: Drift) -> Stretch:
        """Of keyframes ``offsets`` (n,) metres of road ahead of the pose."""
        squares = np.mean(offsets) ** 2 + SPREAD_SHARE * np.var(offsets)
        return cls(float(np.sqrt(squares)), drift)

    @property
    def covariance(self) -> F64:
        """Covariance (6, 6) of the map against the pose, in the axes of the base."""
        return self.drift.covariance(self.road)


def covariance_of(
    fit: Fit,
    map_T_query: F64,
    map_T_target: F64,
    voxel_size: float,
    stretches: tuple[Stretch, Stretch] = (Stretch(), Stretch()),
    *,
    uncertain: bool = False,
) -> F64:
    """Covariance (6, 6) of target_T_query in the target's axes (docs/reference/tables.md).

    What noisy normals alone would claim to know is taken off first. Where the points then hold
    nothing (along a corridor) the error is as large as the search lets it be: the bounds of the
    same place. Uncertain ranges may all be too long or too short, and level ground may be lifted,
    which no number of points averages out. Along the ``stretches`` of road that made the maps of
    query and target poses drift: the map of the target is off and turned against its pose, which
    moves a query that stands aside, and the map of the query against its own. ``uncertain``:
    whether the ranges of either side are.
    """
    query, target = stretches
    share = max(fit.inliers, LEAST_SHARE)
    inflation = max(LEAST_INFLATION, INFLATION_OF_SHARE / share**2)
    about_centre = _about_centre(fit, voxel_size, UNCERTAIN_INFLATION if uncertain else inflation)

    # from the centre of the query to its base, and into the target's axes
    to_base = _in_axes(map_T_target[:3, :3].T) @ _at(map_T_query[:3, 3] - fit.centre)
    C = to_base @ about_centre @ to_base.T

    target_T_query = inverse(map_T_target) @ map_T_query
    of_target = _at(target_T_query[:3, 3])
    of_query = _in_axes(target_T_query[:3, :3])
    C += of_target @ target.covariance @ of_target.T
    C += of_query @ query.covariance @ of_query.T + FLOOR
    return np.asarray((C + C.T) / 2)


def _at(arm: F64) -> F64:
    """Takes increments (6,) about a point to a point at the ``arm`` (3,) from it."""
    x, y, z = arm
    A = np.eye(6)
    A[:3, 3:] = -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return A


def _in_axes(rotation: F64) -> F64:
    """Takes increments (6,) into other axes."""
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = rotation
    return out


def _about_centre(fit: Fit, voxel_size: float, inflation: float) -> F64:
    """Covariance (6, 6) of left increments about the query's centre, in the map's axes."""
    noise = max(fit.rmse if np.isfinite(fit.rmse) else UNKNOWN_NOISE, LEAST_NOISE) ** 2 * inflation
    prior = np.diag(
        [1 / (SAME_PLACE_VOXELS * voxel_size) ** 2] * 3
        + [1 / np.radians(SAME_PLACE_DEGREES) ** 2] * 3
    )
    information, bias = _beyond_normal_noise(
        fit.information, np.concatenate([RANGE_BIAS * fit.range_bias, fit.ground_bias])
    )
    covariance = np.asarray(np.linalg.inv(information / noise + prior))

    of_query, of_target, *of_ground = bias / noise @ covariance
    alone = np.sqrt(1 - COMMON_BIAS)
    common = np.sqrt(COMMON_BIAS)
    of_ranges = [alone * of_query, alone * of_target, common * (of_query - of_target)]
    biases = np.stack([*of_ranges, *of_ground])
    covariance += biases.T @ biases
    return covariance


def _beyond_normal_noise(information: F64, bias: F64) -> tuple[F64, F64]:
    """Information (6, 6) less what normals that are 2 degrees off would pretend, and the bias.

    It is taken off in axes scaled so that lengths and angles compare. Of ``bias`` (n, 6) the share
    in the remaining information is returned.
    """
    points = float(np.trace(information[:3, :3]))
    arms = float(np.trace(information[3:, 3:]))
    if points <= 0:
        return np.zeros((6, 6)), np.zeros_like(bias)
    scale = np.r_[1.0, 1.0, 1.0, np.full(3, max(np.sqrt(arms / points), 1e-6))]
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    kept = np.maximum(values - points * np.sin(NORMAL_NOISE) ** 2, 0.0)
    share = np.divide(kept, values, out=np.zeros(6), where=values > 0)
    remaining = (vectors * kept) @ vectors.T * np.outer(scale, scale)
    return np.asarray(remaining), bias / scale @ (vectors * share) @ vectors.T * scale
