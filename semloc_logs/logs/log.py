"""A recorded log, whatever its container: streams, messages in log-time order, decoded frames."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import NamedTuple, Protocol

from semloc_logs.frames import Frame
from semloc_logs.logs.problems import Problem

MAP_FORMAT = "map"  # the format of a map of points


@dataclass(frozen=True, slots=True)
class Stream:
    """One topic of one message type.

    ``type`` is spelled as in ROS 2 (``sensor_msgs/msg/PointCloud2``) for ROS logs of both
    generations, ``foxglove.PointCloud`` for Foxglove's protobuf and JSON messages, "" when unknown.
    ``encoding`` of the messages: ``cdr``, ``ros1``, ``protobuf``, ``json`` or whatever the log
    claims. ``count`` is the number of messages that can be read.
    """

    topic: str
    type: str
    encoding: str
    count: int


@dataclass(frozen=True, slots=True)
class Definition:
    """The layout of the messages of a stream: ``text`` in the schema language ``encoding``.

    Both are empty when the log has no definition.
    """

    name: str
    encoding: str  # ros2msg, ros2idl, ros1msg, protobuf (a FileDescriptorSet), jsonschema
    text: bytes


class Clock(Enum):
    """Where the time of a message is taken from."""

    HEADER = "header"  # its own stamp
    LOG = "log"  # the time of its recording
    AUTO = "auto"  # its own stamp; the time of its recording while all stamps of its topic are 0


class Message(NamedTuple):
    """A message as recorded; ``type`` and ``encoding`` as in its :class:`Stream`.

    ``publisher`` names the node or the channel where the log has several for one topic. ``clock``
    decides the stamp of its frames.
    """

    topic: str
    type: str
    encoding: str
    log_time_ns: int
    data: bytes | memoryview
    definition: Definition
    publisher: str = ""
    clock: Clock = Clock.HEADER


@dataclass(frozen=True, slots=True)
class Reading:
    """How messages become frames.

    ``offset_ns`` is added to the stamps of a topic. ``left_out``: streams that are not read, as
    topic, type and encoding ("": every encoding).
    """

    clock: Clock = Clock.AUTO
    offset_ns: Mapping[str, int] = field(default_factory=dict)
    left_out: frozenset[tuple[str, str, str]] = frozenset()

    def accepts(self, message: Message) -> bool:
        """Whether the stream of a message is read."""
        if not self.left_out:
            return True
        topic, type_, encoding = message[:3]
        left_out = self.left_out
        return (topic, type_, encoding) not in left_out and (topic, type_, "") not in left_out


class Section(NamedTuple):
    """A part of a log that can be read without the rest: a chunk, a stretch of time of a database.

    ``topics`` that may have messages in it, empty when unknown; ``nbytes`` of the file that it
    takes, roughly. ``messages`` reads the messages of some topics (None: of all) in log-time order.
    """

    start_ns: int
    end_ns: int
    nbytes: int
    topics: frozenset[str]
    messages: Callable[[Collection[str] | None], Iterator[Message]]


class Log(Protocol):
    """An open log. Iterating twice reads the file twice; every pass needs bounded memory."""

    @property
    def path(self) -> Path:
        """The file or directory that was opened."""

    @property
    def format(self) -> str:
        """``mcap``, ``rosbag1``, ``rosbag2`` or, of a map of points, ``map``."""

    @property
    def encoding(self) -> str:
        """Encoding of most streams: ``ros2``, ``ros1``, ``protobuf``, ``json``; "" without."""

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
    def problems(self) -> list[Problem]:
        """Skipped input and the reasons; grows while messages are read."""

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """The messages of ``topics`` (None: of all) in log-time order.

        Damage ends the iteration early and is named in ``problems``; it raises nothing.
        """

    def sections(self) -> list[Section]:
        """The parts of the log by their first log time, from the index: nothing is read for it."""

    def frames(
        self, topics: Collection[str] | None = None, reading: Reading | None = None
    ) -> Iterator[Frame]:
        """The frames of ``topics`` in log-time order; a message may yield several, or none.

        ``reading``: which of their streams, and by which clock. A message that cannot be decoded is
        skipped, counted, and named once per topic in ``problems``.
        """

    def close(self) -> None:
        """Releases the files."""
