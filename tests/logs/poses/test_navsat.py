"""Poses from fixes and an IMU: a vehicle on a circle whose truth in east, north, up is known."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64
from semloc_logs.frames import Frame, Header, ImuSample, NavSatSample
from semloc_logs.logs.inspection.inspect import inspect_log
from semloc_logs.logs.poses.navsat import LocalFrame, NavSatPoses, earth_centred
from semloc_logs.logs.problems import sentences
from semloc_logs.numerics.transforms import inverse, yaw_transform

S = 1_000_000_000
EPOCH = 1_700_000_000 * S
A, B = 6378137.0, 6356752.314245  # m, WGS 84
LATITUDE, LONGITUDE, HEIGHT = 48.0, 11.0, 500.0
RADIUS, SPEED = 40.0, 5.0
ANTENNA = yaw_transform(0.0, (-0.5, 0.3, 1.2))  # base_T_gps
MOUNTED = np.eye(4)  # base_T_imu: its y axis points up, as on a Husky
MOUNTED[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]


# -- coordinates


def test_earth_centred_at_known_places() -> None:
    np.testing.assert_allclose(earth_centred(0, 0, 0), [A, 0, 0], atol=1e-6)
    np.testing.assert_allclose(earth_centred(0, 90, 10), [0, A + 10, 0], atol=1e-6)
    np.testing.assert_allclose(earth_centred(90, 0, 0), [0, 0, B], atol=1e-5)
    np.testing.assert_allclose(earth_centred(-90, 45, 100), [0, 0, -B - 100], atol=1e-5)


def test_axes_point_east_north_and_up() -> None:
    local = LocalFrame(LATITUDE, LONGITUDE, HEIGHT)
    np.testing.assert_allclose(local.position(LATITUDE, LONGITUDE, HEIGHT), 0.0, atol=1e-9)
    np.testing.assert_allclose(
        local.position(LATITUDE, LONGITUDE, HEIGHT + 7), [0, 0, 7], atol=1e-8
    )
    east = local.position(LATITUDE, LONGITUDE + 1e-5, HEIGHT)
    north = local.position(LATITUDE + 1e-5, LONGITUDE, HEIGHT)
    assert east[0] > 0.7
    assert abs(east[1]) < 1e-5
    assert north[1] > 1.1
    assert abs(north[0]) < 1e-9


def degrees_of(east: float, north: float) -> tuple[float, float]:
    """Latitude and longitude of a place near the datum, by the radii of curvature there.

    Good to a millimetre within 100 m.
    """
    eccentricity = 1.0 - (B / A) ** 2
    w = 1.0 - eccentricity * np.sin(np.radians(LATITUDE)) ** 2
    meridian = A * (1.0 - eccentricity) / w**1.5
    normal = A / np.sqrt(w)
    return (
        LATITUDE + np.degrees(north / (meridian + HEIGHT)),
        LONGITUDE + np.degrees(east / ((normal + HEIGHT) * np.cos(np.radians(LATITUDE)))),
    )


@given(st.floats(-100, 100), st.floats(-100, 100), st.floats(-20, 20))
def test_agrees_with_the_radii_of_curvature(east: float, north: float, up: float) -> None:
    latitude, longitude = degrees_of(east, north)
    position = LocalFrame(LATITUDE, LONGITUDE, HEIGHT).position(latitude, longitude, HEIGHT + up)
    np.testing.assert_allclose(position, [east, north, up], atol=5e-3)


# -- a drive on a circle, heading along its tangent


def truth(seconds: float) -> F64:
    """``enu_T_base``; starts at the datum, to the east, and turns left."""
    angle = SPEED * seconds / RADIUS
    return yaw_transform(angle, (RADIUS * np.sin(angle), RADIUS * (1 - np.cos(angle)), 0.0))


def header(topic: str, seconds: float, frame_id: str) -> Header:
    stamp = EPOCH + round(seconds * S)
    return Header(topic, stamp, stamp, frame_id)


def fix(seconds: float, place: F64, sigma: float | None = 0.02) -> Frame:
    latitude, longitude = degrees_of(place[0], place[1])
    covariance = None if sigma is None else np.diag([sigma**2] * 3)
    return NavSatSample(
        header("/fix", seconds, "gps"), latitude, longitude, HEIGHT + place[2], covariance
    )


def antenna_at(seconds: float) -> F64:
    """In the frame of the first fix, which has the antenna at its origin."""
    return np.asarray((truth(seconds) @ ANTENNA)[:3, 3] - (truth(0) @ ANTENNA)[:3, 3])


def imu(seconds: float, *, with_orientation: bool, offset: float = 0.0) -> Frame:
    enu_R_base = truth(seconds)[:3, :3]
    centripetal = enu_R_base[:, 1] * SPEED**2 / RADIUS
    enu_R_imu = yaw_transform(offset)[:3, :3] @ enu_R_base @ MOUNTED[:3, :3]
    force = (enu_R_base @ MOUNTED[:3, :3]).T @ (centripetal + np.array([0, 0, 9.80665]))
    orientation = Rotation.from_matrix(enu_R_imu).as_quat() if with_orientation else None
    return ImuSample(header("/imu", seconds, "imu"), force, np.zeros(3), orientation)


def drive(
    source: NavSatPoses, frames: list[Frame], *, knows: tuple[str, ...] = ("gps", "imu")
) -> dict[float, F64]:
    """Poses by time, taken as they come."""
    mounts = {"gps": ANTENNA, "imu": MOUNTED}

    def base_T(frame: str, _: int) -> F64 | None:
        return mounts[frame] if frame in knows else None

    stamped = []
    for frame in sorted(frames, key=lambda f: f.header.stamp_ns):
        source.take(frame)
        stamped += list(source.poses(base_T))
    source.finish()
    stamped += list(source.poses(base_T))
    return {round((stamp - EPOCH) / S, 3): pose for stamp, pose in stamped}


def fixes(until: float = 20.0, step: float = 0.2) -> list[Frame]:
    return [fix(t, antenna_at(t)) for t in np.arange(0, until, step)]


def samples(*, with_orientation: bool, until: float = 20.0, offset: float = 0.0) -> list[Frame]:
    return [
        imu(t, with_orientation=with_orientation, offset=offset)
        for t in np.arange(-0.005, until, 0.01)
    ]


def check(poses: dict[float, F64], *, position: float, angle: float) -> None:
    start = (truth(0) @ ANTENNA)[:3, 3]
    for seconds, pose in poses.items():
        wanted = truth(seconds)
        wanted[:3, 3] -= start
        off = inverse(wanted) @ pose
        assert np.linalg.norm(off[:3, 3]) < position, seconds
        assert np.degrees(np.linalg.norm(Rotation.from_matrix(off[:3, :3]).as_rotvec())) < angle, (
            seconds
        )


def test_with_the_orientation_of_a_mounted_imu() -> None:
    source = NavSatPoses("/fix", 100)
    poses = drive(source, [*fixes(), *samples(with_orientation=True)])
    assert len(poses) == 100
    check(poses, position=0.01, angle=0.1)
    assert source.problems == []
    content = source.to_json()
    assert (content["heading"], content["fixes"]) == ("imu", 100)


def test_with_the_course_and_an_accelerometer() -> None:
    source = NavSatPoses("/fix", 100)
    poses = drive(source, [*fixes(), *samples(with_orientation=False)])
    assert len(poses) == 100
    # the parabola at both ends of the drive has fixes on one side only
    check({t: p for t, p in poses.items() if 1.5 < t < 18}, position=0.03, angle=1.0)
    check(poses, position=0.2, angle=6.0)
    assert source.to_json()["heading"] == "course"


def test_with_fixes_alone() -> None:
    poses = drive(NavSatPoses("/fix", 20), fixes(step=1.0), knows=("gps",))
    assert len(poses) == 20
    check({t: p for t, p in poses.items() if 1.5 < t < 18}, position=0.05, angle=2.0)


def test_an_imu_of_unknown_mounting_is_not_believed() -> None:
    source = NavSatPoses("/fix", 100)
    check(
        {
            t: p
            for t, p in drive(source, [*fixes(), *samples(with_orientation=True)], knows=()).items()
            if 1.5 < t < 18
        },
        position=2,
        angle=1,
    )
    assert any("from 'imu', the IMU's frame" in note for note in sentences(source.problems))
    assert any("from 'gps', the antenna of /fix" in note for note in sentences(source.problems))


def test_a_heading_that_is_not_relative_to_east() -> None:
    source = NavSatPoses("/fix", 100)
    drive(source, [*fixes(), *samples(with_orientation=True, offset=np.radians(90))])
    (problem,) = sentences(source.problems)
    assert re.search(
        r"off the course over ground by (89|9[0-2]) degrees.*--topic imu=none", problem
    )


def test_uncertain_and_missing_fixes_are_left_out() -> None:
    frames = fixes()
    frames[10] = fix(2.0, antenna_at(2.0) + np.array([30.0, 0, 0]), sigma=8.0)
    frames[11] = fix(2.2, antenna_at(2.2), sigma=None)
    missing = [
        NavSatSample(header("/fix", 3.01 + k, "gps"), np.nan, np.nan, np.nan, has_fix=False)
        for k in range(3)
    ]
    source = NavSatPoses("/fix", 103)
    poses = drive(source, [*frames, *missing, *samples(with_orientation=True)])
    assert len(poses) == 99
    assert 2.0 not in poses
    check(poses, position=0.01, angle=0.1)
    assert sentences(source.problems) == [
        "/fix: 3 of 103 messages report a missing fix; they were left out.",
        "/fix: 1 of 103 messages are less certain than 5 m or out of order; they were left out.",
    ]


def test_a_gap_stays_a_gap() -> None:
    frames = [f for f in fixes() if not 5 * S < f.header.stamp_ns - EPOCH < 12 * S]
    poses = drive(NavSatPoses("/fix", len(frames)), [*frames, *samples(with_orientation=False)])
    assert not [t for t in poses if 5 < t < 11.9]
    check({t: p for t, p in poses.items() if 1.5 < t < 18}, position=0.2, angle=6.0)


def test_a_vehicle_that_never_moves_has_no_heading() -> None:
    source = NavSatPoses("/fix", 50)
    assert drive(source, [fix(0.2 * k, np.zeros(3)) for k in range(50)]) == {}
    (problem,) = sentences(source.problems)
    assert "never moves faster than 1 m/s" in problem
    assert "50 fixes give no pose" in problem


def test_the_heading_before_the_start_is_the_first_course() -> None:
    standing = [fix(0.2 * k - 10, np.zeros(3)) for k in range(50)]
    poses = drive(NavSatPoses("/fix", 150), [*standing, *fixes()], knows=())
    assert len(poses) == 150
    assert abs(np.degrees(np.arctan2(poses[-9.0][1, 0], poses[-9.0][0, 0]))) < 15


def test_driving_backwards_is_not_turning() -> None:
    there = [fix(0.2 * k, np.array([0.4 * k, 0, 0])) for k in range(50)]
    back = [fix(10 + 0.2 * k, np.array([19.6 - 0.4 * k, 0, 0])) for k in range(50)]
    poses = drive(NavSatPoses("/fix", 100), [*there, *back], knows=())
    assert all(abs(np.arctan2(p[1, 0], p[0, 0])) < 0.1 for p in poses.values())


def test_the_fixes_of_a_husky_agree_with_its_odometry(shared: Callable[[str], Path]) -> None:
    """The length by fixes of a metre's noise is longer than by wheels, but of the same size."""
    log = shared("odd_logs/husky_imu_gnss_odometry.bag")
    wheels = inspect_log(log)
    named = inspect_log(log, {"pose": "/fix"})
    poses = wheels["poses"]
    fixed = named["poses"]
    assert isinstance(poses, dict)
    assert isinstance(fixed, dict)
    assert poses["count"] == 3952
    assert fixed["count"] == 989
    assert 1.0 < fixed["length_m"] / poses["length_m"] < 1.4
    assert named["session_frame"] == "enu"
    fallback = inspect_log(log, {"pose": "none"})["poses"]
    assert fallback == fixed


