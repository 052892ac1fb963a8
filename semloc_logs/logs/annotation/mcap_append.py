"""Adding channels to an MCAP file without decoding its records.

An MCAP file is magic, data section, DataEnd, summary, footer, magic. To add records, everything up
to DataEnd is kept as it is, and the tail of the file, from DataEnd on, is written anew: our
records, a continued DataEnd and a summary that lists old and new. Our last record is a metadata
record that states where ours start. A later run finds them by it and puts new ones in their place.

:func:`read_end` reads the end of a file once; :func:`plan_append` turns it and new messages into an
:class:`AppendPlan`, a value; who applies the plan knows nothing of MCAP.
"""

from __future__ import annotations

import hashlib
import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from semloc_logs.errors import LogError
from semloc_logs.logs.annotation.channels import RUN_KEY, NewChannel, NewMessage
from semloc_logs.logs.containers.mcap_records import HEAD, MAGIC, Record, parse, raw, spans
from semloc_logs.logs.containers.mcap_scan import SUMMARY_ORDER, Summary, scan
from semloc_logs.logs.containers.memory import Memory

METADATA_PREFIX = "semloc/"
CHUNK_SIZE = 1 << 20  # bytes of a chunk before compression
MAX_HEADER = 1 << 20  # bytes of the header record that are read
MAX_METADATA = 1 << 24  # bytes; our metadata record is smaller
_DATA_END_SIZE = HEAD.size + 4
_FOOTER_SIZE = HEAD.size + 20
_PADDING = 256  # bytes by which a DataEnd record may be longer than the specification states
_NO_STATISTICS = Statistics(0, 0, {}, 0, 0, 0, 0, 0, 0)


@dataclass(frozen=True, slots=True)
class LogEnd:
    """What the end of a file holds, our own earlier records taken away.

    ``start`` is where our records start; ``crc`` is the CRC of the bytes before, 0 where the file
    has none. ``old_tail`` are the bytes from ``start`` on, our earlier records included.
    """

    header: Header
    start: int
    crc: int
    summary: Summary
    schemas: Sequence[Schema]
    channels: Sequence[Channel]
    old_tail: bytes
    replaces: bool  # whether the file holds records of ours


@dataclass(frozen=True, slots=True)
class AppendPlan:
    """How a file changes: from ``start`` on, ``new_tail`` takes the place of ``old_tail``."""

    start: int
    old_tail: bytes
    new_tail: bytes


class _Tail(NamedTuple):
    """A file from its DataEnd record on."""

    data_end: int  # offset
    crc: int
    groups: dict[int, list[bytes]]  # raw records of the summary by opcode
    data: bytes


class _NewRecords(NamedTuple):
    """The records to add, with the ids that they get in the file."""

    schemas: list[Schema]
    channels: list[Channel]
    messages: list[Message]


def read_header(file: BinaryIO, path: Path) -> Header:
    """The header record; ``LogError`` when the file is no MCAP file."""
    file.seek(0)
    start = file.read(len(MAGIC) + HEAD.size)
    if start[:8] != MAGIC or len(start) < 17 or start[8] != Opcode.HEADER:
        raise LogError(
            f"{path} is not an MCAP file: it does not start with the MCAP magic and a header; "
            "give another file."
        )
    length = int.from_bytes(start[9:], "little")
    body = file.read(min(length, MAX_HEADER))
    if len(body) < length:
        raise LogError(f"{path} is cut off in its header; {_advice(path)}")
    header: Header = _parsed(Header.read, body, path, len(MAGIC))
    return header


