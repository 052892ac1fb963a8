"""MCAP files: by their index where it can be trusted, else by walking over all records.

Memory holds overlapping chunks only, within its limit.
"""

from __future__ import annotations

import struct
import threading
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, Header, Schema, Statistics

from semloc_logs.errors import LogError
from semloc_logs.logs.containers.base import (
    BagFile,
    BaseLog,
    Bytes,
    MessageOrTime,
    closed_on_error,
    encoding_of,
    in_log_time_order,
    open_file,
    read_at,
    read_exactly,
    read_into,
)
from semloc_logs.logs.containers.chunks import (
    LARGE,
    Chunk,
    Index,
    Kind,
    chunk_messages,
    new_index,
)
from semloc_logs.logs.containers.mcap_records import (
    CHUNK_HEAD,
    COMPRESSION_END,
    HEAD,
    MAGIC,
    MESSAGE,
    MESSAGE_BODY,
    IndexedChunk,
    chunk_head,
    chunk_records,
    claimed_size,
    indexed_chunk,
    is_compressed,
    parse,
    spans,
    walk,
)
from semloc_logs.logs.containers.memory import Memory
from semloc_logs.logs.containers.read_ahead import ReadAhead
from semloc_logs.logs.log import Definition, Message, Section, Stream
from semloc_logs.logs.messages.type_names import ros2_type

_FOOTER = struct.Struct("<BQQQI")
_LOOSE = 1 << 22  # messages outside chunks are read in runs of about this many bytes
_CHANNEL_BYTES = 16  # in memory for a byte of a channel's record: its metadata are many short texts


class Part(NamedTuple):
    """A chunk record, or a run of messages outside chunks: its place and its times."""

    offset: int
    size: int
    start_ns: int
    end_ns: int
    channels: frozenset[int]  # empty: unknown
    chunk: bool


