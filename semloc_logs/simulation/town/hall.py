"""An indoor hall: a parking deck or a store with pillars, walls, racks, boxes, doors, pipes and
parked cars.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.simulation.meshes import objects
from semloc_logs.simulation.meshes.shapes import walls_within
from semloc_logs.simulation.meshes.world import (
    BUILDING,
    FENCE,
    POLE,
    ROAD,
    UNLABELLED,
    WALL,
    Mesh,
    MeshBuilder,
    World,
    box,
    cylinder,
    merge,
    place,
)


@dataclass(frozen=True, slots=True, eq=False)
class _Plan:
    """Size in metres, pillars (n, 2), aisles as x positions; everything else follows from them."""

    size: F64
    height: float
    bay: F64
    pillars: F64


def _plan(seed: int) -> _Plan:
    rng = np.random.default_rng([seed, 21])
    size = rng.uniform(24, 45, 2)
    bay = rng.uniform(5.0, 8.5, 2)
    xs, ys = (np.arange(b / 2 + 1, s - 2, b) for b, s in zip(bay, size, strict=True))
    pillars = np.stack(np.meshgrid(xs, ys, indexing="ij"), -1).reshape(-1, 2)
    return _Plan(size, float(rng.uniform(2.5, 5.5)), bay, pillars)


def build_hall(seed: int, condition: int = 0) -> World:
    """A hall of about 35 x 35 m; ``condition`` changes cars, boxes and people. The same arguments
    give the same bytes.
    """
    plan = _plan(seed)
    rng = np.random.default_rng([seed, 22])
    change = np.random.default_rng([seed, 23, condition])
    builder = MeshBuilder(lambda x, y: np.zeros_like(x))
    _shell(builder, plan, rng)
    round_pillars = rng.random() < 0.4
    side = rng.uniform(0.35, 0.8)
    for x, y in plan.pillars:
        pillar = (
            cylinder(side / 2, plan.height, 12)
            if round_pillars
            else box(side, side * rng.uniform(0.8, 1.4), plan.height)
        )
        builder.add(place(pillar, x, y), POLE if side < 0.5 else BUILDING, ground="none")
    for x in np.unique(plan.pillars[:, 0]):
        if rng.random() < 0.7:
            builder.add(
                box(
                    0.4, plan.size[1], rng.uniform(0.3, 0.7), x, plan.size[1] / 2, plan.height - 0.7
                ),
                BUILDING,
                ground="none",
            )
    _fill(builder, plan, rng, change, parking=bool(rng.random() < 0.5))
    return builder.build()


def _shell(builder: MeshBuilder, plan: _Plan, rng: np.random.Generator) -> None:
    """Floor, ceiling, walls with doors set back, pipes under the ceiling."""
    w, d = plan.size
    builder.add(box(w + 4, d + 4, 0.3, w / 2, d / 2, -0.3), ROAD, ground="none")
    builder.add(box(w + 4, d + 4, 0.3, w / 2, d / 2, plan.height), BUILDING, ground="none")
    for length, yaw, x, y in walls_within(w, d):
        u = 0.0
        while u < length:
            piece = min(rng.uniform(1.0, 7.0), length - u)
            back = rng.choice([0.0, 0.0, 0.0, 0.3, -0.25, 1.2]) if piece < 5 else 0.0
            mesh = box(piece + 0.02, 0.2, plan.height, u + piece / 2, -0.1 - back)
            builder.add(place(mesh, x, y, 0, yaw), BUILDING, ground="none")
            if back:
                for end in (u, u + piece):
                    cheek = box(0.1, abs(back) + 0.2, plan.height, end, -0.1 - back / 2)
                    builder.add(place(cheek, x, y, 0, yaw), BUILDING, ground="none")
            u += piece
    for _ in range(int(rng.integers(2, 9))):
        along = rng.random() < 0.5
        offset = rng.uniform(1, min(w, d) - 1)
        z = plan.height - rng.uniform(0.2, 0.6)
        size = rng.uniform(0.1, 0.6)
        pipe = (
            box(w, size, size, w / 2, offset, z - size)
            if along
            else box(size, d, size, offset, d / 2, z - size)
        )
        builder.add(pipe, BUILDING, ground="none")


def _fill(
    builder: MeshBuilder,
    plan: _Plan,
    rng: np.random.Generator,
    change: np.random.Generator,
    *,
    parking: bool,
) -> None:
    """Rooms, racks, boxes, cars and people, clear of the aisles that :func:`hall_walk` takes."""
    w, d = plan.size
    for x in _islands(plan):
        for y in np.arange(2.5, d - 2.5, 2.7 if parking else 4.0):
            if parking:
                if change.random() < 0.6:
                    _add(
                        builder,
                        objects.car(change) if change.random() < 0.9 else objects.van(change),
                        x,
                        y,
                        change.choice([0, np.pi]),
                    )
            elif rng.random() < 0.55:
                _add(builder, [(_rack(rng, plan.height), FENCE)], x, y, np.pi / 2)
    for _ in range(int(rng.integers(1, 4))):
        size = rng.uniform(2, 6, 2)
        corner = np.array([rng.choice([0.0, w - size[0]]), rng.uniform(0, d - size[1])])
        builder.add(box(size[0], size[1], plan.height, *(corner + size / 2)), WALL, ground="none")
    for _ in range(int(change.integers(10, 40))):
        x = change.choice(_islands(plan)) + change.normal() * 0.6 if len(_islands(plan)) else 1.0
        size = change.uniform(0.3, 1.4, 3)
        _add(builder, [(box(*size), UNLABELLED)], x, change.uniform(1, d - 1), change.uniform(0, 3))
    for _ in range(int(change.integers(0, 4))):
        _add(
            builder,
            objects.person(change),
            change.uniform(1, w - 1),
            change.uniform(1, d - 1),
            change.uniform(0, 6),
        )


def _rack(rng: np.random.Generator, height: float) -> Mesh:
    """A rack 3.6 m long along x with goods on some of its boards."""
    top = min(height - 0.4, rng.uniform(1.8, 4.0))
    deep = rng.uniform(0.5, 1.1)
    meshes = [box(0.08, 0.08, top, sx * 1.8, sy * deep / 2) for sx in (-1, 0, 1) for sy in (-1, 1)]
    for z in np.arange(0.15, top, rng.uniform(0.5, 1.3)):
        meshes.append(box(3.6, deep, 0.05, z=z))
        meshes += [
            box(rng.uniform(0.3, 0.8), deep * 0.8, rng.uniform(0.2, 0.5), x, z=z)
            for x in np.arange(-1.4, 1.5, 0.9)
            if rng.random() < 0.6
        ]
    return merge(*meshes)


def _add(builder: MeshBuilder, parts: objects.Parts, x: float, y: float, yaw: float) -> None:
    for mesh, label in parts:
        builder.add(place(mesh, x, y, 0, yaw), label, ground="none")


def _aisles(plan: _Plan) -> F64:
    """x of the aisles: half way between every other pair of pillar rows."""
    rows = np.unique(plan.pillars[:, 0])
    return ((rows[:-1] + rows[1:]) / 2)[::2]


def _islands(plan: _Plan) -> F64:
    rows = np.unique(plan.pillars[:, 0])
    return ((rows[:-1] + rows[1:]) / 2)[1::2]


def hall_walk(seed: int, length: float) -> F64:
    """A line (n, 2) of at least ``length`` metres up and down the aisles of the hall of the same
    seed, round and round.
    """
    plan = _plan(seed)
    rng = np.random.default_rng([seed, 24])
    aisles = _aisles(plan)
    d = plan.size[1]
    points = [np.array([aisles[0], 1.8])]
    walked, up = 0.0, True
    while walked < length:
        x = float(rng.choice(aisles)) + rng.normal() * 0.3
        end = d - 1.3 if up else 1.3
        for p in (np.array([x, points[-1][1]]), np.array([x + rng.normal() * 0.3, end])):
            walked += float(np.linalg.norm(p - points[-1]))
            points.append(p)
        up = not up
    return np.array(points)
