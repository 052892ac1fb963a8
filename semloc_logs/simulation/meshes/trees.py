"""Trees: a trunk, limbs and branches that reach into an envelope, and leaves about the ends; in
winter twigs instead of leaves.

A tree takes one number from the caller's generator and draws everything else from a generator of
its own, wood before leaves: so it stands in the same place with the same wood in every season.
Trunks count as vegetation, as in Cityscapes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.simulation.meshes.shapes import Parts, Rng, joined, triangles_of, tubes
from semloc_logs.simulation.meshes.world import VEGETATION, Mesh

LEAF_AREA = 0.26  # mean area of a loose triangle whose corners lie within +-1, of :func:`leaves`


@dataclass(frozen=True, slots=True)
class Species:
    """Ranges of the full-grown height in metres, of the clear stem and of the crown's radius as
    shares of it; the crown's shape.

    ``cover`` is the leaves' area over the area of the crown seen from the side; ``leaf`` their size
    in metres; ``rise`` how steep limbs are.
    """

    height: tuple[float, float]
    clear: tuple[float, float]
    radius: tuple[float, float]
    shape: str
    share: float
    cover: float = 1.6
    leaf: float = 0.34
    rise: float = 0.6
    stems: tuple[int, int] = (1, 1)
    evergreen: bool = False


SPECIES = {
    "round": Species((7.5, 13.5), (0.2, 0.36), (0.24, 0.36), "round", 0.24),
    "lime": Species((9.0, 16.0), (0.16, 0.3), (0.2, 0.28), "egg", 0.12, cover=2.0),
    "column": Species((8.0, 17.0), (0.06, 0.16), (0.08, 0.13), "round", 0.06, rise=2.5),
    "spreading": Species((7.0, 12.5), (0.2, 0.34), (0.38, 0.52), "flat", 0.1, cover=1.4, rise=0.45),
    "vase": Species((8.0, 14.0), (0.18, 0.3), (0.26, 0.36), "vase", 0.1, cover=1.4, rise=1.4),
    "birch": Species(
        (8.0, 14.0),
        (0.14, 0.3),
        (0.15, 0.22),
        "egg",
        0.08,
        cover=0.9,
        leaf=0.24,
        rise=1.2,
        stems=(1, 3),
    ),
    "weeping": Species(
        (6.5, 11.0), (0.25, 0.35), (0.35, 0.48), "dome", 0.04, cover=1.7, leaf=0.3, rise=1.0
    ),
    "multistem": Species(
        (4.0, 8.0),
        (0.08, 0.2),
        (0.3, 0.45),
        "vase",
        0.08,
        cover=1.3,
        leaf=0.28,
        rise=1.0,
        stems=(3, 6),
    ),
    "pollard": Species((4.0, 7.0), (0.5, 0.62), (0.24, 0.36), "round", 0.04, cover=2.0, rise=0.5),
    "young": Species(
        (3.5, 5.5), (0.35, 0.5), (0.14, 0.22), "egg", 0.06, cover=1.0, leaf=0.22, rise=1.2
    ),
    "cone": Species(
        (6.0, 16.0), (0.02, 0.14), (0.14, 0.24), "cone", 0.05, leaf=0.36, evergreen=True
    ),
    "cypress": Species(
        (3.0, 8.0), (0.0, 0.06), (0.1, 0.16), "cone", 0.03, leaf=0.24, evergreen=True
    ),
    "pine": Species(
        (8.0, 15.0), (0.5, 0.68), (0.18, 0.3), "flat", 0.05, cover=1.5, rise=0.3, evergreen=True
    ),
    "palm": Species((4.0, 10.0), (0.75, 0.85), (0.2, 0.3), "round", 0.004, evergreen=True),
}
_NAMES = list(SPECIES)
_SHARES = np.array([s.share for s in SPECIES.values()]) / sum(s.share for s in SPECIES.values())


def tree(
    rng: Rng, size: float = 1.0, kind: str | None = None, *, bare: bool = False, leafy: float = 1.0
) -> Parts:
    """A tree of one of ``SPECIES``, at random by default; ``size`` 1 is full-grown.

    With ``bare`` deciduous trees have twigs and no leaves; otherwise ``leafy`` is the share of
    their leaves that they still have.
    """
    own = np.random.default_rng(int(rng.integers(2**62)))
    drawn = str(own.choice(_NAMES, p=_SHARES))
    name = kind or drawn
    species = SPECIES[name]
    height = size * own.uniform(*species.height)
    clear = height * own.uniform(*species.clear)
    radius = height * own.uniform(*species.radius)
    if name == "palm":
        return [(_palm(own, height, 0.6 * radius + 0.8), VEGETATION)]
    if species.shape == "cone":
        return [(_conifer(own, height, clear, radius, species.leaf), VEGETATION)]
    crown = _Crown(clear, height - clear, radius)
    wood, ends = _wood(own, species, height, crown)
    cover = np.random.default_rng(int(own.integers(2**62)))
    hanging = name == "weeping"
    if bare and not species.evergreen:
        return [
            (joined(wood, twigs(cover, ends, 0.3 + 0.06 * radius, hanging=hanging)), VEGETATION)
        ]
    foliage = _foliage(cover, species, ends, crown, hanging=hanging)
    if not species.evergreen and leafy < 1:
        foliage = Mesh(foliage.vertices, foliage.triangles[: int(leafy * len(foliage.triangles))])
    return [(joined(wood, foliage), VEGETATION)]


def _envelope(shape: str, up: F64) -> F64:
    """Radius of the crown as a share of its greatest, at heights ``up`` in [0, 1] over its foot."""
    if shape == "round":
        return np.sqrt(np.clip(1 - (2 * up - 1) ** 2, 0, 1))
    if shape == "egg":
        return np.sqrt(np.clip(up, 0, 1)) * np.clip(1 - up**2, 0, 1) * 1.75 * (1 - 0.15 * up)
    if shape == "flat":
        return np.clip(up, 0, 1) ** 0.5 * np.clip(1.05 - up**5, 0, 1)
    if shape == "vase":
        return (0.25 + 0.75 * np.clip(up, 0, 1)) * np.sqrt(np.clip(1.02 - up**6, 0, 1))
    return np.sqrt(np.clip(1.02 - up**2, 0, 1))  # a dome


class _Crown(NamedTuple):
    """The crown of a tree in metres: its foot over the ground, its height and radius."""

    foot: float
    height: float
    radius: float


def _wood(rng: Rng, species: Species, height: float, crown: _Crown) -> tuple[Mesh, F64]:
    """Trunks, limbs and branches, and the ends of the branches (n, 3)."""
    thick = (0.017 * height + 0.03) * rng.uniform(0.75, 1.3)
    stems, meshes = _stems(rng, species, height, crown, thick)

    limbs = int(np.clip(rng.integers(6, 11) + len(stems), 6, 14))
    begin, tip = _limbs(rng, species, stems, limbs, crown)
    bend = (
        0.55 * begin
        + 0.45 * tip
        - np.array([0, 0, 1.0])
        * (0.08 * np.linalg.norm(tip - begin, axis=1))[:, None]
        * np.sign(species.rise - 0.8)
    )
    meshes.append(tubes(begin, bend, 0.42 * thick, 0.28 * thick, 5))
    meshes.append(tubes(bend, tip, 0.28 * thick, 0.1 * thick, 4))

    # branches from the nearest point of a limb or a stem to points all over the crown
    t = np.linspace(0.35, 1.0, 5)[:, None, None]
    along = np.concatenate([(bend + (tip - bend) * t).reshape(-1, 3), *(s[4:] for s in stems)])
    number = int(np.clip(10 + 4.0 * crown.radius * np.sqrt(crown.height), 14, 50))
    ends = _inside(rng, species.shape, number, crown) + 0.7 * stems[0][3] * [1, 1, 0]
    gap = ends[:, None] - along[None]
    cost = np.linalg.norm(gap, axis=2) + 0.8 * np.maximum(-gap[:, :, 2], 0)
    meshes.append(tubes(along[cost.argmin(1)], ends, 0.1 * thick + 0.008, 0.012, 3))
    return joined(*meshes), np.concatenate([ends, tip])


def _stems(
    rng: Rng, species: Species, height: float, crown: _Crown, thick: float
) -> tuple[list[F64], list[Mesh]]:
    """The lines (n, 3) of the stems, and their meshes."""
    starts = []
    meshes = []
    count = int(rng.integers(species.stems[0], species.stems[1] + 1))
    for k in range(count):
        spread = 0.0 if count == 1 else 0.45 * crown.radius
        angle = 2 * np.pi * k / count + rng.uniform(-0.4, 0.4)
        top = np.array(
            [
                spread * np.cos(angle),
                spread * np.sin(angle),
                crown.foot + crown.height * rng.uniform(0.6, 0.8),
            ]
        )
        foot = crown.foot
        levels = np.array([-0.4, 0.35, 0.55 * foot, foot, foot + 0.3 * crown.height, top[2]])
        share = np.clip(levels / top[2], 0, 1)
        wander = np.cumsum(rng.normal(size=(len(levels), 2)) * 0.011 * height, axis=0) * (
            share[:, None] > 0.1
        )
        line = np.column_stack([top[None, :2] * share[:, None] + wander, levels])
        line[:, :2] += (
            (0.25 * thick if count == 1 else 0.3)
            * np.array([np.cos(angle), np.sin(angle)])
            * (count > 1)
        )
        width = thick * (1.0 if count == 1 else 0.6) * np.array([1.5, 1.0, 0.9, 0.8, 0.5, 0.15])
        meshes.append(tubes(line[:-1], line[1:], width[:-1], width[1:], 7))
        starts.append(line)
    return starts, meshes


def _limbs(
    rng: Rng, species: Species, lines: list[F64], count: int, crown: _Crown
) -> tuple[F64, F64]:
    """Both ends (n, 3) of the limbs."""
    up = np.sort(rng.uniform(0.0, 0.75, count) ** 1.3)
    stem = rng.integers(0, len(lines), count)
    z = crown.foot + up * crown.height * 0.8
    base = np.array(
        [
            [
                np.interp(h, lines[s][:, 2], lines[s][:, 0]),
                np.interp(h, lines[s][:, 2], lines[s][:, 1]),
                h,
            ]
            for s, h in zip(stem, z, strict=True)
        ]
    )
    angle = 2.4 * np.arange(count) + rng.uniform(-0.5, 0.5, count) + rng.uniform(0, 6.3)
    high = np.clip(up * 0.8 + rng.uniform(0.12, 0.3, count) * species.rise, 0.1, 0.93)
    out = crown.radius * _envelope(species.shape, high) * rng.uniform(0.6, 0.85, count)
    tip = np.column_stack(
        [out * np.cos(angle), out * np.sin(angle), crown.foot + high * crown.height]
    )
    return base, tip


def _inside(rng: Rng, shape: str, count: int, crown: _Crown) -> F64:
    """Points (n, 3) in the crown, more of them near its surface, which has lumps and dents."""
    up = rng.uniform(0.03, 0.97, count)
    angle = rng.uniform(0, 2 * np.pi, count)
    phase = rng.uniform(0, 2 * np.pi, 4)
    lumps = (
        1
        + 0.16 * np.sin(2 * angle + phase[0]) * np.sin(4 * up + phase[1])
        + 0.12 * np.sin(3 * angle + 5 * up + phase[2])
    )
    out = crown.radius * _envelope(shape, up) * lumps * np.sqrt(rng.uniform(0.2, 1.0, count))
    z = crown.foot + up * crown.height
    return np.column_stack([out * np.cos(angle), out * np.sin(angle), z])


def leaves(rng: Rng, centre: F64, size: float | F64) -> Mesh:
    """A loose triangle of about ``size`` metres about each centre (n, 3)."""
    reach = np.broadcast_to(np.asarray(size, np.float64), (len(centre),))[:, None, None]
    return triangles_of(centre[:, None] + rng.uniform(-0.8, 0.8, (len(centre), 3, 3)) * reach)


def _foliage(rng: Rng, species: Species, ends: F64, crown: _Crown, *, hanging: bool) -> Mesh:
    """Leaves about the ends (n, 3) of the branches."""
    radius = crown.radius
    area = np.pi / 4 * crown.height * 2 * radius
    count = int(
        np.clip(
            species.cover
            * rng.uniform(0.75, 1.3)
            * 2
            * area
            / (LEAF_AREA * 0.64 * species.leaf**2 * 4),
            100,
            1100,
        )
    )
    size = species.leaf * 1.1 * max(1.0, np.sqrt(area / 40))
    pick = rng.integers(0, len(ends), count)
    wide = 0.28 + 0.13 * radius
    centre = ends[pick] + rng.normal(size=(count, 3)) * [wide, wide, 0.8 * wide]
    if hanging:
        centre[:, 2] -= (
            rng.uniform(0, 0.75, count)
            * np.maximum(centre[:, 2] - 0.7, 0)
            * (np.hypot(*centre[:, :2].T) > 0.4 * radius)
        )
    centre[:, 2] = np.maximum(centre[:, 2], 0.45)
    return leaves(rng, centre, size)


def twigs(rng: Rng, ends: F64, length: float, *, hanging: bool = False, each: int = 9) -> Mesh:
    """Thin triangles that run outwards from the ends of branches (n, 3)."""
    start = np.repeat(ends, each, axis=0) + rng.normal(size=(each * len(ends), 3)) * 0.5 * length
    middle = ends.mean(0)
    away = start - [middle[0], middle[1], 0.6 * middle[2]]
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-6)
    way = away + rng.normal(size=away.shape) * 0.5 + [0, 0, 0.2]
    if hanging:
        way = rng.normal(size=away.shape) * 0.12 - [0, 0, 1.6]
    end = start + way * length * rng.uniform(0.5, 1.3, (len(start), 1))
    end[:, 2] = np.maximum(end[:, 2], 0.3)
    across = rng.normal(size=start.shape) * 0.018
    return triangles_of(np.stack([start - across, start + across, end], axis=1))


def _conifer(rng: Rng, height: float, clear: float, radius: float, leaf: float) -> Mesh:
    """A straight trunk with whorls of sagging branches that carry the needles."""
    count = int(np.clip(14 * height, 40, 190))
    up = 1 - np.sqrt(rng.uniform(0.0004, 1, count))
    angle = 2.4 * np.arange(count) + rng.uniform(-0.3, 0.3, count)
    out = np.maximum(radius * (1 - up) * rng.uniform(0.7, 1.08, count), 0.12)
    z = clear + up * (height - clear)
    start = np.column_stack([np.zeros(count), np.zeros(count), z])
    sag = rng.uniform(-0.1, 0.3)
    end = np.column_stack(
        [out * np.cos(angle), out * np.sin(angle), np.maximum(z - sag * out, 0.15)]
    )
    trunk = np.array([[0, 0, -0.4], [0, 0, 0.6 * height], [0, 0, height]])
    thick = 0.013 * height + 0.03
    wood = tubes(
        trunk[:-1], trunk[1:], np.array([1.3, 0.6]) * thick, np.array([0.6, 0.1]) * thick, 6
    )
    needles = int(np.clip(26 * radius * height, 150, 1000))
    pick = rng.integers(0, count, needles)
    centre = start[pick] + (end - start)[pick] * np.sqrt(rng.uniform(0.08, 1, needles))[:, None]
    corners = centre[:, None] + rng.uniform(-1, 1, (needles, 3, 3)) * [
        1.2 * leaf,
        1.2 * leaf,
        0.5 * leaf,
    ]
    corners[..., 2] = np.maximum(corners[..., 2], 0.05)
    return joined(wood, tubes(start, end, 0.02, 0.01, 3), triangles_of(corners))


def _palm(rng: Rng, height: float, radius: float) -> Mesh:
    top = np.array([*rng.normal(size=2) * 0.04 * height, 0.85 * height])
    line = np.array([[0, 0, -0.4], 0.5 * top * [0.6, 0.6, 1], top])
    fronds = int(rng.integers(14, 26))
    angle = 2.4 * np.arange(fronds)
    steep = rng.uniform(-0.3, 1.1, fronds)
    way = np.column_stack([np.cos(angle), np.sin(angle), steep])
    side = np.column_stack([-np.sin(angle), np.cos(angle), np.zeros(fronds)]) * 0.28
    middle = top + 0.55 * radius * way
    tip = top + radius * way * [1, 1, 0.4] - [0, 0, 0.3 * radius]
    root = np.broadcast_to(top, middle.shape)
    corners = [
        np.stack(c, axis=1)
        for c in ((root, middle - side, middle + side), (middle - side, middle + side, tip))
    ]
    return joined(tubes(line[:-1], line[1:], 0.2, 0.16, 7), triangles_of(np.concatenate(corners)))
