"""Sessions over logs in memory: waiting, base frames, gaps, several logs; and over real logs."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from semloc_logs.errors import LogError, RoleError
from semloc_logs.frames import (
    Camera,
    DepthFrame,
    Frame,
    Header,
    ImageFrame,
    ImuSample,
    LidarFrame,
    PoseSample,
    TransformSample,
)
from semloc_logs.logs.log import Message, Reading, Section, Stream
from semloc_logs.logs.poses.mountings import Mountings, StaticTransform
from semloc_logs.logs.problems import Problem, ProblemKind, lost, sentences
from semloc_logs.logs.session.session import Session, SessionOptions, open_session
from semloc_logs.numerics.transforms import Array, rotation_angle, yaw_transform
from semloc_logs.settings import Logs

S = 1_000_000_000
EPOCH = 1_700_000_000 * S
TYPES = {
    LidarFrame: "sensor_msgs/msg/PointCloud2",
    DepthFrame: "sensor_msgs/msg/Image",
    ImageFrame: "sensor_msgs/msg/Image",
    Camera: "sensor_msgs/msg/CameraInfo",
    TransformSample: "tf2_msgs/msg/TFMessage",
    ImuSample: "sensor_msgs/msg/Imu",
}


class FakeLog:
    """Frames in memory as a log."""

    def __init__(
        self,
        frames: Iterable[Frame],
        name: str = "drive.mcap",
        pose_type: str = "nav_msgs/msg/Odometry",
    ) -> None:
        self._frames = sorted(frames, key=lambda f: f.header.log_time_ns)
        self.path = Path(name)
        self.format = "mcap"
        self.encoding = "ros2"
        times = [f.header.log_time_ns for f in self._frames]
        self.start_ns: int | None = times[0] if times else None
        self.end_ns: int | None = times[-1] if times else None
        self.problems: list[Problem] = []
        self.given = 0
        kinds = {f.header.topic: TYPES.get(type(f), pose_type) for f in self._frames}
        topics = [f.header.topic for f in self._frames]
        self.streams = [
            Stream(topic, kind, "cdr", topics.count(topic)) for topic, kind in sorted(kinds.items())
        ]

    def sections(self) -> list[Section]:
        return []

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        return iter(())

    def frames(
        self, topics: Collection[str] | None = None, reading: Reading | None = None
    ) -> Iterator[Frame]:
        for frame in self._frames:
            if topics is None or frame.header.topic in topics:
                self.given += 1
                yield frame

    def close(self) -> None:
        pass


def header(topic: str, seconds: float, frame_id: str, late: float = 0.0) -> Header:
    return Header(topic, EPOCH + round(seconds * S), EPOCH + round((seconds + late) * S), frame_id)


def sweep(seconds: float, topic: str = "/points", frame_id: str = "lidar") -> LidarFrame:
    points = np.array([[5.0, 0.0, 0.0], [0.0, 7.0, 0.0]], np.float32)
    return LidarFrame(header(topic, seconds, frame_id), points, label=np.array([1, 2], np.uint32))


def odometry(
    seconds: float, child: str = "base_link", late: float = 0.0, topic: str = "/odom"
) -> PoseSample:
    return PoseSample(
        header(topic, seconds, "odom", late), child, yaw_transform(0.0, (seconds, 0.0, 0.0))
    )


def static(parent: str, child: str, pose: Array, seconds: float = 0.0) -> TransformSample:
    return TransformSample(header("/tf_static", seconds, parent), child, pose, static=True)


def moving(
    parent: str, child: str, seconds: float, pose: Array, late: float = 0.0
) -> TransformSample:
    return TransformSample(header("/tf", seconds, parent, late), child, pose, static=False)


MOUNT = yaw_transform(np.pi / 2, (1.0, 0.0, 2.0))


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


def test_frames_wait_for_late_poses_in_bounded_memory() -> None:
    frames: list[Frame] = [static("base_link", "lidar", MOUNT)]
    frames += [sweep(0.1 * k) for k in range(400)]
    frames += [odometry(0.1 * k, late=2.0) for k in range(401)]
    log = FakeLog(frames)
    session = Session([log])
    most = seen = 0
    for cloud in session.clouds():
        seen += 1
        assert cloud.session_T_base is not None
        assert cloud.session_T_base[0, 3] == pytest.approx(
            (cloud.header.stamp_ns - EPOCH) / S, abs=1e-6
        )
        most = max(most, len(session._pass.waiting))
    assert seen == 400
    assert most <= 30


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


def test_transforms_that_come_late() -> None:
    frames: list[Frame] = [
        *[sweep(0.1 * k) for k in range(30)],
        *[odometry(0.1 * k) for k in range(31)],
    ]
    frames.append(static("base_link", "lidar", MOUNT, seconds=2.0))
    session = Session([FakeLog(frames)])
    assert len(list(session.clouds())) == 30
    assert session.base_frame == "base_link"


def test_base_link_hangs_below_the_frame_of_the_pose() -> None:
    frames: list[Frame] = [
        static("base_footprint", "base_link", yaw_transform(0.0, (0.0, 0.0, 0.5))),
        static("base_link", "lidar", MOUNT),
        *[sweep(0.1 * k) for k in range(3)],
        *[odometry(0.1 * k, "base_footprint") for k in range(4)],
    ]
    session = Session([FakeLog(frames)])
    clouds = list(session.clouds())
    assert session.base_frame == "base_link"
    assert clouds[1].session_T_base is not None
    np.testing.assert_allclose(clouds[1].session_T_base[:3, 3], [0.1, 0.0, 0.5], atol=1e-9)


def test_the_frame_of_the_pose_is_the_base_without_base_link() -> None:
    frames: list[Frame] = [
        static("imu", "lidar", MOUNT),
        *[sweep(0.1 * k) for k in range(3)],
        *[odometry(0.1 * k, "imu") for k in range(4)],
    ]
    session = Session([FakeLog(frames)])
    assert len(list(session.clouds())) == 3
    assert session.base_frame == "imu"
    np.testing.assert_allclose(session.base_T_sensors()["lidar"], MOUNT)


def test_an_unconnected_sensor_is_taken_as_the_base_with_a_problem() -> None:
    session = Session(
        [FakeLog([*[sweep(0.1 * k) for k in range(3)], *[odometry(0.1 * k) for k in range(4)]])]
    )
    clouds = list(session.clouds())
    assert len(clouds) == 3
    np.testing.assert_allclose(clouds[0].points, sweep(0).points)
    [problem] = session.problems
    assert "'lidar' with 'base_link'" in problem.text
    assert problem.assumed
    assert not problem.lost


def test_the_user_gives_a_missing_mounting() -> None:
    frames: list[Frame] = [
        *[sweep(0.1 * k) for k in range(3)],
        *[sweep(0.1 * k, "/rear", "/rear") for k in range(3)],
        *[odometry(0.1 * k) for k in range(4)],
    ]
    turned = (1.0, 0.0, 2.0, 0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))
    logs = Logs(mountings={"lidar": turned, "rear": (-1.0, 0.0, 2.0, 0.0, 0.0, 0.0, 1.0)})
    session = Session([FakeLog(frames)], SessionOptions(logs=logs))
    clouds = {cloud.header.topic: cloud for cloud in session.clouds()}
    np.testing.assert_allclose(clouds["/points"].points, [[1, 5, 2], [-6, 0, 2]], atol=1e-6)
    np.testing.assert_allclose(clouds["/rear"].points, [[4, 0, 2], [-1, 7, 2]], atol=1e-6)
    assert session.base_frame == "base_link"
    assert session.problems == []


def test_a_given_mounting_overrules_the_log() -> None:
    frames: list[Frame] = [static("base_link", "lidar", MOUNT), sweep(0.0), sweep(0.1)]
    frames += [odometry(0.1 * k) for k in range(4)]
    logs = Logs(mountings={"lidar": (0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)})
    clouds = list(Session([FakeLog(frames)], SessionOptions(logs=logs)).clouds())
    np.testing.assert_allclose(clouds[1].points, [[5, 0, 1], [0, 7, 1]], atol=1e-6)


def depth_frames(frame_id: str) -> list[Frame]:
    """A wall 2 m in front of a camera of 4 x 4 pixels, and poses of base_link."""
    K = np.array([[4.0, 0, 1.5], [0, 4, 1.5], [0, 0, 1]])
    camera = Camera(
        header("/camera/camera_info", 0.0, frame_id),
        4,
        4,
        K,
        np.zeros(5),
        np.eye(3),
        np.zeros((3, 4)),
        "plumb_bob",
    )
    frames: list[Frame] = [camera]
    for k in range(3):
        depth = np.full((4, 4), 2.0, np.float32)
        frames.append(DepthFrame(header("/camera/depth/image", 0.1 * k, frame_id), depth))
        frames.append(odometry(0.1 * k))
    return frames


def axes_problems(frames: Sequence[Frame], **mountings: tuple[float, ...]) -> list[Problem]:
    session = Session([FakeLog(frames)], SessionOptions(logs=Logs(mountings=mountings)))
    assert len(list(session.clouds())) == 3
    return session.problems


OPTICAL = np.array([[0.0, 0, 1, 0.5], [-1, 0, 0, 0], [0, -1, 0, 1], [0, 0, 0, 1]])
OPTICAL_POSE = (0.5, 0.0, 1.0, -0.5, 0.5, -0.5, 0.5)


def test_a_depth_image_in_a_body_frame_is_an_assumption() -> None:
    right = static("base_link", "camera_link", OPTICAL)
    assert axes_problems([right, *depth_frames("camera_link")]) == []
    body = static("base_link", "camera_link", yaw_transform(0.0, (0.5, 0.0, 1.0)))
    [problem] = axes_problems([body, *depth_frames("camera_link")])
    assert problem.assumed
    assert "The z axis of 'camera_link', along which the pictures of" in problem.text
    assert axes_problems([body, *depth_frames("camera_link")], camera_link=OPTICAL_POSE) == []


def test_a_depth_image_in_the_base_frame_is_an_assumption_unless_it_is_called_optical() -> None:
    [problem] = axes_problems(depth_frames("base_link"))
    assert problem.assumed
    assert "taken as poses of the optical frame (z forward) of /camera/depth/image" in problem.text
    assert axes_problems(depth_frames("base_link"), base_link=OPTICAL_POSE) == []
    session = Session(
        [FakeLog(depth_frames("base_link"))],
        SessionOptions(logs=Logs(mountings={"base_link": OPTICAL_POSE})),
    )
    # 2 m in front of the camera, which looks along x from (0.5, 0, 1)
    points = next(session.clouds()).points
    np.testing.assert_allclose(points[:, 0], 2.5, atol=1e-6)


def test_transforms_of_another_log_hold_until_the_log_has_its_own() -> None:
    frames: list[Frame] = [*[sweep(0.1 * k) for k in range(3)]]
    frames += [odometry(0.1 * k) for k in range(4)]
    note = Problem("", ProblemKind.TRANSFORM, "from part_0.mcap", lost=False)
    lent = StaticTransform("base_link", "lidar", (0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))
    options = SessionOptions(mountings=Mountings(lent=(lent,), problems=(note,)))
    session = Session([FakeLog(frames)], options)
    clouds = list(session.clouds())
    np.testing.assert_allclose(clouds[0].points, [[5, 0, 1], [0, 7, 1]], atol=1e-6)
    assert session.problems == [note]
    own = Session([FakeLog([static("base_link", "lidar", MOUNT), *frames])], options)
    np.testing.assert_allclose(next(own.clouds()).points, [[1, 5, 2], [-6, 0, 2]], atol=1e-6)


def fixed_sweep(seconds: float, frame_id: str) -> LidarFrame:
    """Two walls that stand still in the odometry's frame; the last point is out of range."""
    points = np.array([[30.0, 0.0, 0.0], [0.0, 7.0, 0.0], [200.0, 0.0, 0.0]], np.float32)
    offset_ns = np.array([0, 50_000_000, 99_000_000], np.int64)
    return LidarFrame(header("/cloud", seconds, frame_id), points, offset_ns=offset_ns)


