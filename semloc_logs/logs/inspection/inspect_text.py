"""What ``semloc inspect`` prints for people: 80 columns, units instead of nanoseconds."""

from __future__ import annotations

import shlex
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from semloc_logs.logs.inspection import units
from semloc_logs.logs.log import MAP_FORMAT
from semloc_logs.logs.messages.stamps import utc

WIDTH = 80
_FORMATS = {
    "mcap": "MCAP",
    "rosbag1": "ROS 1 bag",
    "rosbag2": "ROS 2 bag",
    MAP_FORMAT: "map of points",
}
_ENCODINGS = {"ros1": "ROS 1", "ros2": "ROS 2", "protobuf": "protobuf", "json": "JSON"}
_LABELS = {
    "cloud": "recorded with the points",
    "images": "recorded as label images",
    "geometry": "not recorded: they come from geometry, or from --seg-model",
}
_NAMES = 14  # columns of names at the left, such as stereo_right


def inspect_text(content: Mapping[str, Any]) -> str:
    """The text of one log, from the object of ``inspect --json``."""
    blocks = [_head(content), *_streams(content), *_scene(content), *_findings(content)]
    return "\n".join(line for block in blocks for line in block)


def _wrapped(text: str, first: str = "", rest: str | None = None) -> list[str]:
    """Lines of at most 80 columns; paths and topics are never broken."""
    return textwrap.wrap(
        text,
        WIDTH,
        initial_indent=first,
        subsequent_indent=" " * len(first) if rest is None else rest,
        break_long_words=False,
        break_on_hyphens=False,
    )


def _entry(name: str, text: str) -> list[str]:
    """A line with a name in front, such as ``Poses   28.9 m``."""
    return _wrapped(text, f"{name:<{_NAMES}}")


def _head(content: Mapping[str, Any]) -> list[str]:
    parts = [_FORMATS.get(content["format"], content["format"])]
    parts.append(_ENCODINGS.get(content["encoding"], "no messages"))
    parts.append(units.size(content["size_bytes"]))
    if content["start_ns"] is not None:
        parts.append(f"{_date(content['start_ns'])} UTC")
        parts.append(units.duration(content["duration_s"]))
    return [content["path"], *_wrapped(", ".join(parts), "  "), ""]


def _date(stamp_ns: int) -> str:
    """Such as ``2021-09-02 10:15:58``."""
    return utc(stamp_ns).replace("T", " ").removesuffix("Z").partition(".")[0]


def _streams(content: Mapping[str, Any]) -> Iterator[list[str]]:
    used = [s for s in content["streams"] if s["role"]]
    unused = [s for s in content["streams"] if not s["role"]]
    for stream in sorted(used, key=lambda s: (s["role"], s["topic"])):
        lines = [f"{stream['role']:<{_NAMES}}{stream['topic']}"]
        kind = stream["type"].rpartition("/")[2].rpartition(".")[2]
        facts = [_messages(stream), kind, *_facts(stream["topic"], content)]
        yield lines + _wrapped(", ".join(facts), " " * _NAMES)
    if unused:
        name = "not used"
        for stream in unused:
            text = f"{stream['topic']} ({stream['type'] or 'unknown type'}, {stream['count']:,})"
            yield _entry(name, text)
            name = ""
    yield [""]


def _messages(stream: Mapping[str, Any]) -> str:
    count = stream["count"]
    text = f"{count:,} message{'' if count == 1 else 's'}"
    return text if stream["rate_hz"] is None else f"{text}, {units.rate(stream['rate_hz'])}"


def _facts(topic: str, content: Mapping[str, Any]) -> Iterator[str]:
    """What the first message of a sensor or camera tells."""
    camera = content["cameras"].get(topic)
    if camera is not None:
        yield f"{camera['width']} x {camera['height']} pixels"
        yield f"model {camera['model']}" if camera["model"] else "no distortion model"
    facts = content["sensors"].get(topic) or content["pictures"].get(topic) or {}
    if facts.get("width"):
        yield f"{facts['width']} x {facts['height']} pixels"
    if facts.get("encoding"):
        yield facts["encoding"]
    if "points" in facts:
        yield f"{facts['points']:,} points in the first"
        yield "with labels" if facts["labels"] else "without labels"
        yield "with point times" if facts["point_times"] else "without point times"
    if facts.get("range_m"):
        yield f"95 % within {units.distance(facts['range_m'])}"
    if "frame_id" in facts:
        frame = f"frame {facts['frame_id']}" if facts["frame_id"] else "no frame_id"
        yield frame if facts["base_T_sensor"] else f"{frame}: no transform to the base frame"


