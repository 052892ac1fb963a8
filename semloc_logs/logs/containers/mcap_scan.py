"""What the summary of an MCAP file should list, found by walking through its data section."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, ChunkIndex, MetadataIndex, Statistics

from semloc_logs.errors import LogError
from semloc_logs.logs.containers.mcap_records import (
    HEAD,
    MAGIC,
    MESSAGE_BODY,
    chunk_head,
    chunk_records,
    parse,
    raw,
    spans,
    walk,
)
from semloc_logs.logs.containers.memory import Memory

MAX_NAMES = 1 << 16  # bytes at the start of attachments and metadata in which their names lie
SUMMARY_ORDER = (
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.STATISTICS,
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.METADATA_INDEX,
)


@dataclass(frozen=True, slots=True)
class Summary:
    """Raw summary records by opcode, the statistics, the number of messages outside of chunks."""

    groups: dict[int, list[bytes]]
    statistics: Statistics
    loose_messages: int


_ENTRY_BYTES = 100  # in memory for an entry of a record that is kept
_RECORD_BYTES = 1000  # and for the record


@dataclass(slots=True)
class _Found:
    memory: Memory
    kept: int = 0  # bytes
    schemas: dict[int, bytes] = field(default_factory=dict)
    channels: dict[int, bytes] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    attachments: list[AttachmentIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)
    start_ns: int | None = None
    end_ns: int = 0
    loose: int = 0

    def keep(self, size: int) -> None:
        """Counts the bytes that are kept; LogError where it is too much."""
        self.kept += size
        if self.kept > self.memory.most_of_one:
            raise LogError(
                f"what its summary lists takes more than {self.memory.most_of_one} bytes"
            )

    def definition(self, opcode: int, raw: bytes) -> None:
        kept = self.schemas if opcode == Opcode.SCHEMA else self.channels
        key = struct.unpack_from("<H", raw, 9)[0]
        if key not in kept:
            self.keep(len(raw))
            kept[key] = raw

    def message(self, head: bytes) -> None:
        """Count a message by the first 22 bytes of its record's content."""
        channel, _, log_time, _ = struct.unpack("<HIQQ", head)
        self.counts[channel] = self.counts.get(channel, 0) + 1
        self.start_ns = log_time if self.start_ns is None else min(self.start_ns, log_time)
        self.end_ns = max(self.end_ns, log_time)


def scan(file: BinaryIO, data_end: int, path: Path, memory: Memory) -> Summary:
    """Walk the records of the data section, which ends at ``data_end``.

    Chunks are decompressed one at a time and their checksums verified. Raises ``LogError`` where a
    record does not fit, is damaged, or is too large for ``memory``.
    """
    contents = _Found(memory)
    offset = end = len(MAGIC)
    try:
        for opcode, start, size in walk(file, offset, data_end):
            offset = start
            _visit(contents, file, opcode, offset, size)
            end = offset + size
        if end != data_end:
            offset = end
            raise LogError("record reaches beyond the data section")
    except (struct.error, LogError) as error:
        raise LogError(
            f"{path} is damaged at offset {offset} ({error}) and has no complete summary; "
            f"recover it with `mcap recover {path} -o OUT.mcap`."
        ) from error
    return _summarise(contents)


def _visit(contents: _Found, file: BinaryIO, opcode: int, offset: int, size: int) -> None:
    """Note one record of ``size`` bytes; the file is at the start of its body."""
    length = size - HEAD.size
    if opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.CHUNK):
        contents.memory.check(length)
    if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
        contents.definition(opcode, HEAD.pack(opcode, length) + file.read(length))
    elif opcode == Opcode.MESSAGE:
        contents.message(file.read(min(length, MESSAGE_BODY)))
        contents.loose += 1
    elif opcode == Opcode.CHUNK:
        _visit_chunk(contents, HEAD.pack(opcode, length) + file.read(length), offset)
    elif opcode == Opcode.MESSAGE_INDEX and contents.chunks:
        channel, entries = struct.unpack("<HI", file.read(6))
        chunk = contents.chunks[-1]
        # writers differ on whether a channel without messages in the chunk gets an index; one
        # without entries tells nothing
        if entries:
            contents.keep(_ENTRY_BYTES)
            chunk.message_index_offsets[channel] = offset
        chunk_end = chunk.chunk_start_offset + chunk.chunk_length
        chunk.message_index_length = offset + size - chunk_end
    elif opcode == Opcode.ATTACHMENT:
        body = file.read(min(length, MAX_NAMES))
        contents.keep(_RECORD_BYTES + len(body))
        contents.attachments.append(parse(_attachment_index(offset, size), body))
    elif opcode == Opcode.METADATA:
        name = parse(ReadDataStream.read_prefixed_string, file.read(min(length, MAX_NAMES)))
        contents.keep(_RECORD_BYTES + len(name))
        contents.metadata.append(MetadataIndex(offset, size, name))


def _attachment_index(offset: int, size: int) -> Callable[[ReadDataStream], AttachmentIndex]:
    def read(stream: ReadDataStream) -> AttachmentIndex:
        log_time = stream.read8()
        create_time = stream.read8()
        name = stream.read_prefixed_string()
        media_type = stream.read_prefixed_string()
        data_size = stream.read8()
        return AttachmentIndex(offset, size, log_time, create_time, data_size, name, media_type)

    return read


def _visit_chunk(contents: _Found, record: bytes, offset: int) -> None:
    head = chunk_head(record)
    data = chunk_records(record, head, contents.memory)
    contents.keep(_RECORD_BYTES)
    for opcode, start, stop in spans(data):
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            contents.definition(opcode, bytes(data[start - HEAD.size : stop]))
        elif opcode == Opcode.MESSAGE:
            contents.message(bytes(data[start : min(stop, start + MESSAGE_BODY)]))
    contents.chunks.append(
        ChunkIndex(
            chunk_length=len(record),
            chunk_start_offset=offset,
            compression=head.compression,
            compressed_size=head.data.stop - head.data.start,
            message_end_time=head.end_ns,
            message_index_length=0,
            message_index_offsets={},
            message_start_time=head.start_ns,
            uncompressed_size=head.unpacked_size,
        )
    )


def _summarise(contents: _Found) -> Summary:
    statistics = Statistics(
        attachment_count=len(contents.attachments),
        channel_count=len(contents.channels),
        channel_message_counts=dict(sorted(contents.counts.items())),
        chunk_count=len(contents.chunks),
        message_count=sum(contents.counts.values()),
        message_end_time=contents.end_ns,
        message_start_time=contents.start_ns or 0,
        metadata_count=len(contents.metadata),
        schema_count=len(contents.schemas),
    )
    # where some messages lie outside of chunks, an index of the chunks would hide them from readers
    chunks = [] if contents.loose else contents.chunks
    groups: dict[int, list[bytes]] = {
        Opcode.SCHEMA: [contents.schemas[k] for k in sorted(contents.schemas)],
        Opcode.CHANNEL: [contents.channels[k] for k in sorted(contents.channels)],
        Opcode.STATISTICS: [raw(statistics)],
        Opcode.CHUNK_INDEX: [raw(i) for i in chunks],
        Opcode.ATTACHMENT_INDEX: [raw(i) for i in contents.attachments],
        Opcode.METADATA_INDEX: [raw(i) for i in contents.metadata],
    }
    return Summary(groups, statistics, contents.loose)