@pytest.mark.parametrize("through", ["the topic", "TF", "TF, above the odometry's frame"])
def test_clouds_in_the_fixed_frame_are_moved_back_once(through: str) -> None:
    frame_id = "map" if "above" in through else "odom"
    frames: list[Frame] = [fixed_sweep(2.0 * k, frame_id) for k in range(5)]
    if through == "the topic":
        frames += [odometry(0.1 * k, child="body") for k in range(101)]
    else:
        pose = [yaw_transform(0.0, (0.1 * k, 0.0, 0.0)) for k in range(101)]
        frames += [moving("odom", "base_link", 0.1 * k, pose[k]) for k in range(101)]
        frames.append(static("map", "odom", np.eye(4), -0.5))
    session = Session([FakeLog(frames)])
    clouds = list(session.clouds())
    assert len(clouds) == 5
    for k, cloud in enumerate(clouds):
        assert cloud.session_T_base is not None
        # the vehicle drives along x at 1 m/s, and its points are in the base frame at the stamp
        assert cloud.session_T_base[0, 3] == pytest.approx(2.0 * k)
        np.testing.assert_allclose(cloud.points, [[30 - 2 * k, 0, 0], [-2 * k, 7, 0]], atol=1e-5)
        np.testing.assert_array_equal(cloud.origin, 0)
    assert session.to_json()["sweeps_deskewed"] == 0
    assert [problem.is_reported for problem in session.problems] == [False]
    assert f"/cloud is in '{frame_id}', the frame that the poses" in session.problems[0].text


