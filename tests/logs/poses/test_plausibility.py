"""Tracks that no vehicle can have made are recognised; drives that it can have made are not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semloc_logs.arrays import F64
from semloc_logs.logs.poses.plausibility import implausible
from semloc_logs.logs.poses.track import PoseTrack
from semloc_logs.numerics.transforms import inverse, yaw_transform

STEP_NS = 50_000_000


def _drive(count: int = 200, speed: float = 8.0, turn: float = 0.02) -> F64:
    """Poses (count, 4, 4) every 0.05 s along a bend, from the origin on."""
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ yaw_transform(turn, (speed * 0.05, 0.0, 0.0)))
    return np.array(poses)


def _track(poses: F64, step_ns: int = STEP_NS) -> PoseTrack:
    track = PoseTrack()
    for i, pose in enumerate(poses):
        track.append((i + 1) * step_ns, pose)
    return track


@given(
    speed=st.floats(0, 60),
    turn=st.floats(-0.2, 0.2),
    noise=st.floats(0, 0.1),
    seed=st.integers(0, 100),
)
def test_a_drive_at_any_speed_and_with_noise_is_possible(
    speed: float, turn: float, noise: float, seed: int
) -> None:
    poses = _drive(60, speed, turn)
    poses[:, :3, 3] += np.random.default_rng(seed).normal(0, noise, (60, 3))
    assert implausible(_track(poses)) is None


def test_hard_braking_is_possible() -> None:
    way = np.r_[np.arange(0, 20, 1.0), 20 + np.cumsum(np.linspace(1.0, 0.0, 40))]
    poses = np.array([yaw_transform(0.0, (x, 0.0, 0.0)) for x in way])
    assert implausible(_track(poses)) is None


def test_two_publishers_in_turn_are_recognised() -> None:
    poses = _drive()
    poses[1::2] = yaw_transform(0.35, (3.0, -2.0, 0.0)) @ poses[1::2]
    jump = implausible(_track(poses))
    assert jump is not None
    assert "two publishers" in jump.text
    assert len(jump.stamps_ns) > 150


@pytest.mark.parametrize("is_identity", [True, False])
def test_poses_that_are_not_known_at_times_are_no_second_publisher(is_identity: bool) -> None:
    """Every seventh pose, from the 14th on, is the identity, or another one that stays."""
    poses = _drive()
    poses[14::7] = np.eye(4) if is_identity else yaw_transform(0.5, (-40.0, 9.0, 0.0))
    jump = implausible(_track(poses))
    assert jump is not None
    # the first pose of the drive is the identity
    what = "28 of its 200 poses are exactly the identity, "
    assert (what if is_identity else "27 of its 200 poses are exactly one pose, ") in jump.text
    assert "their publisher sends it where it does not know the pose" in jump.text
    assert len(jump.stamps_ns) == (28 if is_identity else 27)


def test_noisy_poses_are_not_taken_for_two_publishers() -> None:
    poses = _drive()
    poses[:, :2, 3] += np.random.default_rng(3).normal(0, 0.6, (200, 2))
    jump = implausible(_track(poses))
    assert jump is not None
    assert "jump to and fro" in jump.text
    assert "too noisy to build a map with" in jump.text


@pytest.mark.parametrize("is_made_up", [False, True], ids=["goes on there", "has moved on"])
def test_poses_that_freeze_at_once_are_recognised(is_made_up: bool) -> None:
    poses = _drive(300)
    if not is_made_up:
        poses[160:] = poses[120] @ inverse(poses[160]) @ poses[160:]
    poses[120:160] = poses[120]  # 2 s
    jump = implausible(_track(poses))
    assert jump is not None
    if is_made_up:
        assert "jump once" in jump.text
        return
    assert "the poses are exactly the same from 1970-01-01T00:00:06.050Z" in jump.text
    assert "8.0 m/s: the odometry froze" in jump.text


def test_poses_that_freeze_until_the_end_are_recognised() -> None:
    poses = _drive()
    poses[120:] = poses[120]
    jump = implausible(_track(poses))
    assert jump is not None
    assert "the odometry froze" in jump.text


def test_a_vehicle_that_brakes_and_stands_is_possible() -> None:
    speeds = np.r_[np.full(60, 8.0), np.arange(8.0, 0.0, -0.4), np.zeros(80), np.full(1, 0.4)]
    way = np.cumsum(speeds * 0.05)
    poses = np.array([yaw_transform(0.0, (x, 0.0, 0.0)) for x in way])
    assert implausible(_track(poses)) is None


def test_poses_that_repeat_between_slow_updates_are_possible() -> None:
    assert implausible(_track(np.repeat(_drive(40), 8, axis=0))) is None


def test_odometry_that_lost_the_way_in_a_gap_is_recognised() -> None:
    poses = _drive(turn=0.0)
    poses[140:] = poses[99] @ inverse(poses[139]) @ poses[140:]
    track = PoseTrack()
    for i, pose in enumerate(poses):
        if not 100 <= i < 140:  # 2 s without poses
            track.append((i + 1) * STEP_NS, pose)
    jump = implausible(track)
    assert jump is not None
    assert "the poses have a gap of 2.05 s from 1970-01-01T00:00:05.000Z" in jump.text
    assert "the odometry lost the way between" in jump.text


def test_poses_that_are_repeated_until_the_next_one_are_named_so() -> None:
    jump = implausible(_track(np.repeat(_drive(40)[::8], 40, axis=0)))  # 3.2 m each 2 s
    assert jump is not None
    assert "the poses change only every 2.00 s, by 3.2 m" in jump.text


def test_a_clock_that_was_set_forward_is_not_only_lost_odometry() -> None:
    track = PoseTrack()
    for i, pose in enumerate(_drive(turn=0.0)):
        track.append((i + 1) * STEP_NS + (2_000_000_000 if i >= 100 else 0), pose)
    jump = implausible(track)
    assert jump is not None
    assert "a gap of 2.05 s" in jump.text
    assert "their clock was set forward, or the odometry lost the way" in jump.text


def test_a_clock_that_was_set_back_is_named_where_poses_come_in_their_order() -> None:
    track = PoseTrack()
    for i, pose in enumerate(_drive(turn=0.0)):
        track.append((i + 1) * STEP_NS - (1_010_000_000 if i >= 100 else 0), pose)
    jump = implausible(track)
    assert jump is not None
    assert "the clock of their stamps was set back" in jump.text
    assert "go back in time by 0.96 s" in jump.text


def test_a_clock_that_was_set_back_is_named_where_poses_are_sorted_by_it() -> None:
    poses = _drive(turn=0.0)
    stamped = [((i + 1) * STEP_NS - (1_010_000_000 if i >= 100 else 0), i) for i in range(200)]
    track = PoseTrack()
    for stamp_ns, i in sorted(stamped):
        track.append(stamp_ns, poses[i])
    jump = implausible(track)
    assert jump is not None
    assert "the clock was set back by about 1.0 s" in jump.text


def test_a_slow_publisher_among_the_poses_of_a_fast_one_is_recognised() -> None:
    poses = _drive()
    poses[2::5] = yaw_transform(0.0, (0.0, 4.0, 0.0)) @ poses[2::5]
    jump = implausible(_track(poses))
    assert jump is not None
    assert "two publishers" in jump.text


@pytest.mark.parametrize("silent", [0, 100])
def test_a_restart_at_the_identity_is_recognised_with_and_without_a_silence(silent: int) -> None:
    poses = _drive()
    poses[120:] = inverse(poses[120]) @ poses[120:]
    track = PoseTrack()
    for i, pose in enumerate(poses):
        track.append((i + 1 + (silent if i >= 120 else 0)) * STEP_NS, pose)
    jump = implausible(track)
    assert jump is not None
    assert "start again at the identity" in jump.text
    assert ("without any" in jump.text) == (silent > 0)
    assert jump.stamps_ns == ((121 + silent) * STEP_NS,)


def test_a_return_to_the_start_is_possible() -> None:
    poses = _drive(315, 8.0, 2 * np.pi / 314)  # once around a circle
    assert np.linalg.norm(poses[-1][:3, 3]) < 0.1
    assert implausible(_track(poses)) is None


@pytest.mark.parametrize(("metres", "is_found"), [(0.8, False), (1.6, True)])
def test_a_jump_counts_beyond_the_slack(metres: float, is_found: bool) -> None:
    poses = _drive()
    poses[100:] = yaw_transform(0.0, (0.0, metres, 0.0)) @ poses[100:]
    jump = implausible(_track(poses))
    assert (jump is not None) == is_found
    if jump is not None:
        assert "jump once" in jump.text
        assert jump.stamps_ns == (101 * STEP_NS,)


def test_a_sudden_turn_is_a_jump() -> None:
    poses = _drive()
    poses[100:] = poses[100:] @ yaw_transform(2.0)  # beside 0.02 rad of the bend
    jump = implausible(_track(poses))
    assert jump is not None
    assert "116 degrees" in jump.text


def test_a_vehicle_that_moved_in_a_gap_is_possible() -> None:
    poses = _drive()
    track = PoseTrack()
    for i, pose in enumerate(poses):
        if not 80 <= i < 160:  # 4 s without poses
            track.append((i + 1) * STEP_NS, pose)
    assert implausible(track) is None


def test_millimetres_are_not_metres() -> None:
    poses = _drive(200, 8.0)
    poses[:, :3, 3] *= 1000
    jump = implausible(_track(poses))
    assert jump is not None
    assert "not in metres" in jump.text


def test_a_few_poses_tell_nothing() -> None:
    assert implausible(_track(_drive(2))) is None
    assert implausible(PoseTrack()) is None
