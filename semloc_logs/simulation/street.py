"""A street world along a road network: what is static follows from the seed, what changes between sessions from ``condition``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from semloc_logs.simulation import objects
from semloc_logs.simulation.buildings import building
from semloc_logs.simulation.conditions import Condition
from semloc_logs.simulation.ground import Ground
from semloc_logs.simulation.network import Road, RoadNetwork, path_network
from semloc_logs.simulation.objects import Parts
from semloc_logs.simulation.world import F64, Mesh, MeshBuilder, World, join_worlds, place

Rng = np.random.Generator


@dataclass(frozen=True, slots=True)
class _Style:
    """How one side of a road is built up; lengths in metres, shares in [0, 1]."""

    setback: float
    storeys: float
    plot: float
    gap: float
    built: float
    garden: float
    frontage: str
    roofs: tuple[str, ...]
    tree_pitch: float
    tree_size: float
    lamp_pitch: float
    parked: float
    paved: float


def _style(rng: Rng, town: Rng) -> _Style:
    """A side's style: a kind drawn from what the town has, then all of it varied."""
    kinds = ("suburb", "suburb", "rows", "rows", "city", "city", "park", "country", "yards")
    favourite = kinds[int(town.integers(len(kinds)))]
    kind = favourite if rng.random() < 0.6 else kinds[int(rng.integers(len(kinds)))]
    setback, storeys, plot, gap, built, garden = {
        "suburb": (3.5, 2.0, 12.0, 3.0, 0.95, 2.0),
        "rows": (2.0, 2.6, 7.0, 0.0, 0.97, 1.1),
        "city": (0.5, 4.5, 16.0, 0.8, 0.97, 0.2),
        "park": (6.0, 1.5, 14.0, 25.0, 0.15, 5.0),
        "country": (6.0, 1.6, 15.0, 14.0, 0.5, 3.0),
        "yards": (5.0, 1.9, 28.0, 6.0, 0.85, 0.6),
    }[kind]
    frontage = {"city": "none", "park": "none", "yards": "fence"}.get(kind, "any")
    roofs = {"city": ("flat", "gable", "hip"), "yards": ("flat", "flat", "gable"), "rows": ("gable", "cross")}.get(
        kind, ("gable", "cross", "hip")
    )
    return _Style(
        setback * rng.uniform(0.5, 1.6),
        max(1.0, storeys * rng.uniform(0.7, 1.4)),
        plot * rng.uniform(0.75, 1.4),
        gap * rng.uniform(0.4, 1.6),
        built,
        garden * rng.uniform(0.4, 1.6),
        frontage,
        roofs,
        float(rng.choice([9.0, 14.0, 25.0, 200.0])) * rng.uniform(0.8, 1.2),
        rng.uniform(0.45, 1.0),
        rng.uniform(22, 40),
        rng.uniform(0.1, 0.85),
        {"city": 0.8, "rows": 0.4, "yards": 0.6}.get(kind, 0.1),
    )


class _Side:
    """One side of a road, with coordinates along it (u) and outwards from the edge of the carriageway (v)."""

    def __init__(self, road: Road, sign: int) -> None:
        self.road, self.sign = road, sign
        self.path = road.path
        self.along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(road.path, axis=0), axis=1))])
        self.length = float(self.along[-1])

    def at(self, u: float, v: float) -> tuple[float, float, float]:
        """x, y and the yaw of the road (of the right-hand traffic on this side) at (u, v)."""
        k = int(np.clip(np.searchsorted(self.along, u) - 1, 0, len(self.path) - 2))
        a, b = self.path[max(k - 2, 0)], self.path[min(k + 3, len(self.path) - 1)]
        t = (b - a) / np.linalg.norm(b - a)
        out = self.sign * np.array([t[1], -t[0]])
        p = self.path[k] + t * (u - self.along[k]) + out * (self.road.half_width + v)
        return float(p[0]), float(p[1]), float(np.arctan2(t[1] * self.sign, t[0] * self.sign))

    def line(self, u0: float, u1: float, v: float) -> F64:
        """A plan line at distance v from u0 to u1."""
        return np.array([self.at(u, v)[:2] for u in np.linspace(u0, u1, max(2, int((u1 - u0) / 2) + 1))])


