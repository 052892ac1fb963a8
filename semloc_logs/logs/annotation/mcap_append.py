"""Adding channels to an MCAP file without decoding what is there.

An MCAP file is magic, data section, DataEnd, summary, footer, magic. To add records, everything up
to DataEnd is kept as it is and the end of the file, from DataEnd on, is written anew: our records,
a continued DataEnd and a summary that lists old and new. Our last record is a metadata record that
says where ours start, so that a later run finds them, takes them away and puts new ones in.
"""

from __future__ import annotations

import hashlib
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
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
from semloc_logs.logs.containers.mcap_scan import SUMMARY_ORDER, Summary, raw, scan

MAGIC = b"\x89MCAP0\r\n"
METADATA_PREFIX = "semloc/"
RUN_KEY = "semloc.run_id"  # in the metadata of each of our channels
CHUNK_SIZE = 1 << 20  # bytes of a chunk before compression
_DATA_END_SIZE = 9 + 4
_FOOTER_SIZE = 9 + 20
_PADDING = 256  # bytes by which a DataEnd record may be longer than the specification says


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
    """A message to add; ``channel`` counts the channels that are added with it. Its publish time is
    its log time.
    """

    channel: int
    log_time_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Ending:
    """What is known of a file from its end, without our own records: ``offset`` is where the file
    is to be continued.

    ``crc`` is that of the bytes before ``offset``, 0 where the file has none. ``replaces`` tells
    that the file holds our records.
    """

    offset: int
    crc: int
    summary: Summary
    replaces: bool


def read_header(file: BinaryIO, path: Path) -> Header:
    """The header record; ``LogError`` when the file is no MCAP file."""
    file.seek(0)
    start = file.read(8 + 9)
    if start[:8] != MAGIC or len(start) < 17 or start[8] != Opcode.HEADER:
        raise LogError(
            f"{path} is not an MCAP file: it does not start with the MCAP magic and a header; give another file."
        )
    length = int.from_bytes(start[9:], "little")
    body = file.read(min(length, 1 << 20))
    if len(body) < length:
        raise LogError(
            f"{path} is cut off in its header; recover it with `mcap recover {path} -o OUT.mcap`."
        )
    return _parse(Header.read, body, path, 8)  # type: ignore[no-any-return]


def read_ending(file: BinaryIO, path: Path) -> Ending:
    """The end of an MCAP file, our own earlier records taken away.

    A file whose summary is missing or incomplete is scanned for what it should list. Raises
    ``LogError`` when the file is cut off or damaged, or when it holds records of ours that were
    moved by another tool.
    """
    read_header(file, path)
    data_end, crc, groups = _locate(file, path)
    own = _own_metadata(file, groups, data_end)
    summary = _complete_summary(groups, path) or scan(file, data_end, path)
    ending = (
        Ending(data_end, crc, summary, False) if own is None else _without_own(own, summary, path)
    )
    for channel in definitions(ending, path)[1]:
        if RUN_KEY in channel.metadata:
            raise LogError(
                f"{path} holds results on {channel.topic} that another tool moved or followed by other records, so they cannot be"
                " replaced; annotate the original log, or remove the /semloc/ topics with `mcap filter` first."
            )
    return ending


def definitions(ending: Ending, path: Path) -> tuple[list[Schema], list[Channel]]:
    """Schemas and channels of a file; ``LogError`` where they make no sense."""
    groups = ending.summary.groups
    schemas = [
        _parse(Schema.read, record[9:], path, ending.offset)
        for record in groups.get(Opcode.SCHEMA, ())
    ]
    return schemas, [
        _parse(Channel.read, record[9:], path, ending.offset)
        for record in groups.get(Opcode.CHANNEL, ())
    ]


def empty_ending(profile: str, library: str) -> tuple[bytes, Ending]:
    """The first bytes of a new file, and the ending that continues it."""
    start = MAGIC + raw(Header(profile, library))
    return start, Ending(
        len(start), zlib.crc32(start), Summary({}, Statistics(0, 0, {}, 0, 0, 0, 0, 0, 0), 0), False
    )


