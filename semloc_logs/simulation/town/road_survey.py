"""Real drives as road networks: streets along a recorded trajectory, the same street where it was
driven again.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.sparse import coo_array, csr_array
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from semloc_logs.arrays import F64
from semloc_logs.errors import LogError
from semloc_logs.logs.poses.trajectory_file import TrajectoryFile, read_trajectory
from semloc_logs.simulation.meshes.objects import resample
from semloc_logs.simulation.town.road_network import (
    Road,
    RoadNetwork,
    drawn_road,
    drawn_stubs,
    left_of,
)

LANE = 1.75  # m from the driven line to the middle of the road, which is on its left
_NEAR = 7.0  # m between two passes of one street
_APART = 40.0  # m along the drive between two passes
_PARALLEL = 0.8  # cosine of the angle between two passes of one street
_SHORTEST = 50.0  # m
_MOST_CELLS = 4e7  # raster cells of 0.5 m that a drive may spread over

Rng = np.random.Generator


def read_drive(path: Path) -> F64:
    """Positions (n, 3) in metres, z up, about every metre along the drive of a TUM or KITTI file.

    KITTI poses are of a camera (x right, y down, z ahead; KITTI odometry development kit),
    TUM poses of a frame with z up. LogError for files that cannot be read, drives that are
    too short, leap, or spread over too large an area.
    """
    read = read_trajectory(TrajectoryFile(path))
    positions = read.poses[:, :3, 3]
    if read.stamps_ns is None:
        positions = np.column_stack([positions[:, 2], -positions[:, 0], -positions[:, 1]])
    positions = positions - positions[0]
    extent = np.ptp(positions[:, :2], axis=0) + 100.0
    if not (np.isfinite(extent).all() and extent.prod() * 4 < _MOST_CELLS):
        raise LogError(
            f"The drive of {path} spreads over {extent[0]:.0f} m x {extent[1]:.0f} m, "
            "which is too much: give a part of it."
        )
    kept = [0]
    for k in range(1, len(positions)):  # standing and trembling add nothing to the way
        if np.hypot(*(positions[k, :2] - positions[kept[-1], :2])) > 0.7:
            kept.append(k)
    if (
        len(kept) < 2
        or (length := float(np.linalg.norm(np.diff(positions[kept, :2], axis=0), axis=1).sum()))
        < _SHORTEST
    ):
        raise LogError(f"The drive of {path} is shorter than {_SHORTEST:.0f} m: give a longer one.")
    leaps = np.linalg.norm(np.diff(positions[kept, :2], axis=0), axis=1)
    if leaps.max() > 60:
        raise LogError(
            f"The drive of {path} leaps by {leaps.max():.0f} m "
            f"after pose {kept[int(leaps.argmax())]}: give one without gaps."
        )
    points = resample(positions[kept], length / max(1, round(length)))
    return np.column_stack(
        [
            gaussian_filter1d(points[:, k], sigma, mode="nearest")
            for k, sigma in enumerate((2.5, 2.5, 6.0))
        ]
    )


def drive_network(rng: Rng, drive: F64) -> RoadNetwork:
    """Streets along a drive (n, 3) with points about every metre, as :func:`read_drive` gives it.

    Where the drive comes near an earlier part of itself in the same or the opposite direction it is
    the same street; where paths cross or part there is a crossing. ``survey`` of the network is the
    drive and, beside it, the lane of the other direction, heights of all passes made to agree.
    """
    plan = drive[:, :2]
    tangent = np.gradient(plan, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    fresh, pairs = _first_passes(plan, tangent)
    centre = _smooth(plan + LANE * left_of(tangent), 3.0)
    narrow = rng.uniform(0.95, 1.2)
    nodes: list[F64] = []
    roads: list[Road] = []
    for first, last in _pieces(plan, centre, fresh):
        ends = [_node(nodes, centre[k]) for k in (first, last)]
        if last - first >= 6:
            road = drawn_road(
                rng, ends[0], ends[1], resample(centre[first : last + 1], 1.0), narrow
            )
            wide = max(road.half_width, LANE + 1.9 + (2.0 if road.parking else 0.0))
            roads.append(Road(road.a, road.b, road.path, wide, road.sidewalk, road.parking))
    heights = _agreeing_heights(drive, pairs)
    other = opposite_lane(plan)
    survey = np.concatenate([np.column_stack([line, heights]) for line in (plan, other)])
    stubs, circles = drawn_stubs(rng, tuple(roads), (*roads, *_driven(plan)), narrow)
    return RoadNetwork(np.array(nodes), tuple(roads), survey, stubs, circles)


def _driven(plan: F64) -> list[Road]:
    """All of a drive as a road, as far as what has to stay clear of it is concerned."""
    return [Road(-1, -1, plan, 3.0, 0.0, False)]


def opposite_lane(line: F64) -> F64:
    """The lane (n, 2) to the left of a driven line (n, 2) with points about every metre or half
    metre, in the same order.
    """
    tangent = np.gradient(line, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    spacing = float(np.median(np.linalg.norm(np.diff(line, axis=0), axis=1)))
    return _smooth(line + 2 * LANE * left_of(tangent), 3.0 / spacing)


def _smooth(line: F64, sigma: float) -> F64:
    return np.column_stack([gaussian_filter1d(line[:, k], sigma, mode="nearest") for k in (0, 1)])


def _first_passes(plan: F64, tangent: F64) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Which points are driven for the first time (n,), and all pairs (m, 2) of points of different
    passes that are near each other.
    """
    pairs = (
        np.sort(cKDTree(plan).query_pairs(_NEAR, output_type="ndarray"), axis=1)
        .astype(np.int64)
        .reshape(-1, 2)
    )
    pairs = pairs[np.diff(pairs, axis=1).ravel() > _APART]
    parallel = np.abs((tangent[pairs[:, 0]] * tangent[pairs[:, 1]]).sum(1)) > _PARALLEL
    # a first pass counts only if it is a first pass itself: in the order of the drive
    again = np.zeros(len(plan), bool)
    twins = pairs[parallel]
    order = np.argsort(twins[:, 1], kind="stable")
    for early, late in twins[order].tolist():
        again[late] |= not again[early]
    fresh = ~again
    for value, least in ((True, 20), (False, 10)):  # short stretches belong to their neighbours
        edges = np.flatnonzero(np.diff(np.concatenate([[-1], fresh.astype(np.int8), [-1]])))
        for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            if b - a < least and fresh[a] == value and a > 0 and b < len(fresh):
                fresh[a:b] = not value
    return fresh, pairs