def test_a_fixed_frame_that_nothing_connects_is_not_taken_as_the_sensor() -> None:
    frames: list[Frame] = [fixed_sweep(0.1 * k, "map") for k in range(5)]
    frames += [odometry(0.1 * k) for k in range(6)]
    session = Session([FakeLog(frames)])
    assert list(session.clouds()) == []
    assert (
        "no transform leads from their frame 'map' to the base frame 'base_link'"
        in (sentences(lost(session.problems))[0])
    )


def test_a_second_unconnected_sensor_is_not_guessed() -> None:
    frames: list[Frame] = [
        *[sweep(0.1 * k) for k in range(3)],
        *[odometry(0.1 * k) for k in range(4)],
    ]
    frames += [sweep(0.1 * k, "/rear", "rear") for k in range(3)]
    session = Session([FakeLog(frames)])
    assert {cloud.header.topic for cloud in session.clouds()} == {"/points"}
    assert any(
        "/rear: 3 of 3 frames are left out: no transform" in problem
        for problem in sentences(lost(session.problems))
    )


def test_a_pose_without_child_frame_is_that_of_the_sensor() -> None:
    frames: list[Frame] = [
        *[sweep(0.1 * k) for k in range(3)],
        *[odometry(0.1 * k, "", topic="/pose") for k in range(4)],
    ]
    session = Session([FakeLog(frames, pose_type="geometry_msgs/msg/PoseStamped")])
    assert len(list(session.clouds())) == 3
    assert session.base_frame == "lidar"
    [problem] = session.problems
    assert "/pose does not name the frame whose pose it is" in problem.text
    assert problem.assumed


