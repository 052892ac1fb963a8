from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semloc_logs.alignment.surface import NEIGHBOURS, surface_of


@given(st.integers(0, 10_000), st.sampled_from([0.2, 0.5, 1.3]), st.sampled_from([0.1, 0.4, 2.0]))
@settings(max_examples=30, deadline=None)
def test_the_nearest_is_that_of_brute_force(seed: int, cell: float, radius: float) -> None:
    rng = np.random.default_rng(seed)
    points, query = rng.uniform(-2, 2, (150, 3)) + 1e4, rng.uniform(-3, 3, (60, 3)) + 1e4
    surface = surface_of(points, cell)
    assert sorted(map(tuple, surface.points)) == sorted(map(tuple, points))
    found = surface.nearest(query, radius)
    distance = np.linalg.norm(query[:, None] - surface.points[None], axis=2)
    np.testing.assert_array_equal(found, np.where(distance.min(1) < radius, distance.argmin(1), -1))


def test_planes_are_made_where_they_are_met() -> None:
    rng = np.random.default_rng(0)
    floor = np.c_[rng.uniform(0, 4, (800, 2)), np.zeros(800)]
    bush = rng.uniform(0, 1, (800, 3)) + np.array([8.0, 0, 0])
    surface = surface_of(np.concatenate([floor, bush]), 0.5)
    on_floor = surface.points[:, 2] == 0
    assert (surface.planar == -1).all()
    half = np.flatnonzero(surface.points[:, 1] < 2)
    surface.look_at(half)
    assert set(np.flatnonzero(surface.planar >= 0)) == set(half)
    assert (surface.planar[half][on_floor[half]] == 1).all()
    np.testing.assert_allclose(np.abs(surface.normals[half][on_floor[half], 2]), 1, atol=1e-6)
    assert surface.planar[half][~on_floor[half]].mean() < 0.5


def test_points_with_few_around_are_no_planes() -> None:
    surface = surface_of(np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]), 0.3)
    surface.look_at(np.arange(3))
    assert surface.planar.tolist() == [0, 0, 0]
    assert surface_of(np.zeros((0, 3)), 0.3).nearest(np.zeros((2, 3)), 1.0).tolist() == [-1, -1]
    crowd = surface_of(np.random.default_rng(1).uniform(0, 0.2, (5 * NEIGHBOURS, 3)) * np.array([1, 1, 0]), 0.3)
    crowd.look_at(np.arange(len(crowd.points)))
    assert crowd.planar.mean() == pytest.approx(1, abs=0.3)