def _pieces(
    plan: F64, centre: F64, fresh: NDArray[np.bool_], longest: int = 220
) -> list[tuple[int, int]]:
    """First and last point of every road: first passes, cut where another one starts, ends or
    crosses, and where they are too long.
    """
    padded = np.concatenate([[False], fresh, [False]]).astype(np.int8)
    runs = np.flatnonzero(np.diff(padded)).reshape(-1, 2)
    runs = np.column_stack(
        [np.maximum(runs[:, 0] - 4, 0), np.minimum(runs[:, 1] + 3, len(plan) - 1)]
    )
    number = np.full(len(plan), -1)
    for k, (a, b) in enumerate(runs):
        number[a : b + 1] = k
    cuts: list[set[int]] = [{int(a), int(b)} for a, b in runs]
    for k, (a, b) in enumerate(runs):
        for end in (a, b):  # a road ends on another one, or on an earlier part of itself
            others = np.flatnonzero(
                (number >= 0) & ((number != k) | (np.abs(np.arange(len(plan)) - end) > _APART))
            )
            if len(others):
                distance = np.linalg.norm(centre[others] - centre[end], axis=1)
                if distance.min() < _NEAR + 3:
                    nearest = int(others[distance.argmin()])
                    cuts[number[nearest]].add(nearest)
    inside = np.flatnonzero(number >= 0)
    close = inside[cKDTree(centre[inside]).query_pairs(1.0, output_type="ndarray").reshape(-1, 2)]
    for i, j in close[np.abs(np.diff(close, axis=1)).ravel() > _APART].tolist():
        for p in (i, j):
            cuts[number[p]].add(p)
    pieces = []
    for run in cuts:
        first = min(run)
        last = max(run)
        kept = [first]
        for p in sorted(run):
            if p - kept[-1] > 12 and last - p > 12:
                kept.append(p)
        for a, b in pairwise([*kept, last]):
            steps = (
                np.linspace(a, b, max(2, int(np.ceil((b - a) / longest)) + 1)).astype(int).tolist()
            )
            pieces += list(pairwise(steps))
    return pieces


def _node(nodes: list[F64], position: F64, merge: float = 12.0) -> int:
    """The number of the crossing at a point (2,): one that is there already, or a new one."""
    if nodes:
        distance = np.linalg.norm(np.array(nodes) - position, axis=1)
        if distance.min() < merge:
            return int(distance.argmin())
    nodes.append(position)
    return len(nodes) - 1


def _agreeing_heights(drive: F64, pairs: NDArray[np.int64]) -> F64:
    """Heights (n,) with the rises of the drive, that are equal where it passes twice:
    least squares, a drift shared out.
    """
    n = len(drive)
    pairs = pairs[:: max(1, len(pairs) // (4 * n))]
    steps = np.arange(n - 1)
    rows = np.arange(n - 1 + len(pairs))
    ahead = np.concatenate([steps + 1, pairs[:, 1]])
    back = np.concatenate([steps, pairs[:, 0]])
    rise = np.concatenate([np.diff(drive[:, 2]), np.zeros(len(pairs))])
    weight = np.concatenate([np.ones(n - 1), np.full(len(pairs), 0.02)])
    matrix = csr_array(
        coo_array(
            (
                np.concatenate([weight, -weight]),
                (np.concatenate([rows, rows]), np.concatenate([ahead, back])),
            ),
            shape=(len(rows), n),
        )
    )
    normal = (
        matrix.T @ matrix
        + 1e-9 * csr_array((np.ones(n), (np.arange(n), np.arange(n))), shape=(n, n))
    ).tocsc()
    return np.asarray(spsolve(normal, matrix.T @ (weight * rise)), np.float64)
