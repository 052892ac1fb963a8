"""Sessions over logs in memory: clouds with poses, gaps, several logs."""

from __future__ import annotations

import json
from collections.abc import Iterable

import numpy as np
import pytest

from semloc_logs.errors import LogError, RoleError
from semloc_logs.frames import (
    Frame,
    ImuSample,
    PoseSample,
)
from semloc_logs.logs.problems import Problem, ProblemKind, lost, sentences
from semloc_logs.logs.session.session import Session, open_session
from semloc_logs.numerics.transforms import yaw_transform
from tests.logs.session.memory_log import (
    MOUNT,
    FakeLog,
    header,
    moving,
    odometry,
    static,
    sweep,
)


def test_clouds_in_the_base_frame_with_poses() -> None:
    frames: list[Frame] = [static("base_link", "lidar", MOUNT)]
    frames += [sweep(0.1 * k + 0.05) for k in range(10)]
    frames += [odometry(0.1 * k) for k in range(12)]
    session = Session([FakeLog(frames)])
    clouds = list(session.clouds())
    assert len(clouds) == 10
    np.testing.assert_allclose(clouds[3].points, [[1.0, 5.0, 2.0], [-6.0, 0.0, 2.0]], atol=1e-5)
    np.testing.assert_allclose(clouds[3].origin, [1.0, 0.0, 2.0])
    assert clouds[3].session_T_base is not None
    assert clouds[3].session_T_base[0, 3] == pytest.approx(0.35)
    assert clouds[3].label is not None
    assert (session.base_frame, session.session_frame) == ("base_link", "odom")
    stamps, poses = session.trajectory()
    assert len(stamps) == 12
    assert poses[-1, 0, 3] == pytest.approx(1.1)
    assert session.problems == []
    assert lost(session.problems) == []
    assert json.loads(json.dumps(session.to_json()))["frames"]["/points"] == {
        "seen": 10,
        "used": 10,
        "left_out": {},
    }


def test_twice_gives_the_same() -> None:
    session = Session(
        [
            FakeLog(
                [
                    static("base_link", "lidar", MOUNT),
                    *[sweep(0.1 * k) for k in range(5)],
                    *[odometry(0.1 * k) for k in range(6)],
                ]
            )
        ]
    )
    first = list(session.clouds())
    second = list(session.clouds())
    assert len(first) == len(second) == 5
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.points, b.points)
    assert session.to_json()["frames"] == {"/points": {"seen": 5, "used": 5, "left_out": {}}}


def test_a_gap_in_the_poses_costs_its_frames_and_a_sentence() -> None:
    frames: list[Frame] = [
        static("base_link", "lidar", MOUNT),
        *[sweep(0.1 * k) for k in range(300)],
    ]
    frames += [odometry(0.1 * k) for k in range(301) if not 100 < k < 200]
    session = Session([FakeLog(frames)])
    clouds = list(session.clouds())
    assert len(clouds) == 201  # the frames at both edges of the gap have a pose of their own
    assert session._pass.waiting.nbytes == 0
    assert sentences(lost(session.problems)) == [
        "/points: 99 of 300 frames are left out: the poses have a gap of 10.00 s between their "
        "stamps (2023-11-14T22:13:30.100Z to 2023-11-14T22:13:39.900Z)."
    ]


def test_why_a_pose_is_missing_is_told_by_the_whole_stream() -> None:
    mount = static("base_link", "lidar", MOUNT)
    sweeps = [sweep(0.1 * k) for k in range(100)]

    def reason(poses: Iterable[Frame]) -> str:
        session = Session([FakeLog([mount, *sweeps, *poses])])
        list(session.clouds())
        [problem] = [p for p in sentences(session.problems) if p.startswith("/points")]
        return problem.partition("left out: ")[2]

    begins = reason(odometry(4.0 + 0.1 * k) for k in range(70))
    assert begins.startswith("their stamps (2023-11-14T22:13:20.000Z to 2023-11-14T22:13:23.800Z)")
    assert "begin 4.00 s before the first pose (2023-11-14T22:13:24.000Z)" in begins
    ends = reason(odometry(0.1 * k) for k in range(41))
    assert "end 5.90 s after the last pose (2023-11-14T22:13:24.000Z)" in ends
    gaps = reason(odometry(0.1 * k) for k in range(101) if k % 50 < 30)
    assert gaps.startswith("the poses have 2 gaps of up to 2.10 s between their stamps")
    # a clock that starts at 0, recorded at the same time
    other = reason(
        PoseSample(header("/odom", -1.7e9 + 0.1 * k, "odom", 1.7e9), "base_link", np.eye(4))
        for k in range(100)
    )
    assert "end 53.9 years after the last pose (1970-01-01T00:00:09.900Z)" in other
    # recorded when frames have waited for 10 s: not a gap, and not before the poses
    sweeps = [sweep(0.1 * k) for k in range(300)]
    late = reason(odometry(0.1 * k, late=12.0) for k in range(300))
    assert "were recorded later than frames can wait" in late


def test_poses_that_start_late_and_a_clock_of_its_own() -> None:
    frames: list[Frame] = [
        static("base_link", "lidar", MOUNT),
        *[sweep(0.1 * k) for k in range(200)],
    ]
    late = Session([FakeLog([*frames, *[odometry(10.0 + 0.1 * k) for k in range(110)]])])
    assert len(list(late.clouds())) == 101
    other = Session(
        [FakeLog([*frames, *[odometry(-9000.0 + 0.1 * k, late=9000.0) for k in range(200)]])]
    )
    assert list(other.clouds()) == []
    assert "2023-11-14T22:13:20.000Z" in sentences(lost(other.problems))[0]