def read_end(file: BinaryIO, path: Path, memory: Memory | None = None) -> LogEnd:
    """The end of an MCAP file, our own earlier records taken away, within ``memory``.

    A file whose summary is missing or incomplete is scanned for what it should list. Raises
    ``LogError`` when the file is cut off or damaged, or when it holds records of ours that another
    tool moved.
    """
    memory = Memory() if memory is None else memory
    header = read_header(file, path)
    tail = _read_tail(file, path, memory)
    own = _own_metadata(file, tail)
    summary = _complete_summary(tail.groups, path) or scan(file, tail.data_end, path, memory)
    start = tail.data_end
    crc = tail.crc
    if own is not None:
        start, crc, summary = _without_own(own, summary, path)
    _check(path, tail.data_end - start, start, memory)
    file.seek(start)
    old_tail = file.read(tail.data_end - start) + tail.data
    schemas = _definitions(Schema.read, summary.groups.get(Opcode.SCHEMA, ()), path, start)
    channels = _definitions(Channel.read, summary.groups.get(Opcode.CHANNEL, ()), path, start)
    for channel in channels:
        if RUN_KEY in channel.metadata:
            raise LogError(
                f"{path} holds results on {channel.topic} that another tool moved or followed by "
                "other records, so they cannot be replaced; annotate the original log, or remove "
                "the /semloc/ topics with `mcap filter` first."
            )
    return LogEnd(header, start, crc, summary, schemas, channels, old_tail, own is not None)


def empty_end(profile: str, library: str) -> tuple[bytes, LogEnd]:
    """The first bytes of a new file, and the end that continues it."""
    header = Header(profile, library)
    start = MAGIC + raw(header)
    summary = Summary({}, _NO_STATISTICS, 0)
    return start, LogEnd(header, len(start), zlib.crc32(start), summary, (), (), b"", False)


def plan_append(
    end: LogEnd,
    channels: Sequence[NewChannel],
    messages: Sequence[NewMessage],
    name: str,
    metadata: Mapping[str, str],
) -> AppendPlan:
    """The tail with our records: messages (in log-time order), then the metadata record ``name``.

    After them come DataEnd, summary and footer.
    """
    new = _numbered(end.summary, channels if messages else (), messages)
    # a log whose messages lie outside of chunks stays so: readers that find one chunk index look
    # nowhere else
    indexes: list[ChunkIndex] = []
    if end.summary.loose_messages:
        body = b"".join(raw(r) for r in (*new.schemas, *new.channels, *new.messages))
    else:
        body, indexes = _chunks(end.start, new)
    own = raw(Metadata(name, {**metadata, **_marker(end, body, new)}))
    own_index = MetadataIndex(end.start + len(body), len(own), name)
    body += own

    groups = {opcode: list(entries) for opcode, entries in end.summary.groups.items()}
    added: dict[int, Sequence[Any]] = {
        Opcode.SCHEMA: new.schemas,
        Opcode.CHANNEL: new.channels,
        Opcode.CHUNK_INDEX: indexes,
        Opcode.METADATA_INDEX: [own_index],
    }
    for opcode, records in added.items():
        groups.setdefault(opcode, []).extend(raw(record) for record in records)
    groups[Opcode.STATISTICS] = [raw(_with_new(end.summary.statistics, new, len(indexes)))]

    body += raw(DataEnd(zlib.crc32(body, end.crc) if end.crc else 0))
    return AppendPlan(end.start, end.old_tail, body + _summary(end.start + len(body), groups))


def content_end(log: Path) -> int | None:
    """How many bytes of an MCAP file are recorded content, our own records not counted.

    None when its end is missing or damaged.
    """
    try:
        with log.open("rb") as file:
            tail = _read_tail(file, log, Memory())
            own = _own_metadata(file, tail)
            return tail.data_end if own is None else int(own.metadata["start"])
    except LogError:
        return None


# -- reading


def _read_tail(file: BinaryIO, path: Path, memory: Memory) -> _Tail:
    """The end of a file from DataEnd on; ``LogError`` when it is cut off or damaged."""
    size = file.seek(0, 2)
    cut = LogError(f"{path} is cut off or damaged at its end (offset {size}); {_advice(path)}")
    file.seek(max(0, size - _FOOTER_SIZE - len(MAGIC)))
    end = file.read()
    if len(end) != _FOOTER_SIZE + len(MAGIC) or end[-8:] != MAGIC:
        raise cut
    if end[: HEAD.size] != HEAD.pack(Opcode.FOOTER, 20):
        raise cut
    summary_start, _, summary_crc = struct.unpack("<QQI", end[9:29])
    footer_at = size - len(end)
    summary_start = summary_start or footer_at
    if not len(MAGIC) + _DATA_END_SIZE <= summary_start <= footer_at:
        raise cut

    _check(path, 2 * (footer_at - summary_start), summary_start, memory)
    before_at = max(0, summary_start - _DATA_END_SIZE - _PADDING)
    file.seek(before_at)
    data = file.read(footer_at - before_at)
    record = _data_end(data[: summary_start - before_at])
    if record is None:
        raise cut
    summary = data[summary_start - before_at :]
    if summary_crc and zlib.crc32(end[:25], zlib.crc32(summary)) != summary_crc:
        raise LogError(
            f"{path} has a damaged summary (checksum at offset {size - 12}); {_advice(path)}"
        )
    groups = _groups(summary, cut)
    crc = int.from_bytes(record[9:13], "little")
    return _Tail(summary_start - len(record), crc, groups, record + summary + end)