# -- altitudes that are not measured


def without_altitude(frame: Frame) -> Frame:
    assert isinstance(frame, NavSatSample)
    return replace(frame, altitude=np.nan)


def climb(until: float) -> list[Frame]:
    """East at 5 m/s, up at 0.5 m/s."""
    return [fix(t, np.array([5.0 * t, 0.0, 0.5 * t])) for t in np.arange(0, until, 0.2)]


def test_heights_between_known_ones_are_interpolated() -> None:
    frames = climb(20.0)
    known = drive(NavSatPoses("/fix", 100), climb(20.0), knows=("gps",))
    # the first fixes too, and the last one
    for k in (0, 1, 7, 8, 9, 50, 99):
        frames[k] = without_altitude(frames[k])
    source = NavSatPoses("/fix", 100)
    poses = drive(source, frames, knows=("gps",))
    assert len(poses) == 100
    assert sentences(source.problems) == []
    # heights count from the first one known, which is 0.2 m above the start: 0.5 m/s after 0.4 s
    heights = {t: pose[2, 3] - known[t][2, 3] + 0.2 for t, pose in poses.items()}
    assert abs(heights[1.6]) < 1e-3
    assert abs(heights[10.0]) < 1e-3
    # before the first and after the last the nearest height serves
    assert heights[0.0] == pytest.approx(0.2, abs=1e-3)
    assert heights[19.8] == pytest.approx(-0.1, abs=1e-3)


