"""Parts that messages of several types share, and how to make a converter of one type."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.frames import Frame, Header
from semloc_logs.logs.log import Clock, Message
from semloc_logs.logs.messages.definitions import UndecodableError
from semloc_logs.numerics import transforms

# a parsed message and the one it was parsed from -> frames
Convert = Callable[[Any, Message], Iterator[Frame]]
# the same where the header is all that is needed of the latter
Body = Callable[[Header, Any], Iterator[Frame]]

# errors that hostile values in a well-formed message may raise in converters
BAD_VALUES = (
    ArithmeticError,
    AttributeError,
    LookupError,
    TypeError,
    ValueError,
    MemoryError,
    cv2.error,
)

_UNIT = 0.1  # of the length of a quaternion, off 1: rounding makes less


def ros(body: Body) -> Convert:
    """A converter of ROS messages that begin with a std_msgs/Header."""
    return lambda m, message: body(ros_header(m, message), m)


def foxglove(body: Body, frame: str = "frame_id") -> Convert:
    """A converter of Foxglove's messages, with time and ``frame`` among their other fields."""
    return lambda m, message: body(foxglove_header(m, message, getattr(m, frame)), m)


def check_time(time_ns: int) -> int:
    """Nanoseconds that fit 64-bit integers, also after a difference of two."""
    if abs(time_ns) >= 1 << 62:
        raise UndecodableError(f"its time of {time_ns} ns is impossible")
    return time_ns


def stamp_ns(time: Any) -> int | None:
    """Nanoseconds of a ROS time, protobuf timestamp or JSON {sec, nsec}; None without one."""
    if time is None:
        return None
    for seconds, nanoseconds in (("sec", "nanosec"), ("seconds", "nanos"), ("sec", "nsec")):
        s = getattr(time, seconds, None)
        n = getattr(time, nanoseconds, None)
        if s is not None and n is not None:
            return check_time(int(s) * 1_000_000_000 + int(n))
    raise UndecodableError("its time stamp has neither seconds nor nanoseconds")


def header_at(recorded_ns: int | None, frame_id: str, message: Message) -> Header:
    """A header with the recorded stamp, or with the log time where the message's clock wants it."""
    clock = message.clock
    log_time_ns = message.log_time_ns
    lacks_stamp = recorded_ns is None or (recorded_ns == 0 and clock is Clock.AUTO)
    if recorded_ns is None or lacks_stamp or clock is Clock.LOG:
        recorded_ns = log_time_ns
    return Header(message.topic, recorded_ns, log_time_ns, frame_id, lacks_stamp, message.publisher)


def ros_header(m: Any, message: Message) -> Header:
    """The header of a message with a std_msgs/Header."""
    return header_at(stamp_ns(m.header.stamp), m.header.frame_id, message)


def foxglove_header(m: Any, message: Message, frame_id: Any) -> Header:
    """The header of a message with a ``timestamp``; ``frame_id`` is "" unless it is a string."""
    if not isinstance(frame_id, str):
        frame_id = ""
    return header_at(stamp_ns(m.timestamp), frame_id, message)


def vector(v: Any) -> F64:
    """x, y, z (3,); a missing value is 0."""
    return np.array([v.x or 0.0, v.y or 0.0, v.z or 0.0], float)


def quaternion(q: Any) -> F64:
    """x, y, z, w (4,), of any length; a missing value is 0."""
    return np.array([q.x or 0.0, q.y or 0.0, q.z or 0.0, q.w or 0.0], float)


def unit_transform(translation: Any, rotation: Any) -> F64:
    """As :func:`transform`, of a quaternion that a program computed: its length is 1."""
    pose = transform(translation, rotation)
    norm = math.hypot(*quaternion(rotation))
    if abs(norm - 1.0) > _UNIT:
        raise UndecodableError(
            f"the quaternion of its pose has the length {norm:.2g} and not 1: it is not a rotation;"
            " are these Euler angles?"
        )
    return pose


def transform(translation: Any, rotation: Any) -> F64:
    """A pose (4, 4) in metres. UndecodableError when it is not finite or its quaternion is zero."""
    t = vector(translation)
    q = quaternion(rotation)
    norm = math.hypot(*q)
    if not (np.isfinite(t).all() and math.isfinite(norm)):
        raise UndecodableError("its pose has values that are not finite")
    if norm < 1e-6:
        raise UndecodableError("the quaternion of its pose is zero")
    return transforms.transform(t, q)
