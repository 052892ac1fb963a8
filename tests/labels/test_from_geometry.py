from __future__ import annotations

import numpy as np
import pytest

from semloc_logs.arrays import F64
from semloc_logs.labels.from_geometry import classify
from semloc_logs.labels.space import BUILDING, POLE, ROAD, UNLABELLED, VEGETATION
from semloc_logs.numerics.local_shape import shape


def plane(
    rng: np.random.Generator,
    n: int,
    low: tuple[float, float, float],
    high: tuple[float, float, float],
) -> F64:
    return rng.uniform(low, high, (n, 3)) + rng.normal(0, 0.01, (n, 3))


def street(rng: np.random.Generator, slope: float = 0.0) -> dict[int, F64]:
    """Ground, a house front and a flat roof, a pole and a bush, 2 cm noise."""
    angle = rng.uniform(0, 2 * np.pi, 120)
    bush = rng.normal(0, 1, (1500, 3))
    bush *= (rng.uniform(0, 1, 1500) ** (1 / 3) / np.linalg.norm(bush, axis=1))[:, None]
    parts = {
        ROAD: plane(rng, 8000, (-15, -15, 0), (15, 15, 0)),
        BUILDING: np.concatenate(
            [
                plane(rng, 4000, (-15, 12, 0.6), (15, 12, 7)),
                plane(rng, 2500, (-15, 12.5, 7.5), (15, 15, 7.5)),
            ]
        ),
        POLE: np.c_[
            3 + 0.05 * np.cos(angle), -4 + 0.05 * np.sin(angle), np.linspace(0.5, 4.5, 120)
        ],
        VEGETATION: bush * 1.5 + [-6, -6, 2.4],
    }
    return {k: p + np.c_[np.zeros((len(p), 2)), slope * p[:, 0]] for k, p in parts.items()}


@pytest.mark.parametrize("slope", [0.0, 0.08])
@pytest.mark.parametrize("scale", [1.0, 1 / 6])
def test_a_street_and_a_room_in_its_shape(slope: float, scale: float) -> None:
    parts = street(np.random.default_rng(0), slope)
    points = np.concatenate(list(parts.values())) * scale
    truth = np.concatenate([np.full(len(p), k) for k, p in parts.items()])
    label = classify(points, np.array([0, 0, 1.8]) * scale, scale)
    share = {k: float((label[truth == k] == k).mean()) for k in parts}
    assert share[ROAD] > 0.97
    assert share[BUILDING] > 0.9
    assert share[POLE] > 0.85
    assert share[VEGETATION] > 0.8
    wrong_ground = (label == ROAD) & (truth != ROAD)
    assert wrong_ground.sum() < 0.01 * len(points)


def test_points_far_away_and_in_odd_places_are_unlabelled_and_cost_no_memory() -> None:
    rng = np.random.default_rng(0)
    ground = rng.uniform((-5, -5, 0), (5, 5, 0.02), (500, 3))
    points = np.concatenate([ground, [[1e7, -1e7, 3.0], [0.0, 0.0, 1e30]]])
    label = classify(points, np.array([0, 0, 1.8]))
    assert (label[:500] == ROAD).all()
    assert label[500:].tolist() == [UNLABELLED, UNLABELLED]


def test_no_points_and_few_points() -> None:
    origin = np.array([0, 0, 1.8])
    assert classify(np.zeros((0, 3)), origin).tolist() == []
    few = np.array([[0.0, 0, 0], [1, 0, 3], [5, 5, 2]])
    assert classify(few, origin).tolist()[0] == ROAD
    s = shape(few)
    assert s.scattered.tolist() == [1, 1, 1]


def test_classes_do_not_depend_on_the_order_of_points_or_on_where_the_map_begins() -> None:
    rng = np.random.default_rng(3)
    points = np.concatenate(list(street(rng).values()))
    origin = np.array([0, 0, 1.8])
    label = classify(points, origin)
    turned = rng.permutation(len(points))
    assert (classify(points[turned], origin) == label[turned]).mean() > 0.999
    away = np.array([600.0, -300.0, 30.0])  # whole voxels and cells
    assert (classify(points + away, origin + away) == label).mean() > 0.999


def slow_shape(
    points: F64, i: int, neighbours: int, radius: float
) -> tuple[F64, F64, float, float, float]:
    distance = np.linalg.norm(points - points[i], axis=1)
    nearest = np.argsort(distance, kind="stable")[:neighbours]
    nearest = nearest[distance[nearest] < radius]
    values, vectors = np.linalg.eigh(np.cov(points[nearest].T, bias=True))
    s = np.sqrt(np.maximum(values, 0))
    return vectors[:, 0], vectors[:, 2], (s[2] - s[1]) / s[2], (s[1] - s[0]) / s[2], s[0] / s[2]


@pytest.mark.parametrize("radius", [np.inf, 0.8])
def test_shape_is_that_of_the_covariance_of_the_neighbours(radius: float) -> None:
    points = np.random.default_rng(0).uniform(0, 3, (300, 3)) * [1, 1, 0.3]
    s = shape(points, 12, radius)
    np.testing.assert_allclose(s.linear + s.planar + s.scattered, 1, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(s.normal, axis=1), 1, atol=1e-5)
    for i in range(0, 300, 7):
        normal, direction, linear, planar, scattered = slow_shape(points, i, 12, radius)
        assert abs(s.normal[i] @ normal) > 1 - 1e-5
        assert abs(s.direction[i] @ direction) > 1 - 1e-5
        np.testing.assert_allclose(
            [s.linear[i], s.planar[i], s.scattered[i]], [linear, planar, scattered], atol=1e-5
        )


def test_points_without_neighbours_are_scattered() -> None:
    s = shape(
        np.array([[0.0, 0, 0], [10, 0, 0], [20, 0, 0], [30, 0, 0], [40, 0, 0]]), 4, radius=1.0
    )
    assert s.scattered.tolist() == [1] * 5
    assert np.isfinite(s.normal).all()
    same = shape(np.ones((6, 3)), 4)  # all in one place
    assert np.isfinite(same.normal).all()
