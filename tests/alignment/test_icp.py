from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from semloc_logs.alignment.covariance import (
    COMMON_BIAS,
    RANGE_BIAS,
    Stretch,
    covariance_of,
    stiffness,
)
from semloc_logs.alignment.hypotheses import SAME_PLACE_VOXELS
from semloc_logs.alignment.icp import Fit, Step, Weighting, _add_point, _increment, align
from semloc_logs.alignment.level_ground import ground_bias
from semloc_logs.alignment.query_map import Query
from semloc_logs.alignment.refine import fine_fit
from semloc_logs.alignment.surface import flattened_surface, surface_of
from semloc_logs.alignment.target_map import point_surface
from semloc_logs.mapping.drift import UNMEASURED, Drift
from semloc_logs.numerics.transforms import apply, exp_se3, inverse, rotation_angle, yaw_transform
from semloc_logs.settings import Settings
from semloc_logs.voxels.grid import Fuser

F64 = NDArray[np.float64]
CELL = 0.4
STEPS = tuple(Step(radius, 15) for radius in (1.0, 0.5, 0.2))


def room(rng: np.random.Generator, n: int, noise: float = 0.01, corridor: bool = False) -> F64:
    """Walls, floor and ceiling of a room of 8 x 5 x 3 m with a slanted panel and a pillar; a
    corridor has two walls and a floor only.
    """
    long = 40.0 if corridor else 8.0
    u, v = rng.uniform(0, 1, (2, n))
    sides = [
        np.c_[u * long - long / 2, np.full(n, -2.5), v * 3],
        np.c_[u * long - long / 2, np.full(n, 2.5), v * 3],
        np.c_[u * long - long / 2, v * 5 - 2.5, np.zeros(n)],
    ]
    if not corridor:
        sides += [
            np.c_[np.full(n, -4), u * 5 - 2.5, v * 3],
            np.c_[np.full(n, 4), u * 5 - 2.5, v * 3],
            np.c_[u * 8 - 4, v * 5 - 2.5, np.full(n, 3)],
            np.c_[u * 2 - 1, v + u - 1, 3 * v],
        ]
    points = np.concatenate(sides)
    return points + rng.normal(0, noise, points.shape)


def error(found: F64, truth: F64) -> tuple[float, float]:
    d = inverse(truth) @ found
    return float(np.linalg.norm(d[:3, 3])), rotation_angle(d[:3, :3])


def fit(truth: F64, start: F64, seed: int = 0, noise: float = 0.01) -> Fit:
    """The query is the room seen from the frame of ``truth``, sampled anew."""
    rng = np.random.default_rng(seed)
    target = surface_of(room(rng, 1500, noise), CELL)
    return align(apply(inverse(truth), room(rng, 700, noise)), target, start, STEPS)


SMALL = exp_se3(np.array([0.15, -0.2, 0.1]), np.array([0.03, -0.02, 0.06]))


@pytest.mark.parametrize(
    "truth",
    [
        np.eye(4),
        yaw_transform(2.5, (3.0, -1.0, 0.5)),
        exp_se3(np.array([1.0, 2, 3]), np.array([0.3, -0.2, 1.0])),
    ],
)
def test_a_known_transform_is_found_to_a_millimetre(truth: F64) -> None:
    found = fit(truth, truth @ SMALL, noise=0.004)
    distance, angle = error(found.target_T_query, truth)
    assert distance < 0.001
    assert angle < 0.0005
    assert found.inliers > 0.98
    assert 0.004 < found.rmse < 0.012  # the noise of the points and of the planes
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
    near = align(query, surface_of(target, CELL), SMALL, STEPS)
    far = align(query, surface_of(apply(shift, target), CELL), shift @ SMALL, STEPS)
    assert error(inverse(shift) @ far.target_T_query, near.target_T_query)[0] < 1e-4
    both = align(
        apply(shift, query),
        surface_of(apply(shift, target), CELL),
        shift @ SMALL @ inverse(shift),
        STEPS,
    )
    assert error(apply_both(shift, both.target_T_query), near.target_T_query)[0] < 1e-4
    np.testing.assert_allclose(far.information, near.information, rtol=0.02, atol=2)


def apply_both(shift: F64, T: F64) -> F64:
    return inverse(shift) @ T @ shift


