"""What the summary of an MCAP file should list, found by walking through its data section."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Chunk, ChunkIndex, McapRecord, MetadataIndex, Statistics

from semloc_logs.errors import LogError

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
    """Raw summary records by opcode, the statistics, and the number of messages that lie outside of
    chunks.
    """

    groups: dict[int, list[bytes]]
    statistics: Statistics
    loose_messages: int


@dataclass(slots=True)
class _Found:
    schemas: dict[int, bytes] = field(default_factory=dict)
    channels: dict[int, bytes] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    attachments: list[AttachmentIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)
    start_ns: int | None = None
    end_ns: int = 0
    loose: int = 0

    def definition(self, opcode: int, raw: bytes) -> None:
        kept = self.schemas if opcode == Opcode.SCHEMA else self.channels
        kept.setdefault(struct.unpack_from("<H", raw, 9)[0], raw)

    def message(self, head: bytes) -> None:
        """Count a message by the first 22 bytes of its record's content."""
        channel, _, log_time, _ = struct.unpack("<HIQQ", head)
        self.counts[channel] = self.counts.get(channel, 0) + 1
        self.start_ns = log_time if self.start_ns is None else min(self.start_ns, log_time)
        self.end_ns = max(self.end_ns, log_time)


def scan(file: BinaryIO, data_end: int, path: Path) -> Summary:
    """Walk the records of the data section, which ends at ``data_end``.

    Chunks are decompressed one at a time and their checksums verified. Raises ``LogError`` where a
    record does not fit or is damaged.
    """
    found = _Found()
    at = len(b"\x89MCAP0\r\n")
    try:
        while at < data_end:
            file.seek(at)
            head = file.read(9)
            opcode, length = struct.unpack("<BQ", head)
            if at + 9 + length > data_end:
                raise ValueError("record reaches beyond the data section")
            _visit(found, file, opcode, at, length, head)
            at += 9 + length
    except (
        struct.error,
        ValueError,
        KeyError,
        EOFError,
        RuntimeError,
        zstandard.ZstdError,
        McapError,
    ) as error:
        raise LogError(
            f"{path} is damaged at offset {at} ({error}) and has no complete summary; recover it with `mcap recover {path} -o OUT.mcap`."
        ) from error
    return _summarise(found)


def _visit(found: _Found, file: BinaryIO, opcode: int, at: int, length: int, head: bytes) -> None:
    if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
        found.definition(opcode, head + file.read(length))
    elif opcode == Opcode.MESSAGE:
        found.message(file.read(min(length, 22)))
        found.loose += 1
    elif opcode == Opcode.CHUNK:
        _visit_chunk(found, file.read(length), at)
    elif opcode == Opcode.MESSAGE_INDEX and found.chunks:
        channel, size = struct.unpack("<HI", file.read(6))
        chunk = found.chunks[-1]
        # writers differ on whether a channel without messages in the chunk gets an index; one
        # without entries says nothing
        if size:
            chunk.message_index_offsets[channel] = at
        chunk.message_index_length = at + 9 + length - chunk.chunk_start_offset - chunk.chunk_length
    elif opcode == Opcode.ATTACHMENT:
        stream = ReadDataStream(BytesIO(file.read(min(length, 1 << 16))))
        log_time = stream.read8()
        create_time = stream.read8()
        name = stream.read_prefixed_string()
        media_type = stream.read_prefixed_string()
        found.attachments.append(
            AttachmentIndex(at, 9 + length, log_time, create_time, stream.read8(), name, media_type)
        )
    elif opcode == Opcode.METADATA:
        name = ReadDataStream(BytesIO(file.read(min(length, 1 << 16)))).read_prefixed_string()
        found.metadata.append(MetadataIndex(at, 9 + length, name))


def _visit_chunk(found: _Found, content: bytes, at: int) -> None:
    chunk = Chunk.read(ReadDataStream(BytesIO(content)))
    data = _decompress(chunk)
    for opcode, start, stop in _records(data):
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            found.definition(opcode, data[start:stop])
        elif opcode == Opcode.MESSAGE:
            found.message(data[start + 9 : min(stop, start + 31)])
    found.chunks.append(
        ChunkIndex(
            chunk_length=9 + len(content),
            chunk_start_offset=at,
            compression=chunk.compression,
            compressed_size=len(chunk.data),
            message_end_time=chunk.message_end_time,
            message_index_length=0,
            message_index_offsets={},
            message_start_time=chunk.message_start_time,
            uncompressed_size=chunk.uncompressed_size,
        )
    )


def _decompress(chunk: Chunk) -> bytes:
    """The records of a chunk; memory grows with what is there, not with what the chunk claims."""
    limit = chunk.uncompressed_size
    if chunk.compression == "zstd":
        out = bytearray()
        with zstandard.ZstdDecompressor().stream_reader(BytesIO(chunk.data)) as reader:
            while len(out) <= limit and (block := reader.read(1 << 20)):
                out += block
        data = bytes(out)
    elif chunk.compression == "lz4":
        decoder = lz4.frame.LZ4FrameDecompressor()
        out = bytearray(decoder.decompress(chunk.data, max_length=1 << 20))
        while not decoder.eof and len(out) <= limit:
            block = decoder.decompress(b"", max_length=1 << 20)
            if not block and decoder.needs_input:
                break
            out += block
        data = bytes(out)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise ValueError(f"unknown compression {chunk.compression!r}")
    if len(data) != limit:
        raise ValueError(f"chunk of {len(data)} bytes where {limit} were announced")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("chunk with a wrong checksum")
    return data


def _records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and stop of the records in a chunk."""
    at = 0
    while at < len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        if at + 9 + length > len(data):
            raise ValueError("record reaches beyond its chunk")
        yield opcode, at, at + 9 + length
        at += 9 + length


def _summarise(found: _Found) -> Summary:
    statistics = Statistics(
        attachment_count=len(found.attachments),
        channel_count=len(found.channels),
        channel_message_counts=dict(sorted(found.counts.items())),
        chunk_count=len(found.chunks),
        message_count=sum(found.counts.values()),
        message_end_time=found.end_ns,
        message_start_time=found.start_ns or 0,
        metadata_count=len(found.metadata),
        schema_count=len(found.schemas),
    )
    # where some messages lie outside of chunks, an index of the chunks would hide them from readers
    chunks = [] if found.loose else found.chunks
    groups: dict[int, list[bytes]] = {
        Opcode.SCHEMA: [found.schemas[k] for k in sorted(found.schemas)],
        Opcode.CHANNEL: [found.channels[k] for k in sorted(found.channels)],
        Opcode.STATISTICS: [raw(statistics)],
        Opcode.CHUNK_INDEX: [raw(i) for i in chunks],
        Opcode.ATTACHMENT_INDEX: [raw(i) for i in found.attachments],
        Opcode.METADATA_INDEX: [raw(i) for i in found.metadata],
    }
    return Summary(groups, statistics, found.loose)


def raw(record: McapRecord) -> bytes:
    """The bytes of a record, its opcode and length included."""
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
