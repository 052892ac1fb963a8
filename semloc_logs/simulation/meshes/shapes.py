"""Shapes that the things of a town are put together from, many at a time; and the layer of snow on
them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64, I64
from semloc_logs.simulation.meshes.world import BUILDING, CAR, WALL, Mesh, cylinder, place

# meshes about the foot of a thing, each with its Cityscapes train id
Parts = list[tuple[Mesh, int]]
Rng = np.random.Generator
T = TypeVar("T", bound=np.generic)

_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)])
_FACES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
_TRIANGLES = np.array([t for a, b, c, d in _FACES for t in ((a, b, c), (a, c, d))], np.int64)


def boxes(rows: F64) -> Mesh:
    """Boxes (n, 6) of (length, width, height, x, y, z) in metres, each standing on z and centred on
    (x, y).
    """
    rows = np.asarray(rows, np.float64).reshape(-1, 6)
    vertices = _CORNERS[None] * rows[:, None, :3] + rows[:, None, 3:]
    triangles = _TRIANGLES[None] + 8 * np.arange(len(rows), dtype=np.int64)[:, None, None]
    return Mesh(vertices.reshape(-1, 3), triangles.reshape(-1, 3))


def walls_within(width: float, depth: float) -> Iterator[tuple[float, float, float, float]]:
    """The walls of a room from (0, 0) to (width, depth), metres: length, yaw, and the corner (x, y)
    where each starts; the room is on their left.
    """
    yield width, 0.0, 0.0, 0.0
    yield depth, np.pi / 2, width, 0.0
    yield width, np.pi, width, depth
    yield depth, -np.pi / 2, 0.0, depth


def tubes(
    start: F64, end: F64, first_radius: F64 | float, last_radius: F64 | float, sides: int = 5
) -> Mesh:
    """Open tubes between points (n, 3) and (n, 3) that taper from one radius to the other, in
    metres.
    """
    n = len(start)
    axis = end - start
    axis = axis / np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-9)
    helper = np.where(
        np.abs(axis[:, 2:]) < 0.9, np.array([[0.0, 0.0, 1.0]]), np.array([[1.0, 0.0, 0.0]])
    )
    across = np.cross(axis, helper)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    other = np.cross(axis, across)
    angle = 2 * np.pi * np.arange(sides) / sides
    circle = (
        across[:, None] * np.cos(angle)[None, :, None]
        + other[:, None] * np.sin(angle)[None, :, None]
    )
    radii = [
        np.broadcast_to(np.asarray(r, np.float64), (n,))[:, None, None]
        for r in (first_radius, last_radius)
    ]
    vertices = np.concatenate(
        [start[:, None] + circle * radii[0], end[:, None] + circle * radii[1]], axis=1
    )
    i = np.arange(sides, dtype=np.int64)
    j = (i + 1) % sides
    one = np.concatenate(
        [np.column_stack([i, j, j + sides]), np.column_stack([i, j + sides, i + sides])]
    )
    triangles = one[None] + 2 * sides * np.arange(n, dtype=np.int64)[:, None, None]
    return Mesh(vertices.reshape(-1, 3), triangles.reshape(-1, 3))


def triangles_of(corners: F64) -> Mesh:
    """Loose triangles (n, 3, 3)."""
    return Mesh(corners.reshape(-1, 3), np.arange(3 * len(corners), dtype=np.int64).reshape(-1, 3))


def loft(sections: F64) -> Mesh:
    """Closed cross-sections (s, k, 3) joined one to the next, both ends closed by a fan."""
    s, k, _ = sections.shape
    r, c = (g.ravel() for g in np.meshgrid(np.arange(s - 1), np.arange(k), indexing="ij"))
    a = r * k + c
    b = r * k + (c + 1) % k
    fan = np.column_stack([np.zeros(k - 2, np.int64), np.arange(1, k - 1), np.arange(2, k)])
    sides = [np.column_stack([a, b, b + k]), np.column_stack([a, b + k, a + k])]
    return Mesh(
        sections.reshape(-1, 3),
        np.concatenate([*sides, fan[:, ::-1], fan + (s - 1) * k]).astype(np.int64),
    )


def body(x: F64, top: F64, width: F64 | float, low: float, belt: float, tumblehome: float) -> Mesh:
    """A vehicle's hull along +x: at stations ``x`` (s,) it is ``top`` (s,) high and ``width`` wide;
    drawn in above ``belt``.
    """
    half = np.zeros_like(x) + np.asarray(width, np.float64) / 2
    middle = np.minimum(belt, top - 0.02)
    narrow = np.maximum(half - tumblehome * (top - middle), 0.25 * half)
    columns: list[tuple[F64, F64 | float]] = [
        (-half, low),
        (-half, middle),
        (-narrow, top),
        (narrow, top),
        (half, middle),
        (half, low),
    ]
    return loft(
        np.stack([np.column_stack([x, y, np.zeros_like(x) + z]) for y, z in columns], axis=1)
    )


def wheels(
    places: list[tuple[float, float]], radius: float, width: float = 0.22, sides: int = 10
) -> Mesh:
    """Wheels standing on z = 0 at (x, y), rolling along x."""
    wheel = cylinder(radius, width, sides)
    lying = Mesh(wheel.vertices[:, [0, 2, 1]] + [0, -width / 2, radius], wheel.triangles)
    meshes = [place(lying, x, y) for x, y in places]
    offsets = len(lying.vertices) * np.arange(len(meshes), dtype=np.int64)
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([lying.triangles + o for o in offsets]),
    )


def resample(path: F64, spacing: float) -> F64:
    """The plan path (n, 2) with points every ``spacing`` metres, ends kept."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    distances = np.linspace(0, along[-1], max(2, int(np.ceil(along[-1] / spacing)) + 1))
    return np.column_stack([np.interp(distances, along, path[:, k]) for k in range(path.shape[1])])


def snow_cover(parts: Parts, depth: float, steepest: float = 0.6) -> Parts:
    """The parts with a layer ``depth`` metres thick on buildings, walls and vehicles, where the
    normal's vertical share is ``steepest``.

    A layer has the class of what it lies on. Faces that look down get one too: it lies inside the
    thing.
    """
    result: Parts = []
    for mesh, label in parts:
        result.append((mesh, label))
        if label not in (BUILDING, WALL) and not CAR <= label <= CAR + 3:
            continue
        corners = mesh.vertices[mesh.triangles]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        level = np.abs(normal[:, 2]) > steepest * np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
        if level.any():
            result.append((triangles_of(corners[level] + [0.0, 0.0, depth]), label))
    return result


def grid(rows: NDArray[T], columns: NDArray[T]) -> tuple[NDArray[T], NDArray[T]]:
    """All pairs of (n,) and (m,) as two arrays (n * m,)."""
    a, b = np.meshgrid(rows, columns, indexing="ij")
    return a.ravel(), b.ravel()


def joined(*meshes: Mesh) -> Mesh:
    """One mesh of those that have triangles."""
    kept = [m for m in meshes if len(m.triangles)]
    if not kept:
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    offsets = np.cumsum([0] + [len(m.vertices) for m in kept[:-1]])
    triangles: list[I64] = [m.triangles + offset for m, offset in zip(kept, offsets, strict=True)]
    return Mesh(np.concatenate([m.vertices for m in kept]), np.concatenate(triangles))
