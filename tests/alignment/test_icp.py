"""Fits on points: known transforms, outliers, uncertain points, rays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semloc_logs.alignment.icp import Step, Weighting, _add_point, _increment, align
from semloc_logs.alignment.query_map import Query
from semloc_logs.alignment.refine import fine_fit
from semloc_logs.alignment.surface import flattened_surface, surface_of
from semloc_logs.alignment.target_map import point_surface
from semloc_logs.arrays import F64
from semloc_logs.numerics.transforms import apply, exp_se3, inverse, yaw_transform
from semloc_logs.settings import Settings
from semloc_logs.voxels.grid import Fuser
from tests.alignment.fits import CELL, SMALL, STEPS, error, fit, room


@pytest.mark.parametrize(
    "truth",
    [
        np.eye(4),
        yaw_transform(2.5, (3.0, -1.0, 0.5)),
        exp_se3(np.array([1.0, 2, 3]), np.array([0.3, -0.2, 1.0])),
    ],
)
def test_a_known_transform_is_found_to_a_millimetre(truth: F64) -> None:
    fitted = fit(truth, truth @ SMALL, noise=0.004)
    distance, angle = error(fitted.target_T_query, truth)
    assert distance < 0.001
    assert angle < 0.0005
    assert fitted.inliers > 0.98
    assert 0.004 < fitted.rmse < 0.012  # the noise of the points and of the planes
    assert error(truth @ SMALL, truth)[0] > 0.2  # there was something to find


def test_forward_and_backward_are_inverse() -> None:
    rng = np.random.default_rng(1)
    a = room(rng, 1200)
    b = apply(inverse(yaw_transform(0.7, (1.0, 0.0, 0.0))), room(rng, 1200))
    T = yaw_transform(0.7, (1.0, 0.0, 0.0))
    there = align(b, surface_of(a, CELL), T @ SMALL, STEPS).target_T_query
    back = align(a, surface_of(b, CELL), inverse(T @ SMALL), STEPS).target_T_query
    distance, angle = error(there @ back, np.eye(4))
    assert distance < 0.002
    assert angle < 0.0007


def test_far_from_the_origin_the_result_is_the_same() -> None:
    """Rotations act about the query's centre, so coordinates of kilometres do no harm."""
    rng = np.random.default_rng(2)
    target = room(rng, 1200)
    query = room(rng, 600)
    shift = yaw_transform(0.0, (30_000.0, -20_000.0, 500.0))
    at_origin = align(query, surface_of(target, CELL), SMALL, STEPS)
    far = align(query, surface_of(apply(shift, target), CELL), shift @ SMALL, STEPS)
    assert error(inverse(shift) @ far.target_T_query, at_origin.target_T_query)[0] < 1e-4
    both = align(
        apply(shift, query),
        surface_of(apply(shift, target), CELL),
        shift @ SMALL @ inverse(shift),
        STEPS,
    )
    assert error(apply_both(shift, both.target_T_query), at_origin.target_T_query)[0] < 1e-4
    np.testing.assert_allclose(far.information, at_origin.information, rtol=0.02, atol=2)


def apply_both(shift: F64, T: F64) -> F64:
    return inverse(shift) @ T @ shift


def test_outliers_are_not_followed() -> None:
    rng = np.random.default_rng(3)
    target = surface_of(room(rng, 1500), CELL)
    query = np.concatenate([room(rng, 500), rng.uniform((-4, -2.5, 0), (4, 2.5, 3), (1500, 3))])
    fitted = align(query, target, SMALL, STEPS)
    assert error(fitted.target_T_query, np.eye(4))[0] < 0.01
    assert 0.5 < fitted.inliers < 0.95


def test_information_of_point_distances_is_that_of_numerical_differences() -> None:
    rng = np.random.default_rng(0)
    # not about its mean, so that translation and rotation couple
    arm = rng.normal(1, 2, (9, 3))
    weight = rng.uniform(0.1, 1, 9)
    expected = np.zeros((6, 6))
    for a, w in zip(arm, weight, strict=True):
        J = np.zeros((3, 6))
        for k in range(6):
            step = 1e-6 * np.eye(6)[k]
            J[:, k] = (
                apply(exp_se3(step[:3], step[3:]), a[None])[0]
                - apply(exp_se3(-step[:3], -step[3:]), a[None])[0]
            ) / 2e-6
        expected += w * J.T @ J
    information = np.zeros((6, 6))
    g = np.zeros(6)
    for a, w in zip(arm, weight, strict=True):
        _add_point(information, g, a, np.array([0.1, -0.3, 0.2]), w)
    np.testing.assert_allclose(np.triu(information), np.triu(expected), atol=1e-6)
    o = np.array([0.1, -0.3, 0.2])
    np.testing.assert_allclose(
        g, np.r_[weight.sum() * o, (np.cross(arm, o) * weight[:, None]).sum(0)]
    )


