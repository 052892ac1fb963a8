"""Shapes have the volumes that one can work out by hand, and rays hit what a slow obvious ray
caster hits.
"""

from __future__ import annotations

import sys

import numpy as np
import pytest
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.errors import SemlocError
from semloc_logs.simulation.meshes.world import (
    Mesh,
    MeshBuilder,
    Scene,
    World,
    box,
    cylinder,
    ellipsoid,
    extrude,
    gabled_roof,
    join_worlds,
    place,
    ribbon,
)


def volume(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def open_edges(mesh: Mesh) -> int:
    """Edges that are not shared by exactly two triangles."""
    edges = np.sort(
        np.concatenate(
            [mesh.triangles[:, (0, 1)], mesh.triangles[:, (1, 2)], mesh.triangles[:, (2, 0)]]
        ),
        axis=1,
    )
    return int((np.unique(edges, axis=0, return_counts=True)[1] != 2).sum())


@pytest.mark.parametrize(
    ("mesh", "expected"),
    [
        (box(2.0, 3.0, 4.0), 24.0),
        (extrude(np.array([[0.0, 0], [4, 0], [4, 3], [0, 3]]), 1.0, 3.0), 24.0),
        (gabled_roof(6.0, 4.0, 2.0), 24.0),
        (cylinder(1.0, 2.0, sides=4), 4.0),  # a square of diagonal 2, two high
        (cylinder(1.0, 3.0, sides=4, top_radius=0.0), 2.0),  # a pyramid
        (
            ribbon(
                np.array([[0.0, 0], [5, 0], [10, 0]]),
                np.array([[-1.0, 0], [1, 0], [1, 2], [-1, 2]]),
            ),
            40.0,
        ),
    ],
)
def test_solids_are_closed_and_have_their_volume(mesh: Mesh, expected: float) -> None:
    assert abs(volume(mesh)) == pytest.approx(expected, rel=2e-3)
    assert open_edges(mesh) == 0


def test_ellipsoid_nears_its_volume() -> None:
    mesh = ellipsoid((1.0, 2.0, 3.0), rings=40, sides=80)
    assert abs(volume(mesh)) == pytest.approx(4 / 3 * np.pi * 6, rel=0.01)


def test_place_turns_about_z_then_moves() -> None:
    moved = place(
        Mesh(np.array([[1.0, 0.0, 5.0]]), np.zeros((0, 3), np.int64)), 10.0, 20.0, 1.0, np.pi / 2
    )
    np.testing.assert_allclose(moved.vertices, [[10.0, 21.0, 6.0]], atol=1e-12)


def test_builder_puts_meshes_on_the_ground() -> None:
    builder = MeshBuilder(lambda x, y: 0.1 * x)
    for ground in ("none", "rigid", "drape"):
        builder.add(box(2.0, 2.0, 1.0, x=10.0), 2, ground=ground)
    z = builder.build().vertices.reshape(3, 8, 3)[:, :, 2]
    assert z[0].min() == 0.0
    assert z[1].min() == pytest.approx(1.0)
    assert (z[2].min(), z[2].max()) == (pytest.approx(0.9), pytest.approx(2.1))


def first_hits(triangles: F64, origins: F64, directions: F64) -> tuple[F64, NDArray[np.int64]]:
    """Distance and number of the first triangle of each ray, one at a time by solving for the
    barycentric coordinates.
    """
    distance = np.full(len(origins), np.inf)
    number = np.full(len(origins), -1)
    for r, (o, d) in enumerate(zip(origins, directions, strict=True)):
        for k, (a, b, c) in enumerate(triangles):
            u, v, t = np.linalg.solve(np.column_stack([b - a, c - a, -d]), o - a)
            if u >= 0 and v >= 0 and u + v <= 1 and 0 < t < distance[r]:
                distance[r], number[r] = t, k
    return distance, number


def test_rays_hit_what_the_slow_caster_hits() -> None:
    rng = np.random.default_rng(3)
    triangles = rng.uniform(-5, 5, (25, 1, 3)) + rng.normal(size=(25, 3, 3)) * 2
    world = World(
        triangles.reshape(-1, 3).astype(np.float32),
        np.arange(75, dtype=np.int32).reshape(-1, 3),
        np.arange(25, dtype=np.uint8),
    )
    origins = rng.normal(size=(200, 3))
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distance, number, _ = Scene(world).cast(
        origins.astype(np.float32), directions.astype(np.float32)
    )
    expected_distance, expected_number = first_hits(triangles, origins, directions)
    assert (expected_number >= 0).sum() > 50
    assert (expected_number < 0).sum() > 10
    np.testing.assert_array_equal(number, expected_number)
    np.testing.assert_allclose(distance, expected_distance, atol=1e-4)


def test_an_empty_world_is_refused() -> None:
    with pytest.raises(SemlocError, match="no triangles"):
        Scene(MeshBuilder(lambda x, y: x).build())


def test_without_embreex_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "embreex", None)
    with pytest.raises(SemlocError, match=r"the extra 'sim': pip install 'semloc_logs\[sim\]'"):
        Scene(
            World(
                np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.int32), np.zeros(1, np.uint8)
            )
        )


def test_pieces_keep_their_numbers_apart_when_worlds_are_joined() -> None:
    builder = MeshBuilder(lambda x, y: np.zeros_like(x))
    builder.add(box(1, 1, 1), 2)
    builder.add(box(1, 1, 1, x=5), 13)
    one = builder.build()
    both = join_worlds(one, one)
    assert np.array_equal(both.objects, np.repeat([0, 1, 2, 3], 12))
    assert np.array_equal(both.vertices[both.triangles[24:]], one.vertices[one.triangles])
    assert np.array_equal(both.labels, np.tile(one.labels, 2))