def test_poses_from_the_tf_tree() -> None:
    frames: list[Frame] = [
        static("base_link", "lidar", MOUNT),
        *[sweep(0.1 * k) for k in range(20)],
    ]
    frames += [
        moving("odom", "base_link", 0.1 * k, yaw_transform(0.0, (0.1 * k, 0.0, 0.0)), late=0.5)
        for k in range(21)
    ]
    frames += [
        moving("map", "odom", 0.1 * k, yaw_transform(0.0, (100.0, 0.0, 0.0))) for k in range(21)
    ]
    session = Session([FakeLog(frames)])
    clouds = list(session.clouds())
    assert len(clouds) == 20
    assert clouds[7].session_T_base is not None
    assert clouds[7].session_T_base[0, 3] == pytest.approx(0.7)
    assert session.session_frame == "odom"
    assert len(session.trajectory()[0]) == 21


def test_without_any_pose_stream() -> None:
    session = Session(
        [FakeLog([static("base_link", "lidar", MOUNT), *[sweep(0.1 * k) for k in range(3)]])]
    )
    clouds = list(session.clouds())
    assert [cloud.session_T_base for cloud in clouds] == [None, None, None]
    assert session.base_frame == "base_link"
    assert len(session.problems) == 1
    assert "no pose stream" in sentences(session.problems)[0]
    assert len(session.trajectory()[0]) == 0


def test_logs_recorded_back_to_back_and_side_by_side() -> None:
    first = FakeLog(
        [
            static("base_link", "lidar", MOUNT),
            *[sweep(0.1 * k) for k in range(10)],
            *[odometry(0.1 * k) for k in range(10)],
        ],
        "a.mcap",
    )
    second = FakeLog(
        [*[sweep(1 + 0.1 * k) for k in range(10)], *[odometry(1 + 0.1 * k) for k in range(10)]],
        "b.mcap",
    )
    skipped = Problem("/points", ProblemKind.MESSAGE, "/points: 1 message skipped.", lost=True)
    cut_off = Problem("", ProblemKind.FILE, "b.mcap: the file is cut off at byte 9.", lost=True)
    second.problems += [skipped, cut_off]
    session = Session([first, second])
    assert len(list(session.clouds())) == 20
    assert sentences(lost(session.problems)) == [
        "b.mcap: /points: 1 message skipped.",
        "b.mcap: the file is cut off at byte 9.",
    ]
    sensors = FakeLog([sweep(0.1 * k + 0.05) for k in range(10)])
    poses = FakeLog([odometry(0.1 * k) for k in range(11)])
    assert len(list(Session([sensors, poses]).clouds())) == 10


def test_a_later_log_is_not_touched_before_its_time() -> None:
    first = FakeLog([*[sweep(0.1 * k) for k in range(50)], *[odometry(0.1 * k) for k in range(51)]])
    second = FakeLog([sweep(100.0), odometry(100.0)])
    clouds = Session([first, second]).clouds()
    next(clouds)
    assert second.given == 0


def test_up_from_a_tilted_imu_on_a_turning_base() -> None:
    rng = np.random.default_rng(1)
    base_T_imu = np.eye(4)
    base_T_imu[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # its y axis points up
    frames: list[Frame] = [
        static("base_link", "lidar", MOUNT),
        static("base_link", "imu", base_T_imu),
        sweep(0.0),
    ]
    frames += [odometry(0.1 * k) for k in range(100)]
    for k in range(1000):
        force = (
            np.array([0.0, 9.81, 0.0])
            + rng.normal(0, 0.3, 3)
            + (np.array([6.0, 0.0, 0.0]) if k % 10 == 0 else 0.0)
        )
        frames.append(ImuSample(header("/imu", 0.0099 * k, "imu"), force, np.zeros(3)))
    session = Session([FakeLog(frames)])
    list(session.clouds())
    for up in (session.imu_up_in_base(), session.imu_up_in_session()):
        assert up is not None
        np.testing.assert_allclose(up, [0.0, 0.0, 1.0], atol=0.02)


def test_logs_that_cannot_be_a_session() -> None:
    with pytest.raises(LogError, match="none was named"):
        open_session([])
    with pytest.raises(RoleError, match="No topic is a LIDAR, depth images or a stereo pair"):
        Session([FakeLog([odometry(0.0)])])
    with pytest.raises(RoleError, match=r"^drive\.mcap holds no messages\.$"):
        Session([FakeLog([])])
    damaged = FakeLog([])
    damaged.problems.append(Problem("", ProblemKind.FILE, "drive.mcap is cut off.", lost=True))
    with pytest.raises(RoleError, match=r"^drive\.mcap is cut off\. drive\.mcap holds no messages"):
        Session([damaged])
    with pytest.raises(RoleError, match=r"drive.mcap: .*--topic pose=/a"):
        Session([FakeLog([sweep(0.0), odometry(0.0, topic="/a"), odometry(0.0, topic="/b")])])


def test_repeated_and_backward_poses_are_counted() -> None:
    frames: list[Frame] = [
        static("base_link", "lidar", MOUNT),
        sweep(0.05),
        odometry(0.0),
        odometry(0.0, late=0.01),
        odometry(0.1),
        odometry(0.05, late=0.1),
    ]
    session = Session([FakeLog(frames)])
    assert len(list(session.clouds())) == 1
    assert any(
        "1 repeated and 1 back in time" in problem for problem in sentences(session.problems)
    )