def test_outliers_are_not_followed() -> None:
    rng = np.random.default_rng(3)
    target = surface_of(room(rng, 1500), CELL)
    query = np.concatenate([room(rng, 500), rng.uniform((-4, -2.5, 0), (4, 2.5, 3), (1500, 3))])
    found = align(query, target, SMALL, STEPS)
    assert error(found.target_T_query, np.eye(4))[0] < 0.01
    assert 0.5 < found.inliers < 0.95


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
    found = np.zeros((6, 6))
    g = np.zeros(6)
    for a, w in zip(arm, weight, strict=True):
        _add_point(found, g, a, np.array([0.1, -0.3, 0.2]), w)
    np.testing.assert_allclose(np.triu(found), np.triu(expected), atol=1e-6)
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
        found = align(query, target, SMALL, STEPS)
        assert found.inliers == 0
        assert found.rmse == np.inf
        assert not found.information.any()
        np.testing.assert_array_equal(found.target_T_query, SMALL)
    empty = align(
        room(np.random.default_rng(0), 100), surface_of(np.zeros((0, 3)), CELL), SMALL, STEPS
    )
    assert empty.count == 0


@pytest.mark.parametrize(("count", "inliers"), [(11, 0.0), (12, 1.0)])
def test_twelve_points_are_enough(count: int, inliers: float) -> None:
    floor = np.stack(np.meshgrid(np.arange(12.0), np.arange(12.0), 0.0), -1).reshape(-1, 3)
    found = align(floor[:count], surface_of(floor, 1.0), np.eye(4), (Step(0.4, 0),))
    assert (found.count, found.inliers) == (count, inliers)


def test_distances_are_of_the_points_that_meet_a_surface() -> None:
    """Twenty points a decimetre above a floor, and twenty far away."""
    floor = np.stack(np.meshgrid(np.arange(12.0), np.arange(12.0), 0.0), -1).reshape(-1, 3)
    query = floor[:40] + np.array([0.0, 0.0, 0.1])
    query[20:, 2] = 10.0
    found = align(query, surface_of(floor, 1.0), np.eye(4), (Step(0.4, 0),))
    assert (found.count, found.inliers) == (20, 0.5)
    assert found.rmse == pytest.approx(0.1)
    np.testing.assert_array_equal(found.target_T_query, np.eye(4))  # a step of no iterations


def test_of_an_increment_that_turns_too_far_the_same_share_moves() -> None:
    """By 1 m and 0.4 rad, of which 0.2 rad are allowed: half of both."""
    pull = np.array([-1.0, 0.0, 0.0, 0.0, 0.0, -0.4])
    T, length, angle = _increment(np.eye(4), np.zeros(3), np.eye(6), pull)
    assert (length, angle) == pytest.approx((0.5, 0.2), rel=1e-4)
    np.testing.assert_allclose(T, yaw_transform(0.2, (0.5, 0.0, 0.0)), atol=1e-5)


def test_covariance_of_a_room_and_of_a_corridor() -> None:
    rng = np.random.default_rng(4)
    for corridor in (False, True):
        target = surface_of(room(rng, 1500, corridor=corridor), CELL)
        found = align(
            room(rng, 700, corridor=corridor)[:, :3],
            target,
            SMALL if not corridor else exp_se3(np.zeros(3), np.zeros(3)),
            STEPS,
        )
        C = covariance_of(found, np.eye(4), np.eye(4), 0.3)
        assert np.linalg.eigvalsh(C).min() > 0
        np.testing.assert_allclose(C, C.T)
        values, vectors = np.linalg.eigh(C[:3, :3])
        if corridor:
            assert abs(vectors[0, -1]) > 0.99  # the corridor runs along x
            assert values[-1] > 3 * values[-2]
        else:
            assert values[-1] < 3 * values[0]
            assert np.sqrt(values[-1]) < 0.05


def test_covariance_says_what_is_not_known() -> None:
    rng = np.random.default_rng(4)
    found = align(
        room(rng, 700, corridor=True),
        surface_of(room(rng, 1500, corridor=True), CELL),
        np.eye(4),
        STEPS,
    )
    assert covariance_of(found, np.eye(4), np.eye(4), 0.3)[0, 0] > 0.3**2


