"""Street furniture standing on z = 0: poles of many kinds, signs and signals, shelters, benches,
bins; and people.
"""

from __future__ import annotations

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.simulation.meshes.shapes import Parts, Rng, boxes, joined, tubes, wheels
from semloc_logs.simulation.meshes.world import (
    BUILDING,
    FENCE,
    PERSON,
    POLE,
    TRAFFIC_LIGHT,
    TRAFFIC_SIGN,
    UNLABELLED,
    VEGETATION,
    Mesh,
    box,
    cylinder,
    ellipsoid,
    place,
)


def person(rng: Rng) -> Parts:
    """Somebody who stands or walks along +x: a grown-up or a child, with arms, sometimes a bag, a
    pram or a suitcase.
    """
    height = float(rng.uniform(1.05, 1.45) if rng.random() < 0.12 else rng.uniform(1.52, 1.92))
    stride = rng.uniform(0.0, 0.32)
    broad = rng.uniform(0.85, 1.2)
    hip = 0.5 * height
    shoulder = 0.82 * height
    lines = []
    for s in (-1, 1):
        lines += [([0, 0.09 * s, hip], [s * stride / 2, 0.1 * s, 0.0], 0.085, 0.06)]
        lines += [
            (
                [0, 0.2 * s * broad, shoulder - 0.04],
                [-s * stride * 0.7, 0.27 * s * broad, 0.44 * height],
                0.055,
                0.045,
            )
        ]
    start, end = (np.array([line[k] for line in lines], np.float64) for k in (0, 1))
    limbs = tubes(
        start, end, np.array([line[2] for line in lines]), np.array([line[3] for line in lines]), 5
    )
    trunk = cylinder(0.17, shoulder - hip + 0.08, 8, 0.16, z=hip - 0.06)
    torso = Mesh(trunk.vertices * [0.7 * broad, 1.15 * broad, 1.0], trunk.triangles)
    parts: Parts = [
        (joined(limbs, torso, ellipsoid((0.1, 0.085, 0.13), 0.925 * height, 4, 6)), PERSON)
    ]
    extra = rng.random()
    if extra < 0.06:
        rows = [
            [0.7, 0.45, 0.35, 0.75, 0, 0.5],
            [0.5, 0.04, 0.04, 0.3, 0, 0.95],
            [0.3, 0.4, 0.35, 0.95, 0, 0.8],
        ]
        parts.append(
            (
                joined(
                    boxes(np.array(rows)),
                    wheels([(x, s * 0.2) for x in (0.5, 1.0) for s in (-1, 1)], 0.12, 0.05, 6),
                ),
                UNLABELLED,
            )
        )
    elif extra < 0.2:
        parts[0] = (joined(parts[0][0], box(0.18, 0.3, 0.42, -0.2, 0, 0.55 * height)), PERSON)
    return parts


def pole(rng: Rng, kind: str) -> Parts:
    """A pole of a ``kind``; arms and faces look along +y.

    ``lamp``, ``double`` and ``park`` give light, ``mast`` carries wires, ``signals`` traffic
    lights; ``sign``, ``crossing``, ``parking``, ``street`` (a name) and ``gantry`` (over the
    carriageway) carry signs; ``flag`` and ``bollard``.
    """
    makers = {
        "lamp": _lamp,
        "double": _double,
        "park": _park,
        "mast": _mast,
        "signals": _signals,
        "gantry": _gantry,
        "bollard": _bollard,
    }
    if kind in makers:
        return makers[kind](rng)
    if kind == "flag":
        height = float(rng.uniform(6, 9))
        return [
            (cylinder(0.06, height, 6, 0.04), POLE),
            (box(0.02, 0.9, 2.0, 0, 0.5, height - 2.2), UNLABELLED),
        ]
    return _sign(rng, kind)


def _bollard(rng: Rng) -> Parts:
    height = float(rng.uniform(0.6, 1.1))
    kind = rng.integers(3)
    if kind == 0:
        return [(joined(cylinder(0.06, height, 6), cylinder(0.09, 0.1, 6, z=height - 0.08)), POLE)]
    return [
        (
            cylinder(0.08, height, 6)
            if kind == 1
            else joined(
                cylinder(0.16, 0.6 * height, 8, 0.13), ellipsoid((0.14, 0.14, 0.1), 0.6 * height)
            ),
            POLE,
        )
    ]