def _check(path: Path, size: int, offset: int, memory: Memory) -> None:
    """LogError where a part of the file is too large for memory."""
    if size > memory.most_of_one:
        raise LogError(f"{path}: its end from offset {offset} on {memory.too_much(size)}.")


def _groups(summary: bytes, error: LogError) -> dict[int, list[bytes]]:
    """The raw records of a summary by opcode, without the summary offsets."""
    groups: dict[int, list[bytes]] = {}
    try:
        for opcode, start, stop in spans(summary):
            if opcode != Opcode.SUMMARY_OFFSET:
                groups.setdefault(opcode, []).append(summary[start - HEAD.size : stop])
    except LogError:
        raise error from None
    return groups


def _data_end(before: bytes) -> bytes | None:
    """The DataEnd record at the end of ``before``; a writer may have extended it by some bytes."""
    for padding in range(len(before) - _DATA_END_SIZE + 1):
        record = before[len(before) - _DATA_END_SIZE - padding :]
        if record[: HEAD.size] == HEAD.pack(Opcode.DATA_END, 4 + padding):
            return record
    return None


def _complete_summary(groups: Mapping[int, list[bytes]], path: Path) -> Summary | None:
    """The summary as it is, if it lists everything that its statistics count."""
    if len(groups.get(Opcode.STATISTICS, ())) != 1:
        return None
    counted = _parsed(Statistics.read, groups[Opcode.STATISTICS][0][HEAD.size :], path, 0)
    listed = {
        opcode: len({entry[9:11] for entry in groups.get(opcode, ())})
        for opcode in (Opcode.SCHEMA, Opcode.CHANNEL)
    }
    for opcode in (Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX):
        listed[opcode] = len(groups.get(opcode, ()))
    expected = {
        Opcode.SCHEMA: counted.schema_count,
        Opcode.CHANNEL: counted.channel_count,
        Opcode.CHUNK_INDEX: counted.chunk_count,
        Opcode.ATTACHMENT_INDEX: counted.attachment_count,
        Opcode.METADATA_INDEX: counted.metadata_count,
    }
    if listed != expected or sum(counted.channel_message_counts.values()) != counted.message_count:
        return None
    loose = counted.message_count if not counted.chunk_count else 0
    return Summary(dict(groups), counted, loose)


def _own_metadata(file: BinaryIO, tail: _Tail) -> Metadata | None:
    """Our metadata record, if ours are the last of the data section, exactly as we wrote them."""
    for entry in tail.groups.get(Opcode.METADATA_INDEX, ()):
        if entry[29 : 29 + len(METADATA_PREFIX)] != METADATA_PREFIX.encode():
            continue
        offset = int.from_bytes(entry[9:17], "little")
        length = tail.data_end - offset
        if not 0 < offset < tail.data_end or length >= MAX_METADATA:
            continue
        file.seek(offset)
        record = file.read(length)
        if record[: HEAD.size] != HEAD.pack(Opcode.METADATA, length - HEAD.size):
            continue
        try:
            metadata: Metadata = parse(Metadata.read, record[HEAD.size :])
            start = int(metadata.metadata["start"])
            digest = metadata.metadata["records_sha256"]
        except (KeyError, ValueError, LogError):
            continue
        if len(MAGIC) < start <= offset and hash_range(file, start, offset).hexdigest() == digest:
            return metadata
    return None


def hash_range(file: BinaryIO, start: int, stop: int) -> Any:
    """sha256 object over the bytes [start, stop) of an open file."""
    digest = hashlib.sha256()
    file.seek(start)
    while start < stop and (block := file.read(min(1 << 20, stop - start))):
        digest.update(block)
        start += len(block)
    return digest


