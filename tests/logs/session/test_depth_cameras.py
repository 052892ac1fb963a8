"""Sessions of depth cameras: labels, calibration, the order of images."""

from __future__ import annotations

import numpy as np

from semloc_logs.frames import (
    DepthFrame,
    Frame,
    ImageFrame,
)
from semloc_logs.logs.problems import lost, sentences
from semloc_logs.logs.session.session import Session
from tests.logs.session.memory_log import (
    MOUNT,
    FakeLog,
    depth_camera,
    header,
    odometry,
    static,
    sweep,
)


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
