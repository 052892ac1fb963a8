"""Triangle worlds with one class a triangle, the shapes they are put together from, and the rays
that are cast into them.

A mesh is a pair (vertices (n, 3) float64 in metres, triangles (m, 3) int64). Labels are Cityscapes
train ids.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64, I64
from semloc_logs.errors import SemlocError

ROAD, SIDEWALK, BUILDING, WALL, FENCE, POLE, TRAFFIC_LIGHT, TRAFFIC_SIGN, VEGETATION, TERRAIN = (
    range(10)
)
PERSON, RIDER, CAR, TRUCK, BUS, TRAIN, MOTORCYCLE, BICYCLE = range(11, 19)
UNLABELLED = 255


class Mesh(NamedTuple):
    """Vertices (n, 3) in metres and triangles (m, 3) of vertex numbers."""

    vertices: F64
    triangles: I64


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """``vertices`` (n, 3) float32 in metres, ``triangles`` (m, 3) int32, ``labels`` (m,) uint8
    Cityscapes train ids (255 = none).

    ``objects`` (m,) int32 numbers, from 0 in the order of the triangles, say which triangles are of
    one piece; empty: nobody knows.
    """

    vertices: NDArray[np.float32]
    triangles: NDArray[np.int32]
    labels: NDArray[np.uint8]
    objects: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))


def require_ray_caster(what: str) -> None:
    """SemlocError naming the extra that ``what`` needs, when its package is not installed."""
    if find_spec("embreex") is None:
        raise SemlocError(f"{what} needs the extra 'sim': pip install 'semloc_logs[sim]'")


class Scene:
    """A world that rays can be cast into."""

    def __init__(self, world: World) -> None:
        require_ray_caster("the simulation of a sensor")
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        if not len(world.triangles):
            raise SemlocError(
                "the world to simulate has no triangles, so there is nothing to scan: "
                "give it at least a ground"
            )
        self.world = world
        self.labels = world.labels
        self._scene: Any = EmbreeScene()
        self._mesh: Any = TriangleMesh(self._scene, world.vertices[world.triangles])

    def cast(
        self, origins: NDArray[np.float32], directions: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.int64], F64]:
        """First hits of rays (n, 3), (n, 3): distance in lengths of the direction (inf = none),
        triangle (-1 = none), normal (n, 3).
        """
        hit = self._scene.run(
            np.ascontiguousarray(origins, np.float32),
            np.ascontiguousarray(directions, np.float32),
            query="INTERSECT",
            output=1,
        )
        triangle = np.asarray(hit["primID"]).astype(np.int64)
        distance = np.where(triangle >= 0, hit["tfar"], np.inf).astype(np.float32)
        return distance, triangle, np.asarray(hit["Ng"], np.float64)


class MeshBuilder:
    """Collects meshes and puts them on the ground ``height(x, y)``."""

    def __init__(self, height: Callable[[F64, F64], F64]) -> None:
        self.height = height
        self._vertices: list[F64] = []
        self._triangles: list[I64] = []
        self._labels: list[NDArray[np.uint8]] = []
        self._count = 0

    def add(self, mesh: Mesh, label: int | NDArray[np.uint8], *, ground: str = "rigid") -> None:
        """Add a mesh whose z counts from the ground: moved as a whole (``rigid``), vertex by vertex
        (``drape``) or not (``none``).
        """
        vertices = np.array(mesh.vertices, np.float64)
        if not len(mesh.triangles):
            return
        if ground == "drape":
            vertices[:, 2] += self.height(vertices[:, 0], vertices[:, 1])
        elif ground == "rigid":
            centre = (vertices[:, :2].min(0) + vertices[:, :2].max(0)) / 2
            vertices[:, 2] += self.height(centre[:1], centre[1:])[0]
        self._vertices.append(vertices)
        self._triangles.append(mesh.triangles + self._count)
        self._labels.append(np.broadcast_to(np.asarray(label, np.uint8), (len(mesh.triangles),)))
        self._count += len(vertices)

    def build(self) -> World:
        """The world of all meshes so far."""
        if not self._vertices:
            return World(
                np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros(0, np.uint8)
            )
        return World(
            np.concatenate(self._vertices).astype(np.float32),
            np.concatenate(self._triangles).astype(np.int32),
            np.concatenate(self._labels).astype(np.uint8),
            np.repeat(
                np.arange(len(self._labels), dtype=np.int32), [len(part) for part in self._labels]
            ),
        )


def join_worlds(first: World, second: World) -> World:
    """One world of two."""
    pieces = int(first.objects.max(initial=-1)) + 1
    return World(
        np.concatenate([first.vertices, second.vertices]),
        np.concatenate([first.triangles, second.triangles + np.int32(len(first.vertices))]),
        np.concatenate([first.labels, second.labels]),
        np.concatenate([first.objects, second.objects + np.int32(pieces)]),
    )


def place(mesh: Mesh, x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> Mesh:
    """The mesh turned by ``yaw`` about +z and moved to (x, y, z)."""
    c = np.cos(yaw)
    s = np.sin(yaw)
    turned = mesh.vertices @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return Mesh(turned + np.array([x, y, z]), mesh.triangles)


def merge(*meshes: Mesh) -> Mesh:
    """One mesh of several."""
    offsets = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    triangles = [m.triangles + offset for m, offset in zip(meshes, offsets, strict=True)]
    return Mesh(np.concatenate([m.vertices for m in meshes]), np.concatenate(triangles))


_BOX_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)])
_BOX_QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
_BOX_TRIANGLES = np.array(
    [t for a, b, c, d in _BOX_QUADS for t in ((a, b, c), (a, c, d))], np.int64
)


def box(
    length: float, width: float, height: float, x: float = 0.0, y: float = 0.0, z: float = 0.0
) -> Mesh:
    """A box standing on z, centred on (x, y): ``length`` along x, ``width`` along y."""
    return Mesh(_BOX_CORNERS * [length, width, height] + [x, y, z], _BOX_TRIANGLES)


def quads(corners: F64) -> Mesh:
    """Flat or folded quads (n, 4, 3)."""
    start = 4 * np.arange(len(corners), dtype=np.int64)[:, None]
    triangles = np.concatenate([start + np.array([0, 1, 2]), start + np.array([0, 2, 3])])
    return Mesh(corners.reshape(-1, 3), triangles)


def upright_quads(start: F64, end: F64, bottom: F64 | float, top: F64 | float) -> Mesh:
    """Vertical quads between plan points (n, 2) and (n, 2), from ``bottom`` to ``top``."""
    corners = np.zeros((len(start), 4, 3))
    corners[:, (0, 3), :2] = start[:, None]
    corners[:, (1, 2), :2] = end[:, None]
    corners[:, (0, 1), 2] = np.reshape(bottom, (-1, 1))
    corners[:, (2, 3), 2] = np.reshape(top, (-1, 1))
    return quads(corners)


def extrude(outline: F64, bottom: float, top: float) -> Mesh:
    """Walls and flat ends over a plan outline (n, 2); the ends are a fan about the mean, so the
    outline has to be star-shaped about it.
    """
    n = len(outline)
    low = np.column_stack([outline, np.full(n, bottom)])
    high = np.column_stack([outline, np.full(n, top)])
    middle = outline.mean(0)
    vertices = np.concatenate([low, high, [np.append(middle, bottom)], [np.append(middle, top)]])
    i = np.arange(n, dtype=np.int64)
    j = (i + 1) % n
    sides = np.concatenate([np.column_stack([i, j, j + n]), np.column_stack([i, j + n, i + n])])
    ends = np.concatenate(
        [
            np.column_stack([j, i, np.full(n, 2 * n)]),
            np.column_stack([i + n, j + n, np.full(n, 2 * n + 1)]),
        ]
    )
    return Mesh(vertices, np.concatenate([sides, ends]))


def gabled_roof(length: float, width: float, height: float, hip: float = 0.0) -> Mesh:
    """A roof over a rectangle: ridge along x at ``height``; ``hip`` metres are cut from both ends
    of the ridge.
    """
    a = length / 2
    b = width / 2
    r = max(length / 2 - hip, 0.01)
    vertices = np.array(
        [[-a, -b, 0], [a, -b, 0], [a, b, 0], [-a, b, 0], [-r, 0, height], [r, 0, height]],
        np.float64,
    )
    triangles = np.array(
        [[0, 1, 5], [0, 5, 4], [2, 3, 4], [2, 4, 5], [1, 2, 5], [3, 0, 4], [0, 2, 1], [0, 3, 2]],
        np.int64,
    )
    return Mesh(vertices, triangles)


def cylinder(
    radius: float, height: float, sides: int = 8, top_radius: float | None = None, z: float = 0.0
) -> Mesh:
    """A closed cylinder or, with another ``top_radius``, a (truncated) cone, standing on z."""
    angle = 2 * np.pi * np.arange(sides) / sides
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    mesh = extrude(radius * circle, z, z + height)
    if top_radius is not None:
        mesh.vertices[sides : 2 * sides, :2] = top_radius * circle
    return mesh


def ellipsoid(
    radii: tuple[float, float, float], z: float = 0.0, rings: int = 5, sides: int = 8
) -> Mesh:
    """An ellipsoid about (0, 0, z)."""
    polar = np.linspace(0, np.pi, rings + 1)
    angle = 2 * np.pi * np.arange(sides) / sides
    unit = np.stack(
        [
            np.outer(np.sin(polar), np.cos(angle)),
            np.outer(np.sin(polar), np.sin(angle)),
            np.outer(np.cos(polar), np.ones(sides)),
        ],
        -1,
    )
    return Mesh(
        unit.reshape(-1, 3) * radii + [0, 0, z], _grid_triangles(rings + 1, sides, closed=True)
    )


def _grid_triangles(rows: int, columns: int, *, closed: bool) -> I64:
    """Triangles of a grid of rows x columns vertices; ``closed`` joins the last column to the
    first.
    """
    r, c = np.meshgrid(
        np.arange(rows - 1), np.arange(columns if closed else columns - 1), indexing="ij"
    )
    a = (r * columns + c).ravel()
    b = (r * columns + (c + 1) % columns).ravel()
    return np.concatenate(
        [np.column_stack([a, b, b + columns]), np.column_stack([a, b + columns, a + columns])]
    ).astype(np.int64)


def ribbon(path: F64, section: F64) -> Mesh:
    """A closed cross-section (k, 2) of (left, up) metres swept along a plan path (n, 2), with
    closed ends; it stands on z = 0.
    """
    tangent = np.gradient(path, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    left = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    plan = path[:, None, :] + left[:, None, :] * section[None, :, :1]
    up = np.broadcast_to(section[None, :, 1:], (*plan.shape[:2], 1))
    vertices = np.concatenate([plan, up], -1).reshape(-1, 3)
    k = len(section)
    last = (len(path) - 1) * len(section)
    fan = np.column_stack([np.zeros(k - 2, np.int64), np.arange(1, k - 1), np.arange(2, k)])
    return Mesh(
        vertices, np.concatenate([_grid_triangles(len(path), k, closed=True), fan, fan + last])
    )
