"""The records of an MCAP file: one walk over them and one bounded decompressor.

Every error is a ``LogError`` that states the fault; the caller adds the file and the offset.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO
from typing import NamedTuple, TypeVar

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import McapRecord

from semloc_logs.errors import LogError
from semloc_logs.logs.containers.base import Bytes, SizedFile, decompress, read_exactly
from semloc_logs.logs.containers.memory import Memory

MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")  # of a record: opcode, length of its body
MESSAGE = struct.Struct("<BQHIQQ")  # head, channel, sequence, log time, publish time
MESSAGE_BODY = MESSAGE.size - HEAD.size  # bytes of a message's body before its data
_CHUNK = struct.Struct("<BQQQQII")  # head, times, size and CRC unpacked, length of the compression
CHUNK_HEAD = _CHUNK.size  # bytes at the start of a chunk record that state its sizes
COMPRESSION_END = CHUNK_HEAD + 8  # bytes at its start that tell whether it is compressed
_DATA_LENGTH = struct.Struct("<Q")
_CHUNK_INDEX = struct.Struct("<QQQQI")  # times, offset, size, bytes of the message indexes' offsets
_INDEX_OFFSET = struct.Struct("<HQ")  # channel, offset of its message index

Record = TypeVar("Record")


class IndexedChunk(NamedTuple):
    """What the index claims of a chunk: place, times and channels (none: unknown)."""

    offset: int
    size: int
    start_ns: int
    end_ns: int
    channels: frozenset[int]


class ChunkHead(NamedTuple):
    """What a chunk record claims; ``data`` is the part of the record that is compressed."""

    start_ns: int
    end_ns: int
    unpacked_size: int
    crc: int
    compression: str
    data: slice


def raw(record: McapRecord) -> bytes:
    """The bytes of a record, its opcode and length included."""
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def parse(read: Callable[[ReadDataStream], Record], body: bytes) -> Record:
    """A record from its body; ``LogError`` when the bytes make no sense."""
    try:
        return read(ReadDataStream(BytesIO(body)))
    except (McapError, struct.error, ValueError, MemoryError, OverflowError) as error:
        reason = error or type(error).__name__
        raise LogError(f"a record cannot be parsed ({reason})") from error


def spans(data: Bytes) -> Iterator[tuple[int, int, int]]:
    """(opcode, start of the body, end of the body) of the records in ``data``, in their order.

    ``LogError`` where they stop to fit.
    """
    position = 0
    size = len(data)
    head = HEAD.size
    unpack = HEAD.unpack_from
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
        raise LogError(f"{size - position} bytes at its end are not a record")


def walk(file: SizedFile, position: int, end: int) -> Iterator[tuple[int, int, int]]:
    """(opcode, offset, size with the head) of the records of a file between two offsets.

    Stops before the first record that is not valid or reaches beyond ``end``.
    """
    while position + HEAD.size <= end:
        opcode, length = HEAD.unpack(read_exactly(file, position, HEAD.size, end))
        size = HEAD.size + length
        if opcode == 0 or position + size > end:
            return
        yield opcode, position, size
        position += size


def indexed_chunk(body: bytes) -> IndexedChunk:
    """A chunk index from its body; a large log has a hundred thousand of them."""
    try:
        start_ns, end_ns, offset, size, nbytes = _CHUNK_INDEX.unpack_from(body)
    except struct.error as error:
        raise LogError(f"a chunk index cannot be parsed ({error})") from error
    listed = body[_CHUNK_INDEX.size : _CHUNK_INDEX.size + nbytes]
    if len(listed) != nbytes or nbytes % _INDEX_OFFSET.size:
        raise LogError("a chunk index cannot be parsed (its message indexes do not fit)")
    channels = frozenset(channel for channel, _ in _INDEX_OFFSET.iter_unpack(listed))
    return IndexedChunk(offset, size, start_ns, end_ns, channels)


def claimed_size(head: bytes) -> int:
    """The size that a chunk record claims for its records, from its first bytes."""
    if len(head) < CHUNK_HEAD:
        raise LogError("its head is cut off")
    return int(_CHUNK.unpack_from(head)[4])


def is_compressed(head: bytes) -> bool:
    """Whether a chunk record is compressed, from its first bytes."""
    if len(head) < CHUNK_HEAD:
        raise LogError("its head is cut off")
    length = _CHUNK.unpack_from(head)[6]
    return head[CHUNK_HEAD : CHUNK_HEAD + length] not in (b"", b"none")


def chunk_head(record: Bytes) -> ChunkHead:
    """The claims of a whole chunk record; ``LogError`` when they do not fit the record."""
    try:
        opcode, length, start_ns, end_ns, size, crc, name_length = _CHUNK.unpack_from(record)
        compression = bytes(record[_CHUNK.size : _CHUNK.size + name_length]).decode()
        (data_length,) = _DATA_LENGTH.unpack_from(record, _CHUNK.size + name_length)
    except (struct.error, UnicodeDecodeError) as error:
        raise LogError(f"its head is damaged ({error})") from error
    start = _CHUNK.size + name_length + _DATA_LENGTH.size
    if opcode != Opcode.CHUNK or HEAD.size + length != len(record):
        raise LogError("it is not the chunk that the index claims")
    if start + data_length > len(record):
        raise LogError(f"its data claim {data_length} bytes of {len(record) - start}")
    data = slice(start, start + data_length)
    return ChunkHead(start_ns, end_ns, size, crc, compression, data)


def chunk_records(record: Bytes, head: ChunkHead, memory: Memory) -> Bytes:
    """The records in a chunk; memory grows with the data, not with the claimed size.

    An uncompressed chunk is not copied: the result is a view of ``record``.
    """
    data = memoryview(record)[head.data]
    if head.compression in ("", "none") and head.data.stop != len(record):
        data = memoryview(bytes(data))  # a view would keep the rest of the record in memory
    unpacked = decompress(data, head.compression, head.unpacked_size, memory)
    if head.crc and zlib.crc32(unpacked) != head.crc:
        raise LogError("its checksum does not match its data")
    return unpacked
