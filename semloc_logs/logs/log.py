"""A recorded log, whatever its container: streams, messages in log-time order, decoded frames."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

from semloc_logs.frames import Frame
from semloc_logs.logs.problems import Problem


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


class Message(NamedTuple):
    """A message as recorded; ``type`` and ``encoding`` as in its :class:`Stream`."""

    topic: str
    type: str
    encoding: str
    log_time_ns: int
    data: bytes | memoryview
    definition: Definition


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
        """``mcap``, ``rosbag1`` or ``rosbag2``."""

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

    def frames(self, topics: Collection[str] | None = None) -> Iterator[Frame]:
        """The frames of ``topics`` in log-time order; a message may yield several, or none.

        A message that cannot be decoded is skipped, counted, and named once per topic in
        ``problems``.
        """

    def close(self) -> None:
        """Releases the files."""