def _without_own(own: Metadata, summary: Summary, path: Path) -> tuple[int, int, Summary]:
    """Start of our records; CRC and summary as they were before our records came."""
    try:
        start = int(own.metadata["start"])
        crc = int(own.metadata["data_section_crc"])
        times = int(own.metadata["log_start_ns"]), int(own.metadata["log_end_ns"])
        schema_ids = {struct.pack("<H", int(i)) for i in own.metadata["schema_ids"].split()}
        channel_ids = {struct.pack("<H", int(i)) for i in own.metadata["channel_ids"].split()}
    except (KeyError, ValueError, struct.error) as error:
        raise LogError(
            f"{path}: the metadata record {own.name!r} is not one of ours; annotate the original "
            "log."
        ) from error
    groups = {opcode: list(entries) for opcode, entries in summary.groups.items()}
    for opcode, ids in ((Opcode.SCHEMA, schema_ids), (Opcode.CHANNEL, channel_ids)):
        groups[opcode] = [entry for entry in groups.get(opcode, ()) if entry[9:11] not in ids]
    # the offset of what they index lies at byte 25 of chunk indexes, at byte 9 of metadata indexes
    for opcode, place in ((Opcode.CHUNK_INDEX, 25), (Opcode.METADATA_INDEX, 9)):
        groups[opcode] = [
            entry
            for entry in groups.get(opcode, ())
            if int.from_bytes(entry[place : place + 8], "little") < start
        ]
    old = summary.statistics
    ours = {int.from_bytes(i, "little") for i in channel_ids}
    counts = {c: n for c, n in old.channel_message_counts.items() if c not in ours}
    dropped = len(summary.groups.get(Opcode.CHUNK_INDEX, ())) - len(groups[Opcode.CHUNK_INDEX])
    statistics = Statistics(
        attachment_count=old.attachment_count,
        channel_count=old.channel_count - len(channel_ids),
        channel_message_counts=counts,
        chunk_count=old.chunk_count - dropped,
        message_count=sum(counts.values()),
        message_end_time=times[1],
        message_start_time=times[0],
        metadata_count=old.metadata_count - 1,
        schema_count=old.schema_count - len(schema_ids),
    )
    loose = summary.loose_messages and statistics.message_count
    return start, crc, Summary(groups, statistics, loose)


# -- writing


def _numbered(
    summary: Summary, channels: Sequence[NewChannel], messages: Sequence[NewMessage]
) -> _NewRecords:
    """Records with ids above those in use; messages are counted from 0 on each channel."""
    schema_id = _highest_id(summary, Opcode.SCHEMA) + 1
    channel_id = _highest_id(summary, Opcode.CHANNEL) + 1
    if max(schema_id, channel_id) + len(channels) > 1 << 16:
        raise LogError(
            "The log has no free schema or channel ids left; write a sidecar with "
            "`--sidecar OUT.mcap` instead."
        )
    new = _NewRecords([], [], [])
    for k, c in enumerate(channels):
        schema = Schema(schema_id + k, c.schema_data, c.schema_encoding, c.schema_name)
        new.schemas.append(schema)
        new.channels.append(
            Channel(channel_id + k, c.topic, c.message_encoding, dict(c.metadata), schema.id)
        )
    sequence = [0] * len(channels)
    for m in messages:
        time = m.log_time_ns
        number = sequence[m.channel]
        new.messages.append(Message(channel_id + m.channel, time, m.data, time, number))
        sequence[m.channel] += 1
    return new


def _highest_id(summary: Summary, opcode: Opcode) -> int:
    ids = (int.from_bytes(record[9:11], "little") for record in summary.groups.get(opcode, ()))
    return max(ids, default=0)


def _marker(end: LogEnd, body: bytes, new: _NewRecords) -> dict[str, str]:
    """What a later run needs to take our records away."""
    old = end.summary.statistics
    return {
        "start": str(end.start),
        "records_sha256": hashlib.sha256(body).hexdigest(),
        "data_section_crc": str(end.crc),
        "log_start_ns": str(old.message_start_time),
        "log_end_ns": str(old.message_end_time),
        "schema_ids": " ".join(str(s.id) for s in new.schemas),
        "channel_ids": " ".join(str(c.id) for c in new.channels),
    }