def compose(
    ending: Ending,
    channels: Sequence[NewChannel],
    messages: Sequence[NewMessage],
    name: str,
    metadata: Mapping[str, str],
) -> bytes:
    """All bytes of the file from ``ending.offset`` on: our records, DataEnd, summary and footer.
    Messages must be in log-time order.
    """
    offset = ending.offset
    summary = ending.summary
    old = summary.statistics
    schemas, ours = _number(summary, channels if messages else ())
    groups: dict[int, list[bytes]] = {
        opcode: list(entries) for opcode, entries in summary.groups.items()
    }
    groups.setdefault(Opcode.SCHEMA, []).extend(raw(s) for s in schemas)
    groups.setdefault(Opcode.CHANNEL, []).extend(raw(c) for c in ours)
    numbered = _sequenced(messages, [c.id for c in ours])
    # a log whose messages lie outside of chunks has to stay so: readers that find one chunk index
    # look nowhere else
    indexes: list[ChunkIndex] = []
    if summary.loose_messages:
        body = b"".join(raw(r) for r in (*schemas, *ours, *numbered))
    else:
        body, indexes = _chunks(offset, schemas, ours, numbered)
    groups.setdefault(Opcode.CHUNK_INDEX, []).extend(raw(i) for i in indexes)
    record = Metadata(
        name,
        {
            **metadata,
            "start": str(offset),
            "records_sha256": hashlib.sha256(body).hexdigest(),
            "data_section_crc": str(ending.crc),
            "log_start_ns": str(old.message_start_time),
            "log_end_ns": str(old.message_end_time),
            "schema_ids": " ".join(str(s.id) for s in schemas),
            "channel_ids": " ".join(str(c.id) for c in ours),
        },
    )
    metadata_raw = raw(record)
    groups.setdefault(Opcode.METADATA_INDEX, []).append(
        raw(MetadataIndex(offset + len(body), len(metadata_raw), name))
    )
    body += metadata_raw
    counts = dict(old.channel_message_counts) | {
        c.id: sum(m.channel == k for m in messages) for k, c in enumerate(ours)
    }
    times = [m.log_time_ns for m in messages] + (
        [old.message_start_time, old.message_end_time] if old.message_count else []
    )
    statistics = Statistics(
        attachment_count=old.attachment_count,
        channel_count=old.channel_count + len(ours),
        channel_message_counts=counts,
        chunk_count=old.chunk_count + len(indexes),
        message_count=old.message_count + len(messages),
        message_end_time=max(times, default=old.message_end_time),
        message_start_time=min(times, default=old.message_start_time),
        metadata_count=old.metadata_count + 1,
        schema_count=old.schema_count + len(schemas),
    )
    groups[Opcode.STATISTICS] = [raw(statistics)]
    body += raw(DataEnd(zlib.crc32(body, ending.crc) if ending.crc else 0))
    return body + _summary(offset + len(body), groups)


def content_end(log: Path) -> int | None:
    """How many bytes of an MCAP file are recorded content, our own records not counted; None when
    its end is missing or damaged.
    """
    try:
        with log.open("rb") as file:
            data_end, _, groups = _locate(file, log)
            own = _own_metadata(file, groups, data_end)
            return data_end if own is None else int(own.metadata["start"])
    except LogError:
        return None


def _locate(file: BinaryIO, path: Path) -> tuple[int, int, dict[int, list[bytes]]]:
    """Offset of DataEnd, its CRC, and the raw summary records by opcode."""
    size = file.seek(0, 2)
    cut = LogError(
        f"{path} is cut off or damaged at its end (offset {size}); recover it with `mcap recover {path} -o OUT.mcap`."
    )
    file.seek(max(0, size - _FOOTER_SIZE - len(MAGIC)))
    end = file.read()
    if (
        len(end) != _FOOTER_SIZE + len(MAGIC)
        or end[-8:] != MAGIC
        or end[:9] != struct.pack("<BQ", Opcode.FOOTER, 20)
    ):
        raise cut
    summary_start, _, summary_crc = struct.unpack("<QQI", end[9:29])
    footer_at = size - len(end)
    summary_start = summary_start or footer_at
    if not len(MAGIC) + _DATA_END_SIZE <= summary_start <= footer_at:
        raise cut
    file.seek(max(0, summary_start - _DATA_END_SIZE - _PADDING))
    before = file.read(min(summary_start, _DATA_END_SIZE + _PADDING))
    record = _data_end(before)
    if record is None:
        raise cut
    data_end = summary_start - len(record)
    groups: dict[int, list[bytes]] = {}
    data = file.read(footer_at - summary_start)
    if summary_crc and zlib.crc32(end[:25], zlib.crc32(data)) != summary_crc:
        raise LogError(
            f"{path} has a damaged summary (checksum at offset {size - 12}); recover it with `mcap recover {path} -o OUT.mcap`."
        )
    for opcode, entry in _split(data, cut):
        if opcode != Opcode.SUMMARY_OFFSET:
            groups.setdefault(opcode, []).append(entry)
    return data_end, struct.unpack("<I", record[9:13])[0], groups


