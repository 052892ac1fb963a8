"""A recorded log whatever its container: its streams, its messages in log-time order, and the
frames that they decode to.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

from semloc_logs.frames import Frame


@dataclass(frozen=True, slots=True)
class Stream:
    """One topic of one message type.

    ``type`` is spelled as in ROS 2 (``sensor_msgs/msg/PointCloud2``) for ROS logs of both
    generations, ``foxglove.PointCloud`` for Foxglove's protobuf and JSON messages, "" when unknown.
    ``encoding`` is that of the messages: ``cdr``, ``ros1``, ``protobuf``, ``json`` or whatever the
    log claims. ``count`` is the number of messages that can be read.
    """

    topic: str
    type: str
    encoding: str
    count: int


@dataclass(frozen=True, slots=True)
class Definition:
    """How the messages of a stream are laid out: ``text`` in the schema language ``encoding``; both
    empty when the log has none.
    """

    name: str
    encoding: str  # ros2msg, ros2idl, ros1msg, protobuf (a FileDescriptorSet), jsonschema
    text: bytes


class Message(NamedTuple):
    """A message as recorded; ``type`` and ``encoding`` are those of its :class:`Stream`."""

    topic: str
    type: str
    encoding: str
    log_time_ns: int
    data: bytes | memoryview
    definition: Definition


class Log(Protocol):
    """An open log. Iterating twice reads the file twice; every pass needs bounded memory."""

    @property
    def path(self) -> Path:
        """The file or directory that was opened."""

    @property
    def format(self) -> str:
        """``mcap``, ``rosbag1`` or ``rosbag2``."""

    @property
    def encoding(self) -> str:
        """``ros2``, ``ros1``, ``protobuf`` or ``json``: what most streams are recorded in; "" when
        there are none.
        """

    @property
    def start_ns(self) -> int | None:
        """Log time of the first message; None without messages."""

    @property
    def end_ns(self) -> int | None:
        """Log time of the last message; None without messages."""

    @property
    def streams(self) -> list[Stream]:
        """Sorted by topic. A topic with several types has several streams."""

    @property
    def problems(self) -> list[str]:
        """What was skipped and why, in sentences; grows while messages are read."""

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """The messages of ``topics`` (None: of all) in log-time order.

        Damage ends the iteration early with a sentence in ``problems``, it raises nothing.
        """

    def frames(self, topics: Collection[str] | None = None) -> Iterator[Frame]:
        """The frames of ``topics`` in log-time order; a message may yield several, or none.

        A message that cannot be decoded is skipped, counted, and named once per topic in
        ``problems``.
        """

    def close(self) -> None:
        """Releases the files."""
