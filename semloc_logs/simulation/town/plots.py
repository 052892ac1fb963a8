"""Plots of land beside a road: houses, gardens, frontages, drives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.simulation.meshes import objects
from semloc_logs.simulation.meshes.buildings import building
from semloc_logs.simulation.meshes.objects import Parts
from semloc_logs.simulation.meshes.world import Mesh
from semloc_logs.simulation.town.setting import Rng, Setting
from semloc_logs.simulation.town.sides import Side, Style
from semloc_logs.simulation.town.works import scaffolding, shell


@dataclass(frozen=True, slots=True)
class _House:
    """A house to build: the numbers that it follows from, its size in metres, its roof, and whether
    it is its neighbours' mirror image.
    """

    state: int
    width: float
    depth: float
    height: float
    roof: str
    mirrored: bool = False

    def parts(self) -> Parts:
        """Its meshes, the front near y = 0 looking along -y."""
        parts = building(
            np.random.default_rng(self.state), self.width, self.depth, self.height, self.roof
        )
        if not self.mirrored:
            return parts
        return [
            (Mesh(mesh.vertices * [-1.0, 1.0, 1.0], mesh.triangles[:, ::-1]), label)
            for mesh, label in parts
        ]


@dataclass(frozen=True, slots=True)
class _Row:
    """The plots along one side of a road, which begin ``walk`` metres beside the carriageway."""

    setting: Setting
    side: Side
    style: Style
    walk: float


def plots(setting: Setting, side: Side, style: Style) -> None:
    """Everything beyond the pavement along one side of a road."""
    edge = side.road.half_width + 5.0
    walk = side.road.sidewalk + (0.2 if side.road.sidewalk else 1.0)
    row = _Row(setting, side, style, walk)
    model = _drawn_house(setting.rng, style, float(np.clip(style.plot, 5, 45)))
    apart = style.gap
    u = edge + setting.rng.uniform(0, 4)
    number = 0
    while u < side.length - edge + 2:
        if style.copies == "none":
            width = float(np.clip(style.plot * setting.rng.uniform(0.7, 1.35), 5, 45))
            house = _drawn_house(setting.rng, style, width)
            gap = style.gap * setting.rng.uniform(0.3, 1.7)
        else:
            odd = style.copies == "mirror" and number % 2 == 1
            house = replace(model, mirrored=odd)
            gap = 0.0 if style.copies == "mirror" and not odd else apart
        _plot(row, u, gap, house)
        u += house.width + gap
        number += 1


def _drawn_house(rng: Rng, style: Style, width: float) -> _House:
    depth = float(np.clip(rng.uniform(0.6, 1.1) * min(width, 14.0), 6, 18))
    height = 2.9 * max(1.0, style.storeys * rng.uniform(0.75, 1.3)) + rng.uniform(0, 1.0)
    return _House(int(rng.integers(2**31)), width, depth, height, str(rng.choice(style.roofs)))


def _plot(row: _Row, u: float, gap: float, house: _House) -> None:
    """A plot of land: a house perhaps, its garden, frontage and drive."""
    setting = row.setting
    style = row.style
    rng = setting.rng
    width = house.width
    setback, built = _build(row, u, house)
    if style.kind == "car park":
        _car_park(row, u, width + gap, setback)
    elif style.kind == "square":
        _square(row, u, width + gap, setback)
    _pave(row, u - gap / 2, width + gap, setback)
    if gap > 1.8:  # beside the house
        setting.parked(
            row.side, u + width + gap / 2, row.walk + rng.uniform(2.8, 7.0), 0.6, across=True
        )
    if style.setback > 1.2:
        _frontage(row, u - gap / 2, u + width + gap / 2, built)
    _garden(row, u - gap / 2, width + gap, setback + (house.depth if built else 0.0), built)


def _build(row: _Row, u: float, house: _House) -> tuple[float, bool]:
    """Build the house, or not; how far it is set back, and whether it is built."""
    setting = row.setting
    style = row.style
    rng = setting.rng
    width = house.width
    setback = row.walk + max(
        0.3, style.setback * (rng.uniform(0.85, 1.15) if style.copies == "none" else 1.0)
    )
    gx, gy = np.meshgrid(
        np.arange(-width / 2 + 0.2, width / 2, 0.5), np.arange(0.2, house.depth + 0.1, 0.5)
    )
    built = bool(rng.random() < style.built)
    for further in (0.0, 0.8, 2.0, 4.0):  # where the road bends a house has to stand further back
        x, y, yaw = row.side.at(u + width / 2, setback + further)
        c = np.cos(yaw)
        s = np.sin(yaw)
        # the house's +y looks away from the road, which lies to the left of the traffic on this
        # side
        cells = np.column_stack(
            [x + c * gx.ravel() + s * gy.ravel(), y + s * gx.ravel() - c * gy.ravel()]
        )
        if setting.ground.allowed(cells):
            setback += further
            break
    else:
        built = False
    if built:
        _put_house(setting, house, x, y, yaw + np.pi)
        setting.ground.take(cells)
    return setback, built


def _put_house(setting: Setting, house: _House, x: float, y: float, yaw: float) -> None:
    """The house, or what has become of it: an empty plot, a shell or another house, or scaffolds
    before it.
    """
    draw = setting.works.random()
    kind = setting.works.random()
    other = int(setting.works.integers(2**31))
    if draw >= setting.condition.rebuilt:
        setting.put(house.parts(), x, y, yaw)
        return
    if kind < 0.3:
        return
    if kind < 0.5:
        setting.put(shell(house.width, house.depth, house.height), x, y, yaw, moving=True)
        setting.put(scaffolding(house.width, house.depth, house.height), x, y, yaw, moving=True)
    elif kind < 0.75:
        storeys = house.height * (0.5 + (other % 100) / 70)
        setting.put(
            replace(house, state=other, height=max(2.9, storeys), roof="flat").parts(),
            x,
            y,
            yaw,
            moving=True,
        )
    else:
        setting.put(house.parts(), x, y, yaw)
        setting.put(scaffolding(house.width, house.depth, house.height), x, y, yaw, moving=True)


def _car_park(row: _Row, u: float, width: float, depth: float) -> None:
    """Rows of parked cars, and lamps between them."""
    setting = row.setting
    side = row.side
    walk = row.walk
    share = float(setting.rng.uniform(0.2, 0.95))
    room = side.area(u, u + width, walk + 1.0, depth - 2.0)
    if not setting.ground.allowed(room):
        return
    setting.ground.take(room)
    for v in np.arange(walk + 3.5, depth - 3.0, 8.5):
        for along in np.arange(u + 2.0, u + width - 1.5, 2.7):
            for beside in (v, v + 5.2) if v + 8 < depth else (v,):
                setting.parked(side, float(along), float(beside), share, across=True)
        x, y, yaw = side.at(u + width / 2, v + 2.6)
        setting.put(objects.pole(setting.rng, "double"), x, y, yaw, aside=True)


def _square(row: _Row, u: float, width: float, depth: float) -> None:
    """Trees in rows on stone, a few benches, perhaps something in the middle."""
    setting = row.setting
    side = row.side
    walk = row.walk
    rng = setting.rng
    size = rng.uniform(0.5, 0.8)
    kind = str(rng.choice(["round", "column"]))
    pitch = rng.uniform(6.0, 9.0)
    for v in np.arange(walk + 3.0, depth - 4.0, pitch):
        for along in np.arange(u + 1.5, u + width, pitch):
            x, y, yaw = side.at(float(along), float(v))
            if setting.ground.allowed(np.array([[x, y]])) and rng.random() < 0.7:
                setting.put_tree(x, y, float(size), kind)
            elif rng.random() < 0.4:
                setting.put(objects.street_clutter(rng), x, y, yaw, aside=True)
    setting.ground.take(side.area(u, u + width, walk + 1.0, depth - 2.0))


def _pave(row: _Row, u: float, width: float, setback: float) -> None:
    """Stone between the pavement and the house: all of it, or a drive beside the house."""
    setting = row.setting
    drive = setting.rng.uniform(2.4, 4.5)
    whole = setting.rng.random() < row.style.paved
    a, b, far = (
        (u, u + width, setback + 1.0)
        if whole
        else (u + width - drive, u + width, setback + setting.rng.uniform(2, 9))
    )
    if whole or setting.rng.random() < 0.6:
        setting.ground.pave(row.side.area(a, b, row.walk - 0.5, far))


def _frontage(row: _Row, u0: float, u1: float, house: bool) -> None:
    """A hedge, a fence or a wall towards the road, with an opening, and perhaps one beside."""
    setting = row.setting
    side = row.side
    style = row.style
    walk = row.walk
    rng = setting.rng
    if style.frontage == "none" or rng.random() < (0.12 if house else 0.5):
        return
    opening = rng.uniform(2.5, 4.0)
    start = rng.uniform(u0, max(u0 + 0.1, u1 - opening))
    hedge = partial(objects.hedge, bare=setting.condition.bare)
    makers: list[Callable[[Rng, F64], Parts]] = [hedge, objects.fence, objects.garden_wall]
    makers += [objects.retaining_wall, objects.guard_rail]
    make = makers[
        {"fence": 1, "wall": 3, "rail": 4}[style.frontage]
        if style.frontage != "any"
        else int(rng.integers(3))
    ]
    state = int(rng.integers(2**31))
    for a, b in ((u0, start), (start + opening, u1)):
        line = side.line(a + 0.4, b - 0.4, walk + 0.6)
        if b - a > 2.5 and setting.ground.allowed(line):
            setting.put_line(make(np.random.default_rng(state), line))
            setting.ground.take(line)
    if rng.random() < 0.5 and style.setback > 5:
        setting.parked(side, start + opening / 2, walk + 3.2, 0.5, across=True)
    if rng.random() < 0.4 and style.gap > 1:
        line = np.array(
            [side.at(u0, v)[:2] for v in np.linspace(walk + 1, walk + style.setback + 8, 8)]
        )
        if setting.ground.allowed(line):
            setting.put_line(objects.fence(rng, line) if rng.random() < 0.5 else hedge(rng, line))


def _garden(row: _Row, u: float, width: float, behind: float, house: bool) -> None:
    """Trees, bushes and tall grass before the house and behind it."""
    setting = row.setting
    side = row.side
    style = row.style
    walk = row.walk
    rng = setting.rng
    for _ in range(rng.poisson(style.garden * width / 4)):
        has_hedge = rng.random() < (0.5 if house else 0.7)
        v = (
            rng.uniform(walk + 0.8, max(walk + 1.0, walk + style.setback))
            if has_hedge
            else behind + rng.uniform(1, 22)
        )
        x, y, _ = side.at(u + rng.uniform(0, width), v)
        if not setting.ground.allowed(
            np.array([[x, y], [x + 0.6, y], [x - 0.6, y], [x, y + 0.6], [x, y - 0.6]])
        ):
            continue
        if rng.random() < (0.2 if has_hedge else 0.5):
            setting.put_tree(x, y, rng.uniform(0.3, 1.1))
        elif rng.random() < 0.8:
            setting.put(objects.bush(rng, bare=setting.condition.bare), x, y, rng.uniform(0, 6.3))
        else:
            setting.put(objects.tufts(rng), x, y, 0.0)
        setting.ground.take(np.array([[x, y]]))