def held(
    information: F64,
    pull: F64 | None = None,
    rmse: float = 0.1,
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0),
    inliers: float = 1.0,
) -> Fit:
    return Fit(
        np.eye(4),
        inliers,
        1000,
        rmse,
        information,
        np.array(centre),
        np.zeros((2, 6)) if pull is None else pull,
    )


@pytest.mark.parametrize(
    ("share", "uncertain", "inflation"),
    [
        (1.0, False, 1.0),
        (0.25, False, 4.0),  # of fewer points more meet a surface by chance: 0.25 / share^2
        (0.01, False, 100.0),  # no less than 5 %
        (1.0, True, 12.0),
    ],
)
def test_covariance_by_hand(share: float, uncertain: bool, inflation: float) -> None:
    """1200 in each direction of position, 4800 about each axis (arms of 2 m), planes of 0.1 m
    noise.

    Normals 2 degrees off may pretend to know 3600 sin^2(2 degrees) = 4.38 of each. Beside that the
    search bounds the error: 0.99 m and 5 degrees; a centimetre and a milliradian come on top.
    """
    fit = held(np.diag([1200.0] * 3 + [4800.0] * 3), inliers=share)
    C = covariance_of(fit, np.eye(4), np.eye(4), 0.3, uncertain=uncertain)
    position = 1 / ((1200 - 4.3845) / (inflation * 0.01) + 1 / 0.99**2) + 1e-4
    angle = 1 / ((4800 - 4 * 4.3845) / (inflation * 0.01) + 131.31) + 1e-6
    np.testing.assert_allclose(C, np.diag([position] * 3 + [angle] * 3), rtol=1e-4, atol=1e-12)


def test_stiffness_by_hand() -> None:
    """A direction of 5 that shares 2 with a rotation of 2 holds 5 - 2 * 2 / 2 = 3 with it free."""
    information = np.diag([5.0, 4.0, 9.0, 2.0, 7.0, 7.0])
    assert stiffness(held(information)) == pytest.approx(4.0)
    information[0, 3] = information[3, 0] = 2.0
    assert stiffness(held(information)) == pytest.approx(3.0)
    information[4, 4] = np.inf  # one number that is none makes the whole useless
    assert stiffness(held(information)) == 0.0
    assert stiffness(held(np.diag([5.0, 4.0, 0.0, 2.0, 7.0, 7.0]))) == 0.0
    assert stiffness(held(np.diag([5.0, 4.0, 9.0, 2.0, 7.0, 0.0]))) == 0.0  # not solvable


def test_covariance_of_a_fit_that_knows_nothing_is_what_the_search_allows() -> None:
    for nothing in (held(np.zeros((6, 6)), rmse=np.inf), held(np.zeros((6, 6)), rmse=0.0)):
        expected = np.diag([(3.3 * 0.3) ** 2 + 1e-4] * 3 + [np.radians(5.0) ** 2 + 1e-6] * 3)
        np.testing.assert_allclose(covariance_of(nothing, np.eye(4), np.eye(4), 0.3), expected)


def test_too_little_rmse_is_not_believed() -> None:
    """Planes of no noise at all are taken as of 2 cm."""
    information = np.diag([1200.0] * 3 + [4800.0] * 3)
    more, least, none = (
        covariance_of(held(information, rmse=rmse), np.eye(4), np.eye(4), 0.3)
        for rmse in (0.021, 0.02, 0.0)
    )
    np.testing.assert_array_equal(least, none)
    assert more[0, 0] > least[0, 0]


@pytest.mark.parametrize("yaw", [0.5, np.pi / 2, -2.0])
def test_covariance_of_position_and_angles_turns_with_the_target(yaw: float) -> None:
    """A target that looks along ``yaw`` has R^T C R, not R C R^T, and of angles too."""
    half = np.random.default_rng(3).normal(size=(6, 6)) * 30
    found = held(half @ half.T, half[:2] / 10, centre=(1.0, -2.0, 0.5))
    query = yaw_transform(0.3, (2.0, 1.0, 0.0))
    at = (5.0, 3.0, 1.0)
    C = covariance_of(found, query, yaw_transform(0.0, at), 0.3)
    turned = covariance_of(found, query, yaw_transform(yaw, at), 0.3)
    R = np.kron(np.eye(2), yaw_transform(yaw)[:3, :3])
    np.testing.assert_allclose(turned, R.T @ C @ R, rtol=1e-9, atol=1e-15)
    assert np.abs(turned - R @ C @ R.T).max() > 1e-3 * np.abs(C).max()


