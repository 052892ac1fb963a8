"""Road networks: centre lines between crossings, with widths; and routes over them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from semloc_logs.arrays import F64
from semloc_logs.simulation.meshes.objects import resample

Rng = np.random.Generator


@dataclass(frozen=True, slots=True, eq=False)
class Road:
    """A road between crossings ``a`` and ``b``: centre line (n, 2) about every metre, half the
    carriageway, pavement, parking lanes.

    Roads of one ``look`` have the same houses and trees on both sides.
    """

    a: int
    b: int
    path: F64
    half_width: float
    sidewalk: float
    parking: bool
    look: int | None = None

    @property
    def lane(self) -> float:
        """Distance of the driven line from the centre line."""
        return max(1.2, (self.half_width - (2.0 if self.parking else 0.0)) / 2)


@dataclass(frozen=True, slots=True)
class Circle:
    """A round piece of carriageway of a radius ``outer``, or none if that is 0, with an island of a
    radius ``inner`` in it; metres.
    """

    x: float
    y: float
    outer: float
    inner: float

    @property
    def lane(self) -> float:
        """Radius of the driven line round the island."""
        return self.inner + 2.6


@dataclass(frozen=True, slots=True, eq=False)
class RoadNetwork:
    """Crossings (k, 2) and the roads between them.

    ``survey`` are points (n, 3) of lanes that are driven, and how high they are; ``stubs`` are side
    streets that end blind, which no route takes; ``circles`` are turning circles, refuges and
    roundabouts, the latter by the number of their crossing in ``roundabouts``; ``level`` ground has
    no slopes, and nothing behind the plots.
    """

    crossings: F64
    roads: tuple[Road, ...]
    survey: F64 | None = None
    stubs: tuple[Road, ...] = ()
    circles: tuple[Circle, ...] = ()
    roundabouts: dict[int, Circle] = field(default_factory=dict)
    level: bool = False

    def neighbours(self, crossing: int) -> list[tuple[int, int]]:
        """(road, other crossing) of every road at a crossing."""
        return [
            (k, r.b if r.a == crossing else r.a)
            for k, r in enumerate(self.roads)
            if crossing in (r.a, r.b)
        ]


def drawn_road(rng: Rng, a: int, b: int, path: F64, narrow: float) -> Road:
    """A road along a centre line (n, 2), its widths drawn; ``narrow`` multiplies the width of the
    carriageway.
    """
    parking = bool(rng.random() < 0.75)
    half = rng.uniform(2.5, 4.3) * narrow + (2.0 if parking else 0.0)
    sidewalk = 0.0 if rng.random() < 0.12 else rng.uniform(1.2, 3.8)
    return Road(a, b, path, float(half), float(sidewalk), parking)


def repeating_network(rng: Rng, columns: int, rows: int, block: float) -> RoadNetwork:
    """A straight grid on level ground all of whose blocks are copies of one: a trap for who
    recognises places.
    """
    x, y = np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij")
    crossings = np.column_stack([x.ravel(), y.ravel()]) * np.array(
        [block * rng.uniform(0.8, 1.2), block]
    )
    pairs = [(i * rows + j, (i + 1) * rows + j, 0) for i in range(columns - 1) for j in range(rows)]
    pairs += [(i * rows + j, i * rows + j + 1, 1) for i in range(columns) for j in range(rows - 1)]
    model = [drawn_road(rng, 0, 0, crossings, 1.0) for _ in range(2)]
    roads = tuple(
        replace(model[k], a=a, b=b, path=resample(crossings[[a, b]], 1.0), look=k)
        for a, b, k in pairs
    )
    return RoadNetwork(crossings, roads, level=True)


def grid_network(rng: Rng, columns: int, rows: int, block: float) -> RoadNetwork:
    """A bent grid of ``columns`` x ``rows`` crossings about ``block`` metres apart, some roads
    missing, none a dead end.

    Some crossings are roundabouts, some side streets blind alleys, some wide roads have refuges in
    the middle.
    """
    x, y = np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij")
    stretch = rng.uniform(0.75, 1.3)
    crossings = (
        np.column_stack([x.ravel() * block * stretch, y.ravel() * block / stretch])
        + rng.normal(size=(columns * rows, 2)) * 0.1 * block
    )
    shear = rng.normal() * 0.15
    turn = rng.uniform(0, 2 * np.pi)
    crossings = (
        crossings
        @ np.array([[1, 0], [shear, 1]])
        @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    )
    pairs = [(i * rows + j, (i + 1) * rows + j) for i in range(columns - 1) for j in range(rows)]
    pairs += [(i * rows + j, i * rows + j + 1) for i in range(columns) for j in range(rows - 1)]
    degree = np.bincount(np.array(pairs).ravel(), minlength=len(crossings))
    kept = []
    for a, b in pairs:
        if min(degree[a], degree[b]) > 2 and rng.random() < 0.25:
            degree[[a, b]] -= 1
        else:
            kept.append((a, b))
    narrow = rng.uniform(0.85, 1.3)
    roads = tuple(
        drawn_road(rng, a, b, _bend(rng, crossings[a], crossings[b]), narrow) for a, b in kept
    )
    more = rng.spawn(1)[0]  # what follows leaves the towns of a seed where they were
    roundabouts = {}
    for k in np.flatnonzero(
        np.bincount(np.array(kept).ravel(), minlength=len(crossings)) > 2
    ).tolist():
        if more.random() < 0.15:
            inner = more.uniform(3.5, 6.5)
            roundabouts[k] = Circle(
                float(crossings[k, 0]),
                float(crossings[k, 1]),
                inner + more.uniform(4.6, 6.0),
                inner,
            )
    stubs, ends = drawn_stubs(more, roads, roads, narrow)
    return RoadNetwork(
        crossings,
        roads,
        None,
        stubs,
        (*roundabouts.values(), *ends, *_refuges(more, roads)),
        roundabouts,
    )


def drawn_stubs(
    rng: Rng, roads: tuple[Road, ...], every: tuple[Road, ...], narrow: float
) -> tuple[tuple[Road, ...], tuple[Circle, ...]]:
    """Blind alleys off some of the ``roads`` where they stay clear of ``every`` road, and the
    circles at their ends.
    """
    stubs: list[Road] = []
    circles: list[Circle] = []
    for road in roads:
        n = len(road.path)
        side = rng.choice([-1.0, 1.0])
        turn = rng.normal() * 0.2
        length = rng.uniform(28, 45)
        wanted = rng.random() < 0.25
        radius = rng.uniform(5.5, 8.0)
        if not wanted or n < 60:
            continue
        k = int(n * rng.uniform(0.35, 0.65))
        ahead = road.path[k + 2] - road.path[k - 2]
        angle = np.arctan2(ahead[1], ahead[0]) + side * np.pi / 2 + turn
        path = road.path[k] + np.linspace(0, length, int(length))[:, None] * np.array(
            [np.cos(angle), np.sin(angle)]
        )
        others = np.concatenate([r.path for r in (*every, *stubs)])
        if cKDTree(others).query(path[int(road.half_width) + 14 :])[0].min() > 14:
            stubs.append(drawn_road(rng, -1, -1, path, narrow))
            circles.append(
                Circle(
                    float(path[-1, 0]),
                    float(path[-1, 1]),
                    max(radius, stubs[-1].half_width + 1),
                    0.0,
                )
            )
    return tuple(stubs), tuple(circles)


def _refuges(rng: Rng, roads: tuple[Road, ...]) -> list[Circle]:
    """Narrow islands in the middle of roads that are wide enough, four circles in a row each."""
    islands = []
    for road in roads:
        k = int(rng.uniform(0.2, 0.3) * len(road.path))
        wanted = rng.random() < 0.5
        half = road.lane - 1.55
        if wanted and half > 0.5:
            islands += [
                Circle(float(x), float(y), 0.0, min(half, 1.0)) for x, y in road.path[k : k + 4]
            ]
    return islands


def _bend(rng: Rng, start: F64, end: F64) -> F64:
    """A curved line between two points: a sum of two half waves across the straight one."""
    length = float(np.linalg.norm(end - start))
    u = np.linspace(0, 1, max(3, int(length)))
    across = np.array([-(end - start)[1], (end - start)[0]]) / length
    bow = length * (
        rng.normal() * 0.05 * np.sin(np.pi * u) + rng.normal() * 0.025 * np.sin(2 * np.pi * u)
    )
    return resample(start + (end - start) * u[:, None] + across * bow[:, None], 1.0)


def path_network(rng: Rng, path: F64) -> RoadNetwork:
    """Roads along a driven path (n, 2 or 3), parts that are driven again left out; side streets
    branch off here and there.
    """
    points = resample(np.asarray(path, np.float64)[:, :2], 1.0)
    fresh = np.ones(len(points), bool)
    pairs = cKDTree(points).query_pairs(7.0, output_type="ndarray")
    late = pairs.max(1, initial=0)[np.abs(np.diff(pairs, axis=1)).ravel() > 40]
    fresh[late] = False
    crossings: list[F64] = []
    roads: list[Road] = []
    narrow = rng.uniform(0.9, 1.25)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], fresh.astype(np.int8), [0]])))
    for start, stop in edges.reshape(-1, 2):
        for first in range(int(start), int(stop) - 5, 150):
            piece = points[max(first - 8 * (first == start), 0) : min(first + 151, int(stop) + 8)]
            if first == start:
                crossings.append(piece[0])
            crossings.append(piece[-1])
            roads.append(drawn_road(rng, len(crossings) - 2, len(crossings) - 1, piece, narrow))
    return RoadNetwork(np.array(crossings), tuple(roads))


def random_route(rng: Rng, network: RoadNetwork, length: float) -> list[tuple[int, bool]]:
    """Roads to drive in a row, (road, forwards), at least ``length`` metres, without turning back
    at a crossing.
    """
    road = int(rng.integers(len(network.roads)))
    forwards = bool(rng.random() < 0.5)
    route = [(road, forwards)]
    driven = len(network.roads[road].path) * 1.0
    while driven < length:
        here = network.roads[road].b if forwards else network.roads[road].a
        choices = [c for c in network.neighbours(here) if c[0] != road] or network.neighbours(here)
        road, _ = choices[int(rng.integers(len(choices)))]
        forwards = network.roads[road].a == here
        route.append((road, forwards))
        driven += len(network.roads[road].path)
    return route


def left_of(direction: F64) -> F64:
    """Plan directions (n, 2) turned to the left by a right angle."""
    return np.column_stack([-direction[:, 1], direction[:, 0]])


def lane_path(network: RoadNetwork, route: list[tuple[int, bool]]) -> F64:
    """The line (n, 2) that a car drives along a route, on the right, about every metre, corners cut
    not rounded.
    """
    pieces: list[F64] = []
    before: Circle | None = None
    for index, forwards in route:
        road = network.roads[index]
        centre = road.path if forwards else road.path[::-1]
        tangent = np.gradient(centre, axis=0)
        tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
        lane = centre - road.lane * left_of(tangent)
        after = network.roundabouts.get(road.b if forwards else road.a)
        first, last = (
            min(int((c.outer if c else road.half_width) + 2), len(lane) // 3)
            for c in (before, after)
        )
        piece = lane[first : len(lane) - last]
        if before is not None and pieces:
            pieces.append(_round(before, pieces[-1][-1], piece[0]))
        pieces.append(piece)
        before = after
    return np.concatenate(pieces)


def _round(circle: Circle, start: F64, end: F64) -> F64:
    """The line (n, 2) counter-clockwise round an island, from beside one point to another."""
    middle = np.array([circle.x, circle.y])
    first, last = (float(np.arctan2(*(p - middle)[::-1])) for p in (start, end))
    # in and out of the circle a quarter of a lane's width is enough to turn
    angle = np.linspace(first + 0.35, first + (last - first) % (2 * np.pi) - 0.35, 24)
    return np.asarray(middle + circle.lane * np.column_stack([np.cos(angle), np.sin(angle)]))
