"""Large messages: a byte of one must not become a hundred bytes of objects.

A message of some megabytes may become as many objects as it likes. A larger one has to be of a type
whose content is one array of bytes, and the rest of it has to be small.
"""

from __future__ import annotations

import struct
from functools import lru_cache

from semloc_logs.logs.log import Definition, Message
from semloc_logs.logs.messages import livox
from semloc_logs.logs.messages.definitions import (
    UndecodableError,
    json_type,
    ros_types,
    standard_types,
)

LARGE = 8 << 20  # bytes
_MOST_VALUES = 2_000_000  # of JSON: numbers, texts, lists and objects
_MOST_FIELDS = 1000  # of the points of a cloud
_CLOUD = "sensor_msgs/msg/PointCloud2"
_BULK = {
    _CLOUD,
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
    "foxglove.PointCloud",
    "foxglove.RawImage",
    "foxglove.CompressedImage",
}


def check_size(message: Message) -> None:
    """UndecodableError for a large message that would become much larger in memory."""
    size = len(message.data)
    if size <= LARGE or message.type in livox.TYPES:  # read as an array, whatever its size
        return
    if message.encoding == "json":
        data = bytes(message.data)
        if sum(data.count(mark) for mark in (b",", b"{", b"[")) > _MOST_VALUES:
            raise UndecodableError(f"its {size} bytes hold more than {_MOST_VALUES} values")
        return
    type_ = json_type(message.type) if message.encoding == "protobuf" else message.type
    if type_ not in _BULK:
        raise UndecodableError(f"it has {size} bytes, too many for its type")
    if message.encoding == "protobuf":
        _check_protobuf(memoryview(message.data))
        return
    if not _is_standard(message.encoding, type_, message.definition):
        raise UndecodableError(f"it has {size} bytes, too many for the definition in the log")
    if type_ == _CLOUD and (count := _field_count(message)) > _MOST_FIELDS:
        raise UndecodableError(f"it claims {count} fields of its points")


@lru_cache(maxsize=256)
def _is_standard(encoding: str, type_: str, definition: Definition) -> bool:
    """Whether the log defines the type as ROS does."""
    standard = standard_types(encoding)
    used = ros_types(encoding, type_, definition)
    return all(name in standard and standard[name][1] == used[name][1] for name in used)


def _field_count(message: Message) -> int:
    """The number of fields that a PointCloud2 claims."""
    data = message.data
    is_cdr = message.encoding == "cdr"
    order = "<" if not is_cdr or data[1] & 1 else ">"
    try:
        # sequence number or encapsulation, stamp, length of the frame's name
        (length,) = struct.unpack_from(f"{order}I", data, 12)
        place = 16 + length
        if is_cdr:
            place += -place % 4
        _, _, count = struct.unpack_from(f"{order}III", data, place)
    except struct.error as error:
        raise UndecodableError("it is cut off") from error
    return int(count)


def _check_protobuf(data: memoryview) -> None:
    """UndecodableError where more than one field is large, or the fields are many."""
    position = largest = 0
    while position < len(data):
        key, position = _varint(data, position)
        kind = key & 7
        if kind == 2:
            length, position = _varint(data, position)
            largest = max(largest, length)
            position += length
        elif kind == 0:
            _, position = _varint(data, position)
        elif kind in (1, 5):
            position += 8 if kind == 1 else 4
        else:
            raise UndecodableError("its bytes do not match its definition")
        if position - largest > LARGE:
            raise UndecodableError(f"its {len(data)} bytes hold too many fields")


def _varint(data: memoryview, position: int) -> tuple[int, int]:
    value = shift = 0
    while position < len(data) and shift < 70:
        byte = data[position]
        position += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, position
        shift += 7
    raise UndecodableError("its bytes do not match its definition")
