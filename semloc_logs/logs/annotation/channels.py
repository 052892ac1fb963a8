"""The channels of closures in a log: topics, their kinds, and what writes them.

The messages are in the log's own encoding: one foreign channel would make the log unreadable for
some readers. :mod:`channels_ros` and :mod:`channels_foxglove` write the encodings.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Literal, Protocol

from semloc_logs.logs.annotation.closure_record import ClosureRecord
from semloc_logs.logs.annotation.markers import MarkerGroup
from semloc_logs.logs.annotation.scene import Cloud, StampedPose, Transform

Encoding = Literal["ros2", "ros1", "protobuf", "json"]


class Kind(Enum):
    """What the messages of a topic are."""

    CLOSURE = "closure"
    POSE = "pose"
    MARKERS = "markers"
    TRANSFORMS = "transforms"
    CLOUD = "cloud"


CLOSURES, POSE, MARKERS, MAP = (
    "/semloc/loop_closures",
    "/semloc/pose",
    "/semloc/markers",
    "/semloc/map",
)
OVERVIEW = "/semloc/overview"
MOVING, FIXED = "/semloc/tf", "/semloc/tf_static"
TOPICS = {
    CLOSURES: Kind.CLOSURE,
    POSE: Kind.POSE,
    MARKERS: Kind.MARKERS,
    MOVING: Kind.TRANSFORMS,
    FIXED: Kind.TRANSFORMS,
    MAP: Kind.CLOUD,
    OVERVIEW: Kind.MARKERS,
}
LATCHED = (FIXED, MAP, OVERVIEW)  # a reader that starts later gets the last message
COMMON_FRAME = "semloc/common"
QOS_KEY = "offered_qos_profiles"
LATCHING_KEY = "latching"  # of a ROS 1 connection
# where a log has none; as rosbag2 writes it for reliable topics
DEFAULT_QOS = """- history: 1
  depth: 1
  reliability: 1
  durability: 2
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 9223372036
    nsec: 854775807
  liveliness: 1
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false
"""
RUN_KEY = "semloc.run_id"  # in the metadata of each of our channels


@dataclass(frozen=True, slots=True)
class NewChannel:
    """A channel to add, with its schema."""

    topic: str
    message_encoding: str
    schema_name: str
    schema_encoding: str
    schema_data: bytes
    metadata: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class NewMessage:
    """A message to add; its publish time is its log time.

    ``channel`` counts the channels that are added with it.
    """

    channel: int
    log_time_ns: int
    data: bytes


class Encoder(Protocol):
    """The messages in one encoding: a channel for each topic, and the bytes of messages."""

    def channel(self, topic: str, kind: Kind, metadata: Mapping[str, str]) -> NewChannel: ...
    def loop_closure(self, closure: ClosureRecord, stamp_ns: int) -> bytes: ...
    def pose(self, pose: StampedPose) -> bytes: ...
    def markers(self, groups: Sequence[MarkerGroup]) -> bytes: ...
    def transforms(self, transforms: Sequence[Transform]) -> bytes: ...
    def cloud(self, cloud: Cloud, stamp_ns: int) -> bytes: ...


@dataclass(frozen=True, slots=True)
class LogFacts:
    """Facts that a writer needs of a log: encoding, profile, metadata for new channels, times.

    ``start_ns`` and ``end_ns`` are the first and last receive time. ``old_markers``: the log
    defines visualization_msgs/Marker as ROS 2 did before Humble; readers know one definition of a
    type.
    """

    encoding: Encoding
    profile: str
    channel_metadata: Mapping[str, str]
    start_ns: int
    end_ns: int
    messages: int
    old_markers: bool = False


def is_old_marker(name: str, definition: bytes) -> bool:
    """Whether a ROS 2 definition contains visualization_msgs/Marker as it was before Humble."""
    own = name.startswith("visualization_msgs/msg/Marker")
    return (
        own or b"MSG: visualization_msgs/Marker\n" in definition
    ) and b"mesh_file" not in definition


def topics_of_targets(targets: Collection[str]) -> dict[str, str]:
    """A topic for the poses in the frame of each target session, as ROS allows names."""
    topics: dict[str, str] = {}
    for target in sorted(targets):
        name = re.sub("[^A-Za-z0-9_]", "_", target)
        if not name[:1].isalpha():
            name = f"session_{name}"
        topic = f"{POSE}/{name}"
        while topic in topics.values():
            topic += "_"
        topics[target] = topic
    return topics


def latched(metadata: Mapping[str, str], facts: LogFacts) -> dict[str, str]:
    """Metadata of a topic whose last message a late reader gets."""
    if facts.encoding == "ros1":
        return {**metadata, LATCHING_KEY: "1"}
    if facts.encoding != "ros2":
        return dict(metadata)
    profile = metadata.get(QOS_KEY) or DEFAULT_QOS
    for volatile, local in (("volatile", "transient_local"), ("2", "1")):
        profile = re.sub(rf"durability: {volatile}\b", f"durability: {local}", profile)
    return {**metadata, QOS_KEY: profile}


def channel_metadata(run: str, version: str) -> dict[str, str]:
    """Metadata by which our channels are known."""
    return {RUN_KEY: run, "semloc.version": version}