def _data_end(before: bytes) -> bytes | None:
    """The DataEnd record at the end of ``before``; a writer may have extended it by some bytes."""
    for padding in range(len(before) - _DATA_END_SIZE + 1):
        record = before[len(before) - _DATA_END_SIZE - padding :]
        if record[:9] == struct.pack("<BQ", Opcode.DATA_END, 4 + padding):
            return record
    return None


def _split(data: bytes, error: LogError) -> Iterator[tuple[int, bytes]]:
    """Records, header included, that lie one after another in ``data``."""
    at = 0
    while at < len(data):
        if at + 9 > len(data):
            raise error
        stop = at + 9 + int.from_bytes(data[at + 1 : at + 9], "little")
        if stop > len(data):
            raise error
        yield data[at], data[at:stop]
        at = stop


def _complete_summary(groups: Mapping[int, list[bytes]], path: Path) -> Summary | None:
    """The summary as it is, if it lists everything that its statistics count."""
    if len(groups.get(Opcode.STATISTICS, ())) != 1:
        return None
    counted: Statistics = _parse(Statistics.read, groups[Opcode.STATISTICS][0][9:], path, 0)
    listed = {
        opcode: len({entry[9:11] for entry in groups.get(opcode, ())})
        for opcode in (Opcode.SCHEMA, Opcode.CHANNEL)
    }
    listed |= {
        o: len(groups.get(o, ()))
        for o in (Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX)
    }
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


def _own_metadata(
    file: BinaryIO, groups: Mapping[int, list[bytes]], data_end: int
) -> Metadata | None:
    """Our metadata record, if ours are the last records of the data section and exactly as we wrote
    them.
    """
    for entry in groups.get(Opcode.METADATA_INDEX, ()):
        if entry[29 : 29 + len(METADATA_PREFIX)] != METADATA_PREFIX.encode():
            continue
        offset = int.from_bytes(entry[9:17], "little")
        if not 0 < offset < data_end:
            continue
        file.seek(offset)
        record = file.read(data_end - offset) if data_end - offset < 1 << 24 else b""
        if (
            len(record) < 9
            or record[0] != Opcode.METADATA
            or 9 + int.from_bytes(record[1:9], "little") != len(record)
        ):
            continue
        try:
            found: Metadata = Metadata.read(ReadDataStream(BytesIO(record[9:])))
            start = int(found.metadata["start"])
            digest = found.metadata["records_sha256"]
        except (KeyError, ValueError, struct.error, McapError):
            continue
        if len(MAGIC) < start <= offset and hash_range(file, start, offset).hexdigest() == digest:
            return found
    return None


def hash_range(file: BinaryIO, start: int, stop: int) -> Any:
    """sha256 object over the bytes [start, stop) of an open file."""
    digest = hashlib.sha256()
    file.seek(start)
    while start < stop and (block := file.read(min(1 << 20, stop - start))):
        digest.update(block)
        start += len(block)
    return digest


def _without_own(own: Metadata, summary: Summary, path: Path) -> Ending:
    """The ending as it was before our records came."""
    try:
        start = int(own.metadata["start"])
        crc = int(own.metadata["data_section_crc"])
        first = int(own.metadata["log_start_ns"])
        last = int(own.metadata["log_end_ns"])
        ids = {
            Opcode.SCHEMA: own.metadata["schema_ids"].split(),
            Opcode.CHANNEL: own.metadata["channel_ids"].split(),
        }
        drop = {opcode: {struct.pack("<H", int(i)) for i in texts} for opcode, texts in ids.items()}
    except (KeyError, ValueError, struct.error) as error:
        raise LogError(
            f"{path}: the metadata record {own.name!r} is not one of ours; annotate the original log."
        ) from error
    groups = {opcode: list(entries) for opcode, entries in summary.groups.items()}
    for opcode, gone in drop.items():
        groups[opcode] = [entry for entry in groups.get(opcode, ()) if entry[9:11] not in gone]
    chunks = groups.get(Opcode.CHUNK_INDEX, [])
    groups[Opcode.CHUNK_INDEX] = [r for r in chunks if int.from_bytes(r[25:33], "little") < start]
    groups[Opcode.METADATA_INDEX] = [
        r
        for r in groups.get(Opcode.METADATA_INDEX, ())
        if int.from_bytes(r[9:17], "little") < start
    ]
    old = summary.statistics
    channels = {struct.unpack("<H", i)[0] for i in drop[Opcode.CHANNEL]}
    counts = {c: n for c, n in old.channel_message_counts.items() if c not in channels}
    statistics = Statistics(
        attachment_count=old.attachment_count,
        channel_count=old.channel_count - len(channels),
        channel_message_counts=counts,
        chunk_count=old.chunk_count - len(chunks) + len(groups[Opcode.CHUNK_INDEX]),
        message_count=sum(counts.values()),
        message_end_time=last,
        message_start_time=first,
        metadata_count=old.metadata_count - 1,
        schema_count=old.schema_count - len(drop[Opcode.SCHEMA]),
    )
    loose = summary.loose_messages and statistics.message_count
    return Ending(start, crc, Summary(groups, statistics, loose), True)