@pytest.mark.parametrize("child", ["", "odom"], ids=["unnamed", "its own parent"])
def test_a_pose_without_child_frame_is_of_the_vehicle_where_the_sensor_has_a_mounting(
    child: str,
) -> None:
    frames: list[Frame] = [
        static("base_link", "lidar", yaw_transform(0.0, (1.0, 0.0, 2.0))),
        *[sweep(0.1 * k) for k in range(3)],
        *[odometry(0.1 * k, child) for k in range(4)],
    ]
    session = Session([FakeLog(frames)])
    clouds = list(session.clouds())
    np.testing.assert_allclose(clouds[0].points, [[6, 0, 2], [1, 7, 2]], atol=1e-6)
    assert session.base_frame == "base_link"
    [problem] = session.problems
    assert "it is taken as the pose of 'base_link'" in problem.text
    assert problem.assumed


def test_the_pose_of_a_sensors_own_slam_needs_no_child_frame() -> None:
    frames: list[Frame] = [
        *[sweep(0.1 * k, "/camera/points") for k in range(3)],
        *[odometry(0.1 * k, "", topic="/camera/pose") for k in range(4)],
    ]
    session = Session([FakeLog(frames, pose_type="geometry_msgs/msg/PoseStamped")])
    assert len(list(session.clouds())) == 3
    assert session.problems == []