def test_positions_without_any_altitude_are_used_and_it_is_told() -> None:
    source = NavSatPoses("/fix", 100)
    poses = drive(source, [without_altitude(f) for f in climb(20.0)], knows=("gps",))
    assert len(poses) == 100
    assert poses[19.0][0, 3] - poses[0.0][0, 3] == pytest.approx(95.0, abs=0.1)
    [problem] = source.problems
    assert problem.assumed
    assert "/fix has an altitude: its heights are taken as constant" in problem.text


def test_a_first_height_that_comes_late_is_the_datum() -> None:
    """Poses are not held back for it, and do not jump by the height above the ellipsoid."""
    frames = climb(20.0)
    for k in range(50):
        frames[k] = without_altitude(frames[k])
    source = NavSatPoses("/fix", 100)
    for frame in frames[:40]:
        source.take(frame)
    assert list(source.poses(lambda _, __: np.eye(4)))
    poses = drive(source, frames[40:], knows=("gps",))
    assert poses[10.2][2, 3] - poses[9.8][2, 3] == pytest.approx(0.1, abs=0.01)
    assert sentences(source.problems) == []


def test_an_unknown_variance_of_the_height_leaves_the_other_two() -> None:
    frames = fixes()
    for k in range(100):
        wide = np.diag([64.0 if k == 10 else 0.01, 0.01, np.nan])
        frame = frames[k]
        assert isinstance(frame, NavSatSample)
        frames[k] = replace(frame, covariance=wide)
    source = NavSatPoses("/fix", 100)
    assert len(drive(source, frames, knows=("gps",))) == 99
    assert "1 of 100 messages are less certain than 5 m" in sentences(source.problems)[0]
