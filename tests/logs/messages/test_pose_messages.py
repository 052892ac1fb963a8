"""Odometry, poses and transforms of ROS."""

from __future__ import annotations

import math

import numpy as np
import pytest

from semloc_logs.frames import PoseSample, TransformSample
from semloc_logs.logs.problems import sentences
from tests.logs.messages.encoded import LOG_TIME, QUARTER_TURN, TURNED, Ros, odometry


def test_odometry(ros: Ros) -> None:
    [frame] = ros.frames(odometry(ros, QUARTER_TURN), "/odom")
    assert isinstance(frame, PoseSample)
    assert (frame.header.topic, frame.header.stamp_ns, frame.header.log_time_ns) == (
        "/odom",
        5_000_000_007,
        LOG_TIME,
    )
    assert (frame.header.frame_id, frame.child_frame_id) == ("odom", "base")
    np.testing.assert_allclose(frame.frame_T_child, TURNED, atol=1e-12)


@pytest.mark.parametrize(
    "q", [(0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, math.nan), (math.inf, 0.0, 0.0, 1.0)]
)
def test_impossible_rotations_are_skipped_and_counted(
    ros: Ros, q: tuple[float, float, float, float]
) -> None:
    assert ros.frames(odometry(ros, q)) == []
    assert ros.frames(odometry(ros, q)) == []
    [sentence] = sentences(ros.problems)
    assert sentence.startswith(
        "/t: 2 messages skipped; the first because nav_msgs/msg/Odometry at log "
        "time 9000000000 ns: "
    )


def test_pose_stamped_and_with_covariance(ros: Ros) -> None:
    pose = ros.pose((1, 2, 3), QUARTER_TURN)
    [frame] = ros.frames(ros.make("geometry_msgs/msg/PoseStamped", header=ros.header(), pose=pose))
    assert isinstance(frame, PoseSample)
    assert frame.child_frame_id == ""
    np.testing.assert_allclose(frame.frame_T_child, TURNED, atol=1e-12)
    pose = ros.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36))
    [frame] = ros.frames(
        ros.make("geometry_msgs/msg/PoseWithCovarianceStamped", header=ros.header(), pose=pose)
    )
    np.testing.assert_allclose(frame.frame_T_child, TURNED, atol=1e-12)


@pytest.mark.parametrize(
    ("topic", "static"), [("/tf", False), ("/tf_static", True), ("/robot/tf_static", True)]
)
def test_tf_yields_every_transform(topic: str, static: bool) -> None:
    ros = Ros("cdr")
    pose = ros.pose((1, 2, 3), QUARTER_TURN)
    translation = ros.make("geometry_msgs/msg/Vector3", x=1.0, y=2.0, z=3.0)
    transform = ros.make(
        "geometry_msgs/msg/Transform", translation=translation, rotation=pose.orientation
    )
    edges = [
        ros.make(
            "geometry_msgs/msg/TransformStamped",
            header=ros.header(frame_id="a"),
            child_frame_id=c,
            transform=transform,
        )
        for c in ("b", "c")
    ]
    frames = ros.frames(ros.make("tf2_msgs/msg/TFMessage", transforms=edges), topic)
    assert [(f.header.frame_id, f.child_frame_id, f.static) for f in frames] == [
        ("a", "b", static),
        ("a", "c", static),
    ]
    assert all(isinstance(f, TransformSample) for f in frames)
    np.testing.assert_allclose(frames[1].frame_T_child, TURNED, atol=1e-12)