def _lamp(rng: Rng) -> Parts:
    height = float(rng.uniform(4.0, 9.5))
    arm = float(rng.uniform(0.3, 2.4))
    rise = rng.uniform(0.0, 0.5)
    straight = rng.random() < 0.3
    shaft = cylinder(0.1, height, 8, 0.05)
    if straight:
        return [
            (
                joined(
                    shaft,
                    cylinder(0.12, 0.35, 8, 0.28, z=height - 0.05),
                    cylinder(0.16, 1.0, 8, 0.11),
                ),
                POLE,
            )
        ]
    bend = np.array(
        [[0, 0, height - 0.1], [0, 0.5 * arm, height + 0.8 * rise], [0, arm, height + rise]]
    )
    head = place(box(0.28, 0.7, 0.14), 0, arm + 0.2, height + rise - 0.08)
    return [
        (
            joined(
                shaft,
                cylinder(0.15, 1.0, 8, 0.11),
                tubes(bend[:-1], bend[1:], 0.04, 0.035, 5),
                head,
            ),
            POLE,
        )
    ]


def _double(rng: Rng) -> Parts:
    height = float(rng.uniform(6.0, 10.0))
    arm = float(rng.uniform(1.0, 2.2))
    ends = np.array([[0, s * arm, height + 0.3] for s in (-1, 1)])
    top = np.array([[0, 0, height - 0.2]] * 2)
    heads = boxes(np.array([[0.28, 0.7, 0.14, 0, s * (arm + 0.2), height + 0.22] for s in (-1, 1)]))
    return [(joined(cylinder(0.11, height, 8, 0.06), tubes(top, ends, 0.05, 0.04, 5), heads), POLE)]


def _park(rng: Rng) -> Parts:
    height = float(rng.uniform(3.0, 4.5))
    globe = (
        ellipsoid((0.22, 0.22, 0.25), height + 0.2, 5, 8)
        if rng.random() < 0.5
        else cylinder(0.14, 0.45, 6, 0.24, z=height)
    )
    return [
        (
            joined(
                cylinder(0.06, height + 0.1, 7),
                cylinder(0.14, 0.5, 7, 0.08),
                globe,
                cylinder(0.3, 0.08, 8, 0.05, z=height + 0.44),
            ),
            POLE,
        )
    ]


def _mast(rng: Rng) -> Parts:
    """A wooden mast with one or two cross arms, or with a transformer; wires hang a metre or two
    along x from it only.
    """
    height = float(rng.uniform(7.5, 11.0))
    arms = [
        [0.12, rng.uniform(1.2, 2.2), 0.12, 0, 0, height - 0.6 - 0.8 * k]
        for k in range(int(rng.integers(1, 3)))
    ]
    knobs = [[0.08, 0.08, 0.2, 0, 0.42 * y * arms[0][1], height - 0.48] for y in (-1, -0.4, 0.4, 1)]
    extra = [[0.5, 0.5, 0.9, 0, 0.4, height - 3.0]] if rng.random() < 0.25 else []
    return [(joined(cylinder(0.16, height, 8, 0.1), boxes(np.array(arms + knobs + extra))), POLE)]


def wires(rng: Rng, span: float, height: float) -> Parts:
    """Three wires along +x that sag between two masts ``span`` metres apart: of no class."""
    x = np.linspace(0, span, 7)
    z = height - 0.5 - rng.uniform(0.02, 0.035) * span * (1 - (2 * x / span - 1) ** 2)
    lines = [np.column_stack([x, np.full(7, y), z]) for y in (-0.6, 0.0, 0.6)]
    return [(joined(*(tubes(line[:-1], line[1:], 0.012, 0.012, 3) for line in lines)), UNLABELLED)]


def _plate(rng: Rng, height: float, kind: str) -> Mesh:
    """The plate of a sign in the plane x = 0.05 with its lower edge at ``height``; it looks along
    x.
    """
    size = float(rng.uniform(0.42, 0.8))
    if kind == "street":
        return box(0.03, rng.uniform(0.6, 1.1), 0.18, 0.05, 0.35, height)
    if kind in ("crossing", "parking"):
        return box(0.03, size, size * rng.uniform(1.0, 1.4), 0.05, 0, height)
    shape = cylinder(size / 2, 0.03, int(rng.choice([3, 4, 8, 12])))
    spun = place(shape, 0, 0, 0, float(rng.choice([0.0, np.pi / 2, np.pi / 4])))
    return Mesh(spun.vertices[:, [2, 0, 1]] + [0.05, 0, height + size / 2], spun.triangles)


