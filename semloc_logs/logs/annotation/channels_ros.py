"""Our messages as ROS 1 or ROS 2 messages with embedded definitions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from semloc_logs.arrays import F64
from semloc_logs.logs.annotation.channels import Kind, NewChannel
from semloc_logs.logs.annotation.closure_record import ClosureRecord
from semloc_logs.logs.annotation.markers import Marker, MarkerGroup, Shape
from semloc_logs.logs.annotation.scene import Cloud, Colour, StampedPose, Transform
from semloc_logs.numerics.transforms import translation_quaternion
from semloc_logs.schemas import read_text

CLOSURE = "semloc_msgs/msg/LoopClosure"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
MARKERS = "visualization_msgs/msg/MarkerArray"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
CLOUD = "sensor_msgs/msg/PointCloud2"
NAMES = {
    Kind.CLOSURE: CLOSURE,
    Kind.POSE: POSE,
    Kind.MARKERS: MARKERS,
    Kind.TRANSFORMS: TRANSFORMS,
    Kind.CLOUD: CLOUD,
}
_UINT8, _FLOAT32 = 2, 7  # values of sensor_msgs/PointField.datatype
# values of visualization_msgs/Marker.type, equal in ROS 1 and 2
_SHAPES = {
    Shape.SPHERE: 2,
    Shape.LINE_STRIP: 4,
    Shape.LINE_LIST: 5,
    Shape.SPHERES: 7,
    Shape.TEXT: 9,
}


class RosEncoder:
    """Messages of ROS ``version`` 1 or 2, with ``old_markers`` as in ROS 2 before Humble."""

    def __init__(self, version: int, *, old_markers: bool = False) -> None:
        self.version = version
        ros2 = Stores.ROS2_FOXY if old_markers else Stores.ROS2_HUMBLE
        self.store = _store(Stores.ROS1_NOETIC if version == 1 else ros2)

    def channel(self, topic: str, kind: Kind, metadata: Mapping[str, str]) -> NewChannel:
        encoding, schema_encoding = ("ros1", "ros1msg") if self.version == 1 else ("cdr", "ros2msg")
        name = NAMES[kind]
        shown = name if self.version == 2 else name.replace("/msg/", "/")
        definition = self._definition(name).encode()
        return NewChannel(topic, encoding, shown, schema_encoding, definition, metadata)

    def loop_closure(self, closure: ClosureRecord, stamp_ns: int) -> bytes:
        columns = closure.columns() | {"covariance": np.array(closure.covariance)}
        return self._bytes(self._new(CLOSURE, header=self._header(stamp_ns, ""), **columns))

    def pose(self, pose: StampedPose) -> bytes:
        inner = self._new(
            "geometry_msgs/msg/PoseWithCovariance",
            pose=self._pose(*translation_quaternion(pose.frame_T_base)),
            covariance=pose.covariance.reshape(36),
        )
        header = self._header(pose.stamp_ns, pose.frame_id)
        return self._bytes(self._new(POSE, header=header, pose=inner))

    def cloud(self, cloud: Cloud, stamp_ns: int) -> bytes:
        # rgb is a float whose bytes are blue, green, red, 0: as PCL has it
        rows = cloud.rows(("b", "g", "r", "zero", "label"))
        kinds = {"x": _FLOAT32, "y": _FLOAT32, "z": _FLOAT32, "rgb": _FLOAT32, "label": _UINT8}
        fields = [
            self.store.types["sensor_msgs/msg/PointField"](name, 4 * k, kind, 1)
            for k, (name, kind) in enumerate(kinds.items())
        ]
        data = np.frombuffer(rows.tobytes(), np.uint8)
        message = self._new(
            CLOUD,
            header=self._header(stamp_ns, cloud.frame_id),
            height=1,
            width=len(rows),
            fields=fields,
            point_step=rows.itemsize,
            row_step=len(data),
            data=data,
            is_dense=True,
        )
        return self._bytes(message)

    def markers(self, groups: Sequence[MarkerGroup]) -> bytes:
        markers = [
            self._marker(marker, group, self._header(group.stamp_ns, group.frame_id))
            for group in groups
            for marker in group.markers
        ]
        return self._bytes(self._new(MARKERS, markers=markers))

    def transforms(self, transforms: Sequence[Transform]) -> bytes:
        return self._bytes(
            self._new(TRANSFORMS, transforms=[self._transform(t) for t in transforms])
        )

    def _transform(self, transform: Transform) -> Any:
        position, quaternion = translation_quaternion(transform.parent_T_child)
        pose = self._pose(position, quaternion)
        moved = self._new(
            "geometry_msgs/msg/Vector3", x=pose.position.x, y=pose.position.y, z=pose.position.z
        )
        return self._new(
            "geometry_msgs/msg/TransformStamped",
            header=self._header(transform.stamp_ns, transform.parent),
            child_frame_id=transform.child,
            transform=self._new(
                "geometry_msgs/msg/Transform", translation=moved, rotation=pose.orientation
            ),
        )

    def _marker(self, marker: Marker, group: MarkerGroup, header: Any) -> Any:
        one_place = marker.shape in (Shape.SPHERE, Shape.TEXT)
        points = [] if one_place else [self._point(position) for position in marker.points]
        across = marker.size if marker.shape in (Shape.SPHERE, Shape.SPHERES) else 0.0
        scale = {
            "x": 0.0 if marker.shape is Shape.TEXT else marker.size,
            "y": across,
            "z": marker.size if marker.shape is Shape.TEXT else across,
        }
        return self._new(
            "visualization_msgs/msg/Marker",
            header=header,
            ns=marker.kind,
            id=group.number,
            type=_SHAPES[marker.shape],
            pose=self._place(marker.points[0] if one_place else np.zeros(3)),
            scale=self._new("geometry_msgs/msg/Vector3", **scale),
            color=self._color(marker.color),
            frame_locked=True,
            points=points,
            colors=[self._color(color) for color in marker.colors],
            text=marker.text,
        )

    def _color(self, color: Colour) -> Any:
        return self._new("std_msgs/msg/ColorRGBA", **dict(zip("rgba", color, strict=True)))

    def _place(self, position: F64) -> Any:
        """A pose without rotation."""
        return self._pose(position, np.array([0.0, 0.0, 0.0, 1.0]))

    def _pose(self, position: F64, quaternion: F64) -> Any:
        x, y, z, w = (float(v) for v in quaternion)
        turned = self._new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
        return self._new(
            "geometry_msgs/msg/Pose", position=self._point(position), orientation=turned
        )

    def _point(self, position: F64) -> Any:
        x, y, z = (float(v) for v in position)
        return self._new("geometry_msgs/msg/Point", x=x, y=y, z=z)

    def _header(self, stamp_ns: int, frame_id: str) -> Any:
        sec, nanosec = divmod(max(0, stamp_ns), 10**9)  # the exact stamps are in the columns
        stamp = self._new(
            "builtin_interfaces/msg/Time", sec=min(sec, (1 << 31) - 1), nanosec=nanosec
        )
        return self._new("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)

    def _new(self, name: str, **values: Any) -> Any:
        """A message with the given fields; what the definition has beyond them is empty or zero."""
        fields = self.store.fielddefs[name][1]
        return self.store.types[name](
            **{
                field: values[field] if field in values else self._empty(*kind)
                for field, kind in fields
            }
        )

    def _empty(self, kind: int, detail: Any) -> Any:
        if kind == Nodetype.NAME:
            return self._new(detail)
        if kind == Nodetype.BASE:
            return "" if detail[0] == "string" else False if detail[0] == "bool" else 0
        element, size = detail  # a sequence or an array
        return np.zeros(size, element[1][0]) if element[0] == Nodetype.BASE else []

    def _bytes(self, message: Any) -> bytes:
        name = message.__msgtype__
        write = self.store.serialize_ros1 if self.version == 1 else self.store.serialize_cdr
        return bytes(write(message, name))

    def _definition(self, name: str) -> str:
        """The definition of a message type with the definitions of the types in it, as MCAP wants
        it.
        """
        text, _ = self.store.generate_msgdef(name, ros_version=self.version)
        if name != CLOSURE:
            return str(text)
        separator = "=" * 80
        return (
            str(read_text("messages/LoopClosure.msg"))
            + separator
            + str(text).split(separator, 1)[1]
        )


@cache
def _store(distribution: Stores) -> Any:
    store = get_typestore(distribution)
    store.register(get_types_from_msg(read_text("messages/LoopClosure.msg"), CLOSURE))
    if TRANSFORMS not in store.types:  # as in ROS 1
        edges = "geometry_msgs/TransformStamped[] transforms"
        store.register(get_types_from_msg(edges, TRANSFORMS))
    return store
