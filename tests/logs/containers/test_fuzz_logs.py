"""Whatever the bytes: frames come out, or a LogError."""

from __future__ import annotations

import contextlib
import json
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from semloc_logs.errors import LogError
from semloc_logs.logs.containers.open import open_log
from semloc_logs.logs.log import Definition, Message
from semloc_logs.logs.messages.decode import Decoder
from semloc_logs.logs.problems import Problem, Problems, sentences

ROS2 = get_typestore(Stores.ROS2_HUMBLE)
ROS1 = get_typestore(Stores.ROS1_NOETIC)
HURRY = settings(max_examples=15, suppress_health_check=list(HealthCheck))


def ros_messages(store: Any) -> dict[str, Any]:
    """A message of each kind whose bytes hold their size."""
    t = store.types
    head = {"seq": 0} if store is ROS1 else {}
    header = t["std_msgs/msg/Header"](
        stamp=t["builtin_interfaces/msg/Time"](sec=1, nanosec=2), frame_id="f", **head
    )
    field = t["sensor_msgs/msg/PointField"]
    fields = [field(name=n, offset=4 * k, datatype=7, count=1) for k, n in enumerate("xyzt")]
    data = np.arange(64, dtype=np.uint8)
    layout = {
        "height": 1,
        "width": 4,
        "fields": fields,
        "is_bigendian": False,
        "point_step": 16,
        "row_step": 64,
    }
    png = np.array(cv2.imencode(".png", np.full((4, 4), 900, np.uint16))[1]).reshape(-1)
    jpeg = np.array(cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1]).reshape(-1)
    rvl = np.frombuffer(struct.pack("<iffIII", 0, 0, 0, 3, 2, 0x60000000), np.uint8)
    compressed = t["sensor_msgs/msg/CompressedImage"]
    image = t["sensor_msgs/msg/Image"]
    size = {"height": 4, "width": 4, "is_bigendian": 0}
    rotation = t["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    transform = t["geometry_msgs/msg/Transform"](
        translation=t["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0), rotation=rotation
    )
    edge = t["geometry_msgs/msg/TransformStamped"](
        header=header, child_frame_id="c", transform=transform
    )
    messages = {
        "/cloud": t["sensor_msgs/msg/PointCloud2"](
            header=header, data=data, is_dense=True, **layout
        ),
        "/image": image(header=header, encoding="rgb8", step=16, data=data, **size),
        "/depth": image(header=header, encoding="16UC1", step=8, data=data[:32], **size),
        "/bayer": image(header=header, encoding="bayer_rggb8", step=4, data=data[:16], **size),
        "/png": compressed(header=header, format="png", data=png),
        "/jpeg": compressed(header=header, format="jpeg", data=jpeg),
        "/d/compressedDepth": compressed(
            header=header, format="32FC1; compressedDepth", data=np.concatenate([data[:12], png])
        ),
        "/r/compressedDepth": compressed(
            header=header, format="16UC1; compressedDepth rvl", data=rvl
        ),
        "/pose": edge,
    }
    if store is ROS2:
        messages["/tf"] = t["tf2_msgs/msg/TFMessage"](transforms=[edge, edge])
    return messages


@cache
def recorded(kind: str) -> dict[str, bytes]:
    """The files of a small log, by name."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x"
        if kind == "rosbag1":
            with Writer1(path) as bag1:
                for k, (topic, message) in enumerate(ros_messages(ROS1).items()):
                    connection = bag1.add_connection(topic, message.__msgtype__, typestore=ROS1)
                    bag1.write(connection, k, ROS1.serialize_ros1(message, message.__msgtype__))
            return {"x.bag": path.read_bytes()}
        if kind == "rosbag2":
            with Writer2(path, version=8, storage_plugin=StoragePlugin.SQLITE3) as bag2:
                for k, (topic, message) in enumerate(ros_messages(ROS2).items()):
                    connection2 = bag2.add_connection(topic, message.__msgtype__, typestore=ROS2)
                    bag2.write(connection2, k, ROS2.serialize_cdr(message, message.__msgtype__))
            return {p.name: p.read_bytes() for p in path.iterdir()}
        writer = Writer(
            str(path),
            compression=CompressionType.NONE if kind == "mcap" else CompressionType.ZSTD,
            chunk_size=1500,
        )
        writer.start("ros2")
        for k, (topic, message) in enumerate(ros_messages(ROS2).items()):
            text = ROS2.generate_msgdef(message.__msgtype__, ros_version=2)[0].encode()
            channel = writer.register_channel(
                topic, "cdr", writer.register_schema(message.__msgtype__, "ros2msg", text)
            )
            data = bytes(ROS2.serialize_cdr(message, message.__msgtype__))
            writer.add_message(channel, log_time=k, publish_time=k, data=data)
        writer.finish()  # type: ignore[no-untyped-call]
        return {"x.mcap": path.read_bytes()}


def damaged(data: st.DataObject, content: bytes) -> bytes:
    """Some bytes overwritten, and perhaps the end or a piece cut out."""
    out = bytearray(content)
    for _ in range(data.draw(st.integers(0, 4))):
        start = data.draw(st.integers(0, len(out) - 1))
        value = data.draw(
            st.sampled_from([b"\xff", b"\0", b"\xff" * 4, b"\0\0\0\x7f", b"\xff" * 8, b"A"])
            | st.binary(min_size=1, max_size=8)
        )
        out[start : start + len(value)] = value
    cut = data.draw(st.sampled_from(["", "", "end", "piece"]))
    if cut:
        start = data.draw(st.integers(0, len(out)))
        out[start : start + data.draw(st.integers(1, 40)) if cut == "piece" else len(out)] = b""
    return bytes(out)


@pytest.mark.parametrize("kind", ["mcap", "mcap zstd", "rosbag1", "rosbag2"])
@HURRY
@given(data=st.data())
def test_damaged_logs(kind: str, data: st.DataObject) -> None:
    files = recorded(kind)
    with tempfile.TemporaryDirectory() as folder:
        for name, content in files.items():
            Path(folder, name).write_bytes(damaged(data, content))
        path = Path(folder) if kind == "rosbag2" else Path(folder, next(iter(files)))
        with contextlib.suppress(LogError):
            log = open_log(path)
            times = [m.log_time_ns for m in log.messages()]
            # a damaged index may lie about times
            assert times == sorted(times) or kind.startswith(("mcap", "rosbag1"))
            list(log.frames())
            assert all(isinstance(p, Problem) for p in log.problems)
            log.close()


def payloads() -> Iterator[tuple[str, str, str, bytes]]:
    for encoding, store in (("cdr", ROS2), ("ros1", ROS1)):
        for topic, message in ros_messages(store).items():
            serialize = store.serialize_cdr if encoding == "cdr" else store.serialize_ros1
            yield (
                topic,
                message.__msgtype__,
                encoding,
                bytes(serialize(message, message.__msgtype__)),
            )
    cloud = {
        "timestamp": {"sec": 1, "nsec": 2},
        "frame_id": "f",
        "point_stride": 12,
        "data": "AACAPwAAgD8AAIA/",
    }
    cloud["fields"] = [{"name": n, "offset": 4 * k, "type": 7} for k, n in enumerate("xyz")]
    yield "/c", "foxglove.PointCloud", "json", json.dumps(cloud).encode()
    image = {"width": 2, "height": 1, "step": 2, "encoding": "mono8", "data": "AAE="}
    yield "/i", "foxglove.RawImage", "json", json.dumps(image).encode()


PAYLOADS = {
    f"{encoding} {topic}": (topic, type_, encoding, content)
    for topic, type_, encoding, content in payloads()
}


@pytest.mark.parametrize("name", PAYLOADS)
@HURRY
@given(data=st.data())
def test_damaged_messages(name: str, data: st.DataObject) -> None:
    topic, type_, encoding, content = PAYLOADS[name]
    decoder = decoder_of(name)
    decoder.frames(Message(topic, type_, encoding, 1, damaged(data, content), NOTHING))


NOTHING = Definition("", "", b"")


@cache
def decoder_of(name: str) -> Decoder:
    decoder = Decoder(Problems())
    assert decoder.frames(Message(*PAYLOADS[name][:3], 1, PAYLOADS[name][3], NOTHING)), name
    return decoder


@HURRY
@given(
    value=st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
        lambda inner: (
            st.lists(inner, max_size=3)
            | st.dictionaries(st.sampled_from(["timestamp", "sec", "pose", "x", "data"]), inner)
        ),
        max_leaves=8,
    ),
    name=st.sampled_from(
        [
            "timestamp",
            "frame_id",
            "data",
            "fields",
            "point_stride",
            "pose",
            "width",
            "K",
            "transforms",
            "latitude",
        ]
    ),
    type_=st.sampled_from(
        [
            "PointCloud",
            "RawImage",
            "CompressedImage",
            "CameraCalibration",
            "FrameTransforms",
            "LocationFix",
        ]
    ),
)
def test_json_of_any_shape(value: Any, name: str, type_: str) -> None:
    data = json.dumps({name: value}).encode()
    Decoder(Problems()).frames(Message("/t", f"foxglove.{type_}", "json", 1, data, NOTHING))


def test_some_seeds_of_the_fuzzer(repository: Path, tmp_path: Path) -> None:
    """Every message type in every encoding, and layouts of clouds; `make fuzz` runs longer."""
    command = [
        sys.executable,
        "-P",
        str(repository / "benchmarks" / "fuzz.py"),
        "--seed",
        "5000000",
        "--count",
        "400",
    ]
    done = subprocess.run(
        [*command, "--keep", str(tmp_path / "found")], capture_output=True, text=True, timeout=55
    )
    assert done.returncode == 0, done.stdout
    assert "400 inputs, 0 findings" in done.stdout


@pytest.mark.parametrize("type_", ["livox_ros_driver/msg/CustomMsg", "sensor_msgs/msg/PointCloud2"])
def test_definitions_that_cannot_be_parsed_are_named(type_: str) -> None:
    problems = Problems()
    broken = Definition(type_, "ros2msg", b"uint8[ x\n==\nMSG: y\n")
    assert Decoder(problems).frames(Message("/t", type_, "cdr", 1, b"\0\1\0\0", broken)) == []
    assert "definition in the log" in sentences(problems)[0]


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_lists_of_elements_without_content_are_refused(encoding: str) -> None:
    """Four bytes would claim as many objects as memory holds."""
    problems = Problems()
    text = b"E[] transforms\n" + b"=" * 80 + b"\nMSG: tf2_msgs/E\n"
    definition = Definition("", "ros1msg" if encoding == "ros1" else "ros2msg", text)
    data = (b"" if encoding == "ros1" else b"\0\1\0\0") + struct.pack("<I", 2**31)
    assert (
        Decoder(problems).frames(
            Message("/tf", "tf2_msgs/msg/TFMessage", encoding, 1, data, definition)
        )
        == []
    )
    assert "have no content" in sentences(problems)[0]