def _sign(rng: Rng, kind: str) -> Parts:
    height = float(rng.uniform(1.9, 2.5))
    plates = [_plate(rng, height, kind)]
    if rng.random() < 0.35:
        plates.append(box(0.03, 0.42, 0.25, 0.05, 0, height - 0.32))
    if rng.random() < 0.15:
        plates.append(place(_plate(rng, height + 0.1, kind), 0, 0, 0, np.pi / 2))
    turn = rng.normal() * 0.15
    return [
        (cylinder(0.035, float(max(p.vertices[:, 2].max() for p in plates)), 6), POLE),
        (place(joined(*plates), 0, 0, 0, turn), TRAFFIC_SIGN),
    ]


def _gantry(rng: Rng) -> Parts:
    """Direction signs on an arm that reaches over the carriageway."""
    reach = float(rng.uniform(3.0, 6.0))
    high = float(rng.uniform(5.6, 6.3))
    arm = boxes(
        np.array(
            [
                [0.18, reach, 0.18, 0, reach / 2, high + 0.6],
                [0.12, reach, 0.12, 0, reach / 2, high + 0.1],
            ]
        )
    )
    plate = box(
        0.06, reach * rng.uniform(0.4, 0.7), rng.uniform(1.0, 1.8), 0.12, reach * 0.65, high - 0.2
    )
    return [(joined(cylinder(0.18, high + 1.0, 8, 0.14), arm), POLE), (plate, TRAFFIC_SIGN)]


def _signals(rng: Rng) -> Parts:
    """Traffic lights on a pole, with a second set on an arm in two cases of five, and a set for
    people who cross.
    """
    height = float(rng.uniform(2.9, 3.5))
    arm = float(rng.uniform(2.5, 5.0)) if rng.random() < 0.4 else 0.0
    lights = [[0.3, 0.32, 0.95, 0.15, 0, height - 1.0]]
    poles = [cylinder(0.08, height, 8)]
    if arm:
        poles = [cylinder(0.13, 5.9, 8, 0.1), box(0.12, arm, 0.12, y=arm / 2, z=5.6)]
        lights += [[0.3, 0.35, 0.95, 0.15, arm, 5.0]]
        if rng.random() < 0.5:
            lights += [[0.3, 0.35, 0.95, 0.15, 0.5 * arm, 5.0]]
    if rng.random() < 0.6:
        lights += [[0.28, 0.25, 0.6, 0, 0.22, 2.1]]
    return [(joined(*poles), POLE), (boxes(np.array(lights)), TRAFFIC_LIGHT)]


def shelter(rng: Rng) -> Parts:
    """A bus shelter, open towards +y, with a bench; its sign beside it."""
    length = float(rng.uniform(2.8, 5.0))
    depth = float(rng.uniform(1.2, 1.7))
    rows = [
        [length, depth + 0.3, 0.12, 0, 0, 2.4],
        [length, 0.04, 2.0, 0, -depth / 2, 0.2],
        [0.04, depth, 2.0, -length / 2, 0, 0.2],
    ]
    rows += [[0.1, 0.1, 2.4, s * length / 2, t * depth / 2, 0] for s in (-1, 1) for t in (-1, 1)]
    if rng.random() < 0.6:
        rows += [[0.12, depth, 2.1, length / 2, 0, 0.2]]
    bench = [
        [0.6 * length, 0.4, 0.06, 0, -depth / 2 + 0.35, 0.45],
        [0.06, 0.3, 0.45, -0.2 * length, -depth / 2 + 0.35, 0],
    ]
    sign = place(joined(cylinder(0.04, 2.9, 6)), length / 2 + 1.2, depth / 2)
    plate = box(0.04, 0.5, 0.5, length / 2 + 1.25, depth / 2, 2.4)
    return [
        (boxes(np.array(rows)), BUILDING),
        (boxes(np.array(bench)), UNLABELLED),
        (sign, POLE),
        (plate, TRAFFIC_SIGN),
    ]


CLUTTER = (
    "bin",
    "cabinet",
    "bench",
    "skip",
    "letters",
    "hydrant",
    "column",
    "poster",
    "planter",
    "basket",
    "meter",
    "phone",
    "rack",
    "bins",
)


def street_clutter(rng: Rng, kind: str | None = None) -> Parts:
    """One of ``CLUTTER``, at random by default: occupied, mostly of no class."""
    drawn = str(rng.choice(CLUTTER))
    kind = kind or drawn
    size = rng.uniform(0.8, 1.25, 3)
    makers = {
        "column": _advertising_column,
        "hydrant": _hydrant,
        "basket": _basket,
        "meter": _meter,
        "planter": _planter,
        "rack": _rack,
    }
    if kind in makers:
        return makers[kind](rng, size)
    return [(boxes(np.array(_box_clutter(rng, size)[kind])), UNLABELLED)]