class _Street:
    """Puts things on the ground; ``moving`` collects what differs between sessions."""

    def __init__(self, ground: Ground, seed: int, condition: Condition) -> None:
        self.ground, self.seed, self.condition = ground, seed, condition
        self.rng = np.random.default_rng([seed, 11])
        self.change = np.random.default_rng([seed, 12, condition.number])
        self.static = MeshBuilder(ground.height)
        self.moving = MeshBuilder(ground.height)

    def put(self, parts: Parts, x: float, y: float, yaw: float, *, moving: bool = False, aside: bool = False) -> None:
        """Set a thing up at a place, unless it would stand in a lane or, if it has to keep ``aside``, on a carriageway."""
        placed = [(place(mesh, x, y, 0.0, yaw), label) for mesh, label in parts]
        if (aside and self.ground.on_road(x, y)) or not self.ground.passable(placed):
            return
        lift = np.array([0.0, 0.0, float(self.ground.height(np.array([x]), np.array([y]))[0])])
        for mesh, label in placed:
            (self.moving if moving else self.static).add(Mesh(mesh.vertices + lift, mesh.triangles), label, ground="none")

    def put_line(self, parts: Parts) -> None:
        if self.ground.passable(parts):
            for mesh, label in parts:
                self.static.add(mesh, label, ground="drape")

    @property
    def bare(self) -> bool:
        """Whether deciduous plants have lost their leaves."""
        return self.condition.season in ("winter", "snow")

    def put_tree(self, x: float, y: float, size: float, kind: str | None = None) -> None:
        """A tree, that is missing in three sessions of a hundred."""
        season = self.condition.season
        parts = objects.tree(self.rng, size, kind, bare=self.bare, leafy=0.4 if season == "autumn" else 1.0)
        yaw = self.rng.uniform(0, 6.3)
        if self.change.random() >= 0.03:
            self.put(parts, x, y, yaw, aside=True)

    def side(self, side: _Side, style: _Style) -> None:
        """Everything along one side of a road."""
        edge = side.road.half_width + 5.0
        walk = side.road.sidewalk + (0.2 if side.road.sidewalk else 1.0)
        u = edge + self.rng.uniform(0, 4)
        while u < side.length - edge + 2:
            width = float(np.clip(style.plot * self.rng.uniform(0.7, 1.35), 5, 45))
            gap = style.gap * self.rng.uniform(0.3, 1.7)
            self.plot(side, style, u, width, gap, walk)
            u += width + gap
        self.kerbside(side, style, edge, walk)

    def plot(self, side: _Side, style: _Style, u: float, width: float, gap: float, walk: float) -> None:
        """A plot of land: a house perhaps, its garden, frontage and drive."""
        rng = self.rng
        depth = float(np.clip(rng.uniform(0.6, 1.1) * min(width, 14.0), 6, 18))
        setback = walk + max(0.3, style.setback * rng.uniform(0.85, 1.15))
        gx, gy = np.meshgrid(np.arange(-width / 2 + 0.2, width / 2, 0.5), np.arange(0.2, depth + 0.1, 0.5))
        house = bool(rng.random() < style.built)
        for further in (0.0, 0.8, 2.0, 4.0):  # where the road bends a house has to stand further back
            x, y, yaw = side.at(u + width / 2, setback + further)
            c, s = np.cos(yaw), np.sin(yaw)
            # the house's +y looks away from the road, which lies to the left of the traffic on this side
            cells = np.column_stack([x + c * gx.ravel() + s * gy.ravel(), y + s * gx.ravel() - c * gy.ravel()])
            if self.ground.allowed(cells):
                setback += further
                break
        else:
            house = False
        if house:
            height = 2.9 * max(1.0, style.storeys * rng.uniform(0.75, 1.3)) + rng.uniform(0, 1.0)
            parts = building(rng, width, depth, height, str(rng.choice(style.roofs)))
            self.put(parts, x, y, yaw + np.pi)
            self.ground.take(cells)
        self.pave(side, style, u - gap / 2, width + gap, walk, setback)
        if style.setback > 1.5:
            self.frontage(side, style, u - gap / 2, u + width + gap / 2, walk, house)
        self.garden(side, style, u - gap / 2, width + gap, walk, setback + (depth if house else 0.0), house)

    def pave(self, side: _Side, style: _Style, u: float, width: float, walk: float, setback: float) -> None:
        """Stone between the pavement and the house: all of it, or a drive beside the house."""
        drive = self.rng.uniform(2.4, 4.5)
        whole = self.rng.random() < style.paved
        a, b, far = (u, u + width, setback + 1.0) if whole else (u + width - drive, u + width, setback + self.rng.uniform(2, 9))
        if whole or self.rng.random() < 0.6:
            us, vs = np.arange(a, b, 0.3), np.arange(walk - 0.5, far, 0.3)
            rows = np.array([[side.at(float(p), 0.0)[:2], side.at(float(p), 10.0)[:2]] for p in us])
            self.ground.pave((rows[:, :1] + (rows[:, 1:] - rows[:, :1]) * (vs / 10.0)[None, :, None]).reshape(-1, 2))

    def frontage(self, side: _Side, style: _Style, u0: float, u1: float, walk: float, house: bool) -> None:
        rng = self.rng
        if style.frontage == "none" or rng.random() < (0.2 if house else 0.5):
            return
        opening = rng.uniform(2.5, 4.0)
        start = rng.uniform(u0, max(u0 + 0.1, u1 - opening))
        hedge = partial(objects.hedge, bare=self.bare)
        makers: list[Callable[[Rng, F64], Parts]] = [hedge, objects.fence, objects.garden_wall]
        make = makers[int(rng.integers(3)) if style.frontage == "any" else 1]
        state = int(rng.integers(2**31))
        for a, b in ((u0, start), (start + opening, u1)):
            line = side.line(a + 0.4, b - 0.4, walk + 0.6)
            if b - a > 2.5 and self.ground.allowed(line):
                self.put_line(make(np.random.default_rng(state), line))
                self.ground.take(line)
        if rng.random() < 0.5 and style.setback > 5:
            self.parked(side, start + opening / 2, walk + 3.2, 0.5, across=True)
        if rng.random() < 0.4 and style.gap > 1:
            line = np.array([side.at(u0, v)[:2] for v in np.linspace(walk + 1, walk + style.setback + 8, 8)])
            if self.ground.allowed(line):
                self.put_line(objects.fence(rng, line) if rng.random() < 0.5 else hedge(rng, line))

    def garden(self, side: _Side, style: _Style, u: float, width: float, walk: float, behind: float, house: bool) -> None:
        rng = self.rng
        for _ in range(rng.poisson(style.garden * width / 6)):
            near = rng.random() < (0.5 if house else 0.7)
            v = rng.uniform(walk + 0.8, max(walk + 1.0, walk + style.setback)) if near else behind + rng.uniform(1, 22)
            x, y, _ = side.at(u + rng.uniform(0, width), v)
            if not self.ground.allowed(np.array([[x, y], [x + 0.6, y], [x - 0.6, y], [x, y + 0.6], [x, y - 0.6]])):
                continue
            if rng.random() < 0.4:
                self.put_tree(x, y, rng.uniform(0.3, 1.1))
            elif rng.random() < 0.8:
                self.put(objects.bush(rng, bare=self.bare), x, y, rng.uniform(0, 6.3))
            else:
                self.put(objects.tufts(rng), x, y, 0.0)
            self.ground.take(np.array([[x, y]]))

    def parked(self, side: _Side, u: float, v: float, share: float, *, across: bool = False) -> None:
        """A parking place, taken with probability ``share`` in each session by another vehicle."""
        x, y, yaw = side.at(u, v)
        if self.change.random() > share:
            return
        turn = (np.pi / 2 if across else 0.0) + (np.pi if self.change.random() < 0.2 else 0.0) + self.change.normal() * 0.04
        shift = self.change.normal(size=2) * [0.3, 0.15]
        self.put(objects.parked_vehicle(self.change), x + shift[0], y + shift[1], yaw + turn, moving=True)

    def kerbside(self, side: _Side, style: _Style, edge: float, walk: float) -> None:
        """Lamps, signs, street trees, bins, parked cars and people between the carriageway and the plots."""
        rng = self.rng
        if side.road.parking:
            for u in np.arange(edge + 6, side.length - edge - 6, 6.2):
                self.parked(side, u + rng.normal() * 0.3, -1.05, style.parked)
        kerb = 0.5
        lamp, state = str(rng.choice(["lamp", "lamp", "double", "park"])), int(rng.integers(2**31))
        for u in np.arange(edge + rng.uniform(0, 15), side.length - edge, style.lamp_pitch):
            x, y, yaw = side.at(u, kerb)
            self.put(objects.pole(np.random.default_rng(state), lamp), x, y, yaw, aside=True)
        if walk > 2.0 or rng.random() < 0.4:
            for u in np.arange(edge + 3 + rng.uniform(0, style.tree_pitch), side.length - edge, style.tree_pitch):
                x, y, _ = side.at(u + rng.normal(), 0.9 if walk > 2 else walk + 1.0)
                self.put_tree(x, y, style.tree_size * rng.uniform(0.7, 1.2))
        for kind, rate in (
            ("sign", 30.0),
            ("parking", 90.0),
            ("street", 90.0),
            ("mast", 140.0),
            ("bollard", 80.0),
            ("gantry", 900.0),
            ("flag", 400.0),
        ):
            for u in rng.uniform(edge - 3, max(edge, side.length - edge + 3), rng.poisson(side.length / rate)):
                x, y, yaw = side.at(float(u), kerb)
                self.put(objects.pole(rng, kind), x, y, yaw, aside=True)
        if rng.random() < 0.35:
            x, y, yaw = side.at(side.length - edge + 2.5 if side.sign > 0 else edge - 2.5, kerb)
            self.put(objects.pole(rng, "signals"), x, y, yaw, aside=True)
        for _ in range(rng.poisson(side.length / 30)):
            x, y, yaw = side.at(rng.uniform(edge, max(edge + 1, side.length - edge)), max(kerb, walk - 0.5))
            self.put(objects.street_clutter(self.change), x, y, yaw + np.pi, moving=True, aside=True)
        for make, pitch in ((objects.bicycle_stand, 120.0), (objects.shelter, 250.0)):
            for u in rng.uniform(edge, max(edge + 1, side.length - edge - 8), rng.poisson(side.length / pitch if walk > 2.0 else 0.0)):
                x, y, yaw = side.at(float(u), walk - 1.1)
                self.put(make(rng), x, y, yaw, aside=True)
        for _ in range(self.change.poisson(side.length / 40)):
            x, y, yaw = side.at(self.change.uniform(0, side.length), self.change.uniform(0.4, max(0.6, walk)))
            passer = objects.person if self.change.random() < 0.7 else objects.two_wheeler
            self.put(passer(self.change), x, y, self.change.uniform(0, 6.3), moving=True, aside=True)
        for _ in range(self.change.poisson(side.length / 150)):
            x, y, yaw = side.at(self.change.uniform(edge, max(edge + 1, side.length - edge)), 0.4 if side.road.parking else -0.4)
            self.put(objects.rider(self.change), x, y, yaw, moving=True)

    def railway(self) -> None:
        """Wagons on a siding, in one town of three, where there is room for it."""
        rng, ground = self.rng, self.ground
        i, j = np.nonzero(ground.free & (ground.beside > 8))
        if rng.random() > 0.35 or not len(i):
            return
        for k in rng.integers(0, len(i), 60):
            x, y = ground.corner + 0.5 * (np.array([i[k], j[k]]) + 0.5)
            yaw, count = rng.uniform(0, np.pi), int(rng.integers(1, 4))
            gx, gy = np.meshgrid(np.arange(-13.0, 26.0 * count - 13, 0.5), np.arange(-2.5, 2.6, 0.5))
            along = np.array([np.cos(yaw), np.sin(yaw)])
            cells = gx.reshape(-1, 1) * along + gy.reshape(-1, 1) * np.array([-along[1], along[0]]) + [x, y]
            if ground.allowed(cells):
                ground.take(cells)
                for n in range(count):
                    self.put(objects.railway_wagon(rng), x + 26.0 * n * along[0], y + 26.0 * n * along[1], yaw, aside=True)
                return

    def backlands(self) -> None:
        """Trees, sheds and houses in what is left behind the plots."""
        rng, ground = self.rng, self.ground
        i, j = np.nonzero(ground.free & (ground.beside > 5))
        for k in rng.integers(0, max(1, len(i)), int(len(i) * 0.25 / 80) if len(i) else 0):
            x, y = ground.corner + 0.5 * (np.array([i[k], j[k]]) + 0.5)
            size = rng.uniform(3, 11, 2)
            g = np.stack(np.meshgrid(np.arange(-0.5, 0.51, 0.1), np.arange(-0.5, 0.51, 0.1)), -1).reshape(-1, 2)
            yaw = rng.uniform(0, np.pi)
            cells = (g * size) @ np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]]) + [x, y]
            if rng.random() < 0.35 and ground.allowed(cells):
                shape = building(rng, float(size[0]), float(size[1]), rng.uniform(2.3, 7), str(rng.choice(["flat", "gable", "hip"])))
                self.put([(place(m, 0, -size[1] / 2), label) for m, label in shape], x, y, yaw)
                ground.take(cells)
            elif ground.allowed(np.array([[x, y]])):
                self.put_tree(x, y, rng.uniform(0.4, 1.2))


def street_ground(network: RoadNetwork, seed: int) -> Ground:
    """The ground alone of the world that :func:`build_street` makes of the same network and seed; trajectories take heights from it."""
    return Ground(network, np.random.default_rng([seed, 10]))


def build_street(path: F64 | RoadNetwork, seed: int, condition: Condition | int = 0) -> World:
    """A street world along a driven path (n, 2 or 3) in metres or a road network.

    The same seed and condition give the same bytes; the condition's number changes parked cars, people, bins and a few trees, and is
    enough where nothing else differs.
    """
    condition = condition if isinstance(condition, Condition) else Condition(condition)
    network = path if isinstance(path, RoadNetwork) else path_network(np.random.default_rng([seed, 9]), path)
    ground = street_ground(network, seed)
    street = _Street(ground, seed, condition)
    town = int(street.rng.integers(2**31))
    for road in network.roads:
        for sign in (1, -1):
            street.side(_Side(road, sign), _style(street.rng, np.random.default_rng(town)))
    street.railway()
    street.backlands()
    mesh, labels = ground.mesh()
    street.static.add(mesh, labels, ground="none")
    return join_worlds(street.static.build(), street.moving.build())
