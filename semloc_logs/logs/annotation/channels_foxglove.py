"""Our messages as protobuf, or as the JSON that Foxglove defines for the same schemas."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any, Literal

import numpy as np
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.message import Message
from mcap_protobuf.schema import build_file_descriptor_set

from semloc_logs.arrays import F64
from semloc_logs.logs.annotation.channels import Kind, NewChannel
from semloc_logs.logs.annotation.closure_record import ClosureRecord
from semloc_logs.logs.annotation.markers import Marker, MarkerGroup, Shape
from semloc_logs.logs.annotation.scene import Cloud, Colour, StampedPose, Transform
from semloc_logs.numerics.transforms import translation_quaternion
from semloc_logs.schemas import read_text

_STRING = FieldDescriptor.TYPE_STRING
_INT64 = FieldDescriptor.TYPE_INT64
_INT32 = FieldDescriptor.TYPE_INT32
_DOUBLE = FieldDescriptor.TYPE_DOUBLE
# the fields of schemas/messages/LoopClosure.proto after the timestamp, by their numbers
_FIELDS = (
    ("query_session", _STRING),
    ("target_session", _STRING),
    ("query_stamp_ns", _INT64),
    ("target_stamp_ns", _INT64),
    *(
        (name, _DOUBLE)
        for name in (
            "t_x",
            "t_y",
            "t_z",
            "q_x",
            "q_y",
            "q_z",
            "q_w",
            "covariance",
            "overlap",
            "probability",
        )
    ),
    ("inliers", _INT32),
    ("words", _INT32),
)


class FoxgloveEncoder:
    """Messages with ``encoding`` protobuf or json."""

    def __init__(self, encoding: Literal["protobuf", "json"]) -> None:
        self.encoding = encoding

    def channel(self, topic: str, kind: Kind, metadata: Mapping[str, str]) -> NewChannel:
        message = _class_of(kind)
        name = message.DESCRIPTOR.full_name
        if self.encoding == "protobuf":
            data = build_file_descriptor_set(message).SerializeToString(deterministic=True)
            return NewChannel(topic, self.encoding, name, "protobuf", data, metadata)
        if kind is Kind.CLOSURE:
            data = read_text("messages/LoopClosure.json").encode()
        else:
            data = json.dumps({"title": name, **json_schema(message.DESCRIPTOR)}).encode()
        return NewChannel(topic, self.encoding, name, "jsonschema", data, metadata)

    def loop_closure(self, closure: ClosureRecord, stamp_ns: int) -> bytes:
        return self._bytes(loop_closure_class()(timestamp=_time(stamp_ns), **closure.columns()))

    def pose(self, pose: StampedPose) -> bytes:
        message = PoseInFrame(timestamp=_time(pose.stamp_ns), frame_id=pose.frame_id)
        _set_pose(message.pose, *translation_quaternion(pose.frame_T_base))
        return self._bytes(message)

    def cloud(self, cloud: Cloud, stamp_ns: int) -> bytes:
        rows = cloud.rows(("blue", "green", "red", "alpha", "label"))
        rows["alpha"] = 255
        message = PointCloud(
            timestamp=_time(stamp_ns),
            frame_id=cloud.frame_id,
            point_stride=rows.itemsize,
            data=rows.tobytes(),
        )
        _set_pose(message.pose, np.zeros(3))
        for name, (kind, offset, *_) in (rows.dtype.fields or {}).items():
            is_byte = kind == np.uint8
            element = PackedElementField.UINT8 if is_byte else PackedElementField.FLOAT32
            message.fields.add(name=name, offset=offset, type=element)
        return self._bytes(message)

    def markers(self, groups: Sequence[MarkerGroup]) -> bytes:
        update = SceneUpdate()
        for group in groups:
            entity = update.entities.add(
                timestamp=_time(group.stamp_ns), frame_id=group.frame_id, id=group.name
            )
            entity.lifetime.SetInParent()  # zero: stays
            entity.frame_locked = True
            for marker in group.markers:
                _add_marker(entity, marker)
        return self._bytes(update)

    def transforms(self, transforms: Sequence[Transform]) -> bytes:
        message = FrameTransforms()
        for transform in transforms:
            (x, y, z), (qx, qy, qz, qw) = translation_quaternion(transform.parent_T_child)
            message.transforms.add(
                timestamp=_time(transform.stamp_ns),
                parent_frame_id=transform.parent,
                child_frame_id=transform.child,
                translation={"x": float(x), "y": float(y), "z": float(z)},
                rotation={"x": float(qx), "y": float(qy), "z": float(qz), "w": float(qw)},
            )
        return self._bytes(message)

    def _bytes(self, message: Message) -> bytes:
        if self.encoding == "protobuf":
            return bytes(message.SerializeToString(deterministic=True))
        return json.dumps(_json_value(message), allow_nan=False).encode()


def _add_marker(entity: SceneEntity, marker: Marker) -> None:
    colors = [_color(color) for color in marker.colors or (marker.color,)]
    if marker.shape in (Shape.SPHERE, Shape.SPHERES):
        for position, color in zip(marker.points, colors, strict=True):
            sphere = entity.spheres.add(size=dict.fromkeys("xyz", marker.size), color=color)
            _set_pose(sphere.pose, position)
    elif marker.shape is Shape.TEXT:
        text = entity.texts.add(
            billboard=True, font_size=marker.size, color=colors[0], text=marker.text
        )
        _set_pose(text.pose, marker.points[0])
    else:
        is_strip = marker.shape is Shape.LINE_STRIP
        line = entity.lines.add(
            type=LinePrimitive.LINE_STRIP if is_strip else LinePrimitive.LINE_LIST,
            thickness=marker.size,
            points=_points(marker.points),
            color=None if marker.colors else colors[0],
            colors=colors if marker.colors else (),
        )
        _set_pose(line.pose, np.zeros(3))


def _class_of(kind: Kind) -> Any:
    classes = {
        Kind.POSE: PoseInFrame,
        Kind.MARKERS: SceneUpdate,
        Kind.TRANSFORMS: FrameTransforms,
        Kind.CLOUD: PointCloud,
    }
    return loop_closure_class() if kind is Kind.CLOSURE else classes[kind]


@cache
def loop_closure_class() -> Any:
    """The protobuf class of schemas/messages/LoopClosure.proto."""
    file = descriptor_pb2.FileDescriptorProto(
        name="semloc/LoopClosure.proto", package="semloc", syntax="proto3"
    )
    file.dependency.append(timestamp_pb2.DESCRIPTOR.name)
    message = file.message_type.add(name="LoopClosure")
    once = FieldDescriptor.LABEL_OPTIONAL
    many = FieldDescriptor.LABEL_REPEATED
    message.field.add(
        name="timestamp",
        number=1,
        label=once,
        type=FieldDescriptor.TYPE_MESSAGE,
        type_name=".google.protobuf.Timestamp",
    )
    for number, (name, kind) in enumerate(_FIELDS, 2):
        message.field.add(
            name=name, number=number, label=many if name == "covariance" else once, type=kind
        )
    pool = descriptor_pool.Default()
    pool.AddSerializedFile(file.SerializeToString())
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("semloc.LoopClosure"))


def json_schema(descriptor: Descriptor) -> dict[str, Any]:
    """JSON Schema of a protobuf message in Foxglove's JSON.

    Times are sec and nsec, enumerations numbers, bytes base64.
    """
    if descriptor.full_name in ("google.protobuf.Timestamp", "google.protobuf.Duration"):
        title = "time" if descriptor.name == "Timestamp" else "duration"
        return {
            "type": "object",
            "title": title,
            "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
        }
    properties = {}
    for field in descriptor.fields:
        one = _json_field_schema(field)
        properties[field.name] = {"type": "array", "items": one} if _is_repeated(field) else one
    return {"type": "object", "properties": properties}


def _json_field_schema(field: FieldDescriptor) -> dict[str, Any]:
    if field.message_type is not None:
        return json_schema(field.message_type)
    if field.enum_type is not None:
        return {"oneOf": [{"title": v.name, "const": v.number} for v in field.enum_type.values]}
    if field.type == FieldDescriptor.TYPE_BYTES:
        return {"type": "string", "contentEncoding": "base64"}
    kinds = {
        FieldDescriptor.CPPTYPE_STRING: "string",
        FieldDescriptor.CPPTYPE_BOOL: "boolean",
        FieldDescriptor.CPPTYPE_DOUBLE: "number",
        FieldDescriptor.CPPTYPE_FLOAT: "number",
    }
    return {"type": kinds.get(field.cpp_type, "integer")}


def _is_repeated(field: FieldDescriptor) -> bool:
    if hasattr(field, "is_repeated"):  # protobuf 6.31 and later, where label is deprecated
        return bool(field.is_repeated)
    return bool(field.label == FieldDescriptor.LABEL_REPEATED)


def _json_value(message: Message) -> dict[str, Any]:
    """A message as Foxglove's JSON, every field present."""
    if message.DESCRIPTOR.full_name in ("google.protobuf.Timestamp", "google.protobuf.Duration"):
        return {"sec": message.seconds, "nsec": message.nanos}
    out = {}
    for field in message.DESCRIPTOR.fields:
        value = getattr(message, field.name)
        out[field.name] = (
            [_json_item(v) for v in value] if _is_repeated(field) else _json_item(value)
        )
    return out


def _json_item(value: Any) -> Any:
    if isinstance(value, Message):
        return _json_value(value)
    return base64.b64encode(value).decode() if isinstance(value, bytes) else value


def _time(stamp_ns: int) -> timestamp_pb2.Timestamp:
    sec, nanos = divmod(stamp_ns, 10**9)
    return timestamp_pb2.Timestamp(seconds=sec, nanos=nanos)


def _color(color: Colour) -> dict[str, float]:
    return dict(zip("rgba", color, strict=True))


def _points(positions: Iterable[F64]) -> list[Point3]:
    return [Point3(x=float(x), y=float(y), z=float(z)) for x, y, z in positions]


def _set_pose(
    pose: Pose, position: F64, quaternion: F64 | tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)
) -> None:
    pose.position.x, pose.position.y, pose.position.z = (float(v) for v in position)
    q = pose.orientation
    q.x, q.y, q.z, q.w = (float(v) for v in quaternion)
