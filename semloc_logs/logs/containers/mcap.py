"""MCAP files: by their index where it can be trusted, else by walking over what is readable; memory
holds overlapping chunks only.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import NamedTuple, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Header, Schema, Statistics

from semloc_logs.errors import LogError
from semloc_logs.logs.containers.base import (
    BaseLog,
    closed_on_error,
    decompress,
    encoding_of,
    in_log_time_order,
    open_file,
    read_exactly,
)
from semloc_logs.logs.log import Definition, Message, Stream
from semloc_logs.logs.messages.type_names import ros2_type
from semloc_logs.logs.problems import Problems

MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")
# a message record up to its data: opcode, length, channel, sequence, log time, publish time
_MESSAGE = struct.Struct("<BQHIQQ")
_FOOTER = struct.Struct("<BQQQI")
_LOOSE = 1 << 22  # messages outside chunks are read in runs of about this many bytes

Record = TypeVar("Record")


class Part(NamedTuple):
    """A chunk record, or a run of messages outside chunks: where it is and which times it covers."""

    offset: int
    size: int
    start_ns: int
    end_ns: int
    channels: frozenset[int]  # empty: unknown
    chunk: bool


class McapLog(BaseLog):
    """An MCAP file of any profile. LogError unless it starts as one."""

    def __init__(self, path: Path, name: str = "", problems: Problems | None = None) -> None:
        super().__init__(path, "mcap", problems)
        self._name = name or path.name
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._kinds: dict[int, tuple[str, str, str, Definition]] = {}
        self._parts: list[Part] = []
        self._file = open_file(path)
        with closed_on_error(self._file, path):
            self._size = self._file.seek(0, 2)
            self._open()

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """The messages of ``topics`` (None: of all) in log-time order; a damaged chunk is skipped
        and named in ``problems``.
        """
        wanted = None if topics is None else frozenset(topics)
        parts = (
            p
            for p in self._parts
            if wanted is None or not p.channels or any(self._topic(c) in wanted for c in p.channels)
        )
        return in_log_time_order((p.start_ns, partial(self._load, p, wanted)) for p in parts)

    def close(self) -> None:
        """Releases the file."""
        self._file.close()

    # -- opening

    def _open(self) -> None:
        if read_exactly(self._file, 0, min(self._size, len(MAGIC)), self._size) != MAGIC:
            raise LogError("it does not start like an MCAP file")
        profile = self._profile()
        counts = self._read_summary()
        if counts is None:
            counts = self._scan()
        grouped: Counter[tuple[str, str, str]] = Counter()
        for channel in self._channels:
            grouped[self._kind(channel)[:3]] += counts.get(channel, 0)
        self.streams = [
            Stream(topic, type_, encoding, count)
            for (topic, type_, encoding), count in sorted(grouped.items())
        ]
        self.encoding = profile if profile in ("ros1", "ros2") else encoding_of(self.streams)

    def _profile(self) -> str:
        try:
            opcode, length = _RECORD.unpack(read_exactly(self._file, 8, _RECORD.size, self._size))
            if opcode != Opcode.HEADER:
                return ""
            return str(
                self._parse(Header.read, read_exactly(self._file, 17, length, self._size)).profile
            )
        except LogError:
            return ""  # the walk over the file will name the damage

    def _read_summary(self) -> dict[int, int] | None:
        """Message counts by channel if index and statistics can be trusted to describe the whole
        file, else None.
        """
        tail_size = _FOOTER.size + len(MAGIC)
        if self._size < len(MAGIC) + tail_size:
            return None
        footer_at = self._size - tail_size
        tail = read_exactly(self._file, footer_at, tail_size, self._size)
        opcode, length, summary_start, _, crc = _FOOTER.unpack(tail[: _FOOTER.size])
        if (
            not tail.endswith(MAGIC)
            or opcode != Opcode.FOOTER
            or length != 20
            or not len(MAGIC) <= summary_start <= footer_at
        ):
            return None  # not closed, truncated, or closed without a summary (0)
        summary = read_exactly(self._file, summary_start, footer_at - summary_start, self._size)
        if crc and zlib.crc32(tail[: _FOOTER.size - 4], zlib.crc32(summary)) != crc:
            self._problems.add(
                f"{self._name}: the index at byte {summary_start} does not match its checksum, so the whole file was walked."
            )
            return None
        try:
            return self._trusted_summary(summary)
        except LogError as error:
            self._problems.add(
                f"{self._name}: the index at byte {summary_start} is damaged ({error}), so the whole file was walked."
            )
            return None

    def _trusted_summary(self, summary: bytes) -> dict[int, int] | None:
        statistics: Statistics | None = None
        indexes: list[ChunkIndex] = []
        for opcode, start, end in _records(summary):
            body = summary[start:end]
            if opcode == Opcode.STATISTICS:
                statistics = self._parse(Statistics.read, body)
            elif opcode == Opcode.CHUNK_INDEX:
                indexes.append(self._parse(ChunkIndex.read, body))
            else:
                self._define(opcode, body)
        if (
            statistics is None
            or len(indexes) != statistics.chunk_count
            or (statistics.message_count and not indexes)
        ):
            return None
        counts: dict[int, int] = statistics.channel_message_counts
        known = all(
            c in self._channels and self._channels[c].schema_id in (0, *self._schemas)
            for c in counts
        )
        if not known or sum(counts.values()) != statistics.message_count:
            return None  # allowed, but then only a walk tells what is in the file
        for i in indexes:
            if i.chunk_start_offset + i.chunk_length > self._size:
                raise LogError(
                    f"a chunk is claimed at byte {i.chunk_start_offset}, but the file ends at byte {self._size}"
                )
            channels = frozenset(i.message_index_offsets)
            self._parts.append(
                Part(
                    i.chunk_start_offset,
                    i.chunk_length,
                    i.message_start_time,
                    i.message_end_time,
                    channels,
                    True,
                )
            )
        if statistics.message_count:
            self.start_ns = statistics.message_start_time
            self.end_ns = statistics.message_end_time
        return counts

    def _scan(self) -> dict[int, int]:
        """Walks over all records, decompresses every chunk once, and so finds parts and counts of
        what can be read.
        """
        self._parts.clear()
        counts: Counter[int] = Counter()
        position = len(MAGIC)
        closed = False
        loose: list[Part] = []
        while position + _RECORD.size <= self._size and not closed:
            opcode, length = _RECORD.unpack(
                read_exactly(self._file, position, _RECORD.size, self._size)
            )
            end = position + _RECORD.size + length
            if opcode == 0 or end > self._size:
                break
            try:
                if opcode == Opcode.CHUNK:
                    self._scan_chunk(position, end - position, counts)
                elif opcode == Opcode.MESSAGE and length >= 22:
                    self._scan_loose(position, end - position, loose, counts)
                elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self._define(
                        opcode,
                        read_exactly(self._file, position + _RECORD.size, length, self._size),
                    )
            except LogError as error:
                self._problems.add(
                    f"{self._name}: the record at byte {position} was skipped: {error}."
                )
            closed = opcode in (Opcode.DATA_END, Opcode.FOOTER)
            position = end
        self._parts += loose
        if (
            not closed
            or read_exactly(self._file, self._size - len(MAGIC), len(MAGIC), self._size) != MAGIC
        ):
            self._problems.add(
                f"{self._name}: the file is damaged or cut off at byte {position} of {self._size}; "
                f"the {sum(counts.values())} messages before it are used."
            )
        if self._parts:
            self.start_ns, self.end_ns = (
                min(p.start_ns for p in self._parts),
                max(p.end_ns for p in self._parts),
            )
        return counts

    def _scan_chunk(self, offset: int, size: int, counts: Counter[int]) -> None:
        found = self._walk(self._unpack_chunk(offset, size), offset)
        if found:
            times = [f[0] for f in found]
            channels = frozenset(f[1] for f in found)
            counts.update(f[1] for f in found if f[1] in self._channels)
            self._parts.append(Part(offset, size, min(times), max(times), channels, True))

    def _scan_loose(self, offset: int, size: int, loose: list[Part], counts: Counter[int]) -> None:
        _, _, channel, _, log_time, _ = _MESSAGE.unpack(
            read_exactly(self._file, offset, _MESSAGE.size, self._size)
        )
        if channel in self._channels:
            counts[channel] += 1
        last = loose[-1] if loose else None
        if last and last.offset + last.size == offset and last.size + size <= _LOOSE:
            times = min(last.start_ns, log_time), max(last.end_ns, log_time)
            loose[-1] = Part(
                last.offset, last.size + size, *times, last.channels | {channel}, False
            )
        else:
            loose.append(Part(offset, size, log_time, log_time, frozenset((channel,)), False))

    # -- reading

    def _load(self, part: Part, wanted: frozenset[str] | None) -> Iterator[Message]:
        """The messages of one part in log-time order; its bytes live as long as this iterator."""
        try:
            if part.chunk:
                data = self._unpack_chunk(part.offset, part.size)
            else:
                data = read_exactly(self._file, part.offset, part.size, self._size)
        except (LogError, OSError) as error:
            self._problems.add(
                f"{self._name}: the chunk at byte {part.offset} was skipped: {error}."
            )
            return
        view = memoryview(data)
        found = self._walk(data, part.offset)
        found.sort(key=lambda f: f[0])  # stable, and nearly free for what is in order already
        for log_time, channel, start, end in found:
            if channel not in self._channels:
                self._problems.add(
                    f"{self._name}: messages of channel {channel} were skipped: the file does not say what it is."
                )
                continue
            topic, type_, encoding, definition = self._kind(channel)
            if wanted is None or topic in wanted:
                yield Message(topic, type_, encoding, log_time, view[start:end], definition)

    def _unpack_chunk(self, offset: int, size: int) -> bytes:
        record = read_exactly(self._file, offset, size, self._size)
        try:
            opcode, length, _, _, unpacked_size, crc, name_length = struct.unpack_from(
                "<BQQQQII", record
            )
            compression = record[41 : 41 + name_length].decode()
            (data_length,) = struct.unpack_from("<Q", record, 41 + name_length)
        except (struct.error, UnicodeDecodeError) as error:
            raise LogError(f"its head is damaged ({error})") from error
        start = 49 + name_length
        if opcode != Opcode.CHUNK or length + _RECORD.size != size or start + data_length > size:
            raise LogError("it is not the chunk that the index claims")
        data = decompress(record[start : start + data_length], compression, unpacked_size)
        if crc and zlib.crc32(data) != crc:
            raise LogError("its checksum does not match its data")
        return data

    def _walk(self, data: bytes, offset: int) -> list[tuple[int, int, int, int]]:
        """(log time, channel, start, end) of the messages in ``data``; learns of schemas and
        channels on the way.
        """
        found = []
        unpack = _MESSAGE.unpack_from
        record_size = _RECORD.size
        message = int(Opcode.MESSAGE)
        try:
            for opcode, start, end in _records(data):
                if opcode == message:
                    if end - start < 22:
                        raise LogError(f"a message has {end - start} bytes")
                    _, _, channel, _, log_time, _ = unpack(data, start - record_size)
                    found.append((log_time, channel, start + 22, end))
                else:
                    self._define(opcode, data[start:end])
        except LogError as error:
            self._problems.add(
                f"{self._name}: the chunk at byte {offset} is damaged inside: {error}; {len(found)} messages of it are used."
            )
        return found

    def _define(self, opcode: int, body: bytes) -> None:
        if opcode == Opcode.SCHEMA:
            schema = self._parse(Schema.read, body)
            self._schemas.setdefault(schema.id, schema)
        elif opcode == Opcode.CHANNEL:
            channel = self._parse(Channel.read, body)
            self._channels.setdefault(channel.id, channel)

    def _parse(self, read: Callable[[ReadDataStream], Record], body: bytes) -> Record:
        try:
            return read(ReadDataStream(BytesIO(body)))
        except (McapError, struct.error, ValueError, MemoryError, OverflowError) as error:
            raise LogError(
                f"a record cannot be parsed ({error or type(error).__name__})"
            ) from error

    def _topic(self, channel: int) -> str:
        return self._kind(channel)[0] if channel in self._channels else ""

    def _kind(self, channel: int) -> tuple[str, str, str, Definition]:
        """Topic, type, encoding and definition of a channel."""
        if channel not in self._kinds:
            c = self._channels[channel]
            schema = self._schemas.get(c.schema_id)
            definition = (
                Definition(schema.name, schema.encoding, schema.data)
                if schema
                else Definition("", "", b"")
            )
            type_ = (
                ros2_type(definition.name)
                if c.message_encoding in ("cdr", "ros1")
                else definition.name
            )
            if schema is None and c.schema_id:
                return c.topic, type_, c.message_encoding, definition  # its schema may still come
            self._kinds[channel] = (c.topic, type_, c.message_encoding, definition)
        return self._kinds[channel]


def _records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """(opcode, start of its body, end of its body) of the records in ``data``; LogError where they
    stop making sense.
    """
    position = 0
    size = len(data)
    head = _RECORD.size
    unpack = _RECORD.unpack_from
    while position + head <= size:
        opcode, length = unpack(data, position)
        start = position + head
        position = start + length
        if position > size:
            raise LogError(
                f"a record at byte {start - head} in it claims {length} bytes of {size - start}"
            )
        yield opcode, start, position
    if position != size:
        raise LogError(f"{size - position} bytes at its end are no record")
