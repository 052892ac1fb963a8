from __future__ import annotations

import numpy as np
import pytest

from semloc_logs.numerics.local_shape import (
    MOMENTS,
    add_point,
    covariance,
    principal_axes,
    shape,
    shapes_of,
)

RNG = np.random.default_rng(0)


def test_moments_give_the_weighted_covariance() -> None:
    points = RNG.normal(size=(40, 3)) * [3.0, 1.0, 0.2] + [5.0, -2.0, 1.0]
    weight = RNG.uniform(0.5, 2.0, 40)
    moments = np.zeros(MOMENTS)
    for (x, y, z), w in zip(points, weight, strict=True):
        add_point(moments, x, y, z, w)
    mean = np.empty(3)
    a = np.empty((3, 3))
    covariance(moments, mean, a)
    np.testing.assert_allclose(mean, np.average(points, axis=0, weights=weight))
    np.testing.assert_allclose(a, np.cov(points.T, aweights=weight, ddof=0), atol=1e-12)


def test_principal_axes_by_hand() -> None:
    """Standard deviations 3, 1 and 2 along x, y and z."""
    spread = np.empty(3)
    axes = np.empty((3, 3))
    principal_axes(np.diag([9.0, 1.0, 4.0]), spread, axes)
    assert spread.tolist() == [1.0, 2.0, 3.0]
    assert np.abs(axes).tolist() == [[0, 0, 1], [1, 0, 0], [0, 1, 0]]


def test_a_covariance_that_rounding_made_negative_has_no_spread() -> None:
    spread = np.empty(3)
    principal_axes(np.diag([-1e-18, 1.0, 1.0]), spread, np.empty((3, 3)))
    assert spread.tolist() == [0.0, 1.0, 1.0]


@pytest.mark.parametrize(
    ("extent", "name"),
    [((10, 10, 0), "planar"), ((10, 0, 0), "linear"), ((10, 10, 10), "scattered")],
)
def test_planes_lines_and_clouds(extent: tuple[float, float, float], name: str) -> None:
    points = RNG.uniform(-1, 1, (200, 3)) * extent
    shapes = shape(points, neighbours=200)
    shares = {n: float(getattr(shapes, n)[0]) for n in ("linear", "planar", "scattered")}
    assert max(shares, key=lambda n: shares[n]) == name
    assert sum(shares.values()) == pytest.approx(1.0)
    if name == "planar":
        np.testing.assert_allclose(np.abs(shapes.normal[0]), [0, 0, 1], atol=1e-6)
    if name == "linear":
        np.testing.assert_allclose(np.abs(shapes.direction[0]), [1, 0, 0], atol=1e-6)


def test_far_from_the_origin_the_shape_is_the_same() -> None:
    points = np.round(RNG.uniform(-1, 1, (30, 3)) * [1, 1, 0.01] * 1024) / 1024
    index = np.arange(30)[None]
    one, other = (shapes_of(p, np.array([0]), index) for p in (points, points + 2.0**20))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)


def test_missing_neighbours_do_not_count() -> None:
    points = RNG.normal(size=(20, 3))
    rows = np.array([3])
    some = np.array([[3, 5, 7, 9, 11]])
    padded = np.array([[3, -1, 5, 7, -1, 9, 11, -1]])
    for a, b in zip(shapes_of(points, rows, some), shapes_of(points, rows, padded), strict=True):
        np.testing.assert_array_equal(a, b)


def test_few_points_are_scattered() -> None:
    for n in range(4):
        assert shape(RNG.normal(size=(n, 3))).scattered.tolist() == [1.0] * n
