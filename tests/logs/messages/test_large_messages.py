"""Messages of megabytes that would become gigabytes of objects are refused, others decoded."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf import FrameTransforms_pb2, PointCloud_pb2
from mcap_protobuf.schema import build_file_descriptor_set
from rosbags.typesys import Stores, get_typestore

from semloc_logs.frames import LidarFrame
from semloc_logs.logs.log import Definition, Message
from semloc_logs.logs.messages.decode import Decoder
from semloc_logs.logs.messages.large_messages import LARGE
from semloc_logs.logs.problems import Problems, sentences

STORES = {"cdr": get_typestore(Stores.ROS2_HUMBLE), "ros1": get_typestore(Stores.ROS1_NOETIC)}
NOTHING = Definition("", "", b"")
POINTS = LARGE // 16 + 1
CLOUD = "sensor_msgs/msg/PointCloud2"


def decoded(
    type_: str, encoding: str, data: bytes, definition: Definition = NOTHING
) -> tuple[list[Any], list[str]]:
    problems = Problems()
    message = Message("/t", type_, encoding, 1, memoryview(data), definition)
    frames = Decoder(problems).frames(message)
    return frames, sentences(problems)


def cloud(encoding: str, fields: int, frame_id: str = "lidar") -> bytes:
    types = STORES[encoding].types
    field = types["sensor_msgs/msg/PointField"]
    sequence = {"seq": 1} if encoding == "ros1" else {}
    header = types["std_msgs/msg/Header"](
        stamp=types["builtin_interfaces/msg/Time"](sec=1, nanosec=0), frame_id=frame_id, **sequence
    )
    layout = [field(name=n, offset=4 * k, datatype=7, count=1) for k, n in enumerate("xyz")]
    layout += [field(name="f", offset=12, datatype=7, count=1)] * (fields - 3)
    rows = np.ones((POINTS, 4), np.float32)
    message = types[CLOUD](
        header=header,
        height=1,
        width=POINTS,
        fields=layout,
        is_bigendian=False,
        point_step=16,
        row_step=16 * POINTS,
        data=rows.view(np.uint8).reshape(-1),
        is_dense=True,
    )
    store = STORES[encoding]
    serialize = store.serialize_cdr if encoding == "cdr" else store.serialize_ros1
    return bytes(serialize(message, CLOUD))


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
@pytest.mark.parametrize("frame_id", ["", "lidar", "lidar_of_7"])
def test_large_clouds_are_decoded_unless_they_are_all_fields(encoding: str, frame_id: str) -> None:
    [frame], problems = decoded(CLOUD, encoding, cloud(encoding, 3, frame_id))
    assert isinstance(frame, LidarFrame)
    assert len(frame.points) == POINTS
    assert problems == []
    frames, [problem] = decoded(CLOUD, encoding, cloud(encoding, 2000, frame_id))
    assert frames == []
    assert "it claims 2000 fields of its points" in problem


def test_a_large_message_of_another_definition_is_refused() -> None:
    """Its fields might be anything."""
    own = b"std_msgs/Header header\nuint32[] height\nuint8[] data\n"
    definition = Definition(CLOUD, "ros2msg", own)
    frames, [problem] = decoded(CLOUD, "cdr", bytes(LARGE + 1), definition)
    assert frames == []
    assert "too many for the definition in the log" in problem


def test_a_large_message_with_the_definition_of_ros_is_decoded() -> None:
    text = STORES["cdr"].generate_msgdef(CLOUD, ros_version=2)[0].encode()
    [frame], problems = decoded(CLOUD, "cdr", cloud("cdr", 3), Definition(CLOUD, "ros2msg", text))
    assert (len(frame.points), problems) == (POINTS, [])


def test_large_transforms_are_refused() -> None:
    data = b"\0\1\0\0" + struct.pack("<I", 1 << 17) + bytes(LARGE)
    frames, [problem] = decoded("tf2_msgs/msg/TFMessage", "cdr", data)
    assert frames == []
    assert "too many for its type" in problem


def test_large_json_is_refused_for_its_values_only() -> None:
    data = json.dumps({"data": "A" * 2 * LARGE}).encode()
    frames, problems = decoded("foxglove.PointCloud", "json", data)
    assert (len(frames), problems) == (1, [])  # without points, as it names no fields
    _, [problem] = decoded("foxglove.PointCloud", "json", b'{"a":[' + b"{}," * LARGE + b"{}]}")
    assert "hold more than 2000000 values" in problem


def test_large_protobuf_is_refused_for_its_fields_only() -> None:
    def definition(message: Any) -> Definition:
        text = build_file_descriptor_set(message).SerializeToString()
        return Definition(message.DESCRIPTOR.full_name, "protobuf", text)

    message = PointCloud_pb2.PointCloud(frame_id="l", point_stride=16)
    for k, name in enumerate("xyz"):
        message.fields.add(name=name, offset=4 * k, type=7)
    message.pose.orientation.w = 1
    message.data = np.ones((POINTS, 4), np.float32).tobytes()
    known = definition(PointCloud_pb2.PointCloud)
    [frame], problems = decoded(
        "foxglove.PointCloud", "protobuf", message.SerializeToString(), known
    )
    assert (len(frame.points), problems) == (POINTS, [])
    bomb = b"\x2a\0" * LARGE  # a field of points without content, in two bytes
    frames, [problem] = decoded("foxglove.PointCloud", "protobuf", bomb, known)
    assert frames == []
    assert "hold too many fields" in problem
    edges = definition(FrameTransforms_pb2.FrameTransforms)
    _, [problem] = decoded("foxglove.FrameTransforms", "protobuf", b"\x0a\0" * LARGE, edges)
    assert "too many for its type" in problem