def _with_new(old: Statistics, new: _NewRecords, chunks: int) -> Statistics:
    """The statistics of a file with our records."""
    counts = dict(old.channel_message_counts)
    for channel in new.channels:
        counts[channel.id] = sum(m.channel_id == channel.id for m in new.messages)
    times = [m.log_time for m in new.messages]
    if old.message_count:
        times += [old.message_start_time, old.message_end_time]
    return Statistics(
        attachment_count=old.attachment_count,
        channel_count=old.channel_count + len(new.channels),
        channel_message_counts=counts,
        chunk_count=old.chunk_count + chunks,
        message_count=old.message_count + len(new.messages),
        message_end_time=max(times, default=old.message_end_time),
        message_start_time=min(times, default=old.message_start_time),
        metadata_count=old.metadata_count + 1,
        schema_count=old.schema_count + len(new.schemas),
    )


def _chunks(offset: int, new: _NewRecords) -> tuple[bytes, list[ChunkIndex]]:
    """Compressed chunks with their message indexes, as they are at ``offset`` of the file.

    Schemas and channels open the first.
    """
    body = b""
    indexes: list[ChunkIndex] = []
    definitions = b"".join(raw(r) for r in (*new.schemas, *new.channels))
    position = 0
    while position < len(new.messages):
        data = bytearray(b"" if position else definitions)
        first = position
        index: dict[int, MessageIndex] = {}
        while position < len(new.messages) and (position == first or len(data) < CHUNK_SIZE):
            m = new.messages[position]
            entry = index.setdefault(m.channel_id, MessageIndex(m.channel_id, []))
            entry.records.append((m.log_time, len(data)))
            data += raw(m)
            position += 1
        times = [m.log_time for m in new.messages[first:position]]
        written, chunk_index = _chunk(offset + len(body), bytes(data), times, index)
        body += written
        indexes.append(chunk_index)
    return body, indexes


def _chunk(
    start: int, data: bytes, times: list[int], index: Mapping[int, MessageIndex]
) -> tuple[bytes, ChunkIndex]:
    """A chunk at offset ``start`` of the file with its message indexes, and its index."""
    packed = zstandard.ZstdCompressor(level=3).compress(data)
    chunk = raw(Chunk("zstd", packed, max(times), min(times), zlib.crc32(data), len(data)))
    offsets: dict[int, int] = {}
    tail = b""
    for channel_id, entry in index.items():
        offsets[channel_id] = start + len(chunk) + len(tail)
        tail += raw(entry)
    chunk_index = ChunkIndex(
        chunk_length=len(chunk),
        chunk_start_offset=start,
        compression="zstd",
        compressed_size=len(packed),
        message_end_time=max(times),
        message_index_length=len(tail),
        message_index_offsets=offsets,
        message_start_time=min(times),
        uncompressed_size=len(data),
    )
    return chunk + tail, chunk_index


def _summary(start: int, groups: Mapping[int, list[bytes]]) -> bytes:
    """Summary, summary offsets, footer and magic as they are at offset ``start`` of the file."""
    out = b""
    offsets = []
    for opcode in (*SUMMARY_ORDER, *sorted(set(groups) - set(SUMMARY_ORDER))):
        if group := b"".join(groups.get(opcode, ())):
            offsets.append(SummaryOffset(opcode, start + len(out), len(group)))
            out += group
    offset_start = start + len(out)
    out += b"".join(raw(o) for o in offsets)
    footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offset_start)
    crc = zlib.crc32(footer, zlib.crc32(out))
    return out + raw(Footer(start, offset_start, crc)) + MAGIC


def _definitions(
    read: Callable[[ReadDataStream], Record], records: Sequence[bytes], path: Path, offset: int
) -> list[Record]:
    """Schemas or channels of a summary; ``LogError`` where they make no sense."""
    return [_parsed(read, record[HEAD.size :], path, offset) for record in records]


def _parsed(
    read: Callable[[ReadDataStream], Record], body: bytes, path: Path, offset: int
) -> Record:
    """A record from its body; ``LogError`` when its bytes make no sense."""
    try:
        return parse(read, body)
    except LogError as error:
        raise LogError(f"{path} is damaged near offset {offset}; {_advice(path)}") from error


def _advice(path: Path) -> str:
    return f"recover it with `mcap recover {path} -o OUT.mcap`."