@pytest.mark.parametrize(
    "arm", [(10.0, 0.0, 0.0), (0.0, 10.0, 0.0), (0.0, 0.0, 10.0), (3.0, -4.0, 5.0)]
)
def test_an_error_of_angle_moves_the_base_across_its_arm(arm: tuple[float, float, float]) -> None:
    """The base is ``arm`` away from the aligned points: it has the points' covariance,
    moved by a Jacobian of finite differences.
    """
    half = np.random.default_rng(4).normal(size=(6, 6)) * 30
    found = held(half @ half.T)
    here = yaw_transform(0.0, arm)
    J = np.eye(6)
    for k in range(3):
        J[:3, 3 + k] = (
            apply(exp_se3(np.zeros(3), 1e-6 * np.eye(3)[k]), np.array([arm]))[0] - arm
        ) / 1e-6
    floor = np.diag([1e-4] * 3 + [1e-6] * 3)
    C = covariance_of(found, np.eye(4), np.eye(4), 0.3) - floor
    np.testing.assert_allclose(
        covariance_of(found, here, here, 0.3), J @ C @ J.T + floor, rtol=1e-4, atol=1e-9
    )


def test_covariance_lies_in_the_axes_of_the_target() -> None:
    """A corridor along the map's x is one along -y for a target that looks along the map's y."""
    rng = np.random.default_rng(5)
    found = align(
        room(rng, 700, corridor=True),
        surface_of(room(rng, 1500, corridor=True), CELL),
        np.eye(4),
        STEPS,
    )
    C = covariance_of(found, np.eye(4), yaw_transform(np.pi / 2, (3.0, 2.0, 0.0)), 0.3)
    assert abs(np.linalg.eigh(C[:3, :3])[1][1, -1]) > 0.99


def test_covariance_grows_with_the_lever_arm() -> None:
    """Across the arm, the position of a base far from the aligned points is less certain: by the
    angle times the distance.
    """
    rng = np.random.default_rng(6)
    found = align(room(rng, 700), surface_of(room(rng, 1500), CELL), np.eye(4), STEPS)
    near = covariance_of(found, np.eye(4), np.eye(4), 0.3)
    far = covariance_of(found, yaw_transform(0.0, (100.0, 0.0, 0.0)), np.eye(4), 0.3)
    np.testing.assert_allclose(far[3:, 3:], near[3:, 3:])
    centre = found.centre[0]
    expected = near[1, 1] + ((100 - centre) ** 2 - centre**2) * (near[5, 5] - 1e-6)
    assert far[1, 1] == pytest.approx(expected, rel=0.05)
    # the distance alone adds nothing along the arm
    assert far[0, 0] < 2 * near[0, 0] + 1e-6


