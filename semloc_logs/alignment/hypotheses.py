"""Transformation hypotheses from word matches, pooled by voting (paper 3.5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

F64 = NDArray[np.float64]
# two alignments of a query with one target are the same place: to within so many voxels and degrees
SAME_PLACE_VOXELS = 3.3
SAME_PLACE_DEGREES = 5.0
# m per m of road, and degrees per m: what odometry drifts; the acceptance was calibrated with it
ODOMETRY_DRIFT = 0.01
ODOMETRY_TURN_DRIFT = 0.02


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """``target_T_query`` as (yaw, x, y, z), radians and metres, in submap ``group``, with the word
    matches that voted for it.
    """

    group: int
    pose: tuple[float, float, float, float]
    votes: int
    weight: float


def pool(
    group: NDArray[np.integer], yaw: F64, translation: F64, weight: F64, cell: float, most: int
) -> list[Hypothesis]:
    """The ``most`` heaviest cells of (submap, yaw, translation) space.

    Each match gives one hypothesis: ``yaw`` (n,) one of the search's headings, ``translation`` (n,
    3). Votes are counted in cells of ``cell`` metres, once as they lie and once moved by half a
    cell, so that no true pose is split at a border in both.
    """
    if not len(group):
        return []
    headings, heading = np.unique(yaw, return_inverse=True)
    group = np.asarray(group, np.int64)
    owner = group * len(headings) + heading
    parts = []
    for offset in (0.0, 0.5):
        ijk = np.floor(translation / cell + offset).astype(np.int64)
        ijk -= ijk.min(0)
        y_span, z_span = (ijk.max(0) + 1)[1:]
        at = (ijk[:, 0] * y_span + ijk[:, 1]) * z_span + ijk[:, 2]
        order = np.lexsort((at, owner))
        new = (at[order][1:] != at[order][:-1]) | (owner[order][1:] != owner[order][:-1])
        start = np.flatnonzero(np.r_[True, new])
        total = np.add.reduceat(weight[order], start)
        count = np.diff(np.r_[start, len(order)])
        best = np.lexsort((start, -total))[:most]
        mean = (
            np.add.reduceat(translation[order] * weight[order, None], start)[best]
            / total[best, None]
        )
        first = order[start[best]]
        parts.append((group[first], np.c_[yaw[first], mean], count[best], total[best]))
    groups, poses, votes, weights = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.lexsort((*poses.T[::-1], groups, -weights))
    # a cell found twice is one hypothesis
    kept = order[first_apart(groups[order], poses[order], cell / 4, most)]
    columns = (groups[kept], map(tuple, poses[kept].tolist()), votes[kept], weights[kept])
    return [
        Hypothesis(int(g), pose, int(n), float(w)) for g, pose, n, w in zip(*columns, strict=True)
    ]


@njit(cache=True, nogil=True)
def first_apart(
    groups: NDArray[np.int64], poses: F64, distance: float, most: int
) -> NDArray[np.int64]:
    """Numbers of the first ``most`` of ``poses`` (n, 4) as (yaw, x, y, z) in submaps ``groups``
    (n,) that are not beside an earlier one of the same submap: within ``distance`` metres along
    each axis, and 0.05 rad.
    """
    kept = np.empty(len(groups), np.int64)
    count = 0
    for i in range(len(groups)):
        if count == most:
            break
        beside = False
        for k in kept[:count]:
            near = groups[i] == groups[k]
            for axis in range(1, 4):
                near = near and abs(poses[i, axis] - poses[k, axis]) < distance
            if near and np.cos(poses[i, 0] - poses[k, 0]) > np.cos(0.05):
                beside = True
                break
        if not beside:
            kept[count] = i
            count += 1
    return kept[:count]


def of_best_groups(hypotheses: Sequence[Hypothesis], most: int) -> list[Hypothesis]:
    """Those in the ``most`` submaps that have the heaviest ones; of equals the submap with the
    lesser number.
    """
    heaviest: dict[int, float] = {}
    for h in hypotheses:
        heaviest[h.group] = max(heaviest.get(h.group, 0.0), h.weight)
    best = set(sorted(heaviest, key=lambda group: (-heaviest[group], group))[:most])
    return [h for h in hypotheses if h.group in best]
