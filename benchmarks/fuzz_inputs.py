"""Inputs of the fuzzer: a valid message of every type that can be decoded, in every encoding; small
logs; and ways to damage them.
"""

from __future__ import annotations

import base64
import json
import random
import struct
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from foxglove_schemas_protobuf import (
    CameraCalibration_pb2,
    CompressedImage_pb2,
    FrameTransform_pb2,
    FrameTransforms_pb2,
    LocationFix_pb2,
    PointCloud_pb2,
    PoseInFrame_pb2,
    RawImage_pb2,
)
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from semloc_logs.logs.log import Definition, Message
from semloc_logs.logs.messages.decode import CONVERTERS

ROS2 = get_typestore(Stores.ROS2_HUMBLE)
ROS1 = get_typestore(Stores.ROS1_NOETIC)
_LIVOX_POINT = """uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""
_LIVOX = """std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
CustomPoint[] points
"""
for _store in (ROS2, ROS1):
    for _package in ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces"):
        _store.register(get_types_from_msg(_LIVOX_POINT, f"{_package}/msg/CustomPoint"))
        _store.register(get_types_from_msg(_LIVOX, f"{_package}/msg/CustomMsg"))
ROS1.register({n: f for n, f in ROS2.fielddefs.items() if n == "tf2_msgs/msg/TFMessage"})
ROS1.register({"tf/msg/tfMessage": ROS2.fielddefs["tf2_msgs/msg/TFMessage"]})

_PNG16 = bytes(cv2.imencode(".png", np.arange(64, dtype=np.uint16).reshape(8, 8) * 300)[1])
_JPEG = bytes(cv2.imencode(".jpg", np.arange(768, dtype=np.uint8).reshape(16, 16, 3))[1])
_RVL = struct.pack("<iffIII", 0, 100.0, 1.0, 3, 2, 0x60000000)
_PICTURES = [
    ("png", _PNG16),
    ("jpeg", _JPEG),
    ("32FC1; compressedDepth", _RVL[:12] + _PNG16),
    ("16UC1; compressedDepth rvl", _RVL),
]


def _ros(store: Any, name: str, **values: Any) -> Any:
    """A message whose values are small but not empty."""
    fields = store.fielddefs[name][1]
    return store.types[name](
        **{f: values[f] if f in values else _value(store, kind) for f, kind in fields}
    )


def _value(store: Any, field: Any) -> Any:
    kind, content = field
    if kind == Nodetype.NAME:
        return _ros(store, content)
    if kind == Nodetype.BASE:
        return "frame" if content[0] == "string" else False if content[0] == "bool" else 1
    (inner, what), length = content
    if inner == Nodetype.BASE and what[0] != "string":
        return np.ones(
            length or 5,
            {"float64": "f8", "float32": "f4", "byte": "u1", "bool": "?"}.get(what[0], what[0]),
        )
    return [_value(store, (inner, what)) for _ in range(length or 2)]


def _ros_messages(store: Any) -> Iterator[tuple[str, Any]]:
    for name in CONVERTERS:
        if name.startswith("foxglove.") or name not in store.fielddefs:
            continue
        if name.endswith("/PointCloud2"):
            field = store.types["sensor_msgs/msg/PointField"]
            fields = [
                field(name=n, offset=4 * k, datatype=d, count=1)
                for k, (n, d) in enumerate(zip("xyzt", (7, 7, 7, 6), strict=True))
            ]
            data = np.arange(96, dtype=np.uint8)
            yield (
                "/points",
                _ros(
                    store,
                    name,
                    height=2,
                    width=3,
                    fields=fields,
                    point_step=16,
                    row_step=48,
                    data=data,
                ),
            )
        elif name.endswith("/Image"):
            for topic, encoding, size in (
                ("/image", "rgb8", 3),
                ("/depth", "16UC1", 2),
                ("/depth", "32FC1", 4),
                ("/bayer", "bayer_rggb8", 1),
            ):
                data = np.arange(16 * size, dtype=np.uint8)
                yield (
                    topic,
                    _ros(
                        store, name, height=4, width=4, step=4 * size, encoding=encoding, data=data
                    ),
                )
        elif name.endswith("/CompressedImage"):
            for format_, content in _PICTURES:
                topic = "/depth/compressedDepth" if "Depth" in format_ else "/image/compressed"
                yield (
                    topic,
                    _ros(store, name, format=format_, data=np.frombuffer(content, np.uint8)),
                )
        elif name.endswith("/CustomMsg"):
            points = [_ros(store, name.replace("CustomMsg", "CustomPoint")) for _ in range(4)]
            yield "/livox", _ros(store, name, points=points)
        else:
            yield "/" + name.rpartition("/")[2].lower(), _ros(store, name)


def _foxglove() -> Iterator[Any]:
    cloud = PointCloud_pb2.PointCloud(frame_id="l", point_stride=16, data=bytes(range(96)))
    cloud.pose.orientation.w = 1
    for k, (name, kind) in enumerate(zip("xyzt", (7, 7, 7, 5), strict=True)):
        cloud.fields.add(name=name, offset=4 * k, type=kind)
    yield cloud
    yield RawImage_pb2.RawImage(
        width=4, height=4, step=12, encoding="rgb8", data=bytes(48), frame_id="c"
    )
    yield RawImage_pb2.RawImage(
        width=4, height=4, step=8, encoding="16UC1", data=bytes(32), frame_id="c"
    )
    for format_, content in _PICTURES[:2]:
        yield CompressedImage_pb2.CompressedImage(format=format_, data=content, frame_id="c")
    yield CameraCalibration_pb2.CameraCalibration(
        width=4, height=4, K=[9, 0, 2, 0, 9, 2, 0, 0, 1], D=[0.1] * 5, P=[1] * 12, R=[1] * 9
    )
    pose = PoseInFrame_pb2.PoseInFrame(frame_id="odom")
    pose.pose.position.x, pose.pose.orientation.w = 1, 1
    yield pose
    edge = FrameTransform_pb2.FrameTransform(parent_frame_id="a", child_frame_id="b")
    edge.translation.x, edge.rotation.w = 1, 1
    yield edge
    yield FrameTransforms_pb2.FrameTransforms(transforms=[edge, edge])
    yield LocationFix_pb2.LocationFix(latitude=47, longitude=8, altitude=400, frame_id="g")


def _as_json(message: Any) -> Any:
    """As Foxglove writes JSON: bytes in base64, times as sec and nsec, enumerations as numbers."""
    if message.DESCRIPTOR.full_name == "google.protobuf.Timestamp":
        return {"sec": message.seconds, "nsec": message.nanos}
    out: dict[str, Any] = {}
    for field, value in message.ListFields():
        many = hasattr(value, "__len__") and not isinstance(value, str | bytes)
        items = [_item(v) for v in (value if many else [value])]
        out[field.name] = items if many else items[0]
    return out


def _item(value: Any) -> Any:
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    return _as_json(value) if hasattr(value, "DESCRIPTOR") else value


@cache
def messages() -> list[tuple[str, Message]]:
    """(name, message) of every type and encoding, with and without a definition where both work."""
    found = []
    for encoding, store, language in (("cdr", ROS2, "ros2msg"), ("ros1", ROS1, "ros1msg")):
        for topic, m in _ros_messages(store):
            name = m.__msgtype__
            data = bytes(
                store.serialize_cdr(m, name) if encoding == "cdr" else store.serialize_ros1(m, name)
            )
            text = store.generate_msgdef(name, ros_version=2 if encoding == "cdr" else 1)[
                0
            ].encode()
            definitions = (_NOTHING, Definition(name, language, text))
            found += [
                (f"{encoding} {name}", Message(topic, name, encoding, 1, data, d))
                for d in definitions
            ]
    for m in _foxglove():
        m.timestamp.FromNanoseconds(5) if "timestamp" in m.DESCRIPTOR.fields_by_name else None
        name = m.DESCRIPTOR.full_name
        definition = Definition(name, "protobuf", build_file_descriptor_set(m).SerializeToString())
        found.append(
            (
                f"protobuf {name}",
                Message("/t", name, "protobuf", 1, m.SerializeToString(), definition),
            )
        )
        text = json.dumps(_as_json(m)).encode()
        found.append((f"json {name}", Message("/t", name, "json", 1, text, _NOTHING)))
    return found


@cache
def logs() -> list[tuple[str, dict[str, bytes]]]:
    """(name, files) of small logs of every container."""
    out = []
    with tempfile.TemporaryDirectory() as folder:
        for compression in CompressionType:
            path = Path(folder) / "x.mcap"
            with path.open("wb") as file:
                writer = Writer(file, compression=compression, chunk_size=2000)
                writer.start("ros2")
                for k, (_, m) in enumerate(messages()):
                    if m.encoding == "ros1":
                        continue
                    schema = (
                        writer.register_schema(m.type, m.definition.encoding, m.definition.text)
                        if m.definition.text
                        else 0
                    )
                    writer.add_message(
                        writer.register_channel(f"{m.topic}{k}", m.encoding, schema),
                        k,
                        bytes(m.data),
                        k,
                    )
                writer.finish()
            out.append((f"mcap {compression.name}", {"x.mcap": path.read_bytes()}))
        for bag_compression in (None, *Writer1.CompressionFormat):
            path = Path(folder) / f"{bag_compression}.bag"
            bag = Writer1(path)
            if bag_compression is not None:
                bag.set_compression(bag_compression)
            with bag:
                for k, (topic, m1) in enumerate(_ros_messages(ROS1)):
                    connection = bag.add_connection(f"{topic}{k}", m1.__msgtype__, typestore=ROS1)
                    bag.write(connection, k, ROS1.serialize_ros1(m1, m1.__msgtype__))
            out.append((f"bag {bag_compression}", {"x.bag": path.read_bytes()}))
        for storage in StoragePlugin:
            path = Path(folder) / storage.name
            with Writer2(path, version=8, storage_plugin=storage) as bag2:
                for k, (topic, m2) in enumerate(_ros_messages(ROS2)):
                    connection2 = bag2.add_connection(f"{topic}{k}", m2.__msgtype__, typestore=ROS2)
                    bag2.write(connection2, k, ROS2.serialize_cdr(m2, m2.__msgtype__))
            out.append((f"bag2 {storage.name}", {p.name: p.read_bytes() for p in path.iterdir()}))
    return out


_NOTHING = Definition("", "", b"")
_WORDS = [
    b"\xff",
    b"\0",
    b"\xff" * 4,
    b"\0" * 4,
    b"\0\0\0\x7f",
    b"\xff\xff\xff\x7f",
    b"\xff" * 8,
    b"\0\0\0\x80",
    b"\1\0\0\0",
    b"A",
    b'"',
    b"}",
    b"-1",
]
_WORDS += [struct.pack("<d", v) for v in (float("nan"), float("inf"), -1e308, 1e-308)] + [
    struct.pack("<f", v) for v in (float("nan"), 1e38)
]


def damage(rng: random.Random, content: bytes) -> bytes:
    """Bytes overwritten, bits flipped, pieces cut out, doubled or moved, the end cut off."""
    found = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        if not found:
            break
        at = rng.randrange(len(found))
        action = rng.random()
        if action < 0.45:
            word = rng.choice(_WORDS)
            found[at : at + len(word)] = word
        elif action < 0.7:
            found[at] ^= 1 << rng.randrange(8)
        elif action < 0.8:
            found[at : at + rng.randint(1, 40)] = b""
        elif action < 0.9:
            piece = found[at : at + rng.randint(1, 64)]
            where = rng.randrange(len(found) + 1)
            found[where:where] = piece
        else:
            del found[at:]
    return bytes(found)


def layout(rng: random.Random) -> Message:
    """A PointCloud2 with any fields, steps and sizes, nearly always beyond reason, and nearly
    always complete.
    """
    store, encoding = rng.choice([(ROS2, "cdr"), (ROS1, "ros1")])
    names = [
        "x",
        "y",
        "z",
        "t",
        "time",
        "timestamp",
        "ring",
        "label",
        "X",
        "",
        "offset_time",
        "a" * 300,
    ]
    field = store.types["sensor_msgs/msg/PointField"]
    numbers = [0, 1, 3, 4, 8, 12, 16, 17, 24, 48, 255, 65535, 2**31 - 1, 2**31, 2**32 - 1]
    fields = [
        field(
            name=n,
            offset=rng.choice(numbers[:10] if rng.random() < 0.9 else numbers),
            datatype=rng.randrange(10),
            count=rng.choice(numbers),
        )
        for n in rng.sample(names, rng.randint(0, len(names)))
    ]
    if rng.random() < 0.7:
        kinds = [rng.choice((7, 8)) for _ in range(3)]
        fields[:0] = [
            field(name=n, offset=rng.choice((0, 4, 8, 9, 12, 16)), datatype=k, count=1)
            for n, k in zip("xyz", kinds, strict=True)
        ]
    step = rng.choice(numbers)
    width = rng.choice(numbers[:9] if rng.random() < 0.8 else numbers)
    height = rng.choice(numbers[:5])
    row = rng.choice([step * width % 2**32, *numbers])
    size = rng.choice([step * width * height, row * height, *numbers[:11]])
    data = np.frombuffer(rng.randbytes(min(size, 70_000)), np.uint8)
    stamp = store.types["builtin_interfaces/msg/Time"](
        sec=rng.choice([0, 1, 1_700_000_000, 2**31 - 1]), nanosec=rng.choice(numbers)
    )
    header = _ros(store, "std_msgs/msg/Header", stamp=stamp)
    given = {
        "height": height,
        "width": width,
        "fields": fields,
        "is_bigendian": rng.random() < 0.3,
        "point_step": step,
        "row_step": row,
    }
    name = "sensor_msgs/msg/PointCloud2"
    m = _ros(store, name, header=header, data=data, is_dense=rng.random() < 0.5, **given)
    content = bytes(
        store.serialize_cdr(m, name) if encoding == "cdr" else store.serialize_ros1(m, name)
    )
    return Message("/points", name, encoding, 1, content, _NOTHING)
