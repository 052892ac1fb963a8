from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semloc_logs.alignment.surface import (
    LEAST_FLAT,
    NEIGHBOURS,
    RINGS,
    _around,
    flattened_surface,
    look_at,
    nearest_points,
    surface_of,
)


@given(st.integers(0, 10_000), st.sampled_from([0.2, 0.5, 1.3]), st.sampled_from([0.1, 0.4, 2.0]))
@settings(max_examples=30)
def test_the_nearest_is_that_of_brute_force(seed: int, cell: float, radius: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-2, 2, (150, 3)) + 1e4
    query = rng.uniform(-3, 3, (60, 3)) + 1e4
    surface = surface_of(points, cell)
    assert sorted(map(tuple, surface.points)) == sorted(map(tuple, points))
    nearest = nearest_points(surface.arrays, query, radius)
    distance = np.linalg.norm(query[:, None] - surface.points[None], axis=2)
    np.testing.assert_array_equal(
        nearest, np.where(distance.min(1) < radius, distance.argmin(1), -1)
    )


def test_planes_are_made_where_they_are_met() -> None:
    rng = np.random.default_rng(0)
    floor = np.c_[rng.uniform(0, 4, (800, 2)), np.zeros(800)]
    bush = rng.uniform(0, 1, (800, 3)) + np.array([8.0, 0, 0])
    surface = surface_of(np.concatenate([floor, bush]), 0.5)
    on_floor = surface.points[:, 2] == 0
    assert (surface.planar == -1).all()
    half = np.flatnonzero(surface.points[:, 1] < 2)
    look_at(surface.arrays, half)
    assert set(np.flatnonzero(surface.planar >= 0)) == set(half)
    assert (surface.planar[half][on_floor[half]] == 1).all()
    np.testing.assert_allclose(np.abs(surface.normals[half][on_floor[half], 2]), 1, atol=1e-6)
    assert surface.planar[half][~on_floor[half]].mean() < 0.5


@given(st.integers(0, 10_000), st.sampled_from([0.5, 1.0, 2.0]))
@settings(max_examples=20)
def test_the_points_around_a_point_are_those_of_brute_force(seed: int, cell: float) -> None:
    """300 points in 4 m: more than enough lie within the rings of cells, whatever the axis."""
    rng = np.random.default_rng(seed)
    surface = surface_of(rng.uniform(-2, 2, (300, 3)), cell)
    neighbours = _around(surface.points, surface.cells, np.arange(300))
    distance = np.linalg.norm(surface.points[:, None] - surface.points, axis=2)
    nearest = np.argsort(distance, axis=1)[:, :NEIGHBOURS]
    assert np.sort(distance, axis=1)[:, NEIGHBOURS - 1].max() < RINGS * cell
    np.testing.assert_array_equal(neighbours, nearest)


def test_a_plane_is_less_than_0_3_times_as_thick_as_wide() -> None:
    """Two layers of a hexagon and its centre, h above and below: along x and y a standard deviation
    of sqrt(3 / 7) = 0.655 m, along z of h.
    """
    angle = np.arange(6) * np.pi / 3
    flat = np.r_[np.c_[np.cos(angle), np.sin(angle)], np.zeros((1, 2))]
    for thick, is_plane in ((0.29, 1), (0.31, 0)):
        h = thick * np.sqrt(3 / 7)
        points = np.concatenate([np.c_[flat, np.full(7, z)] for z in (-h, h)])
        assert len(points) == NEIGHBOURS
        surface = surface_of(points, 1.0)
        look_at(surface.arrays, np.arange(NEIGHBOURS))
        assert surface.planar.tolist() == [is_plane] * NEIGHBOURS


def test_a_plane_is_at_least_a_tenth_as_wide_as_long() -> None:
    """Two rows of seven points, a metre apart: along x a standard deviation of 2 m."""
    for half, is_plane in ((0.19, 0), (0.21, 1)):
        points = np.array([[x, y, 0.0] for x in range(-3, 4) for y in (-half, half)])
        surface = surface_of(points, 2.0)
        look_at(surface.arrays, np.arange(NEIGHBOURS))
        assert surface.planar.tolist() == [is_plane] * NEIGHBOURS


def test_points_with_few_around_are_no_planes() -> None:
    surface = surface_of(np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]), 0.3)
    look_at(surface.arrays, np.arange(3))
    assert surface.planar.tolist() == [0, 0, 0]
    assert nearest_points(
        surface_of(np.zeros((0, 3)), 0.3).arrays, np.zeros((2, 3)), 1.0
    ).tolist() == [-1, -1]
    crowd = surface_of(
        np.random.default_rng(1).uniform(0, 0.2, (5 * NEIGHBOURS, 3)) * np.array([1, 1, 0]), 0.3
    )
    look_at(crowd.arrays, np.arange(len(crowd.points)))
    assert crowd.planar.mean() == pytest.approx(1, abs=0.3)


@given(st.integers(0, 10_000))
@settings(max_examples=10)
def test_flattened_points_lie_on_the_plane_of_a_slow_weighted_fit(seed: int) -> None:
    """A slanted wall seen in a slab: every kept point lies on the plane of the weighted points
    around it.
    """
    rng = np.random.default_rng(seed)
    radius = 0.6
    noise = 0.05
    points = rng.uniform(-1, 1, (250, 3)) * [1.0, 1.0, 0.1] + 1e3
    spread = rng.uniform(-0.2, 0.2, points.shape)
    kept = np.arange(0, 250, 7)
    sigma = np.linalg.norm(spread, axis=1)
    surface = flattened_surface(points, spread, kept, radius, noise)
    assert surface.sigma == np.median(sigma[kept])
    expected = []
    for p in points[kept]:
        around = np.linalg.norm(points - p, axis=1) <= radius
        w = 1 / (noise**2 + sigma[around] ** 2)
        neighbours = points[around]
        if len(neighbours) < LEAST_FLAT:
            expected.append(p)
            continue
        mean = (w[:, None] * neighbours).sum(0) / w.sum()
        normal = np.linalg.eigh(
            (w[:, None, None] * (neighbours - mean)[:, :, None] * (neighbours - mean)[:, None]).sum(
                0
            )
        )[1][:, 0]
        expected.append(p - normal * ((p - mean) @ normal))
    order = np.lexsort(np.round(surface.points, 6).T)
    wanted = np.array(expected)
    wanted_order = np.lexsort(np.round(wanted, 6).T)
    np.testing.assert_allclose(surface.points[order], wanted[wanted_order], atol=1e-6)
    np.testing.assert_array_equal(surface.spread[order], spread[kept][wanted_order])


@pytest.mark.parametrize(
    ("wide", "high", "is_slab"),
    [(1.0, 0.49, True), (1.0, 0.51, False), (0.11, 0.0, True), (0.09, 0.0, False)],
)
def test_a_slab_is_half_as_thick_as_long_and_no_line(
    wide: float, high: float, is_slab: bool
) -> None:
    """The corners of a box: half its edges are standard deviations, 1 m along x."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    corners *= [1.0, wide, high]
    assert len(corners) == LEAST_FLAT
    surface = flattened_surface(corners, np.full((8, 3), 0.1), np.arange(8), 4.0, 0.05)
    assert surface.planar.tolist() == [is_slab] * 8
    np.testing.assert_allclose(surface.points[:, 2], 0.0, atol=1e-9)
    np.testing.assert_allclose(np.abs(surface.normals[:, 2]), 1.0)
