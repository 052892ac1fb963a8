"""Livox's CustomMsg, a header and a list of 19-byte points, read as one array instead of an object
a point.
"""

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
_NAMES = {"u1": "uint8", "u4": "uint32", "f4": "float32"}
# a point begins with 4 bytes of time, so each but the last is padded to a multiple of 4
_CDR_STEP = 20


@dataclass(frozen=True, slots=True)
class CustomMsg:
    """``points`` (n,) records with offset_time in ns since ``timebase_ns``, x, y, z in metres,
    line.
    """

    sec: int
    nanosec: int
    frame_id: str
    timebase_ns: int
    points: NDArray[np.void]


def livox_parser(encoding: str, type_: str, definition: Definition) -> Parser:
    """A parser of CustomMsg; UndecodableError when the definition in the log is another one."""
    if definition.text.strip():
        types = ros_types(encoding, type_, definition)
        fields = [n for n, _ in types[type_][1]]
        point = [
            (n, d[1][0])
            for n, d in types.get(type_.replace("CustomMsg", "CustomPoint"), ("", ()))[1]
            if d[0] == Nodetype.BASE
        ]
        known = [(n, _NAMES[kind]) for n, kind in _POINT]
        if (
            fields != ["header", "timebase", "point_num", "lidar_id", "rsvd", "points"]
            or point != known
        ):
            raise UndecodableError("its definition in the log is not that of the Livox drivers")
    if encoding not in ("ros1", "cdr"):
        raise UndecodableError(f"Livox messages in {encoding} are not supported")

    def parse(data: bytes | memoryview) -> Any:
        try:
            return _parse(data, is_cdr=encoding == "cdr")
        except struct.error as error:
            raise UndecodableError("its bytes are cut off") from error

    return parse


def _parse(data: bytes | memoryview, *, is_cdr: bool) -> CustomMsg:
    # CDR counts its alignment from behind 4 bytes that say the byte order
    order = ">" if is_cdr and len(data) > 1 and data[1] == 0 else "<"
    body = memoryview(data)[4 if is_cdr else 0 :]
    at = 0 if is_cdr else 4  # ROS 1 headers begin with a sequence number
    sec, nanosec, length = struct.unpack_from(order + "III", body, at)
    at += 12
    if at + length > len(body):
        raise UndecodableError("its bytes are cut off")
    frame_id = bytes(body[at : at + length]).rstrip(b"\0").decode(errors="replace")
    at += length
    if is_cdr:
        at += -at % 8
    (timebase,) = struct.unpack_from(order + "Q", body, at)
    at += 8 + 4 + 1 + 3  # point_num, lidar_id, rsvd
    (count,) = struct.unpack_from(order + "I", body, at)
    at += 4
    size = sum(int(kind[1]) for _, kind in _POINT)
    step = _CDR_STEP if is_cdr else size
    needed = (count - 1) * step + size if count else 0
    if needed > len(body) - at:
        raise UndecodableError(
            f"{count} points of {step} bytes need {needed} bytes, but it has {len(body) - at}"
        )
    formats = [order + kind for _, kind in _POINT]
    offsets = np.cumsum([0, *(int(kind[1]) for _, kind in _POINT)])[:-1].tolist()
    dtype = np.dtype(
        {"names": [n for n, _ in _POINT], "formats": formats, "offsets": offsets, "itemsize": size}
    )
    points = (
        np.ndarray((count,), dtype, buffer=body[at:], strides=(step,))
        if count
        else np.empty(0, dtype)
    )
    return CustomMsg(sec, nanosec, frame_id, timebase, points)
