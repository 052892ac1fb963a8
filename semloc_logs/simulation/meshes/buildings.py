"""Houses, rows, blocks of flats, sheds and halls: walls with openings, roofs, wings, and what hangs
on them.
"""

from __future__ import annotations

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.simulation.meshes import facades, landmarks, roofs
from semloc_logs.simulation.meshes.facades import FOOT, Openings
from semloc_logs.simulation.meshes.greenery import ivy
from semloc_logs.simulation.meshes.shapes import Parts, Rng, boxes, joined
from semloc_logs.simulation.meshes.world import BUILDING, Mesh, cylinder, place

ROOF_SHARES = {
    "gable": (
        ("gable", 0.6),
        ("half-hip", 0.12),
        ("gambrel", 0.08),
        ("mansard", 0.1),
        ("lean-to", 0.1),
    ),
    "cross": (("cross", 1.0),),
    "hip": (("hip", 0.8), ("mansard", 0.2)),
    "flat": (("flat", 0.85), ("lean-to", 0.08), ("mansard", 0.07)),
}


def building(rng: Rng, width: float, depth: float, height: float, roof: str) -> Parts:
    """A building whose front lies near y = 0 and looks along -y; its body reaches to y = ``depth``.
    ``roof``: gable, cross, hip, flat.

    Lengths in metres. It takes one number from ``rng``: a generator in the same state gives the
    same house, whatever is drawn afterwards. Small ones are sheds and garages, broad low ones
    halls, shops or a petrol station, high ones blocks of flats, few a church.
    """
    own = np.random.default_rng(int(rng.integers(2**62)))
    if min(width, depth) < 4.6:
        return landmarks.shed(own, width, depth, min(height, 3.2))
    special = own.random()
    if special < 0.02 and width > 11:
        return landmarks.church(own, width, depth)
    if special < 0.07 and width > 17 and height < 11:
        return landmarks.petrol_station(own, width, depth)
    if width > 20 and height < 9 and special < 0.6:
        return _hall(own, width, depth, height)
    return _house(own, width, depth, height, roof)


def _pick(rng: Rng, shares: tuple[tuple[str, float], ...]) -> str:
    weight = np.array([share for _, share in shares])
    return str(rng.choice([name for name, _ in shares], p=weight / weight.sum()))


def _walls(rng: Rng, where: roofs.Rectangle, height: float, o: Openings) -> tuple[Mesh, F64, F64]:
    """The four walls of a block; the mesh, and the columns (k, 2) and upper floors (m,) of its
    front.
    """
    x0, x1, y0, y1 = where
    corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    front, columns, floors = facades.front_wall(rng, corners[0], corners[1], height, o)
    shares = (float(rng.choice([0.0, 0.3, 0.8])), 0.9, float(rng.choice([0.0, 0.3, 0.8])))
    others = [
        facades.side_wall(rng, corners[k], corners[(k + 1) % 4], height, o, share)
        for k, share in zip((1, 2, 3), shares, strict=True)
    ]
    return joined(front, *others), columns, floors


