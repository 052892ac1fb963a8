from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semloc_logs.arrays import F64
from semloc_logs.labels.sweep_ground import ground_surface

EYE = np.array([0.0, 0.0, 1.8])


def field(rng: np.random.Generator, n: int = 20_000, half: float = 20.0, slope: float = 0.0) -> F64:
    xy = rng.uniform(-half, half, (n, 2))
    return np.asarray(np.c_[xy, slope * xy[:, 0] + rng.normal(0, 0.015, n)])


@pytest.mark.parametrize("slope", [0.0, 0.1, -0.2])
@pytest.mark.parametrize("scale", [1.0, 1 / 6])
def test_a_slope(slope: float, scale: float) -> None:
    p = field(np.random.default_rng(0), slope=slope)
    inside = np.abs(p[:, :2]).max(1) < 18
    surface = ground_surface(p * scale, EYE * scale, scale)
    height = (p * scale)[:, 2] - surface.height_at((p * scale)[:, :2])
    assert np.abs(height[inside]).max() < (0.08 + 0.3 * abs(slope)) * scale


def test_a_car_hides_the_ground_and_a_house_stands_on_it() -> None:
    rng = np.random.default_rng(1)
    p = field(rng)
    under_car = (np.abs(p[:, 0] - 6) < 2.2) & (np.abs(p[:, 1] - 3) < 1)
    behind = p[:, 1] > 12
    car = rng.uniform((3.8, 2, 0.35), (8.2, 4, 1.5), (800, 3))
    house = rng.uniform((-20, 12, 0), (20, 12.1, 9), (4000, 3))
    roof = rng.uniform((-20, 12, 9), (20, 20, 9.1), (3000, 3))
    surface = ground_surface(np.concatenate([p[~under_car & ~behind], car, house, roof]), EYE)
    assert np.abs(surface.height_at(car[:, :2])).max() < 0.12
    assert np.abs(surface.height_at(house[:, :2])).max() < 0.15
    # nothing was seen there: the street goes on
    assert np.abs(surface.height_at(roof[:, :2])).max() < 0.3


def test_echoes_below_the_street_do_not_lower_it() -> None:
    """A mirrored front of a house, metres below the ground, as real sweeps have it."""
    rng = np.random.default_rng(2)
    p = field(rng)
    mirrored = rng.uniform((8, -12, -6), (9, 12, -0.7), (3000, 3))
    surface = ground_surface(np.concatenate([p, mirrored]), EYE)
    assert np.abs(surface.height_at(p[:, :2])).max() < 0.1


def test_a_ceiling_is_no_ground() -> None:
    """A sensor with a narrow view upwards and downwards: more of the ceiling than of the floor."""
    rng = np.random.default_rng(3)
    floor = field(rng, 3000)
    ceiling = field(rng, 20_000) + np.array([0, 0, 3.2])
    floor = floor[np.hypot(floor[:, 0], floor[:, 1]) > 6]
    surface = ground_surface(np.concatenate([floor, ceiling]), EYE)
    assert np.abs(surface.height_at(ceiling[:, :2])).max() < 0.1


def test_seen_and_unseen_ground() -> None:
    p = field(np.random.default_rng(4), half=8)
    p = p[p[:, 0] < 0]
    wall = np.array([[7.0, 0.0, 2.0]])
    surface = ground_surface(np.concatenate([p, wall]), EYE)
    centre = surface.centres()
    seen = (centre[..., 0] < -1) & (np.abs(centre[..., 1]) < 7) & (centre[..., 0] > -7)
    assert (surface.gap[seen] == 0).all()
    assert (surface.gap[centre[..., 0] > 1.5] > 0).all()
    inside = (centre[..., 0] > 1.5) & (centre[..., 0] < 7) & (np.abs(centre[..., 1]) < 7)
    assert np.abs(surface.z[inside]).max() < 0.1


def test_no_points_one_point_and_points_far_away() -> None:
    assert ground_surface(np.zeros((0, 3)), EYE).height_at(np.zeros((1, 2))) == pytest.approx(0.1)
    one = ground_surface(np.array([[3.0, 4.0, 0.5]]), EYE)
    assert one.height_at(np.array([[3.0, 4.0]])) == pytest.approx(0.5, abs=0.01)
    far = ground_surface(
        np.concatenate([field(np.random.default_rng(0)), [[1e9, 0, -3], [0, 0, -1e30]]]), EYE
    )
    assert far.z.size < 100 * 100
    assert np.isfinite(far.height_at(np.array([[1e12, 0.0]]))).all()


@settings(max_examples=30)
@given(st.lists(st.tuples(*[st.floats(-30, 30, width=32)] * 3), min_size=1, max_size=60))
def test_any_points_give_finite_heights(rows: list[tuple[float, float, float]]) -> None:
    p = np.array(rows)
    surface = ground_surface(p, EYE)
    assert np.isfinite(surface.z).all()
    assert (surface.gap >= 0).all()
    assert surface.z.min() >= min(p[:, 2].min(), EYE[2] - 5) - 1e-9
    assert surface.z.max() <= p[:, 2].max() + 1e-9
