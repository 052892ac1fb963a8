"""Messages with points: clouds of ROS 1, ROS 2, Foxglove and Livox."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.frames import Frame, Header, LidarFrame, PointTimeRemark
from semloc_logs.logs.log import Message
from semloc_logs.logs.messages import livox
from semloc_logs.logs.messages.definitions import UndecodableError, binary
from semloc_logs.logs.messages.headers import (
    Convert,
    check_time,
    foxglove,
    header_at,
    ros,
    transform,
    vector,
)
from semloc_logs.logs.messages.point_fields import Field, Layout, Points, decode_points, is_noise
from semloc_logs.logs.messages.point_times import LONGEST_SWEEP_NS, sweep_unit
from semloc_logs.numerics import transforms

# sensor_msgs/PointField
_POINT_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
# foxglove.PackedElementField
_FOXGLOVE_KINDS = {1: "u1", 2: "i1", 3: "u2", 4: "i2", 5: "u4", 6: "i4", 7: "f4", 8: "f8"}


def _point_cloud2(header: Header, m: Any) -> Iterator[Frame]:
    fields = _fields(((f.name, f.offset, f.datatype) for f in m.fields), _POINT_KINDS)
    layout = Layout(m.width, m.height, m.point_step, m.row_step, bool(m.is_bigendian))
    p = decode_points(binary(m.data), layout, fields, header.stamp_ns)
    yield replace(_sweep(header, p), lost=p.not_finite if m.is_dense else 0)


def _foxglove_cloud(header: Header, m: Any) -> Iterator[Frame]:
    step = int(m.point_stride or 0)
    data = binary(m.data)
    fields = _fields(
        ((str(f.name), int(f.offset or 0), f.type) for f in m.fields or ()), _FOXGLOVE_KINDS
    )
    count = len(data) // step if step > 0 else 0
    p = decode_points(data, Layout(count, 1, step, 0), fields, header.stamp_ns)
    points = p.points
    origin = None
    frame_T_cloud = _cloud_pose(m.pose)
    if not np.array_equal(frame_T_cloud, np.eye(4)):
        points = transforms.apply(frame_T_cloud, points).astype(np.float32)
        origin = frame_T_cloud[:3, 3].astype(np.float32)
    yield replace(_sweep(header, p), points=points, origin=origin)


def _fields(recorded: Iterable[tuple[str, int, Any]], kinds: Mapping[int, str]) -> list[Field]:
    """The fields of a point from (name, offset, type). UndecodableError for an axis of no type."""
    fields = []
    for name, offset, type_ in recorded:
        if type_ in kinds:
            fields.append(Field(name, offset, kinds[type_]))
        elif name.lower() in ("x", "y", "z"):
            raise UndecodableError(f"its field {name} has the unknown type {type_}")
    return fields


def _cloud_pose(pose: Any) -> F64:
    """``frame_T_cloud`` (4, 4); what a writer leaves out is 0, and no rotation."""
    out = np.eye(4)
    if pose is None:
        return out
    rotation = pose.orientation
    if rotation is not None and any((rotation.x, rotation.y, rotation.z, rotation.w)):
        zero = SimpleNamespace(x=0.0, y=0.0, z=0.0)
        return transform(zero if pose.position is None else pose.position, rotation)
    if pose.position is not None:
        out[:3, 3] = vector(pose.position)
    if not np.isfinite(out).all():
        raise UndecodableError("its pose has values that are not finite")
    return out


def _livox(m: Any, message: Message) -> Iterator[Frame]:
    header = header_at(check_time(m.sec * 1_000_000_000 + m.nanosec), m.frame_id, message)
    offset = m.points["offset_time"].astype(np.int64)
    unit = sweep_unit(offset)
    offset *= unit
    # the base of the times is the stamp unless the sensor has a clock of its own
    start = m.timebase_ns - header.stamp_ns
    if abs(start) < LONGEST_SWEEP_NS:
        offset += start
    xyz = np.stack([m.points[axis] for axis in "xyz"], axis=1).astype(np.float32)
    finite = np.isfinite(xyz).all(axis=1)
    kept = finite & ((xyz[:, 0] != 0) | (xyz[:, 1] != 0) | (xyz[:, 2] != 0))
    kept &= ~is_noise(m.points["tag"])
    yield LidarFrame(
        header,
        xyz[kept],
        None,
        offset[kept],
        m.points["line"][kept].astype(np.uint16),
        int((~finite).sum()),
        remark=None if unit == 1 else PointTimeRemark.OTHER_UNIT,
    )


def _old_cloud(header: Header, m: Any) -> Iterator[Frame]:
    """sensor_msgs/PointCloud: a list of points, and channels of float32 beside it."""
    channels = {str(c.name).lower(): np.asarray(c.values, np.float32) for c in m.channels}
    columns = {name: values for name, values in channels.items() if len(values) == len(m.points)}
    fields = [Field(n, 4 * k, "f4") for k, n in enumerate(("x", "y", "z", *columns))]
    rows = np.empty((len(m.points), len(fields)), "<f4")
    rows[:, :3] = np.array([(p.x, p.y, p.z) for p in m.points], float).reshape(-1, 3)
    for k, values in enumerate(columns.values()):
        rows[:, 3 + k] = values
    p = decode_points(
        rows.tobytes(), Layout(len(rows), 1, 4 * len(fields), 0), fields, header.stamp_ns
    )
    yield _sweep(header, p)


def _sweep(header: Header, p: Points) -> LidarFrame:
    return LidarFrame(
        header,
        p.points,
        p.label,
        p.offset_ns,
        p.ring,
        remark=p.remark,
        without_return=p.without_return,
        unclaimed=p.unclaimed,
    )


CONVERTERS: dict[str, Convert] = {
    **dict.fromkeys(livox.TYPES, _livox),
    "sensor_msgs/msg/PointCloud2": ros(_point_cloud2),
    "sensor_msgs/msg/PointCloud": ros(_old_cloud),
    "foxglove.PointCloud": foxglove(_foxglove_cloud),
}
