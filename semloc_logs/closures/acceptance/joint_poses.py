"""Poses that neighbouring queries estimate together.

Odometry ties neighbouring queries to one place of the target, so what each of them measured tells
where the others are: the information of all is added, less what odometry drifts on the way from one
to the other (the linear least squares of a pose graph whose odometry is known; Barfoot, State
Estimation for Robotics, 2017, section 8.2). Neighbours share part of their errors, which no number
of them averages out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64, I64, Bools
from semloc_logs.closures.acceptance.consistency import NEAR, TURN, TURN_DRIFT, most_apart
from semloc_logs.closures.acceptance.placements import Pairs, Placed, posed_pairs
from semloc_logs.closures.closure import Alignments, Columns
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import inverse
from semloc_logs.settings import STREET_VOXEL

LIKELY = 0.5  # less probable neighbours may be wrong, and tell nothing
# share of the variance that neighbours have in common. Of right alignments of simulated stereo
# drives, 4 m apart, half of the squared errors were
COMMON = 0.5
ROWS_AT_ONCE = 1000  # alignments whose neighbours are in memory together


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty(Columns):
    """How uncertain alignments (n) are, and the odometry beside them.

    ``covariance`` (n, 6, 6) is of target_T_query in the axes of the target's keyframe;
    ``map_R_target`` (n, 3, 3) takes these into the axes of its map. ``query_drift`` and
    ``target_drift`` (n, 6) are standard deviations of a metre of road in the two sessions, in
    metres and radians.
    """

    covariance: F64
    map_R_target: F64
    query_drift: F64
    target_drift: F64

    @classmethod
    def of(cls, rows: Alignments, maps: Mapping[str, SessionMap]) -> Uncertainty:
        """Of alignments of the sessions ``maps``."""
        n = len(rows)
        axes = np.tile(np.eye(3), (n, 1, 1))
        drifts = np.zeros((2, n, 6))
        for sessions, of_pair in rows.by_pair():
            query, target = (maps[name] for name in sessions)
            axes[of_pair] = target.map_T_base[rows.target_keyframe[of_pair], :3, :3]
            drifts[0, of_pair] = query.drift.rates
            drifts[1, of_pair] = target.drift.rates
        return cls(rows.covariance, axes, *drifts)


@dataclass(frozen=True, slots=True, eq=False)
class JointPoses(Columns):
    """What neighbours change in the poses of alignments (n).

    ``increment`` (n, 6) is added to target_T_query in the target's axes, metres and radians, and
    ``covariance`` (n, 6, 6) is the one of the sum.
    """

    increment: F64
    covariance: F64

    @property
    def sigma(self) -> F64:
        """Standard deviations (n,) of the positions in their worst directions, metres."""
        return np.asarray(np.sqrt(np.linalg.eigvalsh(self.covariance[:, :3, :3])[:, -1]))

    def of(self, rows: Alignments) -> Alignments:
        """The alignments with these poses."""
        poses = rows.target_T_query.copy()
        poses[:, :3, 3] += self.increment[:, :3]
        turns = Rotation.from_rotvec(self.increment[:, 3:]).as_matrix()
        poses[:, :3, :3] = turns @ poses[:, :3, :3]
        return replace(rows, target_T_query=poses, covariance=self.covariance, given=None)


def joint_poses(
    placed: Placed, pairs: Pairs, uncertainty: Uncertainty, probability: F64, voxel_size: float
) -> JointPoses:
    """The poses of alignments (n,), each together with the neighbours that agree with it.

    ``probability`` (n,) is the one that the place and the pose in it are right. Without odometry,
    or without neighbours, nothing changes.
    """
    out = JointPoses(np.zeros((len(placed), 6)), uncertainty.covariance.copy())
    for rows in posed_pairs(placed, pairs).values():
        group = placed.part(rows)
        beside = uncertainty.part(rows)
        likely = probability[rows] >= LIKELY
        for first in range(0, len(rows), ROWS_AT_ONCE):
            some = np.arange(first, min(first + ROWS_AT_ONCE, len(rows)))
            one, other = _neighbours(group, some, likely, voxel_size)
            together = np.unique(one)  # alignments without neighbours keep their very bits
            increment, covariance = _together(group, beside, one, other)
            out.increment[rows[together]] = increment
            out.covariance[rows[together]] = covariance
    return out


def _neighbours(group: Placed, some: I64, likely: Bools, voxel_size: float) -> tuple[I64, I64]:
    """Numbers (m,) of ``some`` alignments, ascending, and of a likely one of another query near
    each that agrees with it.
    """
    scale = voxel_size / STREET_VOXEL
    first = np.searchsorted(group.road, group.road[some] - NEAR * scale, "left")
    counts = np.searchsorted(group.road, group.road[some] + NEAR * scale, "right") - first
    one = np.repeat(some, counts)
    other = np.arange(len(one)) - np.repeat(np.cumsum(counts) - counts - first, counts)
    kept = likely[other] & (group.query[one] != group.query[other])
    one = one[kept]
    other = other[kept]

    along = np.abs(group.road[one] - group.road[other])
    off = _increments(group, one, other)
    agrees = np.linalg.norm(off[:, :3], axis=1) <= most_apart(
        group.sigma[one],
        group.sigma[other],
        along,
        np.abs(group.target_road[one] - group.target_road[other]),
        voxel_size,
    )
    agrees &= np.linalg.norm(off[:, 3:], axis=1) <= TURN + TURN_DRIFT * along / scale
    return one[agrees], other[agrees]


def _predicted(group: Placed, one: I64, other: I64) -> F64:
    """Where the ``other`` alignments and odometry put the queries of ``one`` (m, 4, 4)."""
    own = inverse(group.map_T_query[other]) @ group.map_T_query[one]
    return np.asarray(group.target_T_query[other] @ own)


def _increments(group: Placed, one: I64, other: I64) -> F64:
    """From the poses of ``one`` to those predicted (m, 6), in the axes of the target's map."""
    predicted = _predicted(group, one, other)
    measured = group.target_T_query[one]
    turns = predicted[:, :3, :3] @ np.swapaxes(measured[:, :3, :3], 1, 2)
    return np.hstack(
        [predicted[:, :3, 3] - measured[:, :3, 3], Rotation.from_matrix(turns).as_rotvec()]
    )