def test_the_user_says_where_the_frame_of_an_unnamed_pose_is() -> None:
    frames: list[Frame] = [sweep(0.1), *[odometry(0.1 * k, "", topic="/pose") for k in range(4)]]
    logs = Logs(mountings={"lidar": (0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)})
    log = FakeLog(frames, pose_type="geometry_msgs/msg/PoseStamped")
    session = Session([log], SessionOptions(logs=logs))
    [cloud] = session.clouds()
    np.testing.assert_allclose(cloud.points, [[5, 0, 1], [0, 7, 1]], atol=1e-6)
    assert session.problems == []


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


def test_a_turning_sensor_waits_for_its_transform() -> None:
    frames: list[Frame] = [
        *[sweep(0.1 * k) for k in range(20)],
        *[odometry(0.1 * k) for k in range(21)],
    ]
    frames += [
        moving("base_link", "lidar", 0.1 * k, yaw_transform(0.1 * k), late=0.3) for k in range(21)
    ]
    clouds = list(Session([FakeLog(frames)]).clouds())
    assert len(clouds) == 20
    np.testing.assert_allclose(
        clouds[10].points[0], [5 * np.cos(1.0), 5 * np.sin(1.0), 0.0], atol=1e-5
    )


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


def depth_camera(count: int, period: float, late: float = 0.0) -> list[Frame]:
    """Depth images with labels 0, 1, 2 ..., and poses that are recorded so late (s)."""
    info = Camera(
        header("/camera/depth/camera_info", 0.02, "optical"),
        4,
        4,
        np.array([[2.0, 0, 2], [0, 2, 2], [0, 0, 1]]),
        np.zeros(5),
        np.eye(3),
        np.zeros((3, 4)),
        "plumb_bob",
    )
    frames: list[Frame] = [info]
    for k in range(count):
        seconds = period * k
        depth = np.full((4, 4), 2.0, np.float32)
        frames.append(DepthFrame(header("/camera/depth/image", seconds, "optical"), depth))
        frames.append(
            ImageFrame(
                header("/camera/label", seconds, "optical", late=0.05),
                np.full((4, 4), k, np.uint8),
                "mono8",
            )
        )
        frames.append(odometry(seconds, "", late, topic="/camera/pose"))
    return frames


def test_labels_wait_for_late_poses_with_their_depth_images() -> None:
    """Poses are recorded 5 s late, after 150 more pictures of 30 Hz."""
    frames = depth_camera(240, 1 / 30, late=5.0)
    session = Session([FakeLog(frames, pose_type="geometry_msgs/msg/PoseStamped")])
    clouds = list(session.clouds())
    assert [int(cloud.label[0]) for cloud in clouds if cloud.label is not None] == [*range(240)]


