"""Vehicles along +x, standing on z = 0: cars of seven kinds, vans, lorries, buses, trams and
railway wagons, two-wheelers and riders.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.simulation.meshes.shapes import Parts, Rng, body, boxes, joined, tubes, wheels
from semloc_logs.simulation.meshes.world import (
    BICYCLE,
    BUS,
    CAR,
    MOTORCYCLE,
    RIDER,
    TRAIN,
    TRUCK,
    UNLABELLED,
    Mesh,
    cylinder,
    ellipsoid,
    place,
)


@dataclass(frozen=True, slots=True)
class _Kind:
    """Ranges of length, width, height; height of bonnet and boot as shares of the height; places
    along the length, from the tail (0) to the front (1), of boot's end, roof's end, roof's start
    and the foot of the windscreen.
    """

    length: tuple[float, float]
    width: tuple[float, float]
    height: tuple[float, float]
    bonnet: float
    boot: float
    at: tuple[float, float, float, float]
    share: float


_CARS = {
    "hatchback": _Kind(
        (3.5, 4.4), (1.64, 1.82), (1.40, 1.56), 0.55, 0.66, (0.03, 0.15, 0.55, 0.74), 0.32
    ),
    "saloon": _Kind(
        (4.4, 5.1), (1.74, 1.92), (1.38, 1.50), 0.56, 0.66, (0.16, 0.31, 0.55, 0.70), 0.20
    ),
    "estate": _Kind(
        (4.4, 5.0), (1.74, 1.90), (1.42, 1.54), 0.56, 0.68, (0.02, 0.09, 0.55, 0.71), 0.18
    ),
    "suv": _Kind(
        (4.1, 4.95), (1.78, 2.0), (1.58, 1.90), 0.60, 0.66, (0.02, 0.10, 0.57, 0.72), 0.16
    ),
    "minivan": _Kind(
        (4.2, 5.2), (1.76, 1.95), (1.62, 1.95), 0.56, 0.62, (0.02, 0.07, 0.62, 0.86), 0.08
    ),
    "coupe": _Kind(
        (4.0, 4.7), (1.74, 1.9), (1.24, 1.40), 0.58, 0.68, (0.10, 0.36, 0.52, 0.68), 0.04
    ),
    "mini": _Kind(
        (2.65, 3.5), (1.5, 1.66), (1.42, 1.58), 0.55, 0.66, (0.02, 0.10, 0.66, 0.88), 0.02
    ),
}


def car(rng: Rng, kind: str | None = None) -> Parts:
    """A passenger car: ``hatchback``, ``saloon``, ``estate``, ``suv``, ``minivan``, ``coupe`` or
    ``mini``; a random one by default.
    """
    names = list(_CARS)
    shares = np.array([_CARS[n].share for n in names])
    drawn = str(rng.choice(names, p=shares / shares.sum()))
    k = _CARS[kind or drawn]
    length, width, height = (float(rng.uniform(*r)) for r in (k.length, k.width, k.height))
    bonnet = height * k.bonnet * rng.uniform(0.96, 1.04)
    boot = height * k.boot * rng.uniform(0.96, 1.04)
    boot_end, roof_end, roof_start, screen = np.asarray(k.at) + rng.normal(size=4) * 0.008
    along = np.array(
        [
            0.0,
            0.015,
            boot_end + 0.015,
            roof_end + 0.02,
            (roof_end + roof_start) / 2,
            roof_start,
            screen,
            0.93,
            0.985,
            1.0,
        ]
    )
    top = np.array(
        [
            0.42,
            0.9 * boot,
            boot,
            0.98 * height,
            height,
            0.97 * height,
            bonnet + 0.06,
            bonnet - 0.04,
            0.8 * bonnet,
            0.5,
        ]
    )
    breadth = width * np.array([0.86, 0.94, 0.98, 1, 1, 1, 1, 0.97, 0.9, 0.8])
    hull = body(
        (along - 0.5) * length,
        top,
        breadth,
        rng.uniform(0.17, 0.26),
        0.62 * height,
        rng.uniform(0.22, 0.34),
    )
    radius = float(rng.uniform(0.29, 0.34)) * (1.08 if kind == "suv" else 1.0)
    axles = [(x, s * (width / 2 - 0.12)) for x in (-0.29 * length, 0.31 * length) for s in (-1, 1)]
    mirrors = boxes(
        np.array(
            [
                [0.12, 0.2, 0.14, (screen - 0.56) * length, s * (width / 2 + 0.08), 0.64 * height]
                for s in (-1, 1)
            ]
        )
    )
    extra = (
        [boxes(np.array([[1.4, 1.0, 0.3, -0.05 * length, 0, height]]))]
        if rng.random() < 0.03
        else []
    )
    return [(joined(hull, wheels(axles, radius), mirrors, *extra), CAR)]


def van(rng: Rng) -> Parts:
    """A delivery van, a minibus or a pick-up; Cityscapes counts them as cars."""
    if rng.random() < 0.15:
        return _pickup(rng)
    length = float(rng.uniform(4.4, 6.6))
    width = float(rng.uniform(1.85, 2.1))
    height = float(rng.uniform(1.85, 2.75))
    nose = rng.uniform(0.4, 1.0)
    rake = rng.uniform(0.5, 0.9)
    a = length / 2
    x = np.array([-a, -a + 0.06, -a + 0.15, a - nose - rake, a - nose, a - 0.12, a])
    top = np.array([0.5, height - 0.12, height, height, 1.25, 1.0, 0.5])
    hull = body(
        x,
        top,
        width * np.array([0.96, 0.98, 1, 1, 1, 0.94, 0.86]),
        0.25,
        1.2,
        rng.uniform(0.03, 0.1),
    )
    axles = [(u, s * (width / 2 - 0.13)) for u in (-0.29 * length, a - 0.85) for s in (-1, 1)]
    return [(joined(hull, wheels(axles, 0.34)), CAR)]


def _pickup(rng: Rng) -> Parts:
    length = float(rng.uniform(5.0, 5.6))
    width = float(rng.uniform(1.8, 2.0))
    height = float(rng.uniform(1.7, 1.9))
    a = length / 2
    bed = rng.uniform(1.3, 1.9)
    x = np.array([-a + bed, -a + bed + 0.15, -a + bed + 1.3, a - 1.5, a - 0.15, a])
    hull = body(x, np.array([1.1, height, height, 1.15, 1.0, 0.5]), width, 0.35, 1.1, 0.25)
    wall = 0.08
    rims = [[bed, wall, 0.7, -a + bed / 2, s * (width - wall) / 2, 0.4] for s in (-1, 1)]
    floor = [[bed, width, 0.3, -a + bed / 2, 0, 0.4], [wall, width, 0.7, -a + wall / 2, 0, 0.4]]
    axles = [(u, s * (width / 2 - 0.13)) for u in (-0.3 * length, a - 0.95) for s in (-1, 1)]
    return [(joined(hull, boxes(np.array(rims + floor)), wheels(axles, 0.38)), CAR)]


def camper(rng: Rng) -> Parts:
    """A motorhome with an alcove over the cab; Cityscapes trains nothing on it, networks call it a
    car or a truck.
    """
    length = float(rng.uniform(5.8, 7.2))
    height = float(rng.uniform(2.7, 3.1))
    a = length / 2
    cells = boxes(
        np.array(
            [
                [length - 1.9, 2.2, height - 0.5, -0.95, 0, 0.5],
                [1.6, 2.1, height - 2.0, a - 1.9, 0, 2.0],
            ]
        )
    )
    cab = body(
        np.array([a - 2.1, a - 1.4, a - 0.7, a - 0.1, a]),
        np.array([1.95, 1.95, 1.2, 1.0, 0.5]),
        1.95,
        0.3,
        1.15,
        0.12,
    )
    return [
        (
            joined(
                cells,
                cab,
                wheels([(u, s * 0.9) for u in (-0.25 * length, a - 0.9) for s in (-1, 1)], 0.34),
            ),
            CAR,
        )
    ]


def trailer(rng: Rng) -> Parts:
    """A caravan or a small trailer on its jockey wheel: of no class."""
    if rng.random() < 0.5:
        length = float(rng.uniform(4.0, 6.5))
        height = float(rng.uniform(2.4, 2.65))
        a = length / 2
        x = np.array([-a, -a + 0.3, a - 0.6, a])
        top = np.array([1.6, height, height, 1.3])
        hull = body(x, top, 2.2, 0.4, 1.2, 0.05)
    else:
        length = float(rng.uniform(1.8, 3.2))
        a = length / 2
        hull = boxes(
            np.array(
                [
                    [length, 1.4, 0.12, 0, 0, 0.5],
                    *([length, 0.05, 0.5, 0, s * 0.7, 0.5] for s in (-1, 1)),
                ]
            )
        )
    bar = boxes(np.array([[1.2, 0.1, 0.1, a + 0.55, 0, 0.4], [0.08, 0.08, 0.5, a + 1.0, 0, 0.0]]))
    return [(joined(hull, bar, wheels([(0.0, s * 0.8) for s in (-1, 1)], 0.3)), UNLABELLED)]


def truck(rng: Rng, articulated: float = 0.33) -> Parts:
    """A rigid lorry or, with that probability, an articulated one: with a box, a tarpaulin, a tank,
    a tipper or a load on a flat bed.
    """
    if rng.random() < articulated:
        return [(_articulated(rng), TRUCK)]
    length = float(rng.uniform(5.6, 10.0))
    height = float(rng.uniform(2.6, 3.6))
    bed = length - 2.3
    middle = -length / 2 + bed / 2
    axles = [(u, s * 1.02) for u in (-0.28 * length, length / 2 - 1.2) for s in (-1, 1)]
    frame = boxes(np.array([[length - 0.5, 0.9, 0.35, -0.1, 0, 0.6]]))
    return [
        (
            joined(
                _cab(rng, length / 2),
                place(_cargo(rng, bed, height), middle, 0),
                frame,
                wheels(axles, 0.48, 0.4),
            ),
            TRUCK,
        )
    ]


def _cab(rng: Rng, front: float) -> Mesh:
    height = float(rng.uniform(2.4, 3.4))
    x = front - np.array([1.95, 1.9, 0.35, 0.05, 0.0])
    return body(
        x,
        np.array([height - 0.4, height, height, 1.7, 0.9]),
        rng.uniform(2.2, 2.45),
        0.4,
        1.7,
        0.04,
    )


def _cargo(rng: Rng, length: float, height: float) -> Mesh:
    """What stands on a frame of ``length`` about x = 0, up to ``height`` over ground."""
    kind = rng.choice(["box", "box", "box", "tarpaulin", "tank", "tipper", "flat"])
    floor = [length, 2.45, 0.15, 0, 0, 0.95]
    if kind in ("box", "tarpaulin"):
        return boxes(np.array([[length, 2.48, height - 1.0, 0, 0, 1.0]]))
    if kind == "tank":
        ends = np.array([[-length / 2, 0, 2.0], [length / 2, 0, 2.0]])
        caps = [place(ellipsoid((0.3, 1.0, 1.0), 2.0, 5, 8), x, 0) for x in ends[:, 0]]
        return joined(tubes(ends[:1], ends[1:], 1.0, 1.0, 10), *caps, boxes(np.array([floor])))
    side = 0.6 if kind == "flat" else float(rng.uniform(0.8, 1.4))
    rims = [[length, 0.08, side, 0, s * 1.2, 1.0] for s in (-1, 1)] + [
        [0.08, 2.4, side, s * length / 2, 0, 1.0] for s in (-1, 1)
    ]
    load = [[0.7 * length, 1.9, rng.uniform(0.3, 1.5), -0.05 * length, 0, 1.1]]
    return boxes(np.array([floor, *rims, *load]))


def _articulated(rng: Rng) -> Mesh:
    length = float(rng.uniform(13.5, 16.5))
    height = float(rng.uniform(3.4, 4.0))
    bed = length - 2.8
    rear = -length / 2
    front = length / 2
    axles = [
        (u, s * 1.02)
        for u in (rear + 1.2, rear + 2.5, rear + 3.8, front - 4.2, front - 1.3)
        for s in (-1, 1)
    ]
    frame = boxes(np.array([[length - 0.6, 0.9, 0.3, 0, 0, 0.65]]))
    return joined(
        _cab(rng, front),
        place(_cargo(rng, bed, height), rear + bed / 2, 0),
        frame,
        wheels(axles, 0.5, 0.45),
    )


def bus(rng: Rng) -> Parts:
    """A city bus, an articulated one, a double-decker or a coach."""
    kind = rng.choice(["city", "city", "bent", "double", "coach"])
    length = float(
        {
            "city": rng.uniform(9.0, 12.5),
            "bent": 18.0,
            "double": rng.uniform(9.5, 11.5),
            "coach": rng.uniform(11, 13.5),
        }[kind]
    )
    height = float(
        {"city": 3.0, "bent": 3.05, "double": 4.2, "coach": 3.6}[kind] * rng.uniform(0.97, 1.04)
    )
    a = length / 2
    x = np.array([-a, -a + 0.15, a - 0.5, a - 0.05, a])
    top = np.array([height - 0.4, height, height, 1.6, 1.0])
    hulls = [body(x, top, np.array([2.35, 2.5, 2.5, 2.45, 2.3]), 0.3, 1.5, 0.03)]
    if kind == "bent":
        joint = rng.uniform(-0.05, 0.05) * length
        hulls = [
            boxes(
                np.array(
                    [
                        [a + joint - 0.6, 2.5, height - 0.3, (joint - 0.6 - a) / 2, 0, 0.3],
                        [1.4, 2.1, height - 0.6, joint, 0, 0.4],
                    ]
                )
            )
        ]
        front = np.array([joint + 0.6, joint + 0.7, a - 0.4, a - 0.05, a])
        hulls.append(body(front, top, 2.5, 0.3, 1.5, 0.03))
    if rng.random() < 0.5:
        hulls.append(boxes(np.array([[0.3 * length, 1.6, 0.3, -0.1 * length, 0, height - 0.02]])))
    axles = [(u, s * 1.1) for u in (-a + 3.1, a - 2.6) for s in (-1, 1)]
    return [(joined(*hulls, wheels(axles, 0.48, 0.3)), BUS)]


def tram(rng: Rng) -> Parts:
    """A tram of two to five sections with a pantograph; 16 to 32 m."""
    sections = int(rng.integers(2, 5))
    piece = float(rng.uniform(6.5, 8.5))
    height = float(rng.uniform(3.3, 3.6))
    width = float(rng.uniform(2.3, 2.55))
    length = sections * piece
    meshes = []
    for k in range(sections):
        a = -length / 2 + k * piece + 0.3
        b = -length / 2 + (k + 1) * piece - 0.3
        x = np.linspace(a, b, 4)
        top = np.full(4, height)
        if k == 0:
            x = np.array([a, a + 0.1, a + 0.9, b])
            top = np.array([1.2, 2.0, height, height])
        elif k == sections - 1:
            x = np.array([a, b - 0.9, b - 0.1, b])
            top = np.array([height, height, 2.0, 1.2])
        meshes.append(body(x, top, width, 0.3, 1.4, 0.05))
        meshes.append(
            boxes(
                np.array(
                    [[2.2, 2.0, 0.45, (a + b) / 2, 0, 0.0], [1.8, 1.4, 0.3, (a + b) / 2, 0, height]]
                )
            )
        )
    gaps = [
        [0.8, width - 0.4, height - 0.6, -length / 2 + k * piece, 0, 0.4]
        for k in range(1, sections)
    ]
    arm = np.array(
        [
            [0.0, 0, height + 0.2],
            [0.9, 0, height + 0.8],
            [0.0, 0, height + 1.5],
            [0.0, -0.8, height + 1.5],
            [0.0, 0.8, height + 1.5],
        ]
    )
    arm[:, 0] += (piece - length) / 2
    pantograph = tubes(arm[[0, 1, 3]], arm[[1, 2, 4]], 0.05, 0.05, 4)
    return [(joined(*meshes, boxes(np.array(gaps)), pantograph), TRAIN)]


def railway_wagon(rng: Rng) -> Parts:
    """A carriage, a covered goods wagon, a tank wagon or an open one; 10 to 25 m."""
    kind = rng.choice(["carriage", "covered", "tank", "open"])
    length = float(rng.uniform(20, 25) if kind == "carriage" else rng.uniform(10, 15))
    bogies = [[2.6, 2.2, 0.85, s * 0.34 * length, 0, 0.0] for s in (-1, 1)]
    buffers = [[length + 0.9, 0.3, 0.3, 0, s * 0.87, 0.9] for s in (-1, 1)]
    frame = [length, 2.6, 0.3, 0, 0, 0.85]
    if kind == "tank":
        ends = np.array([[-0.47 * length, 0, 2.5], [0.47 * length, 0, 2.5]])
        caps = [place(ellipsoid((0.4, 1.35, 1.35), 2.5, 5, 10), x, 0) for x in ends[:, 0]]
        return [
            (
                joined(
                    tubes(ends[:1], ends[1:], 1.35, 1.35, 10),
                    *caps,
                    boxes(np.array([*bogies, *buffers, frame])),
                ),
                TRAIN,
            )
        ]
    if kind == "open":
        walls = [[length, 0.1, 1.3, 0, s * 1.35, 1.1] for s in (-1, 1)] + [
            [0.1, 2.7, 1.3, s * length / 2, 0, 1.1] for s in (-1, 1)
        ]
        return [(boxes(np.array([*bogies, *buffers, frame, *walls])), TRAIN)]
    height = float(rng.uniform(3.8, 4.1))
    x = np.array([-length / 2, -length / 2 + 0.2, length / 2 - 0.2, length / 2])
    hull = body(x, np.array([height - 0.2, height, height, height - 0.2]), 2.8, 1.0, 3.2, 0.5)
    return [(joined(hull, boxes(np.array([*bogies, *buffers]))), TRAIN)]


def two_wheeler(rng: Rng, motor: bool | None = None) -> Parts:
    """A parked bicycle, or a motorcycle or scooter with ``motor``; at random by default."""
    drawn = bool(rng.random() < 0.4)
    mesh, label, _ = _machine(rng, drawn if motor is None else motor)
    lean = rng.normal() * 0.06
    mesh.vertices[:, 1] += mesh.vertices[:, 2] * lean
    return [(mesh, label)]


def _machine(rng: Rng, motor: bool) -> tuple[Mesh, int, float]:
    """A two-wheeler, its class and the height of its saddle in metres."""
    if motor:
        radius = float(rng.uniform(0.24, 0.32))
        base = float(rng.uniform(1.25, 1.5))
        x = np.array([-0.75 * base, -0.4 * base, 0.05 * base, 0.25 * base, 0.42 * base])
        hull = body(
            x,
            np.array([0.85, 0.8, 0.78, 1.0, 0.85]),
            np.array([0.2, 0.34, 0.3, 0.36, 0.25]),
            0.35,
            0.7,
            0.1,
        )
        bars = boxes(
            np.array(
                [
                    [0.06, 0.72, 0.06, 0.28 * base, 0, 1.02],
                    [0.35, 0.25, 0.3, -0.72 * base, 0, 0.85],
                ][: 2 if rng.random() < 0.4 else 1]
            )
        )
        fork = tubes(
            np.array([[0.5 * base, 0, radius]]), np.array([[0.3 * base, 0, 1.0]]), 0.06, 0.06, 4
        )
        return (
            joined(hull, bars, fork, wheels([(-base / 2, 0.0), (base / 2, 0.0)], radius, 0.14)),
            MOTORCYCLE,
            0.8,
        )
    radius = float(rng.uniform(0.31, 0.36))
    base = float(rng.uniform(0.98, 1.12))
    rear = [-base / 2, 0, radius]
    front = [base / 2, 0, radius]
    crank = [-0.1, 0, 0.3]
    saddle = [-0.28, 0, 0.92]
    head = [base / 2 - 0.2, 0, 0.85]
    grip = [base / 2 - 0.22, 0, 1.03]
    pairs = np.array(
        [
            [rear, crank],
            [rear, saddle],
            [crank, saddle],
            [crank, head],
            [[-0.25, 0, 0.8], head],
            [front, grip],
        ],
        np.float64,
    )
    rows = [[0.26, 0.16, 0.07, -0.28, 0, 0.92], [0.05, 0.58, 0.05, base / 2 - 0.24, 0, 1.01]]
    if rng.random() < 0.4:
        rows.append(
            [0.35, 0.3, 0.25, base / 2 - 0.05, 0, 0.85]
            if rng.random() < 0.5
            else [0.4, 0.14, 0.04, -0.55, 0, 0.74]
        )
    frame = tubes(pairs[:, 0], pairs[:, 1], 0.025, 0.025, 3)
    return (
        joined(
            frame,
            boxes(np.array(rows)),
            wheels([(-base / 2, 0.0), (base / 2, 0.0)], radius, 0.045, 12),
        ),
        BICYCLE,
        0.95,
    )


def bicycle_stand(rng: Rng) -> Parts:
    """A row of bicycles side by side in hoops along x: 3 to 10 places, some free."""
    parts: Parts = []
    pitch = float(rng.uniform(0.45, 0.8))
    for k in range(int(rng.integers(3, 11))):
        if rng.random() < 0.75:
            mesh, label, _ = _machine(rng, motor=False)
            parts.append(
                (
                    place(mesh, k * pitch, rng.normal() * 0.08, 0, np.pi / 2 + rng.normal() * 0.05),
                    label,
                )
            )
        hoop = np.array(
            [
                [k * pitch + 0.15, -0.35, 0],
                [k * pitch + 0.15, -0.35, 0.8],
                [k * pitch + 0.15, 0.35, 0.8],
                [k * pitch + 0.15, 0.35, 0],
            ]
        )
        parts.append((tubes(hoop[:-1], hoop[1:], 0.025, 0.025, 4), UNLABELLED))
    return parts


def rider(rng: Rng, motor: bool | None = None) -> Parts:
    """Somebody on a bicycle or, with ``motor``, on a motorcycle: the rider and the machine have
    classes of their own.
    """
    drawn = bool(rng.random() < 0.35)
    mesh, label, saddle = _machine(rng, drawn if motor is None else motor)
    return [(mesh, label), (_sitting(rng, saddle), RIDER)]


def _sitting(rng: Rng, saddle: float) -> Mesh:
    tall = float(rng.uniform(0.9, 1.08))
    lean = float(rng.uniform(0.05, 0.3))
    hip = np.array([-0.27, 0, saddle + 0.08])
    shoulder = np.array([-0.27 + lean, 0, saddle + 0.58 * tall])
    lines: list[tuple[F64, F64, float]] = []
    for s, pedal in ((-1, 0.0), (1, 0.2)):
        knee = np.array([0.12, 0.12 * s, saddle - 0.15 + pedal])
        foot = np.array([-0.05, 0.12 * s, 0.15 + pedal])
        lines += [
            (np.add(hip, [0, 0.1 * s, 0]), knee, 0.08),
            (knee, foot, 0.06),
            (np.add(shoulder, [0, 0.2 * s, -0.05]), np.array([0.28, 0.25 * s, 1.05]), 0.05),
        ]
    start, end, radius = (np.array([line[k] for line in lines]) for k in range(3))
    torso = cylinder(0.17, float(np.linalg.norm(shoulder - hip)), 8, 0.2)
    sheared = torso.vertices * [0.8, 1.1, 1.0]
    sheared[:, 0] += sheared[:, 2] * lean / max(shoulder[2] - hip[2], 0.1)
    head = place(ellipsoid((0.12, 0.1, 0.14), 0.0, 4, 6), shoulder[0] + 0.05, 0, shoulder[2] + 0.2)
    return joined(tubes(start, end, radius, radius, 5), Mesh(sheared + hip, torso.triangles), head)
