"""Rare buildings: a church, a petrol station; and sheds, garages, greenhouses and kiosks."""

from __future__ import annotations

import numpy as np

from semloc_logs.simulation.meshes import facades, roofs
from semloc_logs.simulation.meshes.facades import FOOT
from semloc_logs.simulation.meshes.shapes import Parts, Rng, boxes, joined, loft
from semloc_logs.simulation.meshes.world import (
    BUILDING,
    POLE,
    TRAFFIC_SIGN,
    UNLABELLED,
    Mesh,
    box,
    cylinder,
    place,
)


def shed(rng: Rng, width: float, depth: float, height: float) -> Parts:
    """A shed, a garage, a greenhouse or a kiosk on the plan of :func:`buildings.building`."""
    where = (-width / 2, width / 2, 0.0, depth)
    corners = np.array([[-width / 2, 0], [width / 2, 0], [width / 2, depth], [-width / 2, depth]])
    o = facades.openings(rng, str(rng.choice(["windows", "garage", "blank"])))
    walls = [facades.front_wall(rng, corners[0], corners[1], height, o)[0]]
    walls += [
        facades.side_wall(rng, corners[k], corners[(k + 1) % 4], height, o, 0.3) for k in (1, 2, 3)
    ]
    top, _ = roofs.roof(
        rng, str(rng.choice(["gable", "cross", "flat", "lean-to", "hip"])), where, height
    )
    return [(joined(*walls, top), BUILDING)]


def church(rng: Rng, width: float, depth: float) -> Parts:
    """A nave with buttresses and high windows, a tower with a spire before it, a choir behind."""
    nave = min(width, 14.0) / 2
    height = float(rng.uniform(6.0, 10.0))
    storey = float(rng.uniform(3.0, 4.0))
    where = (-nave, nave, 2.0, depth + 3.0)
    tall = facades.Openings(height, storey, 1.1, 1.8, height - 1.2, 0.3, "blank")
    corners = np.array([[-nave, 2.0], [nave, 2.0], [nave, depth + 3.0], [-nave, depth + 3.0]])
    meshes = [
        facades.side_wall(rng, corners[k], corners[(k + 1) % 4], height, tall, 1.0)
        for k in range(4)
    ]
    meshes.append(roofs.roof(rng, "cross", where, height)[0])
    along = np.arange(3.0, depth + 2.5, storey)
    meshes.append(
        boxes(
            np.array(
                [
                    [0.7, 0.7, 0.7 * height - FOOT, s * (nave + 0.3), y, FOOT]
                    for s in (-1, 1)
                    for y in along
                ]
            )
        )
    )
    side = float(rng.uniform(2.0, 2.8))
    high = float(rng.uniform(12, 20))
    tower = np.array([[-side, -0.5], [side, -0.5], [side, 2 * side - 0.5], [-side, 2 * side - 0.5]])
    slits = facades.Openings(5.0, 2.0, 1.0, 3.0, 4.6, 0.35, "windows")
    meshes += [
        facades.side_wall(rng, tower[k], tower[(k + 1) % 4], high, slits, 1.0) for k in range(4)
    ]
    rim = np.column_stack([(tower - tower.mean(0)) * 1.1 + tower.mean(0), np.full(4, high)])
    tip = np.column_stack(
        [
            (tower - tower.mean(0)) * 0.02 + tower.mean(0),
            np.full(4, high + float(rng.uniform(4, 12))),
        ]
    )
    meshes.append(loft(np.stack([rim, tip])))
    meshes.append(place(cylinder(0.7 * nave, height * 0.8 - FOOT, 8, z=FOOT), 0, depth + 3.0))
    meshes.append(place(cylinder(0.78 * nave, 2.5, 8, 0.05, z=0.8 * height), 0, depth + 3.0))
    return [(joined(*meshes), BUILDING)]


def petrol_station(rng: Rng, width: float, depth: float) -> Parts:
    """A canopy on columns over pumps, a shop behind, a board with the prices beside the road."""
    under = min(0.62 * depth, 8.0)
    roof_height = float(rng.uniform(4.4, 5.4))
    wide = 0.7 * width
    rows = [[wide, under, 0.8, 0, under / 2, roof_height]]
    columns = [
        place(cylinder(0.22, roof_height - FOOT, 8, z=FOOT), x, under / 2)
        for x in np.linspace(-0.36, 0.36, 3) * wide
    ]
    pumps = boxes(
        np.array(
            [
                [1.0, 0.6, 1.7, x + s * 1.2, under / 2, -0.2]
                for x in np.linspace(-0.36, 0.36, 3) * wide
                for s in (-1, 1)
            ]
        )
    )
    o = facades.openings(rng, "shop")
    where = (-0.45 * width, 0.45 * width, under + 0.6, max(depth, under + 4.5))
    corners = np.array(
        [[where[0], where[2]], [where[1], where[2]], [where[1], where[3]], [where[0], where[3]]]
    )
    shop: list[Mesh] = [facades.front_wall(rng, corners[0], corners[1], 3.4, o)[0]]
    shop += [
        facades.side_wall(rng, corners[k], corners[(k + 1) % 4], 3.4, o, 0.2) for k in (1, 2, 3)
    ]
    shop.append(roofs.roof(rng, "flat", where, 3.4)[0])
    board = box(1.8, 0.3, 3.5, 0.48 * width, 0.3, 1.8)
    post = box(0.3, 0.25, 2.2, 0.48 * width, 0.3, -0.3)
    return [
        (joined(boxes(np.array(rows)), *columns, *shop), BUILDING),
        (pumps, UNLABELLED),
        (board, TRAFFIC_SIGN),
        (post, POLE),
    ]