def test_depth_camera_with_labels_and_its_own_pose() -> None:
    frames = depth_camera(4, 0.1)
    session = Session([FakeLog(frames, pose_type="geometry_msgs/msg/PoseStamped")])
    clouds = list(session.clouds())
    assert [int(cloud.label[0]) for cloud in clouds if cloud.label is not None] == [0, 1, 2, 3]
    assert session.base_frame == "optical"
    np.testing.assert_allclose(clouds[0].points[0], [-2.0, -2.0, 2.0])
    assert list(session.cameras) == ["/camera/depth/image", "/camera/label"]


def test_depth_without_calibration_is_named() -> None:
    frames: list[Frame] = [
        DepthFrame(header("/depth", 0.0, "optical"), np.ones((4, 4), np.float32)),
        odometry(0.0, "optical"),
    ]
    session = Session([FakeLog(frames)])
    assert list(session.clouds()) == []
    assert "no CameraInfo belongs to them" in sentences(lost(session.problems))[0]


def test_images_come_before_their_clouds() -> None:
    frames: list[Frame] = [
        static("base_link", "lidar", MOUNT),
        *[sweep(0.1 * k) for k in range(10)],
        *[odometry(0.1 * k) for k in range(11)],
    ]
    frames += [
        ImageFrame(
            header("/cam/image", 0.1 * k, "cam", late=0.25), np.zeros((2, 2, 3), np.uint8), "rgb8"
        )
        for k in range(10)
    ]
    seen: list[int] = []
    session = Session([FakeLog(frames)])
    for cloud in session.clouds(on_image=lambda image: seen.append(image.header.stamp_ns)):
        assert cloud.header.stamp_ns in seen
    assert len(seen) == 10


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


class WatchedLog(FakeLog):
    """Calls ``watch`` whenever a frame has been taken."""

    def watch(self) -> None:
        pass

    def frames(
        self, topics: Collection[str] | None = None, reading: Reading | None = None
    ) -> Iterator[Frame]:
        for frame in super().frames(topics, reading):
            yield frame
            self.watch()


def test_sweeps_without_a_pose_wait_for_seconds_only() -> None:
    """500 sweeps in 50 s: the ones of the last 10 s wait, 0.1 s apart."""
    log = WatchedLog([*[sweep(0.1 * k) for k in range(500)], odometry(1000.0)])
    session = Session([log])
    waiting: list[int] = []
    log.watch = lambda: waiting.append(len(session._pass.waiting))  # type: ignore[method-assign]
    assert list(session.clouds()) == []
    assert session.to_json()["frames"] == {
        "/points": {"seen": 500, "used": 0, "left_out": {"before the poses": 500}}
    }
    assert max(waiting) == 101