def _together(group: Placed, beside: Uncertainty, one: I64, other: I64) -> tuple[F64, F64]:
    """Increments (k, 6) and covariances (k, 6, 6) of the alignments (k) among ``one`` (m,) with
    their neighbours ``other`` (m,).
    """
    together, start = np.unique(one, return_index=True)
    alone = np.linalg.inv((1 - COMMON) * _in_axes(beside.map_R_target, beside.covariance)[together])
    predicted = _predicted(group, one, other)
    arm = predicted[:, :3, 3] - group.target_T_query[other, :3, 3]
    far = _at(arm)
    covariance = (1 - COMMON) * _in_axes(beside.map_R_target[other], beside.covariance[other])
    covariance = far @ covariance @ np.swapaxes(far, 1, 2)
    for axes, rates, road in (
        (predicted[:, :3, :3], beside.query_drift[one], group.road),
        (beside.map_R_target[one], beside.target_drift[one], group.target_road),
    ):
        drift = rates * np.abs(road[one] - road[other])[:, None]
        covariance += _in_axes(axes, drift[:, :, None] ** 2 * np.eye(6))
    information = np.linalg.inv(covariance)
    pull = (information @ _increments(group, one, other)[..., None])[..., 0]

    joint = np.linalg.inv(alone + np.add.reduceat(information, start, axis=0))
    increment = (joint @ np.add.reduceat(pull, start, axis=0)[..., None])[..., 0]
    to_target = np.swapaxes(beside.map_R_target[together], 1, 2)
    increment = np.concatenate(
        [(to_target @ part[..., None])[..., 0] for part in np.split(increment, 2, axis=1)], axis=1
    )
    joint = _in_axes(to_target, joint) + COMMON * beside.covariance[together]
    return increment, (joint + np.swapaxes(joint, 1, 2)) / 2


def _in_axes(rotation: F64, covariance: F64) -> F64:
    """Covariances (n, 6, 6) in the axes into which ``rotation`` (n, 3, 3) takes vectors."""
    turned = np.zeros_like(covariance)
    turned[:, :3, :3] = rotation
    turned[:, 3:, 3:] = rotation
    return turned @ covariance @ np.swapaxes(turned, 1, 2)


def _at(arms: F64) -> F64:
    """Take increments about a point to points at the ``arms`` (n, 3) from it (n, 6, 6)."""
    x, y, z = arms.T
    out = np.tile(np.eye(6), (len(arms), 1, 1))
    out[:, 0, 4], out[:, 0, 5] = z, -y
    out[:, 1, 3], out[:, 1, 5] = -z, x
    out[:, 2, 3], out[:, 2, 4] = y, -x
    return out