class McapLog(BaseLog):
    """An MCAP file of any profile. LogError unless it starts as one."""

    def __init__(
        self, path: Path, memory: Memory | None = None, bag_file: BagFile | None = None
    ) -> None:
        super().__init__(path, "mcap", memory, bag_file)
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._kinds: dict[int, tuple[str, str, str, Definition]] = {}
        self._publishers: dict[int, str] = {}  # of channels that share their topic
        self._parts: list[Part] = []
        self._definition_bytes = 0
        self._buffers = threading.local()  # of each thread, for compressed chunks
        self._file = open_file(path)
        with closed_on_error(self._file, path):
            self._size = self._file.seek(0, 2)
            self._open()

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """The messages of ``topics`` (None: of all) in log-time order.

        A damaged chunk is skipped and named in ``problems``.
        """
        wanted = None if topics is None else frozenset(topics)
        parts = [
            p
            for p in self._parts
            if wanted is None or not p.channels or any(self._topic(c) in wanted for c in p.channels)
        ]
        parts.sort(key=lambda p: p.start_ns)  # stable, as the merge is
        with ReadAhead(parts, self._claimed_size, self._unpack, self._memory) as ahead:
            yield from in_log_time_order(
                (p.start_ns, partial(self._load, p, wanted, partial(ahead.take, p))) for p in parts
            )

    def sections(self) -> list[Section]:
        """The chunks and runs of messages outside chunks, by their first log time."""
        topics_of: dict[frozenset[int], frozenset[str]] = {}
        sections = []
        for part in sorted(self._parts, key=lambda p: (p.start_ns, p.offset)):
            topics = topics_of.get(part.channels)
            if topics is None:
                topics = frozenset(self._topic(channel) for channel in part.channels)
                topics_of[part.channels] = topics
            messages = partial(self._load_topics, part)
            sections.append(Section(part.start_ns, part.end_ns, part.size, topics, messages))
        return sections

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
        self._publishers = self._shared_channels()
        self.encoding = profile if profile in ("ros1", "ros2") else encoding_of(self.streams)

    def _profile(self) -> str:
        try:
            opcode, length = HEAD.unpack(read_exactly(self._file, 8, HEAD.size, self._size))
            if opcode != Opcode.HEADER:
                return ""
            return str(parse(Header.read, read_exactly(self._file, 17, length, self._size)).profile)
        except LogError:
            return ""  # the walk over the file will name the damage

    def _read_summary(self) -> dict[int, int] | None:
        """Message counts by channel; None where the index does not describe the whole file."""
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
        if footer_at - summary_start > self._memory.most_of_definitions:
            self._problems.add(
                f"{self._name}: the index at byte {summary_start} has {footer_at - summary_start} "
                "bytes, too many for logs.memory, so the whole file was walked.",
                lost=False,
            )
            return None
        summary = read_exactly(self._file, summary_start, footer_at - summary_start, self._size)
        if crc and zlib.crc32(tail[: _FOOTER.size - 4], zlib.crc32(summary)) != crc:
            self._problems.add(
                f"{self._name}: the index at byte {summary_start} does not match its "
                "checksum, so the whole file was walked."
            )
            return None
        try:
            return self._trusted_summary(summary)
        except LogError as error:
            self._problems.add(
                f"{self._name}: the index at byte {summary_start} is damaged ({error}), "
                "so the whole file was walked."
            )
            return None

    def _trusted_summary(self, summary: bytes) -> dict[int, int] | None:
        statistics, indexes = self._summary_records(summary)
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
            return None  # allowed, but then only a walk finds the contents of the file
        for chunk in indexes:
            if chunk.offset + chunk.size > self._size:
                raise LogError(
                    f"a chunk is claimed at byte {chunk.offset}, "
                    f"but the file ends at byte {self._size}"
                )
            self._parts.append(Part(*chunk, chunk=True))
        if statistics.message_count:
            self.start_ns = statistics.message_start_time
            self.end_ns = statistics.message_end_time
        return counts

    def _summary_records(self, summary: bytes) -> tuple[Statistics | None, list[IndexedChunk]]:
        """Statistics and chunk indexes; learns of schemas and channels on the way."""
        statistics: Statistics | None = None
        indexes: list[IndexedChunk] = []
        known_sets: dict[frozenset[int], frozenset[int]] = {}  # most chunks have the same channels
        for opcode, start, end in spans(summary):
            body = summary[start:end]
            if opcode == Opcode.STATISTICS:
                statistics = parse(Statistics.read, body)
            elif opcode == Opcode.CHUNK_INDEX:
                chunk = indexed_chunk(body)
                channels = known_sets.setdefault(chunk.channels, chunk.channels)
                indexes.append(chunk._replace(channels=channels))
            else:
                self._define(opcode, body)
        return statistics, indexes

    def _scan(self) -> dict[int, int]:
        """Walks over all records and decompresses every chunk once.

        Finds parts and counts of everything that can be read.
        """
        self._parts.clear()
        counts: Counter[int] = Counter()
        position = len(MAGIC)
        closed = False
        loose: list[Part] = []
        for opcode, offset, size in walk(self._file, position, self._size):
            try:
                if opcode == Opcode.CHUNK:
                    self._scan_chunk(offset, size, counts)
                elif opcode == Opcode.MESSAGE and size >= MESSAGE.size:
                    self._scan_loose(offset, size, loose, counts)
                elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    body_size = size - HEAD.size
                    body = self._read(offset + HEAD.size, body_size)
                    self._define(opcode, body)
            except LogError as error:
                self._problems.add(
                    f"{self._name}: the record at byte {offset} was skipped: {error}."
                )
            position = offset + size
            closed = opcode in (Opcode.DATA_END, Opcode.FOOTER)
            if closed:
                break
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
        data = self._unpack_chunk(offset, size)
        index = new_index(len(data), self._memory)
        self._walk(offset, data, index)
        if len(index):
            start_ns = min(entry[0] for entry in index)
            end_ns = max(entry[0] for entry in index)
            by_channel = Counter(entry[1] for entry in index)
            counts.update({c: n for c, n in by_channel.items() if c in self._channels})
            self._parts.append(Part(offset, size, start_ns, end_ns, frozenset(by_channel), True))

    def _scan_loose(self, offset: int, size: int, loose: list[Part], counts: Counter[int]) -> None:
        _, _, channel, _, log_time, _ = MESSAGE.unpack(
            read_exactly(self._file, offset, MESSAGE.size, self._size)
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

    def _load_topics(self, part: Part, topics: Collection[str] | None) -> Iterator[Message]:
        wanted = None if topics is None else frozenset(topics)
        load = partial(self._load, part, wanted, partial(self._unpack, part))
        return in_log_time_order([(part.start_ns, load)])

    def _load(
        self, part: Part, wanted: frozenset[str] | None, unpack: Callable[[], Bytes]
    ) -> Iterator[MessageOrTime]:
        """The messages of one part in log-time order."""
        chunk = Chunk(
            start_ns=part.start_ns,
            claimed_size=partial(self._claimed_size, part),
            unpack=unpack,
            walk=partial(self._walk, part.offset),
            kind=partial(self._wanted_kind, wanted),
        )
        try:
            yield from chunk_messages(chunk, self._memory)
        except (LogError, OSError) as error:
            what = "chunk" if part.chunk else "record"
            self._problems.add(
                f"{self._name}: the {what} at byte {part.offset} was skipped: {error}."
            )

    def _wanted_kind(self, wanted: frozenset[str] | None, channel: int) -> Kind | None:
        if channel not in self._channels:
            self._problems.add(
                f"{self._name}: messages of channel {channel} were skipped: "
                "the file does not say what it is."
            )
            return None
        topic, type_, encoding, definition = self._kind(channel)
        if wanted is not None and topic not in wanted:
            return None
        return Kind(topic, type_, encoding, definition, self._publishers.get(channel, ""))

    def _read(self, offset: int, size: int) -> bytes:
        self._memory.check(size)
        return read_at(self._file, offset, size, self._size)

    def _claimed_size(self, part: Part) -> int:
        """Bytes of a part in memory."""
        if not part.chunk:
            return part.size
        return claimed_size(self._read(part.offset, min(part.size, CHUNK_HEAD)))

    def _unpack(self, part: Part) -> Bytes:
        """The records of a part; called from several threads."""
        if part.chunk:
            return self._unpack_chunk(part.offset, part.size)
        return self._read(part.offset, part.size)

    def _unpack_chunk(self, offset: int, size: int) -> Bytes:
        record = self._chunk_record(offset, size)
        return chunk_records(record, chunk_head(record), self._memory)

    def _chunk_record(self, offset: int, size: int) -> Bytes:
        """A chunk record: in a buffer that the next one overwrites where it is compressed.

        A buffer that is used again spares the pages of a new one.
        """
        self._memory.check(size)
        start = self._read(offset, min(size, COMPRESSION_END))
        if size > LARGE or not is_compressed(start):
            return self._read(offset, size)
        buffer: bytearray = getattr(self._buffers, "record", bytearray())
        if len(buffer) < size:
            buffer = self._buffers.record = bytearray(size)
        record = memoryview(buffer)[:size]
        read_into(self._file, offset, record, self._size)
        return record

    def _walk(self, offset: int, data: Bytes, index: Index) -> None:
        """Puts (log time, channel, start, end) of the messages in ``data`` into ``index``.

        Learns of schemas and channels on the way.
        """
        unpack = MESSAGE.unpack_from
        record_size = HEAD.size
        message = int(Opcode.MESSAGE)
        append = index.append
        try:
            for opcode, start, end in spans(data):
                if opcode == message:
                    if end - start < MESSAGE_BODY:
                        raise LogError(f"a message has {end - start} bytes")
                    _, _, channel, _, log_time, _ = unpack(data, start - record_size)
                    append((log_time, channel, start + MESSAGE_BODY, end))
                else:
                    self._define(opcode, bytes(data[start:end]))
        except LogError as error:
            self._problems.add(
                f"{self._name}: the chunk at byte {offset} is damaged inside: {error}; "
                f"{len(index)} messages of it are used."
            )

    def _define(self, opcode: int, body: bytes) -> None:
        if opcode == Opcode.SCHEMA:
            schema = parse(Schema.read, body)
            if schema.id not in self._schemas:
                self._count_definition(len(body))
                self._schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            self._memory.check(_CHANNEL_BYTES * len(body))
            channel = parse(Channel.read, body)
            if channel.id not in self._channels:
                self._count_definition(_CHANNEL_BYTES * len(body))
                self._channels[channel.id] = channel

    def _count_definition(self, size: int) -> None:
        """LogError where the schemas and channels take too much memory."""
        if self._definition_bytes + size > self._memory.most_of_definitions:
            raise LogError(
                f"its schemas and channels take more than {self._memory.most_of_definitions} bytes"
            )
        self._definition_bytes += size

    def _shared_channels(self) -> dict[int, str]:
        """The node, or else the number, of each channel whose stream has several."""
        channels: dict[tuple[str, str, str], list[int]] = {}
        for channel in self._channels:
            channels.setdefault(self._kind(channel)[:3], []).append(channel)
        return {
            channel: self._channels[channel].metadata.get("callerid") or f"channel {channel}"
            for several in channels.values()
            if len(several) > 1
            for channel in several
        }

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