def test_leaves_without_any_plane_hold_an_alignment_too() -> None:
    rng = np.random.default_rng(1)
    cloud = rng.uniform(-3, 3, (800, 3))
    target = surface_of(cloud, CELL)
    flat = replace(target, planar=np.zeros(800))
    start = exp_se3(np.array([0.05, -0.04, 0.03]), np.array([0.01, 0.0, -0.02]))
    assert (
        error(
            align(cloud[::3], flat, start, (Step(0.5, 30), Step(0.3, 30))).target_T_query, np.eye(4)
        )[0]
        < 1e-3
    )


def test_nothing_to_align() -> None:
    target = surface_of(room(np.random.default_rng(0), 100), CELL)
    for query in (np.zeros((0, 3)), np.full((50, 3), 1e4), np.zeros((5, 3))):
        fitted = align(query, target, SMALL, STEPS)
        assert fitted.inliers == 0
        assert fitted.rmse == np.inf
        assert not fitted.information.any()
        np.testing.assert_array_equal(fitted.target_T_query, SMALL)
    empty = align(
        room(np.random.default_rng(0), 100), surface_of(np.zeros((0, 3)), CELL), SMALL, STEPS
    )
    assert empty.count == 0


@pytest.mark.parametrize(("count", "inliers"), [(11, 0.0), (12, 1.0)])
def test_twelve_points_are_enough(count: int, inliers: float) -> None:
    floor = np.stack(np.meshgrid(np.arange(12.0), np.arange(12.0), 0.0), -1).reshape(-1, 3)
    fitted = align(floor[:count], surface_of(floor, 1.0), np.eye(4), (Step(0.4, 0),))
    assert (fitted.count, fitted.inliers) == (count, inliers)


def test_distances_are_of_the_points_that_meet_a_surface() -> None:
    """Twenty points a decimetre above a floor, and twenty far away."""
    floor = np.stack(np.meshgrid(np.arange(12.0), np.arange(12.0), 0.0), -1).reshape(-1, 3)
    query = floor[:40] + np.array([0.0, 0.0, 0.1])
    query[20:, 2] = 10.0
    fitted = align(query, surface_of(floor, 1.0), np.eye(4), (Step(0.4, 0),))
    assert (fitted.count, fitted.inliers) == (20, 0.5)
    assert fitted.rmse == pytest.approx(0.1)
    np.testing.assert_array_equal(fitted.target_T_query, np.eye(4))  # a step of no iterations


def test_of_an_increment_that_turns_too_far_the_same_share_moves() -> None:
    """By 1 m and 0.4 rad, of which 0.2 rad are allowed: half of both."""
    pull = np.array([-1.0, 0.0, 0.0, 0.0, 0.0, -0.4])
    T, length, angle = _increment(np.eye(4), np.zeros(3), np.eye(6), pull)
    assert (length, angle) == pytest.approx((0.5, 0.2), rel=1e-4)
    np.testing.assert_allclose(T, yaw_transform(0.2, (0.5, 0.0, 0.0)), atol=1e-5)


def seen_by_a_camera(
    rng: np.random.Generator, points: F64, eye: F64, share: float, too_far: float = 0.0
) -> tuple[F64, F64]:
    """Points (n, 3) as a camera at ``eye`` (3,) has them, whose range has a standard deviation of
    ``share`` of it, and that spread (n, 3); all of them ``too_far`` standard deviations off.
    """
    spread = share * (points - eye)
    return points + spread * (rng.normal(size=(len(points), 1)) + too_far), spread


