"""Definitions of messages in the log: used before the standard ones, or named."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from semloc_logs.frames import ImuSample
from semloc_logs.logs.log import Definition, Message
from semloc_logs.logs.problems import sentences
from tests.logs.messages.encoded import QUARTER_TURN, TURNED, Ros

IMU_LIKE = (
    b"geometry_msgs/Vector3 linear_acceleration\n"
    b"geometry_msgs/Vector3 angular_velocity\n"
    b"std_msgs/Header header\n"
)


def test_the_definition_in_the_log_beats_the_standard_one() -> None:
    ros = Ros("cdr")
    data = struct.pack("<4B6d2iI5s", 0, 1, 0, 0, 1, 2, 3, 4, 5, 6, 8, 9, 5, b"base\0")
    definition = Definition("sensor_msgs/msg/Imu", "ros2msg", IMU_LIKE)
    [frame] = ros.decoder.frames(Message("/i", "sensor_msgs/msg/Imu", "cdr", 1, data, definition))
    assert isinstance(frame, ImuSample)
    assert frame.acceleration.tolist() == [1, 2, 3]
    assert frame.angular_velocity.tolist() == [4, 5, 6]
    assert (frame.header.stamp_ns, frame.header.frame_id) == (8_000_000_009, "base")


def test_idl_definitions() -> None:
    idl = """================================================================================
IDL: geometry_msgs/msg/PoseStamped
#include "geometry_msgs/msg/Pose.idl"
module geometry_msgs { module msg { struct PoseStamped {
  std_msgs::msg::Header header;
  geometry_msgs::msg::Pose pose;
}; }; };
"""
    ros = Ros("cdr")
    message = ros.make(
        "geometry_msgs/msg/PoseStamped", header=ros.header(), pose=ros.pose((1, 2, 3), QUARTER_TURN)
    )
    [frame] = ros.frames(
        message, "/p", Definition("geometry_msgs/msg/PoseStamped", "ros2idl", idl.encode())
    )
    np.testing.assert_allclose(frame.frame_T_child, TURNED, atol=1e-12)
    assert sentences(ros.problems) == []


@pytest.mark.parametrize(
    ("encoding", "text"),
    [
        ("ros2msg", b"this is not a definition ["),
        ("ros2msg", b"foo_msgs/Missing header"),
        ("ros2msg", b"std_msgs/Header[1000000000] header"),
        ("ros2msg", b"string[1000000000] header"),
        ("ros2msg", b"sensor_msgs/Imu header"),
        ("ros2idl", b"module {"),
        ("ros2idl", b"const long X = 1 << 100000000000;"),
        ("omg", b"struct"),
        ("ros2msg", b"\xff\xfe\0"),
    ],
)
def test_definitions_that_cannot_be_used_are_named(encoding: str, text: bytes) -> None:
    ros = Ros("cdr")
    definition = Definition("sensor_msgs/msg/Imu", encoding, text)
    for _ in range(2):
        assert (
            ros.decoder.frames(
                Message(
                    "/i", "sensor_msgs/msg/Imu", "cdr", 1, b"\0\1\0\0" + b"\0" * 400, definition
                )
            )
            == []
        )
    [sentence] = sentences(ros.problems)
    assert sentence.startswith("/i: 2 messages skipped")
