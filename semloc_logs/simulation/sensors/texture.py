"""Colours of simulated surfaces, from the place in the world alone: the same from everywhere and in
every session.

Colours are linear reflectances (n, 3).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F32, I64, U8
from semloc_logs.simulation.meshes.world import (
    BUILDING,
    CAR,
    FENCE,
    MOTORCYCLE,
    PERSON,
    POLE,
    RIDER,
    ROAD,
    SIDEWALK,
    TERRAIN,
    TRAFFIC_LIGHT,
    TRAFFIC_SIGN,
    TRUCK,
    UNLABELLED,
    VEGETATION,
    WALL,
)
from semloc_logs.simulation.sensors.noise import (
    Octaves,
    Real,
    Stone,
    cell,
    letters,
    number,
    octaves,
    stones,
    within,
)
from semloc_logs.simulation.sensors.surface_colours import Surfaces


@dataclass(frozen=True, slots=True, eq=False)
class Spots:
    """What is looked at: points and unit normals of the triangles (n, 3), labels (n,), of the
    pieces they belong to the numbers (n,) and boxes (n, 3), of the triangles whether they are
    ``bark`` and numbers, sizes (n,) of the pixels in metres, ``paint`` (n,) share of road marking.
    """

    points: F32
    normals: F32
    labels: U8
    seed: I64
    low: F32
    high: F32
    bark: NDArray[np.bool_]
    own: I64
    footprint: F32
    paint: F32

    def take(self, some: NDArray[np.intp]) -> Spots:
        """Some of the spots."""
        return Spots(*(getattr(self, field.name)[some] for field in fields(self)))

    def noise(
        self, size: float, count: int, keep: float, *, stretch: float = 1.0, seed: int = 0
    ) -> F32:
        """:func:`noise.octaves` at the spots."""
        noise = Octaves(size, count, keep, stretch)
        return np.asarray(octaves(self.points, self.footprint, noise, seed))

    def along(self) -> F32:
        """Metres along the level direction of the surface, whichever way the triangle is turned."""
        level = np.stack([-self.normals[:, 1], self.normals[:, 0]], axis=1)
        level /= np.maximum(np.linalg.norm(level, axis=1, keepdims=True), 1e-6)
        level *= np.where(
            level @ np.array([0.83, 0.56], np.float32) < 0, np.float32(-1), np.float32(1)
        )[:, None]
        return np.asarray(np.einsum("ij,ij->i", level, self.points[:, :2]), np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Pixels:
    """What pixels see: points and unit normals of triangles (n, 3), numbers of these and labels
    (n,), sizes (n,) of the pixels in metres, ``paint`` (n,) share of road marking.
    """

    points: F32
    normals: F32
    triangle: I64
    labels: U8
    footprint: F32
    paint: F32

    def take(self, mask: NDArray[np.bool_]) -> Pixels:
        """Some of the pixels."""
        return Pixels(*(getattr(self, field.name)[mask] for field in fields(self)))

    def spots(self, surfaces: Surfaces) -> Spots:
        """The spots on the surfaces of a world."""
        piece = surfaces.piece[self.triangle]
        return Spots(
            self.points,
            self.normals,
            self.labels,
            surfaces.seed[piece],
            surfaces.low[piece],
            surfaces.high[piece],
            surfaces.bark[self.triangle],
            surfaces.own[self.triangle],
            self.footprint,
            self.paint,
        )


def colours(spots: Spots, season: str) -> tuple[F32, F32]:
    """Reflectances (n, 3) and how much is mirrored (n,), both from 0 to 1."""
    colour = np.zeros((len(spots.points), 3), np.float32)
    gloss = np.zeros(len(spots.points), np.float32)
    for label in np.unique(spots.labels).tolist():
        some = np.flatnonzero(spots.labels == label)
        colour[some], gloss[some] = _PAINTERS.get(label, _thing)(spots.take(some), season)
    if season == "snow":
        _snow(spots, colour, gloss)
    return np.maximum(colour, np.float32(0)), gloss


def _rgb(r: Real, g: Real, b: Real) -> F32:
    return np.asarray(np.stack(np.broadcast_arrays(r, g, b), axis=-1), np.float32)


def _mix(a: F32, b: F32, share: NDArray[np.floating]) -> F32:
    return np.asarray(a + (b - a) * share[..., None], np.float32)


def _tone(a: F32, factor: NDArray[np.floating]) -> F32:
    return np.asarray(a * np.maximum(factor, 0.05)[..., None], np.float32)


def _painted(seed: I64, salt: I64 | int) -> F32:
    """Colours of things that are painted: grey ones as often as bright ones."""
    draw = [number(seed, np.asarray(salt) * 7 + k, 3) for k in range(5)]
    grey = 0.05 + 0.5 * draw[1] ** 1.5
    bright = _rgb(0.03 + 0.42 * draw[2] ** 2, 0.03 + 0.3 * draw[3] ** 2, 0.03 + 0.4 * draw[4] ** 2)
    return np.where((draw[0] < 0.55)[:, None], _rgb(grey, grey, grey), bright)


def _wall(spots: Spots, u: F32, h: F32) -> F32:
    """Brick, plaster or panels, with dirt and graffiti."""
    seed = spots.seed
    f = spots.footprint
    rough = spots.noise(1.7, 7, 0.85)
    style = number(seed, 1, 7)
    warm = number(seed, 2, 7)
    joint, tone = stones(u, h, Stone(0.24, 0.083, 0.014), f, seed)
    brick = _tone(
        _mix(_rgb(0.30, 0.11, 0.07), _rgb(0.42, 0.30, 0.17), warm**2),
        1 + 0.38 * tone + 0.24 * rough,
    )
    brick = _mix(brick, _rgb(0.42, 0.40, 0.36), 0.8 * joint)
    r, g, b = (number(seed, k, 7) for k in (3, 4, 5))
    plaster = _tone(
        _rgb(0.42 + 0.22 * r, 0.36 + 0.2 * r * g + 0.08 * b, 0.26 + 0.24 * b), 1 + 0.26 * rough
    )
    joint, tone = stones(u, h, Stone(1.8, 0.9, 0.03), f, seed)
    panel = _mix(
        _tone(_rgb(0.34, 0.33, 0.31), 1 + 0.1 * tone + 0.28 * rough),
        _rgb(0.1, 0.1, 0.1),
        0.8 * joint,
    )
    wall = np.where(
        (style < 0.35)[:, None], brick, np.where((style < 0.8)[:, None], plaster, panel)
    )
    streak = np.maximum(spots.noise(0.7, 1, 1.0, stretch=0.1, seed=5), 0)
    wall = _tone(wall, 1 - 0.35 * np.clip(1 - h / 0.8, 0, 1) - 0.1 * streak)
    i = cell(u, 1.7)
    j = cell(h, 1.1)
    sprayed = (number(i, j, seed) < 0.03) & (h < 2.2)
    return _mix(wall, _painted(seed, i), sprayed * letters(u, h, 0.09, f, seed))


def _facade(spots: Spots) -> tuple[F32, F32]:
    """A wall of a house with its windows and doors."""
    seed = spots.seed
    f = spots.footprint
    u = spots.along()
    h = (
        spots.points[:, 2] - spots.low[:, 2] - np.float32(1.5)
    )  # houses reach that far into the ground
    wall = _wall(spots, u, h)
    storey = 2.6 + 0.6 * number(seed, 6, 7)
    pitch = 1.7 + 1.9 * number(seed, 7, 7)
    i = cell(u, pitch)
    j = cell(h, storey)
    a = u - i * pitch
    b = h - j * storey
    width = 0.75 + 0.5 * number(seed, 8, 7)
    low = 0.85
    high = 2.15
    left = (pitch - width) / 2
    is_open = (j >= 0) & (number(i, j, seed + 1) > 0.15)
    is_door = is_open & (j == 0) & (number(i, 0, seed + 2) < 0.25)
    door = is_door * within(a, left, left + width, f) * within(b, -0.1, 2.1, f)
    panel = within(b % np.float32(0.7), 0.1, 0.6, f) * within(
        a, left + 0.12, left + width - 0.12, f
    )
    colour = _mix(wall, _tone(_painted(seed + i, 77), 0.6 + 0.4 * panel), door)
    has_window = is_open & ~is_door
    frame = (
        has_window
        * within(a, left - 0.08, left + width + 0.08, f)
        * within(b, low - 0.1, high + 0.06, f)
    )
    light = np.where(number(seed, 9, 7) < 0.7, np.float32(0.6), np.float32(0.08))
    colour = _mix(colour, _rgb(light, light, 0.97 * light), frame)
    pane = has_window * within(a, left, left + width, f) * within(b, low, high, f)
    middle = left + width / 2
    pane *= 1 - np.maximum(within(a, middle - 0.03, middle + 0.03, f), within(b, 1.77, 1.83, f))
    curtain = number(i, j, seed + 4)
    folds = 0.75 + 0.25 * np.sin(u * (24 + 14 * curtain)) * (f < 0.08)
    hang = within(b, low + 1.2 * (curtain - 0.5), high, f) * (
        1 - within(a, left + 0.3 * width, left + 0.7 * width * curtain, f)
    )
    inside = _mix(
        _rgb(0.04, 0.045, 0.05),
        _rgb(0.45 * folds, 0.42 * folds, 0.36 * folds),
        hang * (curtain > 0.5),
    )
    poster = ((curtain > 0.35) & (curtain <= 0.5)) * letters(u, h, 0.12, f, seed + 3)
    inside = _mix(inside, _painted(seed + i, j), poster)
    return _mix(colour, inside, pane), np.asarray(0.55 * pane, np.float32)


def _roof(spots: Spots) -> F32:
    """Tiles, or gravel where it is flat."""
    rough = spots.noise(1.5, 7, 0.85, seed=13)
    up = np.abs(spots.normals[:, 2])
    slope = np.sqrt(np.maximum(1 - up**2, 0.05))
    tiling = Stone(0.22, 0.34, 0.03)
    joint, tone = stones(
        spots.along(), spots.points[:, 2] / slope, tiling, spots.footprint, spots.seed
    )
    kind = number(spots.seed, 12, 7)[:, None]
    tile = np.where(
        kind < 0.5,
        _rgb(0.30, 0.11, 0.07),
        np.where(kind < 0.8, _rgb(0.09, 0.09, 0.1), _rgb(0.2, 0.13, 0.1)),
    )
    tiles = _mix(_tone(tile, 1 + 0.35 * tone + 0.3 * rough), _rgb(0.03, 0.03, 0.03), 0.7 * joint)
    return np.where((up > 0.97)[:, None], _tone(_rgb(0.22, 0.21, 0.2), 1 + 0.35 * rough), tiles)


def _building(spots: Spots, season: str) -> tuple[F32, F32]:
    colour = np.zeros((len(spots.points), 3), np.float32)
    gloss = np.zeros(len(spots.points), np.float32)
    is_wall = np.abs(spots.normals[:, 2]) < 0.25
    walls = np.flatnonzero(is_wall)
    roofs = np.flatnonzero(~is_wall)
    colour[walls], gloss[walls] = _facade(spots.take(walls))
    colour[roofs] = _roof(spots.take(roofs))
    return colour, gloss


def _road(spots: Spots, season: str) -> tuple[F32, F32]:
    """Asphalt with mended patches, cracks, covers and worn markings."""
    x = spots.points[:, 0]
    y = spots.points[:, 1]
    f = spots.footprint
    grain = spots.noise(0.35, 6, 0.9, stretch=0.0, seed=17)
    lines = spots.noise(1.6, 4, 0.6, stretch=0.0, seed=29)
    tone = 1 + 0.32 * grain + 0.1 * lines
    i = cell(x, 4.7)
    j = cell(y, 3.9)
    mend = number(i, j, 23)
    a = x - i * np.float32(4.7)
    b = y - j * np.float32(3.9)
    is_mended = mend < 0.2
    inner = (
        within(a, 1.5 - 5 * mend, 2.6 + 8 * mend, f)
        * within(b, 0.6, 1.4 + 11 * mend, f)
        * is_mended
    )
    outer = (
        within(a, 1.45 - 5 * mend, 2.65 + 8 * mend, f)
        * within(b, 0.55, 1.45 + 11 * mend, f)
        * is_mended
    )
    tone = tone * (1 - 0.3 * inner) * (1 - 0.5 * np.maximum(outer - inner, 0))
    cracked = number(cell(x, 6.0), cell(y, 6.0), 24) < 0.6
    tone = tone * (1 - 0.55 * cracked * within(np.abs(lines), -1.0, 0.018, 0.02 + 0.5 * f))
    colour = _tone(_rgb(0.125, 0.123, 0.12), tone)
    r = np.hypot(a - 2.3, b - 1.9)
    grid = within(a % np.float32(0.1), 0.02, 0.08, f) * within(b % np.float32(0.1), 0.02, 0.08, f)
    cover = (mend > 0.955) * within(r, -1.0, 0.36, f)
    colour = _mix(colour, _tone(_rgb(0.1, 0.085, 0.07), 0.6 + 0.9 * grid), cover)
    colour = _tone(colour, 1 - 0.6 * (mend > 0.955) * within(r, 0.35, 0.4, f))
    return _mix(
        colour, _rgb(0.62, 0.62, 0.6), spots.paint * (0.85 - 0.35 * np.maximum(grain, 0))
    ), np.zeros(len(x), np.float32)


def _sidewalk(spots: Spots, season: str) -> tuple[F32, F32]:
    x = spots.points[:, 0]
    y = spots.points[:, 1]
    joint, tone = stones(x + 0.13 * y, y - 0.13 * x, Stone(0.6, 0.4, 0.015), spots.footprint, 67)
    colour = _tone(
        _rgb(0.3, 0.29, 0.27), 1 + 0.16 * tone + 0.22 * spots.noise(0.9, 7, 0.85, seed=71)
    )
    return _mix(colour, _rgb(0.1, 0.1, 0.09), 0.6 * joint), np.zeros(len(x), np.float32)


def _terrain(spots: Spots, season: str) -> tuple[F32, F32]:
    bare = np.clip(0.5 + 1.2 * spots.noise(5.0, 4, 0.6, stretch=0.0, seed=73), 0, 1)
    grass = _mix(_rgb(0.2, 0.16, 0.09), _rgb(0.09, 0.16, 0.04), 0.25 + 0.75 * bare)
    grass = _tone(grass, 1 + 0.38 * spots.noise(0.5, 6, 0.9, seed=79))
    if season == "autumn":
        fallen = (
            number(cell(spots.points[:, 0], 0.12), cell(spots.points[:, 1], 0.12), 83) < 0.16
        ) & (spots.footprint < 0.2)
        grass = np.where(fallen[:, None], _rgb(0.4, 0.22, 0.04), grass)
    return grass, np.zeros(len(grass), np.float32)


def _plant(spots: Spots, season: str) -> tuple[F32, F32]:
    kind = number(spots.seed, 1, 43)
    leaf = number(spots.own, 2, 43)
    green = _mix(_rgb(0.07, 0.15, 0.03), _rgb(0.16, 0.2, 0.05), kind)
    if season == "autumn":
        turned = _mix(_rgb(0.42, 0.24, 0.03), _rgb(0.35, 0.08, 0.03), number(spots.seed, 3, 43))
        green = np.where(
            (kind < 0.8)[:, None], _mix(turned, _rgb(0.2, 0.2, 0.05), 0.6 * leaf), green
        )
    elif season in ("winter", "snow"):
        green = _mix(green, _rgb(0.12, 0.1, 0.06), np.full(len(kind), 0.5))
    colour = _tone(green, 0.55 + 0.9 * leaf + 0.35 * spots.noise(0.3, 5, 0.85, seed=47))
    some = np.flatnonzero(spots.bark)
    if len(some):
        stem = spots.take(some)
        ridges = 0.4 * stem.noise(0.12, 3, 0.8, stretch=0.25, seed=37) + 0.25 * stem.noise(
            0.6, 4, 0.8, seed=41
        )
        colour[some] = _tone(_rgb(0.16, 0.12, 0.085), 1 + ridges)
    return colour, np.zeros(len(colour), np.float32)


def _vehicle(spots: Spots, season: str) -> tuple[F32, F32]:
    """Paint, panes and tyres by height; nothing that stays in place while the vehicle drives."""
    size = spots.high[:, 2] - spots.low[:, 2]
    share = (spots.points[:, 2] - spots.low[:, 2]) / np.maximum(size, 0.1)
    up = np.abs(spots.normals[:, 2])
    is_car = (spots.labels == CAR) & (size < 2.1)
    glazed = (spots.labels != TRUCK) & (up < 0.5) & (share > 0.52) & (share < 0.8)
    pane = np.where(is_car, (up < 0.8) & (share > 0.58) & (share < 0.92), glazed)
    tyre = ~pane & (share < np.where(is_car, 0.24, 0.16))
    colour = np.where(pane[:, None], _rgb(0.03, 0.035, 0.04), _painted(spots.seed, 51))
    gloss = np.where(pane, np.float32(0.6), np.float32(0.12)) * ~tyre
    return np.where(tyre[:, None], _rgb(0.025, 0.025, 0.025), colour), np.asarray(gloss, np.float32)


def _masonry(spots: Spots, season: str) -> tuple[F32, F32]:
    joint, tone = stones(
        spots.along(), spots.points[:, 2], Stone(0.37, 0.19, 0.02), spots.footprint, spots.seed
    )
    stone = _mix(_rgb(0.33, 0.3, 0.25), _rgb(0.36, 0.2, 0.14), number(spots.seed, 1, 57))
    colour = _tone(stone, 1 + 0.4 * tone + 0.22 * spots.noise(0.8, 6, 0.85, seed=53))
    return _mix(colour, _rgb(0.3, 0.29, 0.27), 0.7 * joint), np.zeros(len(colour), np.float32)


def _fence(spots: Spots, season: str) -> tuple[F32, F32]:
    wood = _mix(_rgb(0.24, 0.16, 0.09), _rgb(0.45, 0.45, 0.43), number(spots.seed, 2, 57))
    grain = spots.noise(0.8, 6, 0.85, seed=53) + spots.noise(0.06, 2, 0.8, stretch=0.08, seed=59)
    return _tone(wood, 1 + 0.25 * grain), np.zeros(len(wood), np.float32)


def _pole(spots: Spots, season: str) -> tuple[F32, F32]:
    x, y, z = spots.points.T
    metal = _mix(_rgb(0.2, 0.21, 0.21), _rgb(0.05, 0.08, 0.06), number(spots.seed, 4, 57))
    metal = _tone(metal, 1 + 0.2 * spots.noise(0.8, 6, 0.85, seed=53))
    row = cell(z, 0.23)
    h = z - spots.low[:, 2]
    stuck = (number(row, spots.seed, 58) < 0.22) & (h > 0.5) & (h < 2.2)
    note = _mix(
        _painted(spots.seed, row),
        _rgb(0.6, 0.6, 0.6),
        letters(x + 1.3 * y, z, 0.035, spots.footprint, spots.seed),
    )
    return np.where(stuck[:, None], note, metal), np.zeros(len(x), np.float32)


def _sign(spots: Spots, season: str) -> tuple[F32, F32]:
    """A face with a rim and something written on it."""
    offset = spots.points - (spots.low + spots.high) / 2
    f = spots.footprint
    r = np.linalg.norm(offset, axis=1) / np.maximum(0.5 * (spots.high - spots.low)[:, 2], 0.1)
    kind = number(spots.seed, 5, 57)[:, None]
    rim = np.where(kind < 0.6, _rgb(0.5, 0.02, 0.02), _rgb(0.02, 0.08, 0.4))
    face = np.where(kind < 0.75, _rgb(0.65, 0.65, 0.65), _rgb(0.6, 0.45, 0.03))
    ink = letters(offset[:, 0] + 1.3 * offset[:, 1], offset[:, 2], 0.09, f, spots.seed) * within(
        r, -1.0, 0.62, f
    )
    return _mix(_mix(face, rim, within(r, 0.72, 99.0, f)), _rgb(0.02, 0.02, 0.02), ink), np.zeros(
        len(r), np.float32
    )


def _person(spots: Spots, season: str) -> tuple[F32, F32]:
    share = (spots.points[:, 2] - spots.low[:, 2]) / np.maximum(
        spots.high[:, 2] - spots.low[:, 2], 0.5
    )
    skin = _mix(_rgb(0.4, 0.25, 0.18), _rgb(0.1, 0.06, 0.04), number(spots.seed, 6, 57))
    cloth = np.where((share > 0.48)[:, None], _painted(spots.seed, 61), _painted(spots.seed, 62))
    return np.where((share > 0.87)[:, None], skin, cloth), np.zeros(len(share), np.float32)


def _lamp(spots: Spots, season: str) -> tuple[F32, F32]:
    return np.tile(_rgb(0.03, 0.03, 0.03), (len(spots.points), 1)), np.full(
        len(spots.points), 0.1, np.float32
    )


def _thing(spots: Spots, season: str) -> tuple[F32, F32]:
    """A box, a bin, a bicycle: painted, some of it written on."""
    colour = _tone(_painted(spots.seed, 63), 1 + 0.25 * spots.noise(0.8, 6, 0.85, seed=53))
    written = (spots.labels == UNLABELLED) & (number(spots.seed, 7, 57) < 0.4)
    ink = written * letters(spots.along(), spots.points[:, 2], 0.07, spots.footprint, spots.seed)
    return _mix(colour, _rgb(0.6, 0.58, 0.5), 0.7 * ink), np.zeros(len(colour), np.float32)


def _snow(spots: Spots, colour: F32, gloss: F32) -> None:
    """White on surfaces that are not steep; roads are driven away and salted."""
    up = np.abs(spots.normals[:, 2])
    some = np.flatnonzero((up > 0.35) & ((spots.labels < PERSON) | (spots.labels > MOTORCYCLE)))
    lying = spots.take(some)
    road = lying.noise(2.5, 5, 0.7, stretch=0.0, seed=97)
    cover = np.where(
        lying.labels == ROAD, 1.6 * road - 0.2, 0.9 + 0.7 * lying.noise(2.5, 4, 0.6, seed=89)
    )
    share = np.clip(cover, 0, 1) * np.clip(2 * (up[some] - 0.35), 0, 1)
    colour[some] = _mix(
        colour[some],
        _tone(_rgb(0.75, 0.78, 0.82), 1 + 0.1 * lying.noise(0.5, 6, 0.8, seed=101)),
        share,
    )
    gloss[some] *= 1 - share


_PAINTERS: dict[int, Callable[[Spots, str], tuple[F32, F32]]] = {
    ROAD: _road, SIDEWALK: _sidewalk, BUILDING: _building, WALL: _masonry, FENCE: _fence,
    POLE: _pole, TRAFFIC_LIGHT: _lamp,
    TRAFFIC_SIGN: _sign, VEGETATION: _plant, TERRAIN: _terrain, PERSON: _person, RIDER: _person,
    **dict.fromkeys(range(CAR, MOTORCYCLE), _vehicle),
}  # fmt: skip