def _scene(content: Mapping[str, Any]) -> Iterator[list[str]]:
    """Poses, frames and labels."""
    lines: list[str] = []
    poses = content["poses"]
    if poses["count"]:
        lines += _entry("Poses", ", ".join(_pose_facts(content)))
        span = f"{_date(poses['start_ns'])} to {_date(poses['end_ns'])} UTC"
        lines += _entry("", span) if poses["count"] > 1 else _entry("", _date(poses["start_ns"]))
    if content["base_frame"]:
        lines += _entry("Base frame", content["base_frame"])
    for number, line in enumerate(_tree(content)):
        lines.append(f"{'' if number else 'Frames':<{_NAMES}}{line}")
    if content["sensors"]:
        lines += _entry("Labels", _LABELS[content["labels"]])
    if lines:
        yield [*lines, ""]


def _pose_facts(content: Mapping[str, Any]) -> Iterator[str]:
    poses = content["poses"]
    if poses["count"] == 1:
        yield f"one pose, frame {content['session_frame']}"
        return
    length = units.distance(poses["length_m"])
    yield length if content["complete"] else f"at least {length}, by a sample"
    seconds = (poses["end_ns"] - poses["start_ns"]) * 1e-9
    if seconds > 0:
        yield f"in {units.duration(seconds)}"
    sides = " x ".join(f"{side:.1f}" for side in poses["extent_m"])
    yield f"within {sides} m"
    if content["session_frame"]:
        yield f"frame {content['session_frame']}"
    if poses["gaps"]:
        count = len(poses["gaps"])
        yield f"{count} gap{'' if count == 1 else 's'}"
    refused = {"duplicates": "repeated", "backwards": "back in time", "ahead": "far ahead in time"}
    for key, text in {**refused, "invalid": "invalid"}.items():
        if poses[key]:
            yield f"{poses[key]} {text}"


def _tree(content: Mapping[str, Any]) -> Iterator[str]:
    """The frame tree: children below their parents, fixed frames without children in one line."""
    children: dict[str, list[tuple[str, bool]]] = {}
    for edge in content["transforms"]:
        children.setdefault(edge["parent"], []).append((edge["child"], edge["static"]))
    below = {edge["child"] for edge in content["transforms"]}

    def lines(frame: str, depth: int, above: Sequence[str]) -> Iterator[str]:
        indent = "  " * depth
        leaves = [c for c, is_static in children.get(frame, []) if is_static and c not in children]
        if leaves:
            for line in _wrapped(", ".join(leaves), " " * _NAMES + indent):
                yield line[_NAMES:]
        for child, is_static in children.get(frame, []):
            if child in leaves:
                continue
            yield f"{indent}{child}{'' if is_static else ' (moving)'}"
            if child not in above:  # a loop of contradicting publishers ends here
                yield from lines(child, depth + 1, (*above, child))

    # frames that are all in a loop have no root: any of them serves
    for root in sorted(set(children) - below) or sorted(children)[:1]:
        yield root
        yield from lines(root, 1, (root,))


def _findings(content: Mapping[str, Any]) -> Iterator[list[str]]:
    """Problems, unknown properties, and the verdict."""
    name = "Problems"
    for sentence in content["problems"]:
        yield _wrapped(sentence, f"{name:<{_NAMES - 2}}- ")
        name = ""
    if content["unknown"]:
        text = f"{'; '.join(content['unknown'])}: --full reads all messages."
        yield _entry("Not known", text)
    verdict, _, _ = content["verdict"].partition("; suggested: ")
    yield _entry("Verdict", verdict)
    if content["suggested"]:
        yield _command(content["suggested"])


def _command(text: str) -> list[str]:
    """A command, in lines that can be pasted into a shell."""
    line = f"{'Suggested':<{_NAMES}}{text}"
    if len(line) <= WIDTH:
        return [line]
    groups: list[list[str]] = [[]]
    for word in shlex.split(text):
        if word.startswith("-"):
            groups.append([])
        groups[-1].append(word)

    lines = ["  "]
    for part in map(shlex.join, groups):
        if lines[-1].strip() and len(lines[-1]) + len(part) > WIDTH - 2:
            lines[-1] += "\\"
            lines.append("    ")
        lines[-1] += f"{part} "
    return ["Suggested", *(line.rstrip() for line in lines)]
