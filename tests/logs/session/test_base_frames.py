"""The base frame and mountings of sensors, also where a log has none."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from semloc_logs.frames import (
    Camera,
    DepthFrame,
    Frame,
    LidarFrame,
)
from semloc_logs.logs.poses.mountings import Mountings, StaticTransform
from semloc_logs.logs.problems import Problem, ProblemKind, lost, sentences
from semloc_logs.logs.session.session import Session, SessionOptions
from semloc_logs.numerics.transforms import yaw_transform
from semloc_logs.settings import Logs
from tests.logs.session.memory_log import (
    MOUNT,
    FakeLog,
    header,
    moving,
    odometry,
    static,
    sweep,
)


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
