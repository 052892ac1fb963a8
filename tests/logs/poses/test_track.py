"""Pose streams: interpolation, gaps, refused samples."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from semloc_logs.arrays import F64
from semloc_logs.frames import Header, PoseSample
from semloc_logs.logs.poses.track import PoseTrack
from semloc_logs.numerics.transforms import yaw_transform

S = 1_000_000_000
EPOCH = 1_700_000_000 * S


def track(*seconds: float, max_gap: float = 1.0) -> PoseTrack:
    """A vehicle at 2 m/s along x."""
    made = PoseTrack(max_gap)
    for t in seconds:
        made.append(EPOCH + round(t * S), yaw_transform(0.1 * t, (2.0 * t, 0.0, 0.0)))
    return made


def pose_at(poses: PoseTrack, seconds: float) -> F64 | None:
    return poses.at(EPOCH + round(seconds * S))


def test_interpolates_between_two_poses() -> None:
    pose = pose_at(track(0.0, 0.5, 1.0), 0.75)
    assert pose is not None
    np.testing.assert_allclose(pose, yaw_transform(0.075, (1.5, 0.0, 0.0)), atol=1e-9)


def test_exact_stamps_give_the_recorded_pose_even_beside_a_gap() -> None:
    poses = track(0.0, 0.1, 9.0)
    for t in (0.1, 9.0):
        pose = pose_at(poses, t)
        assert pose is not None
        assert pose[0, 3] == pytest.approx(2.0 * t)


def test_gap_and_outside_are_unknown() -> None:
    poses = track(*np.arange(0, 1.01, 0.1), 5.0, 5.1)
    assert pose_at(poses, 3.0) is None
    assert pose_at(poses, -0.11) is None
    assert pose_at(poses, 5.21) is None


@pytest.mark.parametrize("seconds", [-0.09, 1.06])
def test_the_motion_goes_on_at_the_ends(seconds: float) -> None:
    """A vehicle on a circle of 20 m, 2 m/s: a tenth of a second beyond its poses."""
    circle = PoseTrack()
    for k in range(11):
        circle.append(EPOCH + k * S // 10, on_circle(0.1 * k))
    pose = pose_at(circle, seconds)
    assert pose is not None
    # between the poses its way is straight
    np.testing.assert_allclose(pose, on_circle(seconds), atol=1e-3)


def on_circle(seconds: float) -> F64:
    angle = 0.1 * seconds
    return yaw_transform(angle, (20.0 * np.sin(angle), 20.0 * (1.0 - np.cos(angle)), 0.0))


def test_a_pose_alone_behind_a_gap_is_not_continued() -> None:
    """Nothing tells how fast it moves there."""
    pose = pose_at(track(*np.arange(0, 1.01, 0.1), 5.0), 5.08)
    assert pose is not None
    assert pose[0, 3] == pytest.approx(10.0)


@pytest.mark.parametrize("period", [0.01, 0.1, 0.4])
@pytest.mark.parametrize(
    ("step", "is_steady"),
    [
        ((0.0, 0.0), True),
        ((0.05, 0.0), True),  # its speed grows by 0.5 m/s at most
        ((3.0, 0.0), False),
        ((0.0, 0.3), False),
    ],
)
def test_a_jump_at_an_end_is_not_continued(
    period: float, step: tuple[float, float], is_steady: bool
) -> None:
    """At 2 m/s, the first or the last pose farther on by so many metres, turned by so much."""
    metres, angle = step
    for is_first in (False, True):
        poses = PoseTrack()
        for k in range(51):
            is_off = k == (0 if is_first else 50)
            x = 2.0 * period * k + is_off * (-metres if is_first else metres)
            turned = yaw_transform(is_off * angle, (x, 0.0, 0.0))
            assert poses.append(EPOCH + round(k * period * S), turned)
        end = poses.poses[0 if is_first else -1]
        beyond = pose_at(poses, -0.08 if is_first else 50 * period + 0.08)
        assert beyond is not None
        moved = float(np.linalg.norm(beyond[:3, 3] - end[:3, 3]))
        assert moved == (pytest.approx(0.16, abs=0.06) if is_steady else 0.0)
        np.testing.assert_allclose(beyond[:3, :3], end[:3, :3], atol=1e-9)


def test_one_pose_serves_a_tenth_of_a_second() -> None:
    poses = track(1.0)
    assert pose_at(poses, 1.09) is not None
    assert pose_at(poses, 0.91) is not None
    assert pose_at(poses, 1.11) is None


def test_gap_is_judged_by_the_period_of_a_slow_stream() -> None:
    slow = track(*np.arange(0, 20, 0.5), 21.0)  # 2 Hz, then 1.5 s of nothing
    assert slow.gap_limit_ns() == 3 * S // 2
    assert pose_at(slow, 20.2) is not None
    fast = track(*np.arange(0, 20, 0.1), 21.4)
    assert fast.gap_limit_ns() == S
    assert pose_at(fast, 20.5) is None
    very_slow = track(*np.arange(0, 100, 10))
    assert pose_at(very_slow, 5.0) is None  # nobody interpolates over ten seconds


def test_duplicates_jumps_back_and_nonsense_are_counted() -> None:
    poses = track(0.0, 0.5)
    assert not poses.append(EPOCH + S // 2, np.eye(4))
    assert not poses.append(EPOCH, np.eye(4))
    assert not poses.append(EPOCH + S, np.full((4, 4), np.nan))
    assert not poses.append(EPOCH + S, np.diag([2.0, 1.0, 1.0, 1.0]))
    assert (poses.duplicates, poses.backwards, poses.invalid, len(poses)) == (1, 1, 2, 2)
    assert np.all(np.diff(poses.stamps_ns) > 0)


def test_hostile_numbers_are_refused() -> None:
    poses = track(0.0, 0.5)
    assert not poses.append(2**70, np.eye(4))
    assert not poses.append(EPOCH + S, yaw_transform(0.0, (1e300, 0.0, 0.0)))
    assert poses.invalid == 2
    assert poses.at(2**70) is None
    assert poses.at(-(2**70)) is None
    assert np.isfinite(poses.length())


def test_samples_are_taken_at_their_header_stamp() -> None:
    poses = PoseTrack()
    assert poses.add(
        PoseSample(Header("/odom", 5, 9, "odom"), "base_link", yaw_transform(0.0, (1.0, 2.0, 3.0)))
    )
    assert poses.start_ns == poses.end_ns == 5


def test_grows_and_forgets() -> None:
    poses = PoseTrack(keep_seconds=2.0)
    for k in range(5000):
        poses.append(EPOCH + k * S // 100, yaw_transform(0.0, (k * 0.01, 0.0, 0.0)))
    assert 200 <= len(poses) <= 800
    assert poses.end_ns == EPOCH + 4999 * S // 100
    pose = poses.at(EPOCH + 4998 * S // 100 + S // 200)
    assert pose is not None
    assert pose[0, 3] == pytest.approx(49.985)
    assert poses.at(EPOCH) is None
    assert poses.first_ns == EPOCH


def test_length_and_gaps() -> None:
    poses = track(*np.arange(0, 1.01, 0.1), 5.0, 5.5)
    assert poses.gaps() == [(EPOCH + S, EPOCH + 5 * S)]
    assert poses.length() == pytest.approx(2.0 + 1.0)
    content = poses.to_json()
    assert content["count"] == 13
    assert content["length_m"] == 3.0


def test_an_empty_track_knows_nothing() -> None:
    poses = PoseTrack()
    assert poses.at(0) is None
    assert poses.gaps() == []
    assert poses.length() == 0.0
    assert poses.poses.shape == (0, 4, 4)


@given(
    st.lists(st.integers(0, 4000), min_size=2, max_size=30, unique=True),
    st.lists(st.integers(-300, 4300), min_size=1, max_size=20),
)
def test_agrees_with_a_slow_version(milliseconds: list[int], wanted: list[int]) -> None:
    stamps = np.sort(np.array(milliseconds)) * 1_000_000 + EPOCH
    rng = np.random.default_rng(len(milliseconds))
    rotations = Rotation.random(len(stamps), random_state=rng)
    positions = rng.normal(size=(len(stamps), 3))
    poses = PoseTrack()
    for stamp, rotation, position in zip(
        stamps.tolist(), rotations.as_matrix(), positions, strict=True
    ):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, position
        assert poses.append(stamp, pose)
    limit = poses.gap_limit_ns()

    def between(t: int) -> F64 | None:
        """The pose at a stamp between the ends."""
        k = max(int(np.searchsorted(stamps, t)), 1)
        if not stamps[0] <= t <= stamps[-1]:
            return None
        if t not in stamps and stamps[k] - stamps[k - 1] > limit:
            return None
        w = (t - stamps[k - 1]) / (stamps[k] - stamps[k - 1])
        pose = np.eye(4)
        pose[:3, :3] = Slerp([0, 1], rotations[k - 1 : k + 1])(w).as_matrix()
        pose[:3, 3] = (1 - w) * positions[k - 1] + w * positions[k]
        return pose

    def speeds(target: F64, source: F64, seconds: float) -> F64:
        """Velocity (3,) and the rotation (9,) of a step."""
        step = np.linalg.inv(source) @ target
        return np.concatenate([step[:3, 3] / seconds, step[:3, :3].ravel()])

    def is_steady(end: int, sign: int) -> bool:
        """Whether the motion at an end is as it was a step before."""
        step_before = end - sign * max(100_000_000, abs(end - int(stamps[-2 if sign > 0 else 1])))
        first, second, third = between(end), between(step_before), between(2 * step_before - end)
        if len(stamps) <= 2 or first is None or second is None or third is None:
            return False
        seconds = abs(end - step_before) * 1e-9
        last, before = speeds(first, second, seconds), speeds(second, third, seconds)
        turn = Rotation.from_matrix(before[3:].reshape(3, 3))
        more = turn.inv() * Rotation.from_matrix(last[3:].reshape(3, 3))
        change = float(np.linalg.norm((last - before)[:3]))
        is_as_fast = change <= max(1.0, 0.25 * float(np.linalg.norm(before[:3])))
        rate = float(turn.magnitude()) / seconds
        return is_as_fast and float(more.magnitude()) / seconds <= max(0.2, 0.25 * rate)

    for ms in wanted:
        t = ms * 1_000_000 + EPOCH
        interpolated = poses.at(t)
        inside = int(np.clip(t, stamps[0], stamps[-1]))
        expected = between(inside) if abs(t - inside) <= 100_000_000 else None
        before = between(2 * inside - t)
        goes_on = t != inside and is_steady(inside, int(np.sign(t - inside)))
        if goes_on and expected is not None and before is not None:
            expected = expected @ np.linalg.inv(before) @ expected
        assert (interpolated is None) == (expected is None)
        if interpolated is not None and expected is not None:
            np.testing.assert_allclose(interpolated, expected, atol=1e-7)


def test_a_glitch_of_the_clock_is_taken_back() -> None:
    track = PoseTrack()
    for second in (1, 2, 3, 4000, 4001, 4, 5):
        track.append(second * 1_000_000_000, np.eye(4))
    assert (track.stamps_ns // 1_000_000_000).tolist() == [1, 2, 3, 4, 5]
    assert (track.ahead, track.backwards) == (2, 0)
    track.append(1_500_000_000, np.eye(4))  # a clock that is set back is none
    assert (len(track), track.backwards) == (5, 1)
