"""Transformation hypotheses from word matches, pooled by voting (paper 3.5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.arrays import F64, I64
from semloc_logs.numerics.transforms import inverse, yaw_transform

# two alignments of a query with one target are the same place to within so many voxels and degrees
# (docs/reference/truth.md: a right closure is within 1 m at voxels of 0.30 m, and 5 degrees)
SAME_PLACE_VOXELS = 3.3
SAME_PLACE_DEGREES = 5.0
# drift of odometry, in metres and in degrees for each metre of road: LIDAR odometry on KITTI has
# half of it. A constant, because the acceptance is calibrated with it
ODOMETRY_DRIFT = 0.01
ODOMETRY_TURN_DRIFT = 0.02
SAME_HEADING = 0.05  # rad between poses that are one
CELL_SHARE = 0.25  # of a voting cell: poses nearer than this are one


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A pose of the query in submap ``group`` that word matches voted for.

    ``pose`` is ``target_T_query`` as (yaw, x, y, z), radians and metres; ``weight`` the sum of its
    ``votes``' weights, and ``everywhere`` of all votes that it was pooled from.
    """

    group: int
    pose: tuple[float, float, float, float]
    votes: int
    weight: float
    everywhere: float = 0.0

    @property
    def agreement(self) -> float:
        """Its weight beside what chance brings, which grows with the root of all votes."""
        return self.weight / float(np.sqrt(self.everywhere)) if self.everywhere else np.inf


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
        first, mean, count, total = _heaviest_cells(
            owner, _cell_numbers(translation, cell, offset), translation, weight, most
        )
        parts.append((group[first], np.c_[yaw[first], mean], count, total))
    groups, poses, votes, weights = (np.concatenate(column) for column in zip(*parts, strict=True))

    # a cell that both grids have is one hypothesis
    order = np.lexsort((*poses.T[::-1], groups, -weights))
    kept = order[non_maximum_suppression(groups[order], poses[order], CELL_SHARE * cell, most)]
    everywhere = float(weight.sum())
    columns = (groups[kept], map(tuple, poses[kept].tolist()), votes[kept], weights[kept])
    return [
        Hypothesis(int(g), pose, int(n), float(w), everywhere)
        for g, pose, n, w in zip(*columns, strict=True)
    ]


def _cell_numbers(translation: F64, cell: float, offset: float) -> I64:
    """A number (n,) for the cell that each of ``translation`` (n, 3) lies in."""
    ijk = np.floor(translation / cell + offset).astype(np.int64)
    ijk -= ijk.min(0)
    y_span, z_span = (ijk.max(0) + 1)[1:]
    return np.asarray((ijk[:, 0] * y_span + ijk[:, 1]) * z_span + ijk[:, 2])


def _heaviest_cells(
    owner: I64, cells: I64, translation: F64, weight: F64, most: int
) -> tuple[I64, F64, I64, F64]:
    """The ``most`` heaviest of the cells ``cells`` (n,) of each ``owner`` (n,).

    Of each cell the first match, the weighted mean of the translations, the votes and their weight.
    """
    order = np.lexsort((cells, owner))
    new_cell = cells[order][1:] != cells[order][:-1]
    new_owner = owner[order][1:] != owner[order][:-1]
    start = np.flatnonzero(np.r_[True, new_cell | new_owner])
    total = np.add.reduceat(weight[order], start)
    count = np.diff(np.r_[start, len(order)])
    best = np.lexsort((start, -total))[:most]
    mean = (
        np.add.reduceat(translation[order] * weight[order, None], start)[best] / total[best, None]
    )
    return order[start[best]], mean, count[best], total[best]


@njit(cache=True, nogil=True)
def non_maximum_suppression(groups: I64, poses: F64, distance: float, most: int) -> I64:
    """Numbers of the first ``most`` poses that are not beside an earlier one of the same submap.

    ``poses`` (n, 4) are (yaw, x, y, z) in the submaps ``groups`` (n,), best first. Beside each
    other are those within ``distance`` metres along each axis, and ``SAME_HEADING``.
    """
    kept = np.empty(len(groups), np.int64)
    count = 0
    for i in range(len(groups)):
        if count == most:
            break
        beside = False
        for k in kept[:count]:
            is_beside = groups[i] == groups[k]
            for axis in range(1, 4):
                is_beside = is_beside and abs(poses[i, axis] - poses[k, axis]) < distance
            if is_beside and np.cos(poses[i, 0] - poses[k, 0]) > np.cos(SAME_HEADING):
                beside = True
                break
        if not beside:
            kept[count] = i
            count += 1
    return kept[:count]


def keep_best_submaps(hypotheses: Sequence[Hypothesis], most: int) -> list[Hypothesis]:
    """The hypotheses in the ``most`` submaps that have the heaviest ones.

    Of equally heavy submaps the one with the lesser number is kept.
    """
    heaviest: dict[int, float] = {}
    for h in hypotheses:
        heaviest[h.group] = max(heaviest.get(h.group, 0.0), h.weight)
    best = set(sorted(heaviest, key=lambda group: (-heaviest[group], group))[:most])
    return [h for h in hypotheses if h.group in best]


def pose_matrix(pose: F64) -> F64:
    """``target_T_query`` of (yaw, x, y, z)."""
    return yaw_transform(float(pose[0]), pose[1:])


def yaw_between(a: F64, b: F64) -> float:
    """Absolute yaw difference of two near-level transforms, radians."""
    d = inverse(a) @ b
    return float(abs(np.arctan2(d[1, 0], d[0, 0])))


def same_place(a: F64, b: F64, voxel_size: float, road: float = 0.0) -> bool:
    """Whether two alignments (4, 4) of a query with one target are the same place.

    ``road`` metres of the target's drive lie between them, over which its odometry may drift.
    """
    distance = SAME_PLACE_VOXELS * voxel_size + ODOMETRY_DRIFT * road
    turn = np.radians(SAME_PLACE_DEGREES + ODOMETRY_TURN_DRIFT * road)
    return bool(np.linalg.norm(a[:3, 3] - b[:3, 3]) < distance and yaw_between(a, b) < turn)
