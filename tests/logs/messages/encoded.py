"""Messages in each encoding, and the frames they are decoded to, for tests of decoders."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from rosbags.typesys import Stores, get_typestore

from semloc_logs.logs.log import Definition, Message
from semloc_logs.logs.messages.decode import Decoder
from semloc_logs.logs.problems import Problems

STORES = {"cdr": get_typestore(Stores.ROS2_HUMBLE), "ros1": get_typestore(Stores.ROS1_NOETIC)}
NOTHING = Definition("", "", b"")
LOG_TIME = 9_000_000_000


class Ros:
    """Builds messages of one generation and decodes their bytes."""

    def __init__(self, encoding: str) -> None:
        self.encoding = encoding
        self.store = STORES[encoding]
        self.problems = Problems()
        self.decoder = Decoder(self.problems)

    def make(self, type_: str, /, **fields: Any) -> Any:
        return self.store.types[type_](**fields)

    def header(self, sec: int = 5, nanosec: int = 7, frame_id: str = "lidar") -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        extra = {"seq": 3} if self.encoding == "ros1" else {}
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id, **extra)

    def pose(self, xyz: tuple[float, float, float], q: tuple[float, float, float, float]) -> Any:
        return self.make(
            "geometry_msgs/msg/Pose",
            position=self.make("geometry_msgs/msg/Point", x=xyz[0], y=xyz[1], z=xyz[2]),
            orientation=self.make("geometry_msgs/msg/Quaternion", x=q[0], y=q[1], z=q[2], w=q[3]),
        )

    def frames(
        self, message: Any, topic: str = "/t", definition: Definition = NOTHING
    ) -> list[Any]:
        name = message.__msgtype__
        serialize = (
            self.store.serialize_cdr if self.encoding == "cdr" else self.store.serialize_ros1
        )
        return self.decoder.frames(
            Message(topic, name, self.encoding, LOG_TIME, serialize(message, name), definition)
        )


QUARTER_TURN = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))
TURNED = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]


def odometry(ros: Ros, q: tuple[float, float, float, float]) -> Any:
    zero = ros.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    pose = ros.make(
        "geometry_msgs/msg/PoseWithCovariance", pose=ros.pose((1, 2, 3), q), covariance=np.zeros(36)
    )
    twist = ros.make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
    twist = ros.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36))
    return ros.make(
        "nav_msgs/msg/Odometry",
        header=ros.header(frame_id="odom"),
        child_frame_id="base",
        pose=pose,
        twist=twist,
    )


def descriptors(message: Any) -> Definition:
    file_of: dict[str, Any] = {}

    def add(file: Any) -> None:
        if file.name not in file_of:
            for dependency in file.dependencies:
                add(dependency)
            file_of[file.name] = file

    add(message.DESCRIPTOR.file)
    files = FileDescriptorSet()
    for file in file_of.values():
        file.CopyToProto(files.file.add())
    return Definition(message.DESCRIPTOR.full_name, "protobuf", files.SerializeToString())


def protobuf_frames(message: Any, topic: str = "/t") -> tuple[list[Any], Problems]:
    problems = Problems()
    definition = descriptors(message)
    m = Message(
        topic, definition.name, "protobuf", LOG_TIME, message.SerializeToString(), definition
    )
    return list(Decoder(problems).frames(m)), problems


def json_frames(name: str, value: Any, topic: str = "/t") -> tuple[list[Any], Problems]:
    problems = Problems()
    data = value if isinstance(value, bytes) else json.dumps(value).encode()
    return list(
        Decoder(problems).frames(
            Message(topic, name, "json", LOG_TIME, data, Definition(name, "jsonschema", b"{}"))
        )
    ), problems