def test_errors_of_many_fits_stay_within_the_covariance() -> None:
    """Whitened errors of repeated fits to new samples: not overconfident, and not without any
    meaning.
    """
    squared = []
    for seed in range(12):
        found = fit(
            np.eye(4), exp_se3(np.array([0.05, 0.02, -0.03]), np.array([0.01, 0.0, 0.02])), seed
        )
        C = covariance_of(found, found.target_T_query, np.eye(4), 0.3)
        e = found.target_T_query[:3, 3]
        squared.append(float(e @ np.linalg.solve(C[:3, :3], e)))
    assert np.mean(squared) < 3  # three degrees of freedom


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
    found = fine_fit(start, surface, query).target_T_query
    assert np.linalg.norm(found[1:3, 3]) < 0.06
    assert error(found, np.eye(4))[0] < 0.22
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
    found = align(query, surface_of(grid, CELL), np.eye(4), wide, spread, Weighting(0.1))
    assert found.target_T_query[0, 3] == pytest.approx(-0.1 * 0.2 / 1.2, rel=0.02)
    assert found.rmse == pytest.approx(
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
    found = align(query, surface_of(grid, CELL), np.eye(4), (Step(100.0, 15),), weighting=hold)
    assert found.target_T_query[0, 3] == pytest.approx(-0.05, rel=0.01)


def test_ranges_that_are_all_too_long_widen_the_covariance_along_them() -> None:
    """A wall ahead seen with ranges known to 0.1 m: its points average out, what they share does
    not. Whose ranges they are is all one.
    """
    grid = np.stack(np.meshgrid(5.0, np.arange(-4, 4, 0.1), np.arange(0, 4, 0.1)), -1).reshape(
        -1, 3
    )
    query = grid[::3]
    along = np.array([0.1, 0.0, 0.0])
    certain = align(query, surface_of(grid, CELL), np.eye(4), STEPS)
    assert not certain.range_bias.any()
    least = covariance_of(certain, np.eye(4), np.eye(4), 0.3)[0, 0]
    mapped = flattened_surface(
        grid, np.tile(along, (len(grid), 1)), np.arange(len(grid)), CELL, 0.05
    )
    for found in (
        align(query, surface_of(grid, CELL), np.eye(4), STEPS, np.tile(along, (len(query), 1))),
        align(query, mapped, np.eye(4), STEPS),
    ):
        more = covariance_of(found, np.eye(4), np.eye(4), 0.3)[0, 0] - least
        assert np.sqrt(more) == pytest.approx(RANGE_BIAS * 0.1, rel=0.1)


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
    found = align(query, surface, turned, (Step(2.0, 0),), rays, Weighting(0.1))
    weight = 100 * 0.1 * 2 / 3
    assert found.information[1, 1] == pytest.approx(weight)
    expected = [0.0, weight * 0.3, 0.0, 0.0, 0.0, 0.0]
    np.testing.assert_allclose(found.range_bias, [expected, [0.0] * 6], atol=1e-9)


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
    found = align(query, surface, np.eye(4), (Step(2.0, 1),), rays, Weighting(0.3))
    np.testing.assert_allclose(found.target_T_query[:3, 3], [-0.06, 0.0, 0.0], atol=1e-5)


def test_distances_to_planes_are_those_of_where_a_fit_ends() -> None:
    """Three walls that meet, without noise, half a centimetre off: near enough for a step of 0.4 m
    that others follow, but the last one looks again.
    """
    side = np.stack(np.meshgrid(np.linspace(0, 4, 40), np.linspace(0, 4, 40)), -1).reshape(-1, 2)
    walls = np.concatenate([np.insert(side, axis, 0.0, axis=1) for axis in range(3)])
    query = walls[walls.max(1) < 3][::7] + np.array([0.0, 0.0, 0.005])
    found = align(query, surface_of(walls, CELL), np.eye(4), (Step(0.4, 10),))
    assert found.rmse < 1e-4
    np.testing.assert_allclose(found.target_T_query[:3, 3], [0.0, 0.0, -0.005], atol=1e-4)


def test_what_ranges_of_both_sides_have_in_common_counts_where_they_look_from_opposite_sides() -> (
    None
):
    """The same wall, seen by both with ranges known to 0.1 m: half of the variance is their own,
    half is common and cancels or adds.
    """
    grid = np.stack(np.meshgrid(5.0, np.arange(-4, 4, 0.1), np.arange(0, 4, 0.1)), -1).reshape(
        -1, 3
    )
    query = grid[::3]
    along = np.array([0.1, 0.0, 0.0])
    mapped = flattened_surface(
        grid, np.tile(along, (len(grid), 1)), np.arange(len(grid)), CELL, 0.05
    )
    same, opposite = (
        np.sqrt(
            covariance_of(
                align(query, mapped, np.eye(4), STEPS, np.tile(ray, (len(query), 1))),
                np.eye(4),
                np.eye(4),
                0.3,
            )[0, 0]
        )
        for ray in (along, -along)
    )
    assert same == pytest.approx(RANGE_BIAS * 0.1 * np.sqrt(2 * (1 - COMMON_BIAS)), rel=0.1)
    assert opposite == pytest.approx(
        RANGE_BIAS * 0.1 * np.sqrt(2 * (1 - COMMON_BIAS) + 4 * COMMON_BIAS), rel=0.1
    )


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
    found = align(walls[::3], surface, np.eye(4), (Step(100.0, 15),), weighting=Weighting(0.1))
    assert found.target_T_query[0, 3] == pytest.approx(0.1 * 0.2 / 1.2, rel=0.05)


def test_ranges_pull_no_farther_than_points_hold() -> None:
    """A corridor whose normals are noisy: what they pretend to know along it is taken off, and what
    would pull at that with it.
    """
    rng = np.random.default_rng(5)
    points = room(rng, 700, corridor=True)
    far = 0.1 * points / np.linalg.norm(points, axis=1)[:, None]
    found = align(points, surface_of(room(rng, 1500, corridor=True), CELL), np.eye(4), STEPS, far)
    assert (
        covariance_of(found, np.eye(4), np.eye(4), 0.3)[0, 0] < 2 * (SAME_PLACE_VOXELS * 0.3) ** 2
    )


def test_a_fit_that_meets_too_little_knows_nothing() -> None:
    """The first radius reaches the walls, the last one does not: nothing is left of what the first
    one knew.
    """
    rng = np.random.default_rng(6)
    points = room(rng, 700, noise=0.0)
    off = points + np.array([0.17, 0.17, 0.17]) * rng.choice([-1, 1], (len(points), 1))
    found = align(
        off, surface_of(room(rng, 1500, noise=0.0), CELL), np.eye(4), (Step(0.4, 1), Step(0.001, 1))
    )
    assert (found.inliers, found.rmse) == (0.0, float("inf"))
    assert not found.information.any()
    assert not found.range_bias.any()


def test_a_stretch_of_road_counts_by_its_middle_and_a_share_of_its_width() -> None:
    """Keyframes from 4 m behind the pose to 8 m before it: 2 m in the mean."""
    offsets = np.array([-4.0, 0.0, 4.0, 8.0])
    stretch = Stretch.between(offsets, UNMEASURED)
    assert stretch.road == pytest.approx(np.sqrt(2.0**2 + 0.25 * 20.0))
    assert Stretch.between(np.zeros(1), UNMEASURED).road == 0.0


DRIFT = Drift((0.01, 0.02, 0.03), (1e-3, 2e-3, 3e-3))


def added(query: Stretch, target: Stretch, target_T_query: F64) -> F64:
    """What the drift along both stretches adds to a covariance (6, 6)."""
    found = fit(np.eye(4), SMALL)
    alone, bridged = (
        covariance_of(found, target_T_query, np.eye(4), 0.3, *stretches)
        for stretches in ((Stretch(), Stretch()), (query, target))
    )
    return bridged - alone


@pytest.mark.parametrize("of_query", [True, False])
def test_drift_along_the_road_of_a_map_is_added(of_query: bool) -> None:
    """10 m of road, both bases at one place: 1, 2 and 3 % of it, and 1, 2 and 3 mrad a metre."""
    long = Stretch(10.0, DRIFT)
    query, target = (long, Stretch()) if of_query else (Stretch(), long)
    expected = np.array([0.1, 0.2, 0.3, 0.01, 0.02, 0.03]) ** 2
    np.testing.assert_allclose(added(query, target, np.eye(4)), np.diag(expected), atol=1e-12)


def test_the_drift_of_a_query_is_along_its_own_axes() -> None:
    """A quarter turn: the query's x is the target's y."""
    turned = added(Stretch(10.0, DRIFT), Stretch(), yaw_transform(np.pi / 2, (0.0, 0.0, 0.0)))
    expected = np.array([0.2, 0.1, 0.3, 0.02, 0.01, 0.03]) ** 2
    np.testing.assert_allclose(turned, np.diag(expected), atol=1e-12)


def test_a_turned_map_of_a_target_moves_a_query_aside() -> None:
    """A query 30 m to the left: the target's map is turned by 30 mrad, which is 0.9 m along x."""
    aside = added(Stretch(), Stretch(10.0, DRIFT), yaw_transform(0.0, (0.0, 30.0, 0.0)))
    assert aside[0, 0] == pytest.approx(0.1**2 + (30 * 0.03) ** 2)
    assert aside[1, 1] == pytest.approx(0.2**2)
    assert aside[2, 2] == pytest.approx(0.3**2 + (30 * 0.01) ** 2)
    assert aside[0, 5] == pytest.approx(-30 * 0.03**2)  # turned to the left, it moves back


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
        found = align(points, surface, np.eye(4), (Step(0.12, 10),))
        bias = ground_bias(points, surface, found.target_T_query, found.centre, 0.45, 0.12)
        covariances.append(
            covariance_of(replace(found, ground_bias=bias), np.eye(4), np.eye(4), 0.3)
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