def test_uncertain_points_are_aligned_through_the_slab_they_lie_in() -> None:
    """Two cameras at opposite ends of a hall, ranges wrong by 4 %: the nearest point of a slab is
    near wherever the query starts, so that a plain fit stays there. Across the hall its long walls
    tell, along it the ends, of which each camera knows one well.
    """
    rng = np.random.default_rng(3)
    v = 0.3
    start = exp_se3(np.array([0.35, -0.3, 0.0]), np.array([0.0, 0.0, 0.03]))
    there, there_spread = seen_by_a_camera(
        rng, room(rng, 6000) * [2, 2, 1], np.array([-6.0, 0.0, 1.5]), 0.04
    )
    here, here_spread = seen_by_a_camera(
        rng, room(rng, 3000) * [2, 2, 1], np.array([6.0, 0.5, 1.5]), 0.04
    )
    surface = point_surface(there, there_spread, v)
    assert surface.sigma > 0.25 * v
    query = Query(Fuser(Settings().resolved().fusion).finish(), here, v, here_spread)
    target_T_query = fine_fit(start, surface, query).target_T_query
    assert np.linalg.norm(target_T_query[1:3, 3]) < 0.06
    assert error(target_T_query, np.eye(4))[0] < 0.22
    plain = fine_fit(start, surface_of(there, 2 * v), replace(query, spread=None))
    assert error(plain.target_T_query, np.eye(4))[0] > 0.3


def test_a_certain_point_weighs_as_many_uncertain_ones_as_it_is_more_certain() -> None:
    """A wall at x = 0, 40 points on it that are certain, 40 a decimetre behind it that are known to
    0.2 m across it; noise 0.1 m: the mean of weights 1 and 1 / (1 + 4).
    """
    grid = np.stack(np.meshgrid(0.0, np.arange(-2, 2, 0.1), np.arange(0, 2, 0.1)), -1).reshape(
        -1, 3
    )
    rng = np.random.default_rng(0)
    on = np.c_[np.zeros(40), rng.uniform(-1.5, 1.5, 40), rng.uniform(0.2, 1.8, 40)]
    query = np.r_[on, on + np.array([0.1, 0.0, 0.0])]
    spread = np.r_[np.zeros((40, 3)), np.tile([0.2, 0.0, 0.0], (40, 1))]
    # a kernel this wide weighs all points alike; the last step measures the result
    wide = (Step(100.0, 15), Step(100.0, 0))
    fitted = align(query, surface_of(grid, CELL), np.eye(4), wide, spread, Weighting(0.1))
    assert fitted.target_T_query[0, 3] == pytest.approx(-0.1 * 0.2 / 1.2, rel=0.02)
    assert fitted.rmse == pytest.approx(
        np.sqrt((0.1 * 0.2 / 1.2) ** 2 / 2 + 0.2 * (0.1 / 1.2) ** 2 / 2), rel=0.02
    )


def test_a_start_holds_where_little_says_otherwise() -> None:
    """One wall of 40 points, 0.1 m from where the query starts, against a hold of 40 points: half
    of the way.
    """
    grid = np.stack(np.meshgrid(0.0, np.arange(-2, 2, 0.1), np.arange(0, 2, 0.1)), -1).reshape(
        -1, 3
    )
    rng = np.random.default_rng(0)
    query = np.c_[np.full(40, 0.1), rng.uniform(-1.5, 1.5, 40), rng.uniform(0.2, 1.8, 40)]
    hold = Weighting(hold=40.0)
    fitted = align(query, surface_of(grid, CELL), np.eye(4), (Step(100.0, 15),), weighting=hold)
    assert fitted.target_T_query[0, 3] == pytest.approx(-0.05, rel=0.01)


def test_rays_turn_with_the_query() -> None:
    """A wall along x of the target that a query, turned by 90 degrees, sees along its own x.

    It is 0.3 m off, as a ray of 0.3 m across it says. 100 points weigh a tenth with a noise of 0.1
    m, and two thirds of that in a kernel as wide: 0.3^2 / (0.3^2 + 0.3^2) to one.
    """
    wall = np.stack(np.meshgrid(np.linspace(-1, 1, 10), 0.0, np.linspace(0, 2, 10)), -1)
    surface = surface_of(wall.reshape(-1, 3), CELL)
    surface.normals[:] = [0.0, -1.0, 0.0]
    surface.planar[:] = 1.0
    turned = yaw_transform(np.pi / 2)
    query = apply(inverse(turned), surface.points + np.array([0.0, 0.3, 0.0]))
    rays = np.tile([0.3, 0.0, 0.0], (100, 1))
    fitted = align(query, surface, turned, (Step(2.0, 0),), rays, Weighting(0.1))
    weight = 100 * 0.1 * 2 / 3
    assert fitted.information[1, 1] == pytest.approx(weight)
    expected = [0.0, weight * 0.3, 0.0, 0.0, 0.0, 0.0]
    np.testing.assert_allclose(fitted.range_bias, [expected, [0.0] * 6], atol=1e-9)