def test_sweeps_that_wait_take_a_part_of_the_memory_only() -> None:
    """A quarter of 64 MiB; 60 sweeps of 1 MiB come within a second."""
    points = np.ones(((1 << 20) // 12, 3), np.float32)
    sweeps = [LidarFrame(header("/points", k / 60, "lidar"), points) for k in range(60)]
    log = WatchedLog([static("base_link", "lidar", MOUNT), *sweeps, odometry(1000.0)])
    session = Session([log], SessionOptions(logs=Logs(memory=64 << 20)))
    nbytes: list[int] = []
    log.watch = lambda: nbytes.append(session._pass.waiting.nbytes)  # type: ignore[method-assign]
    assert list(session.clouds()) == []
    assert 15 << 20 < max(nbytes) <= 16 << 20


def test_four_lidars_wait_for_poses_that_are_recorded_a_second_late() -> None:
    """72 sweeps wait at once, each for its own pose."""
    topics = [f"/lidar_{k}/points" for k in range(4)]
    frames: list[Frame] = [static("base_link", "lidar", MOUNT)]
    frames += [sweep(k / 18, topic) for k in range(90) for topic in topics]
    frames += [odometry(0.05 * k, late=1.0) for k in range(101)]
    session = Session([FakeLog(frames)], SessionOptions(topics={"lidar": ",".join(topics)}))
    clouds = list(session.clouds())
    assert len(clouds) == 360
    for cloud in clouds:
        assert cloud.session_T_base is not None
        seconds = (cloud.header.stamp_ns - EPOCH) / S
        assert cloud.session_T_base[0, 3] == pytest.approx(seconds, abs=1e-6)
    assert lost(session.problems) == []


class TestRecordedLogs:
    def test_basement_has_a_pose_for_every_sweep(self, shared: Callable[[str], Path]) -> None:
        for name, count in (("basement_a.mcap", 88), ("basement_b.bag", 87)):
            session = open_session([shared(f"logs/{name}")])
            clouds = list(session.clouds())
            assert len(clouds) == count
            assert all(c.session_T_base is not None for c in clouds)
            assert (session.base_frame, session.session_frame, session.problems) == (
                "base_link",
                "odom",
                [],
            )
            session.close()

    def test_the_two_basements_meet_in_their_common_frame(
        self, shared: Callable[[str], Path]
    ) -> None:
        """The last sweep of a and the first of b, within a second, show the same hall."""
        from scipy.spatial import cKDTree

        truth = json.loads(shared("logs/basement_truth.json").read_text())
        halls = []
        for name, which in (("basement_a.mcap", -1), ("basement_b.bag", 0)):
            session = open_session([shared(f"logs/{name}")])
            cloud = list(session.clouds())[which]
            assert cloud.session_T_base is not None
            pose = np.array(truth[name]["T_common_session"]) @ cloud.session_T_base
            halls.append(cloud.points @ pose[:3, :3].T + pose[:3, 3])
            session.close()
        distance, _ = cKDTree(halls[0]).query(halls[1][::20])
        assert np.median(distance) < 0.1

    @pytest.mark.parametrize("name", ["room_a.mcap", "room_b"])
    def test_room_depth_frames_overlap(self, shared: Callable[[str], Path], name: str) -> None:
        """Neighbouring depth images, put together by their poses, show the same surfaces."""
        from scipy.spatial import cKDTree

        session = open_session([shared(f"logs/{name}")], SessionOptions(stride=8))
        worlds = []
        for cloud, _ in zip(session.clouds(), range(6), strict=False):
            assert cloud.session_T_base is not None
            worlds.append(
                cloud.points @ cloud.session_T_base[:3, :3].T + cloud.session_T_base[:3, 3]
            )
        assert session.base_frame == "camera_optical"
        distance, _ = cKDTree(worlds[0]).query(worlds[-1])
        assert np.median(distance) < 0.04
        session.close()

    def test_kitti_sweeps_have_labels_and_one_pose(self, shared: Callable[[str], Path]) -> None:
        session = open_session([shared("logs/kitti00_000052.mcap")])
        (cloud,) = session.clouds()
        assert cloud.label is not None
        assert len(cloud.label) == len(cloud.points) > 100_000
        assert cloud.session_T_base is not None
        assert rotation_angle(cloud.session_T_base[:3, :3]) == 0.0

    def test_a_drive_without_poses(self, shared: Callable[[str], Path]) -> None:
        session = open_session([shared("logs/kitti_drive_camera_lidar.mcap")])
        pictures: list[int] = []
        clouds = list(session.clouds(on_image=lambda image: pictures.append(image.header.stamp_ns)))
        assert len(clouds) == len(pictures) == 24
        assert all(c.session_T_base is None for c in clouds)
        assert session.base_frame == "velodyne"
        assert "camera_left" in session.base_T_sensors()
        assert len(session.problems) == 1
        session.close()
