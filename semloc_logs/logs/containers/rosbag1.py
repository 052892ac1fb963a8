"""ROS 1 bags (format 2.0), read by their index.

Where it is missing or damaged, the readable chunks are found by a walk over the file.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Collection, Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from semloc_logs.errors import LogError
from semloc_logs.logs.containers.base import (
    BaseLog,
    Bytes,
    MessageOrTime,
    closed_on_error,
    decompress,
    in_log_time_order,
    open_file,
    read_exactly,
)
from semloc_logs.logs.containers.chunks import Chunk, Index, Kind, chunk_messages, new_index
from semloc_logs.logs.containers.memory import Memory
from semloc_logs.logs.log import Definition, Message, Section, Stream
from semloc_logs.logs.messages.type_names import ros2_type

MAGIC = b"#ROSBAG V2.0\n"
_U32 = struct.Struct("<I")
_TIME = struct.Struct("<II")
_MESSAGE, _BAG, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 5, 6, 7
_MAX_HEAD = 1 << 20
_MOST_CONNECTIONS = 1 << 16  # in a chunk

Fields = dict[bytes, bytes]


class Part(NamedTuple):
    """A chunk record: where it is and which times and connections it covers."""

    offset: int
    start_ns: int
    end_ns: int
    connections: frozenset[int]


class Connection(NamedTuple):
    """What one publisher sends; ``node`` is its name, "" where the bag does not have it."""

    topic: str
    type: str
    definition: Definition
    node: str


class Rosbag1Log(BaseLog):
    """A ROS 1 bag. LogError unless it is one of format 2.0 without encryption."""

    def __init__(self, path: Path, memory: Memory | None = None) -> None:
        super().__init__(path, "rosbag1", memory)
        self.encoding = "ros1"
        self._connections: dict[int, Connection] = {}
        self._publishers: dict[int, str] = {}  # of connections that share their topic
        self._parts: list[Part] = []
        self._definition_bytes = 0
        self._file = open_file(path)
        with closed_on_error(self._file, path):
            self._size = self._file.seek(0, 2)
            self._open()

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """The messages of ``topics`` (None: of all) in log-time order.

        A damaged chunk is skipped and named in ``problems``.
        """
        ids = self._ids(topics)
        return in_log_time_order(
            (p.start_ns, partial(self._load, p, ids)) for p in self._parts if p.connections & ids
        )

    def sections(self) -> list[Section]:
        """The chunks by their first log time; a chunk ends where the next one starts."""
        offsets = sorted({self._size, *(p.offset for p in self._parts)})
        end_of = dict(pairwise(offsets))
        known = self._connections
        return [
            Section(
                part.start_ns,
                part.end_ns,
                end_of[part.offset] - part.offset,
                frozenset(known[c].topic for c in part.connections if c in known),
                partial(self._load_topics, part),
            )
            for part in sorted(self._parts, key=lambda p: (p.start_ns, p.offset))
        ]

    def _ids(self, topics: Collection[str] | None) -> set[int]:
        """The connections of ``topics`` (None: all)."""
        return {
            c for c, known in self._connections.items() if topics is None or known.topic in topics
        }

    def close(self) -> None:
        """Releases the file."""
        self._file.close()

    # -- opening

    def _open(self) -> None:
        magic = read_exactly(self._file, 0, min(self._size, len(MAGIC)), self._size)
        if magic != MAGIC:
            known = magic.startswith(b"#ROSBAG V")
            raise LogError(
                "only bags of format 2.0 are supported; convert it with rosbag migrate"
                if known
                else "it does not start like a ROS 1 bag"
            )

        counts = None
        try:
            head, _, _ = self._record(len(MAGIC))
            if head.get(b"encryptor"):
                raise LogError("the bag is encrypted")
            counts = self._read_index(head)
        except _DamageError as error:
            self._problems.add(
                f"{self.path.name}: the index is damaged ({error}), so the whole file was walked."
            )
        if counts is None:
            counts = self._scan()

        grouped: Counter[tuple[str, str]] = Counter()
        for connection, (topic, type_, *_) in self._connections.items():
            grouped[topic, type_] += counts.get(connection, 0)
        self._publishers = self._shared_connections()
        self.streams = [
            Stream(topic, type_, "ros1", count) for (topic, type_), count in sorted(grouped.items())
        ]
        if self._parts:
            self.start_ns = min(p.start_ns for p in self._parts)
            self.end_ns = max(p.end_ns for p in self._parts)

    def _shared_connections(self) -> dict[int, str]:
        """The node, or else the number, of each connection whose stream has several."""
        connections: dict[tuple[str, str], list[int]] = {}
        for number, known in self._connections.items():
            connections.setdefault(known[:2], []).append(number)
        return {
            number: self._connections[number].node or f"connection {number}"
            for several in connections.values()
            if len(several) > 1
            for number in several
        }

    def _read_index(self, head: Fields) -> Counter[int] | None:
        """Message counts by connection; None when the bag was not closed."""
        if _number(head, b"op", "<B") != _BAG:
            raise _DamageError("the bag header is missing")
        position = _number(head, b"index_pos", "<Q")
        if position == 0:
            return None
        chunks = _number(head, b"chunk_count", "<I")
        counts: Counter[int] = Counter()
        while position < self._size:
            fields, start, end = self._record(position)
            if _number(fields, b"op", "<B") == _CHUNK_INFO:
                self._index_part(fields, start, end, counts)
            else:
                self._connect(fields, start, end)
            position = end
        if sum(counts.values()) and not set(counts) <= set(self._connections):
            raise _DamageError("it counts messages of connections that it does not name")
        if len(self._parts) != chunks:
            raise _DamageError(f"it lists {len(self._parts)} of {chunks} chunks")
        self._parts = [p for p in self._parts if p.connections]
        return counts

    def _index_part(self, fields: Fields, start: int, end: int, counts: Counter[int]) -> None:
        count = _number(fields, b"count", "<I")
        if end - start != 8 * count or count > _MOST_CONNECTIONS:
            raise _DamageError("a chunk info has the wrong size")
        pairs = dict(struct.iter_unpack("<II", self._read(start, end)))
        offset = _number(fields, b"chunk_pos", "<Q")
        if offset >= self._size:
            raise _DamageError(
                f"a chunk is claimed at byte {offset}, but the file ends at byte {self._size}"
            )
        self._parts.append(
            Part(offset, _time(fields, b"start_time"), _time(fields, b"end_time"), frozenset(pairs))
        )
        counts.update(pairs)

    def _connect(self, fields: Fields, start: int, end: int) -> None:
        if _number(fields, b"op", "<B") != _CONNECTION:
            return
        connection = _number(fields, b"conn", "<I")
        if connection not in self._connections:
            self._add_connection(connection, fields, self._read(start, end))

    def _add_connection(self, connection: int, fields: Fields, data: bytes) -> None:
        """Learns of a connection; LogError where all of them take too much memory."""
        self._definition_bytes += len(data)
        if self._definition_bytes > self._memory.most_of_definitions:
            raise _DamageError(
                f"its connections take more than {self._memory.most_of_definitions} bytes"
            )
        self._connections[connection] = _connection(fields, data)

    def _scan(self) -> Counter[int]:
        """Walks over all records, decompresses each chunk once and counts readable messages."""
        self._parts.clear()
        counts: Counter[int] = Counter()
        position = len(MAGIC)
        damage = ""
        while position < self._size and not damage:
            try:
                fields, _, end = self._record(position)
                op = _number(fields, b"op", "<B")
            except _DamageError as error:
                damage = str(error)
                break
            if op == _CHUNK:
                self._scan_chunk(position, counts)
            position = end
        self._problems.add(
            f"{self.path.name}: the bag was not closed or is damaged"
            + (f" at byte {position} of {self._size} ({damage})" if damage else "")
            + f"; the {sum(counts.values())} messages that can be read are used."
        )
        return counts

    def _scan_chunk(self, offset: int, counts: Counter[int]) -> None:
        try:
            data = self._unpack_chunk(offset)
            messages = new_index(len(data), self._memory)
            self._walk(offset, data, messages)
        except LogError as error:
            self._problems.add(
                f"{self.path.name}: the chunk at byte {offset} was skipped: {error}."
            )
            return
        connections = Counter(c for _, c, _, _ in messages if c in self._connections)
        if connections:
            start_ns = min(time for time, c, _, _ in messages if c in connections)
            end_ns = max(time for time, c, _, _ in messages if c in connections)
            counts.update(connections)
            self._parts.append(Part(offset, start_ns, end_ns, frozenset(connections)))

    # -- reading

    def _load_topics(self, part: Part, topics: Collection[str] | None) -> Iterator[Message]:
        wanted = self._ids(topics)
        return in_log_time_order([(part.start_ns, partial(self._load, part, wanted))])

    def _load(self, part: Part, wanted: set[int]) -> Iterator[MessageOrTime]:
        """The messages of one chunk in log-time order."""
        chunk = Chunk(
            start_ns=part.start_ns,
            claimed_size=partial(self._claimed_size, part.offset),
            unpack=partial(self._unpack_chunk, part.offset),
            walk=partial(self._walk, part.offset),
            kind=partial(self._wanted_kind, wanted),
        )
        try:
            yield from chunk_messages(chunk, self._memory)
        except (LogError, OSError) as error:
            self._problems.add(
                f"{self.path.name}: the chunk at byte {part.offset} was skipped: {error}."
            )

    def _wanted_kind(self, wanted: set[int], connection: int) -> Kind | None:
        if connection not in wanted:
            return None
        topic, type_, definition, _ = self._connections[connection]
        return Kind(topic, type_, "ros1", definition, self._publishers.get(connection, ""))

    def _chunk(self, offset: int) -> tuple[Fields, int, int]:
        fields, start, end = self._record(offset)
        if _number(fields, b"op", "<B") != _CHUNK:
            raise _DamageError("it is not the chunk that the index claims")
        return fields, start, end

    def _claimed_size(self, offset: int) -> int:
        return _number(self._chunk(offset)[0], b"size", "<I")

    def _unpack_chunk(self, offset: int) -> Bytes:
        fields, start, end = self._chunk(offset)
        compression = fields.get(b"compression", b"none").decode(errors="replace")
        size = _number(fields, b"size", "<I")
        return decompress(self._read(start, end), compression, size, self._memory)

    def _walk(self, offset: int, data: Bytes, index: Index) -> None:
        """Puts (log time, connection, start, end) of the messages in ``data`` into ``index``.

        Learns of connections on the way.
        """
        position = 0
        size = len(data)
        try:
            while position < size:
                fields, start, end = _split(data, position)
                op = fields.get(b"op")
                if op == b"\x02":
                    connection = _number(fields, b"conn", "<I")
                    index.append((_time(fields, b"time"), connection, start, end))
                elif op == b"\x07":
                    connection = _number(fields, b"conn", "<I")
                    if connection not in self._connections:
                        self._add_connection(connection, fields, bytes(data[start:end]))
                position = end
        except LogError as error:
            self._problems.add(
                f"{self.path.name}: the chunk at byte {offset} is damaged inside: {error}; "
                f"{len(index)} messages of it are used."
            )

    def _read(self, start: int, end: int) -> bytes:
        self._memory.check(end - start)
        return read_exactly(self._file, start, end - start, self._size)

    def _record(self, offset: int) -> tuple[Fields, int, int]:
        """Fields, start and end of the data of the record at ``offset`` of the file."""
        try:
            (length,) = _U32.unpack(read_exactly(self._file, offset, 4, self._size))
            if length > _MAX_HEAD:
                raise _DamageError(f"a record header claims {length} bytes")
            head = read_exactly(self._file, offset + 4, length + 4, self._size)
        except _DamageError:
            raise
        except LogError as error:
            raise _DamageError(str(error)) from error
        start = offset + 8 + length
        end = start + _U32.unpack_from(head, length)[0]
        if end > self._size:
            raise _DamageError(f"a record at byte {offset} ends behind the file")
        return _fields(head[:length]), start, end


class _DamageError(LogError):
    """A record does not make sense."""


def _split(data: Bytes, position: int) -> tuple[Fields, int, int]:
    """Fields, start and end of the data of the record at ``position`` of a chunk."""
    size = len(data)
    if position + 4 > size:
        raise _DamageError(f"a record at byte {position} in it is cut off")
    head = position + 4 + _U32.unpack_from(data, position)[0]
    if head + 4 > size:
        raise _DamageError(f"a record at byte {position} in it is cut off")
    end = head + 4 + _U32.unpack_from(data, head)[0]
    if end > size:
        raise _DamageError(f"a record at byte {position} in it is cut off")
    return _fields(bytes(data[position + 4 : head])), head + 4, end


def _fields(head: bytes) -> Fields:
    fields: Fields = {}
    position = 0
    size = len(head)
    while position + 4 <= size:
        end = position + 4 + _U32.unpack_from(head, position)[0]
        name, equals, value = head[position + 4 : end].partition(b"=")
        if end > size or not equals:
            raise _DamageError("a record header cannot be parsed")
        fields[name] = value
        position = end
    return fields


def _number(fields: Fields, name: bytes, layout: str) -> int:
    try:
        return int(struct.unpack(layout, fields[name])[0])
    except (KeyError, struct.error) as error:
        raise _DamageError(
            f"the field {name.decode()} of a record is missing or damaged"
        ) from error


def _time(fields: Fields, name: bytes) -> int:
    try:
        seconds, nanoseconds = _TIME.unpack(fields[name])
    except (KeyError, struct.error) as error:
        raise _DamageError(
            f"the field {name.decode()} of a record is missing or damaged"
        ) from error
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def _connection(fields: Fields, data: bytes) -> Connection:
    """The connection of a record, whose data repeat the header layout."""
    inner = _fields(data)
    topic = fields.get(b"topic", inner.get(b"topic", b"")).decode(errors="replace")
    type_ = ros2_type(inner.get(b"type", b"").decode(errors="replace"))
    text = inner.get(b"message_definition", b"")
    definition = Definition(type_, "ros1msg" if text.strip() else "", text)
    return Connection(
        topic, type_, definition, inner.get(b"callerid", b"").decode(errors="replace")
    )
