"""A furnished room for hand-held depth cameras: walls, doors, tables, chairs, shelves, sofas and
clutter, in true size.
"""

from __future__ import annotations

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.simulation.meshes.shapes import walls_within
from semloc_logs.simulation.meshes.world import (
    BUILDING,
    FENCE,
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

Rng = np.random.Generator


def build_room(seed: int, condition: int = 0) -> World:
    """A room of 3 to 9 m; ``condition`` moves chairs and clutter. The same arguments give the same
    bytes.
    """
    size, height = _size(seed)
    rng = np.random.default_rng([seed, 32])
    change = np.random.default_rng([seed, 33, condition])
    builder = MeshBuilder(lambda x, y: np.zeros_like(x))
    _shell(builder, size, height, rng)
    _along_walls(builder, size, height, rng)
    _in_the_middle(builder, size, rng, change)
    for _ in range(int(change.integers(5, 25))):
        edges = change.uniform(0.05, 0.4, 3)
        x, y = change.uniform(0.3, size - 0.3)
        _add(builder, box(*edges), float(x), float(y), float(change.uniform(0, 3)), UNLABELLED)
    return builder.build()


def room_walk(seed: int, length: float) -> F64:
    """A line (n, 2) of at least ``length`` metres round the room, 0.6 to 1.3 m from its walls, in
    turn closer and farther.
    """
    size, _ = _size(seed)
    rng = np.random.default_rng([seed, 34])
    points: list[F64] = []
    walked = 0.0
    while walked < length:
        margin = np.minimum(rng.uniform(0.6, 1.3, 2), size / 3)
        low = margin
        high = size - margin
        lap = np.array([low, [high[0], low[1]], high, [low[0], high[1]]]) + rng.normal(
            0.0, 0.1, (4, 2)
        )
        walked += float(np.linalg.norm(np.diff(lap, axis=0), axis=1).sum())
        points.append(lap)
    return np.concatenate(points)


def _size(seed: int) -> tuple[F64, float]:
    rng = np.random.default_rng([seed, 31])
    return rng.uniform(3.0, 9.0, 2), float(rng.uniform(2.3, 3.2))


def _add(builder: MeshBuilder, mesh: Mesh, x: float, y: float, yaw: float, label: int) -> None:
    builder.add(place(mesh, x, y, 0.0, yaw), label, ground="none")


def _shell(builder: MeshBuilder, size: F64, height: float, rng: Rng) -> None:
    """Floor, ceiling, walls with doors and windows set back."""
    w, d = size
    builder.add(box(w + 1, d + 1, 0.1, w / 2, d / 2, -0.1), ROAD, ground="none")
    builder.add(box(w + 1, d + 1, 0.1, w / 2, d / 2, height), BUILDING, ground="none")
    for length, yaw, x, y in walls_within(w, d):
        u = 0.0
        while u < length:
            piece = min(float(rng.uniform(0.7, 2.5)), length - u)
            recess = float(rng.choice([0.0, 0.0, 0.12, 0.25, -0.1]))
            wall = box(piece + 0.01, 0.15, height, u + piece / 2, -0.075 - recess)
            _add(builder, wall, x, y, yaw, BUILDING)
            u += piece


def _along_walls(builder: MeshBuilder, size: F64, height: float, rng: Rng) -> None:
    """Shelves, cupboards and sofas with their backs to the walls."""
    for length, yaw, x, y in walls_within(*size):
        u = float(rng.uniform(0.2, 1.0))
        while u < length - 1.2:
            wide = float(rng.uniform(0.5, 1.8))
            kind = rng.choice(["shelf", "cupboard", "sofa", "desk", "gap"])
            if kind != "gap" and u + wide < length - 0.2:
                mesh = _piece(str(kind), wide, height, rng)
                across = np.array([-np.sin(yaw), np.cos(yaw)])
                along = np.array([np.cos(yaw), np.sin(yaw)])
                middle = np.array([x, y]) + (u + wide / 2) * along + 0.3 * across
                _add(
                    builder,
                    mesh,
                    float(middle[0]),
                    float(middle[1]),
                    yaw,
                    FENCE if kind == "shelf" else WALL,
                )
            u += wide + float(rng.uniform(0.0, 0.8))


def _piece(kind: str, wide: float, height: float, rng: Rng) -> Mesh:
    """Furniture ``wide`` m along x whose back is at y = -0.3."""
    if kind == "cupboard":
        return box(wide, float(rng.uniform(0.4, 0.6)), float(rng.uniform(0.7, height - 0.2)))
    if kind == "sofa":
        seat = box(wide, 0.8, 0.42, y=0.1)
        back = box(wide, 0.2, float(rng.uniform(0.7, 0.95)), y=-0.2)
        return merge(seat, back)
    if kind == "desk":
        return merge(
            _table(wide, 0.7, 0.73),
            box(0.5, 0.05, 0.35, y=-0.15, z=0.85),
            box(0.2, 0.2, 0.12, y=-0.15, z=0.73),
        )
    top = float(rng.uniform(1.0, height - 0.2))
    deep = float(rng.uniform(0.25, 0.45))
    parts = [box(0.03, deep, top, side * wide / 2) for side in (-1.0, 1.0)]
    for z in np.arange(0.05, top, rng.uniform(0.28, 0.45)):
        parts.append(box(wide, deep, 0.025, z=float(z)))
        books = np.arange(-wide / 2 + 0.1, wide / 2 - 0.05, 0.15)
        parts += [
            box(0.12, deep * 0.7, float(rng.uniform(0.1, 0.26)), float(u), z=float(z))
            for u in books
            if rng.random() < 0.7
        ]
    return merge(*parts)


def _table(length: float, width: float, height: float) -> Mesh:
    corners = [
        (sx * (length / 2 - 0.05), sy * (width / 2 - 0.05)) for sx in (-1, 1) for sy in (-1, 1)
    ]
    legs = [box(0.05, 0.05, height, x, y) for x, y in corners]
    return merge(*legs, box(length, width, 0.04, z=height - 0.04))


def _chair(rng: Rng) -> Mesh:
    back = box(0.04, 0.42, 0.45, -0.2, z=0.45)
    if rng.random() < 0.4:
        return merge(
            cylinder(0.03, 0.45, 6), cylinder(0.25, 0.05, 8), box(0.45, 0.45, 0.06, z=0.45), back
        )
    return merge(_table(0.42, 0.42, 0.45), back)


def _in_the_middle(builder: MeshBuilder, size: F64, rng: Rng, change: Rng) -> None:
    """Tables with chairs about them; the chairs move between sessions."""
    for _ in range(int(rng.integers(1, 1 + int(size.prod() / 8)))):
        x, y = rng.uniform(1.2, size - 1.2) if (size > 2.5).all() else size / 2
        length = float(rng.uniform(0.7, 1.8))
        width = float(rng.uniform(0.6, 0.9))
        yaw = float(rng.choice([0.0, np.pi / 2]) + rng.normal(0.0, 0.1))
        _add(
            builder,
            _table(length, width, float(rng.uniform(0.4, 0.75))),
            float(x),
            float(y),
            yaw,
            WALL,
        )
        for _ in range(int(rng.integers(0, 5))):
            angle = change.uniform(0, 2 * np.pi)
            distance = 0.7 + change.uniform(0.0, 0.4)
            chair_x = x + distance * np.cos(angle)
            chair_y = y + distance * np.sin(angle)
            _add(builder, _chair(rng), float(chair_x), float(chair_y), float(angle), FENCE)