def _house(rng: Rng, width: float, depth: float, height: float, roof: str) -> Parts:
    town = height > 8.0
    ground = str(
        rng.choice(
            ["windows", "windows", "shop", "garage"] if not town else ["shop", "shop", "windows"]
        )
    )
    o = facades.openings(rng, ground)
    x0 = -width / 2
    x1 = width / 2
    main = (x0, x1, 0.0, depth)
    meshes: list[Mesh] = []
    beside = (
        float(rng.uniform(2.6, 4.0)) if not town and width > 10 and rng.random() < 0.45 else 0.0
    )
    if beside:  # a garage, a carport or a lower wing takes one side of the plot
        left = bool(rng.random() < 0.5)
        main = (x0 + beside, x1, 0.0, depth) if left else (x0, x1 - beside, 0.0, depth)
        meshes.append(_beside(rng, (x0, x0 + beside) if left else (x1 - beside, x1), depth))
    kind = _pick(rng, ROOF_SHARES[roof])
    walls, columns, floors = _walls(rng, main, height, o)
    top, rise = roofs.roof(rng, kind, main, height)
    meshes += [walls, top]
    meshes += _wings(rng, main, depth, height, o, kind)
    if kind in ("gable", "hip", "half-hip", "gambrel") and rise > 2.2 and rng.random() < 0.45:
        meshes.append(roofs.dormers(rng, main, height, rise))
    if kind not in ("flat", "lean-to") and rng.random() < 0.7:
        meshes.append(roofs.chimneys(rng, main, height, rise))
    meshes += _outside(rng, main, height, o, columns, floors)
    parts: Parts = [(joined(*meshes), BUILDING)]
    if rng.random() < 0.06:
        wide = rng.uniform(2.0, max(2.5, 0.6 * width))
        parts += [
            (place(mesh, main[0] + wide / 2, 0.0), label)
            for mesh, label in ivy(rng, float(wide), min(height, float(rng.uniform(2.5, 8.0))))
        ]
    return parts


def _beside(rng: Rng, across: tuple[float, float], depth: float) -> Mesh:
    """A garage, a carport or a low wing between two x, set back."""
    a, b = across
    front = float(rng.uniform(0.0, 0.4) * depth)
    back = min(depth, front + float(rng.uniform(5.0, 7.5)))
    high = float(rng.uniform(2.3, 3.0))
    kind = rng.integers(3)
    if kind == 0:
        posts = [
            place(cylinder(0.08, high + 0.3, 6), x, y, -0.3)
            for x in (a + 0.2, b - 0.2)
            for y in (front + 0.2, back - 0.2)
        ]
        return joined(
            boxes(
                np.array([[b - a + 0.3, back - front, 0.18, (a + b) / 2, (front + back) / 2, high]])
            ),
            *posts,
        )
    o = facades.openings(rng, "garage" if kind == 1 else "windows")
    where = (a, b, front, back)
    return joined(
        _walls(rng, where, high, o)[0],
        roofs.roof(
            rng, str(rng.choice(["flat", "flat", "gable", "cross", "lean-to"])), where, high
        )[0],
    )


def _wings(
    rng: Rng, main: roofs.Rectangle, depth: float, height: float, o: Openings, kind: str
) -> list[Mesh]:
    """A gabled wing that stands a little before the front, or one at the back that makes the plan
    an L.
    """
    x0, x1, _, y1 = main
    width = x1 - x0
    meshes = []
    if kind in ("gable", "hip", "half-hip") and width > 8 and rng.random() < 0.4:
        wide = float(rng.uniform(0.28, 0.5)) * width
        start = float(rng.choice([x0, x1 - wide, x0 + rng.uniform(0, width - wide)]))
        where = (start, start + wide, -float(rng.uniform(0.25, 1.1)), 0.5 * depth)
        meshes += [_walls(rng, where, height, o)[0], roofs.roof(rng, "cross", where, height)[0]]
    if width > 7 and rng.random() < 0.4:
        wide = float(rng.uniform(0.3, 0.6)) * width
        deep = float(rng.uniform(0.25, 0.5)) * depth
        start = float(rng.choice([x0, x1 - wide]))
        low = height if rng.random() < 0.4 else min(height, float(rng.uniform(2.5, 3.5)))
        where = (start, start + wide, y1 - 0.1, y1 + deep)
        meshes += [
            _walls(rng, where, low, o)[0],
            roofs.roof(rng, str(rng.choice(["flat", "cross", "lean-to"])), where, low)[0],
        ]
    return meshes