def _number(summary: Summary, channels: Sequence[NewChannel]) -> tuple[list[Schema], list[Channel]]:
    """Schema and channel records with ids above those in use."""
    used = {
        o: [int.from_bytes(r[9:11], "little") for r in summary.groups.get(o, ())]
        for o in (Opcode.SCHEMA, Opcode.CHANNEL)
    }
    schema_id = max(used[Opcode.SCHEMA], default=0) + 1
    channel_id = max(used[Opcode.CHANNEL], default=0) + 1
    if max(schema_id, channel_id) + len(channels) > 1 << 16:
        raise LogError(
            "The log has no free schema or channel ids left; write a sidecar with `--sidecar OUT.mcap` instead."
        )
    schemas = [
        Schema(schema_id + k, c.schema_data, c.schema_encoding, c.schema_name)
        for k, c in enumerate(channels)
    ]
    return schemas, [
        Channel(channel_id + k, c.topic, c.message_encoding, dict(c.metadata), schema_id + k)
        for k, c in enumerate(channels)
    ]


def _sequenced(messages: Sequence[NewMessage], ids: Sequence[int]) -> list[Message]:
    """Message records, counted from 0 on each channel."""
    seen = [0] * len(ids)
    out = []
    for m in messages:
        out.append(Message(ids[m.channel], m.log_time_ns, m.data, m.log_time_ns, seen[m.channel]))
        seen[m.channel] += 1
    return out


def _chunks(
    offset: int, schemas: list[Schema], channels: list[Channel], messages: list[Message]
) -> tuple[bytes, list[ChunkIndex]]:
    """Compressed chunks with their message indexes, as they stand at ``offset``; schemas and
    channels open the first.
    """
    body = b""
    indexes = []
    compressor = zstandard.ZstdCompressor(level=3)
    at = 0
    while at < len(messages):
        data = bytearray(b"".join(raw(r) for r in (*schemas, *channels)) if at == 0 else b"")
        first = at
        index = dict[int, MessageIndex]()
        while at < len(messages) and (at == first or len(data) < CHUNK_SIZE):
            m = messages[at]
            index.setdefault(m.channel_id, MessageIndex(m.channel_id, [])).records.append(
                (m.log_time, len(data))
            )
            data += raw(m)
            at += 1
        packed = compressor.compress(bytes(data))
        times = [m.log_time for m in messages[first:at]]
        chunk = raw(Chunk("zstd", packed, max(times), min(times), zlib.crc32(data), len(data)))
        start = offset + len(body)
        offsets = dict[int, int]()
        tail = b""
        for channel_id, entry in index.items():
            offsets[channel_id] = start + len(chunk) + len(tail)
            tail += raw(entry)
        indexes.append(
            ChunkIndex(
                len(chunk),
                start,
                "zstd",
                len(packed),
                max(times),
                len(tail),
                offsets,
                min(times),
                len(data),
            )
        )
        body += chunk + tail
    return body, indexes


def _summary(start: int, groups: Mapping[int, list[bytes]]) -> bytes:
    """Summary, summary offsets, footer and magic as they stand at offset ``start``."""
    out = b""
    offsets = []
    for opcode in (*SUMMARY_ORDER, *sorted(set(groups) - set(SUMMARY_ORDER))):
        if group := b"".join(groups.get(opcode, ())):
            offsets.append(SummaryOffset(opcode, start + len(out), len(group)))
            out += group
    offset_start = start + len(out)
    out += b"".join(raw(o) for o in offsets)
    footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offset_start)
    return out + raw(Footer(start, offset_start, zlib.crc32(footer, zlib.crc32(out)))) + MAGIC


def _parse(read: Any, body: bytes, path: Path, offset: int) -> Any:
    """One record's fields; ``LogError`` when its bytes make no sense."""
    try:
        return read(ReadDataStream(BytesIO(body)))
    except (struct.error, ValueError, McapError) as error:
        raise LogError(
            f"{path} is damaged near offset {offset}; recover it with `mcap recover {path} -o OUT.mcap`."
        ) from error
