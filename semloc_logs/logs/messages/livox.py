"""Livox's CustomMsg, a header and a list of 19-byte points, read as one array."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype

from semloc_logs.logs.log import Definition
from semloc_logs.logs.messages.definitions import Parser, UndecodableError, ros_types

PACKAGES = ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces")
TYPES = tuple(f"{package}/msg/CustomMsg" for package in PACKAGES)
# fields of CustomPoint in the drivers of both generations
_POINT = (
    ("offset_time", "u4"),
    ("x", "f4"),
    ("y", "f4"),
    ("z", "f4"),
    ("reflectivity", "u1"),
    ("tag", "u1"),
    ("line", "u1"),
)
_FIELDS = ["header", "timebase", "point_num", "lidar_id", "rsvd", "points"]
_NAMES = {"u1": "uint8", "u4": "uint32", "f4": "float32"}
# a point begins with 4 bytes of time, so each but the last is padded to a multiple of 4
_CDR_STEP = 20


@dataclass(frozen=True, slots=True)
class CustomMsg:
    """``points`` (n,): offset_time in ns since ``timebase_ns``, x, y, z in metres, line."""

    sec: int
    nanosec: int
    frame_id: str
    timebase_ns: int
    points: NDArray[np.void]


def livox_parser(encoding: str, type_: str, definition: Definition) -> Parser:
    """A parser of CustomMsg; UndecodableError when the log defines it in another way."""
    if definition.text.strip():
        _check_definition(ros_types(encoding, type_, definition), type_)
    if encoding not in ("ros1", "cdr"):
        raise UndecodableError(f"Livox messages in {encoding} are not supported")

    def parse(data: bytes | memoryview) -> Any:
        try:
            return _parse(data, is_cdr=encoding == "cdr")
        except struct.error as error:
            raise UndecodableError("its bytes are cut off") from error

    return parse


def _check_definition(types: dict[str, Any], type_: str) -> None:
    fields = [name for name, _ in types[type_][1]]
    point = [
        (name, description[1][0])
        for name, description in types.get(type_.replace("CustomMsg", "CustomPoint"), ("", ()))[1]
        if description[0] == Nodetype.BASE
    ]
    if fields != _FIELDS or point != [(name, _NAMES[kind]) for name, kind in _POINT]:
        raise UndecodableError("its definition in the log differs from the Livox drivers")


def _parse(data: bytes | memoryview, *, is_cdr: bool) -> CustomMsg:
    # CDR counts its alignment from behind 4 bytes, which hold the byte order
    order = ">" if is_cdr and len(data) > 1 and data[1] == 0 else "<"
    body = memoryview(data)[4 if is_cdr else 0 :]
    position = 0 if is_cdr else 4  # ROS 1 headers begin with a sequence number
    sec, nanosec, length = struct.unpack_from(order + "III", body, position)
    position += 12
    if position + length > len(body):
        raise UndecodableError("its bytes are cut off")
    frame_id = bytes(body[position : position + length]).rstrip(b"\0").decode(errors="replace")
    position += length
    if is_cdr:
        position += -position % 8
    (timebase,) = struct.unpack_from(order + "Q", body, position)
    position += 8 + 4 + 1 + 3  # point_num, lidar_id, rsvd
    points = _points(body[position:], order, is_cdr=is_cdr)
    return CustomMsg(sec, nanosec, frame_id, timebase, points)


def _points(data: memoryview, order: str, *, is_cdr: bool) -> NDArray[np.void]:
    """The points (n,) behind their count."""
    (count,) = struct.unpack_from(order + "I", data)
    body = data[4:]
    sizes = [np.dtype(kind).itemsize for _, kind in _POINT]
    size = sum(sizes)
    step = _CDR_STEP if is_cdr else size
    needed = (count - 1) * step + size if count else 0
    if needed > len(body):
        raise UndecodableError(
            f"{count} points of {step} bytes need {needed} bytes, but it has {len(body)}"
        )
    dtype = np.dtype(
        {
            "names": [name for name, _ in _POINT],
            "formats": [order + kind for _, kind in _POINT],
            "offsets": np.cumsum([0, *sizes])[:-1].tolist(),
            "itemsize": size,
        }
    )
    if not count:
        return np.empty(0, dtype)
    return np.ndarray((count,), dtype, buffer=body, strides=(step,))
