"""From the definition of a stream to a function that parses its bytes into an object."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable
from functools import cache
from typing import Any

from google.protobuf.message import DecodeError as ProtobufError
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from semloc_logs.logs.log import Definition
from semloc_logs.logs.messages.type_names import ros2_type

Parser = Callable[[bytes | memoryview], Any]
_MAX_TEXT = 1 << 20  # a definition with all that it depends on has some kilobytes
_MAX_ARRAY = 4096  # fixed arrays of strings or messages are unrolled into code
# texts, comments, includes
_IDL_NOISE = re.compile(
    r'"(?:\\.|[^"\\])*"|//[^\n]*|/\*.*?\*/|^[ \t]*#[^\n]*', re.DOTALL | re.MULTILINE
)
_IDL_SEPARATOR = "=" * 80 + "\n"


class UndecodableError(Exception):
    """A message or a whole stream cannot be decoded; ``str`` is the reason, part of a sentence."""


def parser(encoding: str, type_: str, definition: Definition) -> Parser:
    """Parses messages of ``encoding``; it, or the parser, raises UndecodableError."""
    if encoding in ("cdr", "ros1"):
        return _ros_parser(encoding, type_, definition)
    if encoding == "protobuf":
        return _protobuf_parser(definition)
    if encoding == "json":
        return _parse_json
    raise UndecodableError(
        f"the encoding {encoding[:40]!r} is not supported"
        if encoding
        else "the log does not name its encoding"
    )


def _ros_parser(encoding: str, type_: str, definition: Definition) -> Parser:
    store = get_typestore(Stores.EMPTY)
    types = ros_types(encoding, type_, definition)
    try:
        store.register(
            {name: fields for name, fields in types.items() if name not in store.fielddefs}
        )
        store.get_msgdef(type_)
    except Exception as error:
        # the text is hostile, and the parser of another project answers with any exception
        raise UndecodableError(
            f"its definition in the log cannot be parsed ({_short(error)})"
        ) from error
    deserialize = store.deserialize_cdr if encoding == "cdr" else store.deserialize_ros1

    def parse(data: bytes | memoryview) -> Any:
        try:
            return deserialize(data, type_)
        except Exception as error:  # as above, here for the bytes
            raise UndecodableError(
                f"its bytes do not match its definition ({_short(error)})"
            ) from error

    return parse


def ros_types(encoding: str, type_: str, definition: Definition) -> dict[str, Any]:
    """The definitions that ``type_`` needs: from the log where it has them, else standard ones.

    UndecodableError where a definition is missing.
    """
    try:
        return _ros_types(encoding, type_, definition)
    except UndecodableError:
        raise
    except Exception as error:  # as above: the text is hostile
        raise UndecodableError(
            f"its definition in the log cannot be parsed ({_short(error)})"
        ) from error


def _ros_types(encoding: str, type_: str, definition: Definition) -> dict[str, Any]:
    standard = standard_types(encoding)
    text = definition.text.decode(errors="replace")
    if len(text) > _MAX_TEXT:
        raise UndecodableError(f"its definition has {len(text)} characters")
    if not text.strip():
        if type_ not in standard:
            raise UndecodableError(f"the log does not define its type {type_ or '(none)'}")
        recorded: dict[str, Any] = {}
    elif definition.encoding in ("ros2msg", "ros1msg"):
        recorded = dict(get_types_from_msg(text, type_))
    elif definition.encoding in ("ros2idl", "omgidl"):
        recorded = _idl_types(text)
    else:
        raise UndecodableError(
            f"its definition is written in {definition.encoding[:40]!r}, which is not supported"
        )
    needed: dict[str, Any] = {}
    missing = [type_]
    while missing:
        name = missing.pop()
        fields = recorded.get(name, standard.get(name))
        if fields is None:
            raise UndecodableError(f"the log does not define the type {name}")
        needed[name] = fields
        missing += [n for field in fields[1] for n in _names(field[1]) if n not in needed]
    _refuse_lists_of_nothing(needed)
    return needed


def _refuse_lists_of_nothing(types: dict[str, Any]) -> None:
    """Elements without any byte could be claimed in billions by a message of four bytes."""
    empty: set[str] = set()
    grown = True
    while grown:
        without_bytes = {
            name
            for name, (_, fields) in types.items()
            if all(_has_no_bytes(kind, empty) for _, kind in fields)
        }
        grown = without_bytes != empty
        empty = without_bytes
    for name, (_, fields) in types.items():
        for field, (kind, content) in fields:
            if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) and _has_no_bytes(content[0], empty):
                raise UndecodableError(f"the elements of {name}.{field} have no content")


def _has_no_bytes(field: Any, empty: set[str]) -> bool:
    kind, content = field
    if kind == Nodetype.NAME:
        return content in empty
    return bool(kind == Nodetype.ARRAY and (content[1] == 0 or _has_no_bytes(content[0], empty)))


def _idl_types(text: str) -> dict[str, Any]:
    types: dict[str, Any] = {}
    for section in text.split(_IDL_SEPARATOR):
        body = section.partition("\n")[2] if section.startswith("IDL: ") else section
        body = _IDL_NOISE.sub(lambda match: '""' if match[0][0] == '"' else " ", body)
        # constants are computed by the parser, and a few lines could ask for a number without end
        if "<<" in body or "*" in body:
            raise UndecodableError("its definition computes constants, which is not supported")
        if body.strip():
            types.update(get_types_from_idl(body))
    return types


def _names(field: Any) -> list[str]:
    """The message types that a field refers to.

    UndecodableError for arrays that would be unrolled without end.
    """
    kind, content = field
    if kind == Nodetype.NAME:
        return [content]
    if kind == Nodetype.BASE:
        return []
    inner, length = content
    if (
        kind == Nodetype.ARRAY
        and length > _MAX_ARRAY
        and (inner[0] != Nodetype.BASE or inner[1][0] == "string")
    ):
        raise UndecodableError(f"its definition has an array of {length} elements")
    return _names(inner)


def is_standard(type_: str) -> bool:
    """Whether a ROS 2 type can be decoded without a definition in the log."""
    return type_ in _standard_types("ros2")


def standard_types(encoding: str) -> dict[str, Any]:
    """The fields of the types that ROS defines, for messages in ``cdr`` or ``ros1``."""
    return _standard_types("ros1" if encoding == "ros1" else "ros2")


@cache
def _standard_types(generation: str) -> dict[str, Any]:
    types: dict[str, Any] = dict(get_typestore(Stores.ROS2_HUMBLE).fielddefs)
    if generation == "ros1":
        # has no tf2_msgs, which are laid out the same in both
        types |= get_typestore(Stores.ROS1_NOETIC).fielddefs
        types["tf/msg/tfMessage"] = types["tf2_msgs/msg/TFMessage"]
    types |= get_types_from_msg("uint16 class_id\nstring class_name", "vision_msgs/msg/VisionClass")
    label_info = "std_msgs/Header header\nVisionClass[] class_map\nfloat32 threshold"
    return types | get_types_from_msg(label_info, "vision_msgs/msg/LabelInfo")


def _protobuf_parser(definition: Definition) -> Parser:
    if definition.encoding != "protobuf":
        raise UndecodableError("the log does not define its protobuf type")
    try:
        schema = Schema(id=1, name=definition.name, encoding="protobuf", data=definition.text)
        decode = DecoderFactory().decoder_for("protobuf", schema)
    except Exception as error:
        # descriptors are hostile, and building them raises whatever it likes
        raise UndecodableError(
            f"its definition in the log cannot be parsed ({_short(error)})"
        ) from error
    if decode is None:
        raise UndecodableError("its protobuf definition cannot be used")

    def parse(data: bytes | memoryview) -> Any:
        try:
            return decode(bytes(data))
        except (ProtobufError, ValueError, RecursionError, MemoryError) as error:
            raise UndecodableError(
                f"its bytes do not match its definition ({_short(error)})"
            ) from error

    return parse


class JsonMessage:
    """A JSON object whose members are attributes; a missing member is None."""

    def __init__(self, members: dict[str, Any]) -> None:
        self._members = members

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        return _wrap(self._members.get(name))


def _wrap(value: Any) -> Any:
    if isinstance(value, dict):
        return JsonMessage(value)
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return [_wrap(v) for v in value]
    return value


def _parse_json(data: bytes | memoryview) -> Any:
    try:
        value = json.loads(bytes(data))
    except (ValueError, RecursionError) as error:
        raise UndecodableError(f"it is not JSON ({_short(error)})") from error
    if not isinstance(value, dict):
        raise UndecodableError("it is not a JSON object")
    return JsonMessage(value)


def binary(value: Any) -> bytes | memoryview:
    """The bytes of a data member: themselves, a numpy array of bytes, or base64 text in JSON."""
    if isinstance(value, str):
        return base64.b64decode(value, validate=True)
    if isinstance(value, bytes | memoryview):
        return value
    return memoryview(value).cast("B") if value is not None else b""


def json_type(type_: str) -> str:
    """``foxglove.PointCloud`` for the other names of Foxglove's messages in JSON and protobuf."""
    name = ros2_type(type_)
    for prefix in ("foxglove_msgs/msg/", "foxglove/msg/", "foxglove_schemas."):
        if name.startswith(prefix):
            return "foxglove." + name.removeprefix(prefix)
    return type_


def _short(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return (lines[0] if lines else type(error).__name__)[:160].rstrip(".")