def test_leaves_pull_by_how_certain_they_are() -> None:
    """Eight leaves at the corners of a cube, seen 0.3 m to one side by a certain point each and to
    the other by one of 0.3 m along its ray; noise and kernel are as large.

    Certain ones weigh 1 / (1 + 1), the others a half of 1 / (1 + 1 / 2), a third: the query moves
    by 0.3 m times (1 / 2 - 1 / 3) / (1 / 2 + 1 / 3).
    """
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    surface = surface_of(corners, CELL)
    surface.normals[:] = [1.0, 0.0, 0.0]
    surface.planar[:] = 0.0
    aside = np.array([0.3, 0.0, 0.0])
    rays = np.r_[np.zeros((8, 3)), np.tile([0.0, 0.3, 0.0], (8, 1))]
    query = np.r_[corners + aside, corners - aside]
    fitted = align(query, surface, np.eye(4), (Step(2.0, 1),), rays, Weighting(0.3))
    np.testing.assert_allclose(fitted.target_T_query[:3, 3], [-0.06, 0.0, 0.0], atol=1e-5)


def test_distances_to_planes_are_those_of_where_a_fit_ends() -> None:
    """Three walls that meet, without noise, half a centimetre off: near enough for a step of 0.4 m
    that others follow, but the last one looks again.
    """
    side = np.stack(np.meshgrid(np.linspace(0, 4, 40), np.linspace(0, 4, 40)), -1).reshape(-1, 2)
    walls = np.concatenate([np.insert(side, axis, 0.0, axis=1) for axis in range(3)])
    query = walls[walls.max(1) < 3][::7] + np.array([0.0, 0.0, 0.005])
    fitted = align(query, surface_of(walls, CELL), np.eye(4), (Step(0.4, 10),))
    assert fitted.rmse < 1e-4
    np.testing.assert_allclose(fitted.target_T_query[:3, 3], [0.0, 0.0, -0.005], atol=1e-4)


def test_an_uncertain_wall_of_the_target_weighs_less_than_a_certain_one() -> None:
    """Two walls face the query, of which the map has the second 0.1 m too far and knows it to 0.2
    m; noise 0.1 m: weights 1 and 1 / 5.
    """
    side = np.stack(np.meshgrid(0.0, np.arange(-2, 2, 0.1), np.arange(0, 2, 0.1)), -1).reshape(
        -1, 3
    )
    walls = np.r_[side, side + np.array([10.0, 0.0, 0.0])]
    spread = np.r_[np.zeros_like(side), np.tile([0.2, 0.0, 0.0], (len(side), 1))]
    mapped = walls + np.r_[np.zeros_like(side), np.tile([0.1, 0.0, 0.0], (len(side), 1))]
    surface = flattened_surface(mapped, spread, np.arange(len(mapped)), CELL, 0.1)
    fitted = align(walls[::3], surface, np.eye(4), (Step(100.0, 15),), weighting=Weighting(0.1))
    assert fitted.target_T_query[0, 3] == pytest.approx(0.1 * 0.2 / 1.2, rel=0.05)


def test_a_fit_that_meets_too_little_knows_nothing() -> None:
    """The first radius reaches the walls, the last one does not: nothing is left of what the first
    one knew.
    """
    rng = np.random.default_rng(6)
    points = room(rng, 700, noise=0.0)
    off = points + np.array([0.17, 0.17, 0.17]) * rng.choice([-1, 1], (len(points), 1))
    fitted = align(
        off, surface_of(room(rng, 1500, noise=0.0), CELL), np.eye(4), (Step(0.4, 1), Step(0.001, 1))
    )
    assert (fitted.inliers, fitted.rmse) == (0.0, float("inf"))
    assert not fitted.information.any()
    assert not fitted.range_bias.any()
