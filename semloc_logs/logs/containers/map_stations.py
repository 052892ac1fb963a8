"""Stations in a map of points, and the points that are seen from a place.

A map without a trajectory is walked through: stations stand on its ground, and a tour leads from
each to the nearest that is left.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from semloc_logs.arrays import F64, I64, Bools
from semloc_logs.errors import LogError
from semloc_logs.numerics.transforms import interpolate, yaw_transform

COLUMN = 1.0  # m: edge of the columns that ground is found in
STEP = 0.3  # m: neighbouring columns of one ground differ by less
HEADROOM = 0.5, 2.0  # m above the ground where a station has no points
HEIGHT = 1.7  # m of a station above the ground
SPACING = 8.0  # m between stations
LEAST_GROUND = 0.1  # of the largest connected ground: smaller ones are roofs and ledges
SPEED = 5.0  # m/s of the tour
POSE_STEP = 4.0  # m between its poses: no gap between them is long
FIRST_NS = 1_000_000_000  # a map is older than every drive
SQUARE = 10.0  # m: points are found by squares of this edge
RANGE = 40.0  # m that is seen of a map
# bins of directions: their edges double from level to level, rad
BIN = 0.0125
LEVELS = 5
HIDDEN = 0.6, 0.02  # m and share of the range: a point so far behind another is hidden by it
NEAREST = 0.5  # m: points closer to a station are not seen


@dataclass(frozen=True, slots=True, eq=False)
class Stations:
    """``poses`` (n, 4, 4) of the base in the map at ``stamps_ns`` (n,).

    ``is_tour``: they were found in the map, and no trajectory gives them.
    """

    stamps_ns: I64
    poses: F64
    is_tour: bool = False

    def between(self, number: int) -> Iterator[tuple[int, F64]]:
        """Stamps and poses on the way from a station to the next, with its own."""
        stamps = self.stamps_ns[number : number + 2]
        poses = self.poses[number : number + 2]
        yield int(stamps[0]), poses[0]
        if len(stamps) == 2:
            count = int(np.linalg.norm(poses[1, :3, 3] - poses[0, :3, 3]) / POSE_STEP)
            share = np.arange(1, count + 1) / (count + 1)
            at_ns = stamps[0] + (share * (stamps[1] - stamps[0])).astype(np.int64)
            yield from zip(at_ns.tolist(), interpolate(stamps, poses, at_ns), strict=True)


def tour(xyz: F64) -> Stations:
    """Stations on the ground of a map of points (n, 3). LogError where it has none."""
    ground = _ground(xyz)
    if not len(ground):
        raise LogError(
            "it shows no ground to stand on: give the trajectory that it was recorded along with"
            " --poses."
        )
    stations = _in_turn(_spaced(ground))
    way = np.concatenate([[0.0], np.linalg.norm(np.diff(stations, axis=0), axis=1).cumsum()])
    # the base looks along the tour
    step = np.gradient(stations[:, :2], axis=0) if len(stations) > 1 else np.ones((1, 2))
    yaw = np.arctan2(step[:, 1], step[:, 0])
    poses = np.array([yaw_transform(*station) for station in zip(yaw, stations, strict=True)])
    return Stations(FIRST_NS + (way / SPEED * 1e9).astype(np.int64), poses, is_tour=True)


def _ground(xyz: F64) -> F64:
    """Points (k, 3) on the ground, one of each column with room above it."""
    column = np.floor(xyz[:, :2] / COLUMN).astype(np.int64)
    column -= column.min(0)
    width = int(column[:, 1].max()) + 3
    key = (column[:, 0] + 1) * width + column[:, 1] + 1
    order = np.lexsort((xyz[:, 2], key))
    columns, first = np.unique(key[order], return_index=True)
    lowest = xyz[order[first]]

    above = xyz[:, 2] - lowest[np.searchsorted(columns, key), 2]
    blocked = np.isin(columns, key[(above > HEADROOM[0]) & (above < HEADROOM[1])])
    columns = columns[~blocked]
    lowest = lowest[~blocked]

    # columns of one ground are connected by small steps
    edges: list[tuple[I64, I64]] = []
    for offset in (1, width, width + 1, width - 1):
        place = np.searchsorted(columns, columns + offset)
        place = np.minimum(place, max(len(columns) - 1, 0))
        is_neighbour = columns[place] == columns + offset
        is_level = np.abs(lowest[place, 2] - lowest[:, 2]) < STEP
        here = np.flatnonzero(is_neighbour & is_level)
        edges.append((here, place[here]))
    one, other = (np.concatenate([edge[k] for edge in edges]) for k in (0, 1))
    n = len(columns)
    graph = coo_matrix((np.ones(len(one), bool), (one, other)), shape=(n, n))
    _, part = connected_components(graph, directed=False)
    size = np.bincount(part, minlength=1)
    return np.asarray(lowest[size[part] >= max(LEAST_GROUND * size.max(), 4)])


def _spaced(ground: F64) -> F64:
    """Stations (m, 3) above the ground (n, 3): of each square the column nearest to its middle."""
    square = np.floor(ground[:, :2] / SPACING)
    off = np.linalg.norm(ground[:, :2] / SPACING - square - 0.5, axis=1)
    order = np.lexsort((off, square[:, 1], square[:, 0]))
    _, first = np.unique(square[order], axis=0, return_index=True)
    return np.asarray(ground[order[first]] + [0.0, 0.0, HEIGHT])


def _in_turn(stations: F64) -> F64:
    """The same, each followed by the nearest that is left."""
    left = np.ones(len(stations), bool)
    tree = cKDTree(stations)
    here = 0
    order = [here]
    left[here] = False
    while left.any():
        k = 8
        nearest_stations = np.zeros(0, np.int64)
        while not len(nearest_stations):
            k = min(2 * k, len(stations))
            _, neighbours = tree.query(stations[here], k)
            nearest_stations = neighbours[left[neighbours]]
        here = int(nearest_stations[0])
        order.append(here)
        left[here] = False
    return stations[order]


class Views:
    """A map of points (n, 3) as it is seen from places in it."""

    def __init__(self, xyz: F64) -> None:
        self._xyz = xyz
        square = np.floor(xyz[:, :2] / SQUARE).astype(np.int64)
        self._low = square.min(0)
        self._size = np.ptp(square, axis=0) + 1
        key = (square - self._low) @ [self._size[1], 1]
        self._order = np.argsort(key, kind="stable")
        self._keys = key[self._order]
        # a point stands for the surface up to the next ones
        some = xyz[:: max(1, len(xyz) // 4096)]
        distance, _ = cKDTree(xyz).query(some, min(4, len(xyz)))
        self._spacing = float(np.median(distance[:, -1])) if len(xyz) > 1 else 0.0

    def seen(self, place: F64) -> I64:
        """The rows (k,) of the points that are seen from ``place`` (3,)."""
        rows = self._around(place)
        ray = self._xyz[rows] - place
        reach = np.linalg.norm(ray, axis=1)
        inside = (reach > NEAREST) & (reach < RANGE)
        rows = rows[inside]
        return np.asarray(rows[_is_seen(ray[inside], reach[inside], self._spacing)])

    def _around(self, place: F64) -> I64:
        """The rows of the points in the squares within ``RANGE``."""
        low, high = (
            np.clip(
                np.floor((place[:2] + off) / SQUARE).astype(np.int64) - self._low, 0, self._size
            )
            for off in (-RANGE, RANGE + SQUARE)
        )
        row = np.arange(low[0], high[0])[:, None] * self._size[1]
        ends = np.array([low[1], high[1]])
        first, last = np.searchsorted(self._keys, row + ends).T
        runs = [self._order[one:end] for one, end in zip(first, last, strict=True)]
        return np.concatenate([np.zeros(0, np.int64), *runs])


@njit(cache=True, nogil=True)
def _is_seen(ray: F64, reach: F64, spacing: float) -> Bools:
    """Which points (n,) nothing nearer hides.

    A point hides what lies behind it in the bins that its part of the surface fills.
    """
    n = len(ray)
    seen = np.ones(n, np.bool_)
    azimuth = np.empty(n)
    polar = np.empty(n)
    for i in range(n):
        azimuth[i] = np.arctan2(ray[i, 1], ray[i, 0]) + np.pi
        polar[i] = np.arccos(max(-1.0, min(1.0, ray[i, 2] / reach[i])))
    for level in range(LEVELS):
        edge = BIN * 2**level
        columns = int(2 * np.pi / edge) + 1
        rows = int(np.pi / edge) + 1
        nearest = np.full((rows, columns), np.inf)
        for i in range(n):
            if level == 0 or 2 * spacing >= edge * reach[i]:
                r = min(int(polar[i] / edge), rows - 1)
                c = min(int(azimuth[i] / edge), columns - 1)
                nearest[r, c] = min(nearest[r, c], reach[i])
        for i in range(n):
            r = min(int(polar[i] / edge), rows - 1)
            c = min(int(azimuth[i] / edge), columns - 1)
            if reach[i] > nearest[r, c] * (1 + HIDDEN[1]) + HIDDEN[0]:
                seen[i] = False
    return seen
