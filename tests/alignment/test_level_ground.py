"""Ground that is lifted as a whole, by snow or grass."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semloc_logs.alignment.covariance import covariance_of
from semloc_logs.alignment.icp import Step, align
from semloc_logs.alignment.level_ground import ground_bias
from semloc_logs.alignment.surface import surface_of
from semloc_logs.arrays import F64
from semloc_logs.numerics.transforms import yaw_transform
from tests.alignment.fits import CELL


def ground_and_walls(rng: np.random.Generator, lifted: float, left_only: bool = False) -> F64:
    """Points (n, 3) of 20 m of level ground, a part of it ``lifted``, and of walls around it."""
    ground = np.column_stack([rng.uniform(-10, 10, (6000, 2)), np.zeros(6000)])
    off_road = ground[:, 1] > 3 if left_only else np.abs(ground[:, 1]) > 3
    ground[off_road, 2] += lifted
    along = rng.uniform(-10, 10, 6000)
    height = rng.uniform(0, 4, 6000)
    side = np.where(rng.random(6000) < 0.5, -10.0, 10.0)
    walls = np.where(
        (np.arange(6000) % 2 == 0)[:, None],
        np.column_stack([along, side, height]),
        np.column_stack([side, along, height]),
    )
    return np.concatenate([ground, walls]) + rng.normal(scale=0.01, size=(12000, 3))


@pytest.mark.parametrize("left_only", [False, True])
def test_ground_that_is_lifted_as_a_whole_makes_height_and_tilt_uncertain(left_only: bool) -> None:
    """Snow of 0.2 m beside a road of 6 m, on 70 or 35 % of the ground."""
    rng = np.random.default_rng(8)
    surface = surface_of(ground_and_walls(rng, 0.0), CELL)
    covariances = []
    for lifted in (0.0, 0.2):
        points = ground_and_walls(rng, lifted, left_only)
        fitted = align(points, surface, np.eye(4), (Step(0.12, 10),))
        bias = ground_bias(points, surface, fitted.target_T_query, fitted.centre, 0.45, 0.12)
        covariances.append(
            covariance_of(replace(fitted, ground_bias=bias), np.eye(4), np.eye(4), 0.3)
        )
    same, snow = covariances
    mean = 0.2 * (0.35 if left_only else 0.7)
    assert snow[2, 2] - same[2, 2] == pytest.approx(mean**2, rel=0.15)
    tilt = mean / 5.8  # 5.8 m: a standard deviation of 20 m
    assert 0.3 * tilt < np.sqrt(snow[3, 3] - same[3, 3]) < tilt
    assert snow[5, 5] == pytest.approx(same[5, 5], rel=0.02)  # walls hold the heading
    assert np.sqrt(same[2, 2]) < 0.02


def test_without_level_ground_none_is_off() -> None:
    rng = np.random.default_rng(9)
    points = ground_and_walls(rng, 0.0)[6000:]
    surface = surface_of(points, CELL)
    assert not ground_bias(points, surface, np.eye(4), np.zeros(3), 0.45, 0.12).any()


def test_ground_bias_by_hand() -> None:
    """Level ground at four corners of 4 m by 2 m, 10 m ahead, and rough points beside it.

    A query lies 6 cm above it, as much as the kernel of a radius of 40 cm is wide: a weight of a
    half. Ten points at each corner are looked at, which stand for thirty.
    """
    corners = np.array([[8.0, -1, 0], [8, 1, 0], [12, -1, 0], [12, 1, 0], [10, 5, 0]])
    surface = surface_of(corners, CELL)
    is_flat = surface.points[:, 1] < 5
    surface.normals[:, 2] = np.where(surface.points[:, 0] < 10, 1.0, -1.0)  # to either side
    surface.planar[:] = is_flat
    ahead = yaw_transform(0.0, (10.0, 0.0, 0.0))
    above = np.repeat(corners, 30, axis=0) + np.array([-10, 0, 0.06])
    above[120:, 2] = 0.2
    bias = ground_bias(above, surface, ahead, np.zeros(3), 0.45, 0.4)
    weight = 40 * 3 * 0.5 * 0.06
    width = np.sqrt(2.5)  # the mean of 2^2 and 1^2
    expected = np.zeros((3, 6))
    expected[0, [2, 4]] = weight, -10 * weight  # ground ahead that is lifted turns about y
    expected[1, 4] = -(2**2) / width * weight
    expected[2, 3] = 1**2 / width * weight
    np.testing.assert_allclose(bias, expected, atol=1e-12)
    few = ground_bias(above[:87], surface, ahead, np.zeros(3), 0.45, 0.4)  # 29 of them
    assert not few.any()
    assert ground_bias(above[:90], surface, ahead, np.zeros(3), 0.45, 0.4).any()
