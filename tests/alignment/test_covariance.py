"""The covariance of a fit: by hand, of rooms and corridors, with drift and biased ranges."""

from __future__ import annotations

import numpy as np
import pytest

from semloc_logs.alignment.covariance import (
    COMMON_BIAS,
    RANGE_BIAS,
    Stretch,
    covariance_of,
    stiffness,
)
from semloc_logs.alignment.hypotheses import SAME_PLACE_VOXELS
from semloc_logs.alignment.icp import Fit, align
from semloc_logs.alignment.surface import flattened_surface, surface_of
from semloc_logs.arrays import F64
from semloc_logs.mapping.drift import UNMEASURED, Drift
from semloc_logs.numerics.transforms import apply, exp_se3, yaw_transform
from tests.alignment.fits import CELL, SMALL, STEPS, fit, room


def test_covariance_of_a_room_and_of_a_corridor() -> None:
    rng = np.random.default_rng(4)
    for corridor in (False, True):
        target = surface_of(room(rng, 1500, corridor=corridor), CELL)
        fitted = align(
            room(rng, 700, corridor=corridor)[:, :3],
            target,
            SMALL if not corridor else exp_se3(np.zeros(3), np.zeros(3)),
            STEPS,
        )
        C = covariance_of(fitted, np.eye(4), np.eye(4), 0.3)
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
    fitted = align(
        room(rng, 700, corridor=True),
        surface_of(room(rng, 1500, corridor=True), CELL),
        np.eye(4),
        STEPS,
    )
    assert covariance_of(fitted, np.eye(4), np.eye(4), 0.3)[0, 0] > 0.3**2


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
    fitted = held(half @ half.T, half[:2] / 10, centre=(1.0, -2.0, 0.5))
    query = yaw_transform(0.3, (2.0, 1.0, 0.0))
    position = (5.0, 3.0, 1.0)
    C = covariance_of(fitted, query, yaw_transform(0.0, position), 0.3)
    turned = covariance_of(fitted, query, yaw_transform(yaw, position), 0.3)
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
    fitted = held(half @ half.T)
    here = yaw_transform(0.0, arm)
    J = np.eye(6)
    for k in range(3):
        J[:3, 3 + k] = (
            apply(exp_se3(np.zeros(3), 1e-6 * np.eye(3)[k]), np.array([arm]))[0] - arm
        ) / 1e-6
    floor = np.diag([1e-4] * 3 + [1e-6] * 3)
    C = covariance_of(fitted, np.eye(4), np.eye(4), 0.3) - floor
    np.testing.assert_allclose(
        covariance_of(fitted, here, here, 0.3), J @ C @ J.T + floor, rtol=1e-4, atol=1e-9
    )


def test_covariance_lies_in_the_axes_of_the_target() -> None:
    """A corridor along the map's x is one along -y for a target that looks along the map's y."""
    rng = np.random.default_rng(5)
    fitted = align(
        room(rng, 700, corridor=True),
        surface_of(room(rng, 1500, corridor=True), CELL),
        np.eye(4),
        STEPS,
    )
    C = covariance_of(fitted, np.eye(4), yaw_transform(np.pi / 2, (3.0, 2.0, 0.0)), 0.3)
    assert abs(np.linalg.eigh(C[:3, :3])[1][1, -1]) > 0.99


def test_covariance_grows_with_the_lever_arm() -> None:
    """Across the arm, the position of a base far from the aligned points is less certain: by the
    angle times the distance.
    """
    rng = np.random.default_rng(6)
    fitted = align(room(rng, 700), surface_of(room(rng, 1500), CELL), np.eye(4), STEPS)
    at_origin = covariance_of(fitted, np.eye(4), np.eye(4), 0.3)
    far = covariance_of(fitted, yaw_transform(0.0, (100.0, 0.0, 0.0)), np.eye(4), 0.3)
    np.testing.assert_allclose(far[3:, 3:], at_origin[3:, 3:])
    centre = fitted.centre[0]
    expected = at_origin[1, 1] + ((100 - centre) ** 2 - centre**2) * (at_origin[5, 5] - 1e-6)
    assert far[1, 1] == pytest.approx(expected, rel=0.05)
    # the distance alone adds nothing along the arm
    assert far[0, 0] < 2 * at_origin[0, 0] + 1e-6


def test_errors_of_many_fits_stay_within_the_covariance() -> None:
    """Whitened errors of repeated fits to new samples: not overconfident, and not without any
    meaning.
    """
    squared = []
    for seed in range(12):
        fitted = fit(
            np.eye(4), exp_se3(np.array([0.05, 0.02, -0.03]), np.array([0.01, 0.0, 0.02])), seed
        )
        C = covariance_of(fitted, fitted.target_T_query, np.eye(4), 0.3)
        e = fitted.target_T_query[:3, 3]
        squared.append(float(e @ np.linalg.solve(C[:3, :3], e)))
    assert np.mean(squared) < 3  # three degrees of freedom


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
    for fitted in (
        align(query, surface_of(grid, CELL), np.eye(4), STEPS, np.tile(along, (len(query), 1))),
        align(query, mapped, np.eye(4), STEPS),
    ):
        more = covariance_of(fitted, np.eye(4), np.eye(4), 0.3)[0, 0] - least
        assert np.sqrt(more) == pytest.approx(RANGE_BIAS * 0.1, rel=0.1)


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


def test_ranges_pull_no_farther_than_points_hold() -> None:
    """A corridor whose normals are noisy: what they pretend to know along it is taken off, and what
    would pull at that with it.
    """
    rng = np.random.default_rng(5)
    points = room(rng, 700, corridor=True)
    far = 0.1 * points / np.linalg.norm(points, axis=1)[:, None]
    fitted = align(points, surface_of(room(rng, 1500, corridor=True), CELL), np.eye(4), STEPS, far)
    assert (
        covariance_of(fitted, np.eye(4), np.eye(4), 0.3)[0, 0] < 2 * (SAME_PLACE_VOXELS * 0.3) ** 2
    )


def test_a_stretch_of_road_counts_by_its_middle_and_a_share_of_its_width() -> None:
    """Keyframes from 4 m behind the pose to 8 m before it: 2 m in the mean."""
    offsets = np.array([-4.0, 0.0, 4.0, 8.0])
    stretch = Stretch.between(offsets, UNMEASURED)
    assert stretch.road == pytest.approx(np.sqrt(2.0**2 + 0.25 * 20.0))
    assert Stretch.between(np.zeros(1), UNMEASURED).road == 0.0


DRIFT = Drift((0.01, 0.02, 0.03), (1e-3, 2e-3, 3e-3))


def added(query: Stretch, target: Stretch, target_T_query: F64) -> F64:
    """What the drift along both stretches adds to a covariance (6, 6)."""
    fitted = fit(np.eye(4), SMALL)
    alone, bridged = (
        covariance_of(fitted, target_T_query, np.eye(4), 0.3, stretches)
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