def _advertising_column(_: Rng, size: F64) -> Parts:
    """A column for posters."""
    tall = 3.2 * size[2]
    return [
        (
            joined(
                cylinder(0.6, tall, 12),
                cylinder(0.72, 0.15, 12, z=tall),
                cylinder(0.6, 0.4, 12, 0.1, z=tall + 0.15),
            ),
            UNLABELLED,
        )
    ]


def _hydrant(_: Rng, __: F64) -> Parts:
    """A hydrant."""
    return [
        (
            joined(
                cylinder(0.12, 0.6, 8),
                ellipsoid((0.13, 0.13, 0.12), 0.62, 4, 8),
                box(0.42, 0.14, 0.14, z=0.4),
            ),
            UNLABELLED,
        )
    ]


def _basket(_: Rng, __: F64) -> Parts:
    """A waste basket on a pole."""
    return [
        (cylinder(0.05, 1.2, 6), POLE),
        (place(cylinder(0.19, 0.55, 8, 0.22, z=0.5), 0, 0.25), UNLABELLED),
    ]


def _meter(_: Rng, __: F64) -> Parts:
    """A parking meter."""
    return [(joined(cylinder(0.05, 1.1, 6), box(0.3, 0.25, 0.7, z=1.0)), POLE)]


def _planter(rng: Rng, size: F64) -> Parts:
    """A tub with plants."""
    tub = boxes(np.array([[1.4 * size[0], 0.7 * size[1], 0.6 * size[2], 0, 0, 0]]))
    angle = rng.uniform(0, 2 * np.pi, 60)
    centre = np.column_stack(
        [
            0.5 * np.cos(angle) * size[0],
            0.25 * np.sin(angle),
            0.6 * size[2] + rng.uniform(0.0, 0.5, 60),
        ]
    )
    corners = centre[:, None] + rng.uniform(-0.16, 0.16, (60, 3, 3))
    return [
        (tub, UNLABELLED),
        (
            Mesh(corners.reshape(-1, 3), np.arange(180, dtype=np.int64).reshape(-1, 3)),
            VEGETATION,
        ),
    ]


def _rack(rng: Rng, __: F64) -> Parts:
    """A row of stands for bicycles."""
    return [
        (
            boxes(
                np.array([[0.05, 1.0, 0.8, 0.9 * k, 0, 0] for k in range(int(rng.integers(2, 6)))])
            ),
            FENCE,
        )
    ]


def _box_clutter(rng: Rng, size: F64) -> dict[str, list[list[float]]]:
    """Boxes (length, width, height, x, y, z) of things that are made of these alone, by kind."""
    return {
        "bin": [
            [0.55, 0.6, 1.0, 0, 0, 0.05],
            [0.6, 0.65, 0.08, 0, 0, 1.03],
            [0.4, 0.15, 0.1, 0, -0.25, 0.0],
        ],
        "bins": [[0.55, 0.6, 1.05, 0.68 * k, 0, 0.0] for k in range(int(rng.integers(2, 5)))],
        "cabinet": [
            [1.0 * size[0], 0.4, 1.2 * size[2], 0, 0, 0],
            [1.04 * size[0], 0.46, 0.06, 0, 0, 1.2 * size[2]],
        ],
        "bench": [
            [1.7, 0.45, 0.06, 0, 0, 0.42],
            [1.7, 0.06, 0.42, 0, -0.24, 0.46],
            *([0.1, 0.42, 0.42, s * 0.65, 0, 0] for s in (-1, 1)),
        ],
        "skip": [
            [3.2 * size[0], 1.6, 1.1 * size[2], 0, 0, 0.1],
            [3.0 * size[0], 1.3, 0.1, 0, 0, 0],
        ],
        "letters": [[0.4, 0.45, 0.9, 0, 0, 0.55], [0.12, 0.12, 0.6, 0, 0, 0]],
        "poster": [
            [1.8, 0.18, 2.3, 0, 0, 0.5],
            [0.15, 0.12, 0.6, -0.6, 0, 0],
            [0.15, 0.12, 0.6, 0.6, 0, 0],
        ],
        "phone": [[0.9, 0.9, 2.2, 0, 0, 0], [1.0, 1.0, 0.12, 0, 0, 2.2]],
    }
