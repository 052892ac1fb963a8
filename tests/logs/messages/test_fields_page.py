"""The page on fields of messages names every field of every message that is read, and no other."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from semloc_logs.logs.log import Definition
from semloc_logs.logs.messages import image_codecs, livox, point_fields
from semloc_logs.logs.messages.decode import CONVERTERS
from semloc_logs.logs.messages.definitions import ros_types
from semloc_logs.logs.sensors import picture_calibration

PAGE = Path(__file__).resolve().parents[3] / "docs/reference/fields.md"
# values: their parts have no meaning of their own
PLAIN = {f"geometry_msgs/msg/{n}" for n in ("Point", "Point32", "Quaternion", "Vector3")}
PLAIN |= {"builtin_interfaces/msg/Time"}
FOXGLOVE_PLAIN = {"Vector3", "Quaternion", "Timestamp", "Color", "KeyValuePair"}
NOTHING = Definition("", "", b"")


def documented() -> dict[str, list[str]]:
    """Fields by type, as the page has them."""
    fields: dict[str, list[str]] = {}
    for section in re.split(r"^## ", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]:
        head, _, body = section.partition("\n")
        table = body.partition("| field | use |\n| --- | --- |\n")[2].partition("\n\n")[0]
        rows = re.findall(r"^\| `(\w+)` \| (.+) \|$", table, flags=re.MULTILINE)
        assert len(rows) == len(table.strip().splitlines()), head
        for type_ in head.split(", "):
            assert type_ not in fields
            fields[type_] = [name for name, _ in rows]
    return fields


def ros_fields() -> dict[str, list[str]]:
    """Fields of the ROS messages that are read, and of all messages within them."""
    fields: dict[str, list[str]] = {}
    for type_ in CONVERTERS:
        if type_.startswith("foxglove."):
            continue
        if type_ in livox.TYPES:
            fields[type_] = list(livox._FIELDS)
            fields[type_.replace("CustomMsg", "CustomPoint")] = [n for n, _ in livox._POINT]
            continue
        generation = "ros1" if type_ == "tf/msg/tfMessage" else "cdr"
        for name, (_, content) in ros_types(generation, type_, NOTHING).items():
            if name not in PLAIN:
                fields.setdefault(name, [field for field, _ in content])
    return fields


def foxglove_fields() -> dict[str, list[str]]:
    """The same of Foxglove's messages."""
    fields: dict[str, list[str]] = {}
    names = [t.removeprefix("foxglove.") for t in CONVERTERS if t.startswith("foxglove.")]
    waiting: list[Any] = [
        getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name).DESCRIPTOR
        for name in names
    ]
    while waiting:
        message = waiting.pop()
        if f"foxglove.{message.name}" in fields:
            continue
        fields[f"foxglove.{message.name}"] = [field.name for field in message.fields]
        waiting += [
            field.message_type
            for field in message.fields
            if field.message_type is not None and field.message_type.name not in FOXGLOVE_PLAIN
        ]
    return fields


def test_there_are_types_to_compare() -> None:
    assert len(CONVERTERS) > 20
    assert {"sensor_msgs/msg/RegionOfInterest", "std_msgs/msg/Header"} <= ros_fields().keys()
    assert {"foxglove.PackedElementField", "foxglove.Pose"} <= foxglove_fields().keys()


@pytest.mark.parametrize("type_", sorted({*ros_fields(), *foxglove_fields()}))
def test_every_field_of_a_type_has_a_row(type_: str) -> None:
    rows = documented().get(type_, [])
    if type_.startswith("foxglove."):
        # newer definitions than the installed one have more fields
        missing = set(foxglove_fields()[type_]) - set(rows)
        assert not missing
    else:
        seq = ["seq"] if type_ == "std_msgs/msg/Header" else []
        assert sorted(rows) == sorted(seq + ros_fields()[type_])


def test_no_type_is_documented_that_is_not_read() -> None:
    assert documented().keys() == ros_fields().keys() | foxglove_fields().keys()


def test_names_and_encodings_are_listed() -> None:
    """Names of point fields, encodings of pictures and lens models, as the code has them."""
    listed = {name.lower() for name in re.findall(r"`([^`]+)`", PAGE.read_text(encoding="utf-8"))}
    names = {*point_fields.LABELS, *point_fields.RINGS, *point_fields.TIMES, point_fields.TAG}
    encodings = {e for e in image_codecs._RAW if not e.startswith("bayer_")}
    models = (
        picture_calibration._POLYNOMIAL
        | picture_calibration._WITHOUT_DISTORTION
        | picture_calibration._FISHEYE
    )
    models |= picture_calibration._PINHOLE_AT_ZERO
    # the empty name is written in words, and one model is spelled in two ways
    assert (names | encodings | models) - {"", "kannalabrandt4"} <= listed