def _outside(
    rng: Rng, main: roofs.Rectangle, height: float, o: Openings, columns: F64, floors: F64
) -> list[Mesh]:
    """Balconies or bays, trim, a porch or awnings, steps, string courses and pipes at the front."""
    x0, x1, y, _ = main
    meshes = []
    width = x1 - x0
    if rng.random() < 0.6:
        meshes.append(facades.trim(rng, columns, floors, x0, y, o))
    if len(floors) and rng.random() < (0.45 if height > 8 else 0.2):
        meshes.append(facades.balconies(rng, columns, floors, x0, y, float(rng.uniform(0.5, 1.3))))
    elif len(columns) and rng.random() < 0.4:
        high = float(rng.choice([min(2.7, height), height - 0.2]))
        deep = float(rng.uniform(0.4, 0.9))
        chosen = rng.permutation(len(columns))[: int(rng.integers(1, 4))]
        meshes += [
            facades.bay(
                rng, x0 + float(columns[k].mean()), y, min(o.width + 0.8, o.pitch), deep, high
            )
            for k in chosen
        ]
    if o.ground == "shop":
        meshes.append(
            boxes(np.array([[0.96 * width, 0.2, 0.6, (x0 + x1) / 2, y - 0.1, o.storey - 0.42]]))
        )
        if rng.random() < 0.5:
            for a in np.arange(x0 + 0.3, x1 - 2.0, rng.uniform(3.0, 6.0)):
                wide = min(float(rng.uniform(2.0, 4.0)), x1 - 0.2 - a)
                meshes.append(
                    place(
                        facades.awning(wide, float(rng.uniform(0.8, 1.6)), 2.2),
                        float(a) + wide / 2,
                        y,
                    )
                )
    elif rng.random() < 0.5:
        meshes.append(facades.porch(rng, x0 + float(rng.uniform(0.15, 0.85)) * width, y))
    if rng.random() < 0.3:
        rows = [
            [width, 0.16, 0.2, (x0 + x1) / 2, y - 0.08, z - 0.1]
            for z in (*floors[: int(rng.integers(1, 3))], height - 0.15)
        ]
        meshes.append(boxes(np.array(rows)))
    if rng.random() < 0.5:
        meshes.append(facades.pipes(rng, x0, x1, y, height))
    return meshes


def _hall(rng: Rng, width: float, depth: float, height: float) -> Parts:
    """A workshop, a warehouse or a supermarket: gates, few windows, a flat, low, saw-toothed or
    round roof, a sign or a canopy.
    """
    height = float(np.clip(height, 4.0, 9.0))
    where = (-width / 2, width / 2, 0.0, depth)
    corners = np.array([[-width / 2, 0], [width / 2, 0], [width / 2, depth], [-width / 2, depth]])
    pitch = float(rng.uniform(4.5, 9.0))
    gates = facades.columns_of(width, pitch, float(rng.uniform(2.5, 0.75 * pitch)), 1.0)
    rows = np.array(
        [
            [0.0, min(3.2, height - 0.6)],
            [height - 1.4 if height > 5.5 else height - 0.3, height - 0.25],
        ]
    )
    opened = rng.random((2, len(gates))) < np.array([[0.5], [0.8]])
    panes = facades.Panes(gates, rows, opened, float(rng.uniform(0.2, 0.5)))
    walls = [facades.wall(corners[0], corners[1], FOOT, height, panes)]
    o = facades.openings(rng, "blank")
    walls += [
        facades.side_wall(rng, corners[k], corners[(k + 1) % 4], height, o, 0.15) for k in (1, 2, 3)
    ]
    top, _ = roofs.roof(
        rng, str(rng.choice(["flat", "flat", "gable", "saw", "barrel", "lean-to"])), where, height
    )
    extra = []
    if rng.random() < 0.5:
        extra.append(boxes(np.array([[0.7 * width, 1.2, 0.25, 0, -0.6, 3.4]])))
    if rng.random() < 0.4:
        extra.append(
            boxes(
                np.array(
                    [
                        [
                            rng.uniform(2, 6),
                            0.25,
                            1.2,
                            rng.uniform(-0.2, 0.2) * width,
                            -0.1,
                            height - 0.6,
                        ]
                    ]
                )
            )
        )
    return [(joined(*walls, top, *extra), BUILDING)]
