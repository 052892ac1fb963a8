"""A mounting that is turned about the way, by hand: a road and the fronts beside it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64
from semloc_logs.mapping.mounting_tilt import straight_way, turn_about_way

X, Y, Z = np.eye(3)
# normals of a road and of fronts on both sides, as gravity has them
ROAD, FRONTS = [Z] * 60, [Y] * 10 + [-Y] * 10


def about(axis: F64, degrees: float) -> F64:
    return np.asarray(Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix())


def turned(degrees: float, imu: F64 = Z, convention: F64 = Z, *, fronts: float = math.nan) -> float:
    """The angle (degrees) for a road that is turned about x, with fronts that are turned by
    ``fronts``, else alike.
    """
    wall = degrees if math.isnan(fronts) else fronts
    normals = np.array([*ROAD @ about(X, degrees).T, *FRONTS @ about(X, wall).T])
    up = about(X, degrees) @ Z
    angle = turn_about_way(up, imu, convention, X, normals, np.ones(len(normals)))
    return math.degrees(angle)


@pytest.mark.parametrize("degrees", [5.0, -8.0, 30.0])
def test_a_road_and_fronts_that_are_turned_against_gravity_show_the_angle(degrees: float) -> None:
    assert turned(degrees) == pytest.approx(degrees)


def test_a_road_may_be_inclined_beside_fronts_that_are_plumb() -> None:
    assert turned(6.0, fronts=0.0) == 0.0


def test_a_lane_that_is_banked_is_no_turn() -> None:
    assert turned(3.5) == 0.0
    assert turned(4.5) == pytest.approx(4.5)


def test_an_imu_that_the_frame_of_the_poses_contradicts_tells_nothing() -> None:
    """Which of both is wrong is open then."""
    assert turned(0.0, imu=about(X, 5) @ Z) == 0.0
    assert turned(5.0, imu=about(X, 3) @ Z) == 0.0
    assert turned(5.0, imu=about(X, -1) @ Z) == pytest.approx(6.0)


def test_a_road_that_climbs_is_not_turned_about_the_way() -> None:
    normals = np.array([*ROAD @ about(Y, 10).T, *FRONTS])
    assert turn_about_way(about(Y, 10) @ Z, Z, Z, X, normals, np.ones(len(normals))) == 0.0


def test_without_fronts_nothing_is_told() -> None:
    normals = np.array(ROAD) @ about(X, 8).T
    assert turn_about_way(about(X, 8) @ Z, Z, Z, X, normals, np.ones(len(normals))) == 0.0


def test_the_way_of_a_straight_drive() -> None:
    steps = np.arange(11.0)[:, None]
    along = straight_way(3.0 * steps * Y, 0.3)  # 30 m of at least 9
    assert along is not None
    assert along.tolist() == [0.0, 1.0, 0.0]
    assert straight_way(0.8 * steps * Y, 0.3) is None  # 8 m
    corner = np.concatenate([3.0 * steps * X, 30.0 * X + 3.0 * steps[1:] * Y])
    assert straight_way(corner, 0.3) is None  # 42 m of 60: less than 0.8
    assert straight_way(np.zeros((1, 3)), 0.3) is None
