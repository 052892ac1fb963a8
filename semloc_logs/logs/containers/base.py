"""Parts of all containers: problems, messages of several parts in order, safe decompression."""

from __future__ import annotations

import bz2
import os
import threading
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from heapq import heappop, heappush, heapreplace
from io import BufferedReader
from pathlib import Path
from typing import BinaryIO, NamedTuple, Protocol

import lz4.frame
import zstandard

from semloc_logs.errors import LogError
from semloc_logs.frames import Frame
from semloc_logs.logs.containers.memory import Memory
from semloc_logs.logs.log import Log, Message, Reading, Section, Stream
from semloc_logs.logs.messages.decode import Decoder
from semloc_logs.logs.messages.topic_clocks import TopicClocks
from semloc_logs.logs.problems import Problem, Problems

Bytes = bytes | bytearray | memoryview
# a message, or in its place the log time of one that is read when its turn has come
MessageOrTime = Message | int
_STEP = 1 << 22
_PLAUSIBLE_GROWTH = 64  # point clouds and pictures shrink by less
_engines = threading.local()
_ONE_READER = threading.Lock()  # of files without a descriptor


class BagFile(NamedTuple):
    """A file of a bag: its name there, and the problems of the bag, which get its own."""

    name: str
    problems: Problems


class BaseLog(ABC):
    """The parts of :class:`~semloc_logs.logs.log.Log` that do not depend on the container."""

    def __init__(
        self,
        path: Path,
        format: str,
        memory: Memory | None = None,
        bag_file: BagFile | None = None,
    ) -> None:
        self.path = path
        self.format = format
        self.encoding = ""
        self.start_ns: int | None = None
        self.end_ns: int | None = None
        self.streams: list[Stream] = []
        self._name, self._problems = bag_file or BagFile(path.name, Problems())
        self._memory = Memory() if memory is None else memory
        self._decoder = Decoder(self._problems)

    @property
    def problems(self) -> list[Problem]:
        """Skipped input and the reasons."""
        return list(self._problems)

    @abstractmethod
    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """The messages of ``topics`` in log-time order."""

    @abstractmethod
    def sections(self) -> list[Section]:
        """The parts of the log that can be read one by one, by their first log time."""

    def frames(
        self, topics: Collection[str] | None = None, reading: Reading | None = None
    ) -> Iterator[Frame]:
        """The decoded messages of ``topics`` in log-time order."""
        self._problems.forget_skipped(topics)
        clocks = TopicClocks(reading or Reading())
        for message in self.messages(topics):
            yield from clocks.frames(self._decoder, message)

    @abstractmethod
    def close(self) -> None:
        """Releases the files."""


def open_file(path: Path) -> BufferedReader:
    """``path`` for reading; LogError when that is not possible."""
    try:
        return path.open("rb")
    except OSError as error:
        raise LogError(f"{path} cannot be opened: {error.strerror}.") from error


@contextmanager
def closed_on_error(file: BinaryIO, path: Path) -> Iterator[None]:
    """Closes ``file`` when it turns out not to be a log; the LogError names ``path``."""
    try:
        yield
    except (LogError, OSError) as error:
        file.close()
        raise LogError(f"{path} cannot be read: {error}.") from error


class SizedFile(Protocol):
    """A binary file."""

    def seek(self, offset: int, whence: int = 0, /) -> int:
        """Moves to ``offset``."""

    def read(self, size: int = -1, /) -> bytes:
        """At most ``size`` bytes."""


def encoding_of(streams: Iterable[Stream]) -> str:
    """Encoding of most streams: ``ros2``, ``ros1``, ``protobuf`` or ``json``; "" without any."""
    names = {"cdr": "ros2", "ros1": "ros1", "protobuf": "protobuf", "json": "json"}
    encodings = [names[s.encoding] for s in streams if s.encoding in names]
    return max(sorted(set(encodings)), key=encodings.count, default="")


def merged_streams(logs: Sequence[Log]) -> list[Stream]:
    """The streams of all logs sorted by topic; counts of the same topic and type add up.

    So do encodings, such as in a bag of ROS 1 and an MCAP of ROS 2, unless one log has several.
    """
    counts: Counter[tuple[str, str, str]] = Counter()
    mixed: set[tuple[str, str]] = set()
    for log in logs:
        kinds = Counter((s.topic, s.type) for s in log.streams)
        mixed |= {kind for kind, encodings in kinds.items() if encodings > 1}
        for s in log.streams:
            counts[s.topic, s.type, s.encoding] += s.count
    usual: dict[tuple[str, str], str] = {}
    for (topic, type_, encoding), _ in sorted(counts.items(), key=lambda item: (-item[1], item[0])):
        usual.setdefault((topic, type_), encoding)
    added: Counter[tuple[str, str, str]] = Counter()
    for (topic, type_, encoding), count in counts.items():
        is_one = (topic, type_) not in mixed
        added[topic, type_, usual[topic, type_] if is_one else encoding] += count
    return [Stream(*key, count) for key, count in sorted(added.items())]


def in_log_time_order(
    parts: Iterable[tuple[int, Callable[[], Iterator[MessageOrTime]]]],
) -> Iterator[Message]:
    """Merges parts: each a lower bound of its log times and a function that opens it.

    Each part is in log-time order by itself. It is opened when its time has come, so memory holds
    only parts that overlap; equal times keep the order of the parts. A part that yields the time of
    its next message is resumed when that time has come, and reads the message then.
    """
    waiting = sorted(
        ((start, k, part) for k, (start, part) in enumerate(parts)),
        key=lambda w: w[:2],
        reverse=True,
    )
    heap: list[tuple[int, int, MessageOrTime | None, Iterator[MessageOrTime]]] = []

    def open_due() -> None:
        while waiting and (not heap or waiting[-1][0] <= heap[0][0]):
            _, order, part = waiting.pop()
            opened = iter(part())
            if (first := next(opened, None)) is not None:
                heappush(heap, (_time(first), order, first, opened))

    while waiting or heap:
        open_due()
        if not heap:
            continue
        time, order, item, opened = heap[0]
        heap[0] = (time, order, None, opened)  # a message may keep much memory alive
        if isinstance(item, Message):
            yield item
        item = None
        # nearly always: parts rarely overlap, so run through this one until the next is due
        if len(heap) == 1:
            due = waiting[-1][0] if waiting else None
            for following in opened:
                if due is not None and (time := _time(following)) >= due:
                    heap[0] = (time, order, following, opened)
                    break
                if following.__class__ is not int:
                    yield following  # type: ignore[misc]  # a message
                del following
            else:
                heappop(heap)
        elif (following_ := next(opened, None)) is not None:
            heapreplace(heap, (_time(following_), order, following_, opened))
            following_ = None
        else:
            heappop(heap)


def _time(item: MessageOrTime) -> int:
    return item if isinstance(item, int) else item.log_time_ns


def read_exactly(file: SizedFile, offset: int, size: int, file_size: int) -> bytes:
    """``size`` bytes at ``offset``; LogError when the file is shorter, before any allocation."""
    _check_claim(offset, size, file_size)
    file.seek(offset)
    return _checked_size(file.read(size), offset, size)


def read_at(file: BufferedReader, offset: int, size: int, file_size: int) -> bytes:
    """As :func:`read_exactly`, by several threads at once."""
    if not _has_descriptor(file):  # of a server: one after the other
        with _ONE_READER:
            return read_exactly(file, offset, size, file_size)
    _check_claim(offset, size, file_size)
    data = os.pread(file.fileno(), size, offset)
    # the system gives at most 2 GiB at once
    while len(data) < size and (
        more := os.pread(file.fileno(), size - len(data), offset + len(data))
    ):
        data += more
    return _checked_size(data, offset, size)


def read_into(file: BufferedReader, offset: int, buffer: memoryview, file_size: int) -> None:
    """As :func:`read_at`, into a ``buffer`` of the size that is wanted."""
    size = len(buffer)
    if not _has_descriptor(file):
        buffer[:] = read_at(file, offset, size, file_size)
        return
    _check_claim(offset, size, file_size)
    count = os.preadv(file.fileno(), [buffer], offset)
    if count != size:
        raise LogError(f"only {count} of {size} bytes could be read at byte {offset}")


def _has_descriptor(file: BufferedReader) -> bool:
    try:
        file.fileno()
    except OSError:
        return False
    return True


def _check_claim(offset: int, size: int, file_size: int) -> None:
    if offset < 0 or size < 0 or offset + size > file_size:
        raise LogError(
            f"{size} bytes are claimed at byte {offset}, but the file ends at byte {file_size}"
        )


def _checked_size(data: bytes, offset: int, size: int) -> bytes:
    if len(data) != size:
        raise LogError(f"only {len(data)} of {size} bytes could be read at byte {offset}")
    return data


def decompress(data: Bytes, compression: str, size: int, memory: Memory) -> Bytes:
    """The ``size`` bytes that ``data`` holds; ``data`` itself where it is not compressed.

    LogError for another size, a claim beyond ``memory`` or damaged data.
    """
    memory.check(max(size, len(data)))
    if compression in ("", "none"):
        unpacked = data
    elif compression not in ("zstd", "lz4", "bz2"):
        raise LogError(f"the compression {compression[:40]!r} is unknown")
    else:
        try:
            unpacked = _unpack(data, compression, size, memory)
        except (
            zstandard.ZstdError,
            RuntimeError,
            EOFError,
            OSError,
            ValueError,
            MemoryError,
        ) as error:
            raise LogError(f"its {compression} data are damaged ({error})") from error
    if len(unpacked) != size:
        raise LogError(f"it holds {len(unpacked)} bytes where {size} are claimed")
    return unpacked


def unpack_whole(data: bytes, memory: Memory) -> Bytes:
    """What ``data``, as a ROS 1 bag compresses its chunks, hold, whatever size is claimed."""
    most = memory.most_of_one
    if data.startswith(b"BZh"):
        unpacked: Bytes = _gather(_feed(bz2.BZ2Decompressor(), data), most)
    elif data.startswith(b"\x04\x22\x4d\x18"):
        unpacked = _gather(_feed(lz4.frame.LZ4FrameDecompressor(), data), most)
    else:
        unpacked = data
    memory.check(len(unpacked))
    return unpacked


def _unpack(data: Bytes, compression: str, size: int, memory: Memory) -> Bytes:
    """Decompresses plausible sizes at once, and claims to grow by more than that in steps."""
    plausible = size <= max(_PLAUSIBLE_GROWTH * len(data), _STEP)
    if compression == "zstd":
        if plausible and zstandard.frame_content_size(data) in (size, -1):
            return _unpack_zstd(data, memory.buffer(size))
        return _gather(
            zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True).read, size
        )
    if compression == "bz2":
        engine = bz2.BZ2Decompressor()
        return _gather(_feed(engine, data), size)
    return _gather(_feed(lz4.frame.LZ4FrameDecompressor(), data), size)


def _unpack_zstd(data: Bytes, buffer: memoryview) -> memoryview:
    """What ``data`` hold, in the buffer; shorter or with one byte more where they claim another."""
    with _zstd().stream_reader(data, read_across_frames=True) as reader:
        done = 0
        while done < len(buffer) and (count := reader.readinto(buffer[done:])):
            done += count
        if done == len(buffer) and reader.read(1):
            raise zstandard.ZstdError(f"they hold more than {done} bytes")
    return buffer[:done]


def _zstd() -> zstandard.ZstdDecompressor:
    """A decompressor, one a thread: making one takes as long as a small chunk."""
    engine = getattr(_engines, "zstd", None)
    if engine is None:
        engine = _engines.zstd = zstandard.ZstdDecompressor()
    return engine


class _Engine(Protocol):
    @property
    def eof(self) -> bool: ...

    def decompress(self, data: Bytes, max_length: int = -1) -> bytes: ...


def _feed(engine: _Engine, data: Bytes) -> Callable[[int], bytes]:
    """A function that reads at most so many decompressed bytes of ``data``."""
    rest = [data]

    def read(size: int) -> bytes:
        if engine.eof:
            return b""
        return engine.decompress(rest.pop() if rest else b"", max_length=size)

    return read


def _gather(read: Callable[[int], bytes], size: int) -> bytes | bytearray:
    """At most ``size + 1`` bytes: one too many shows that the claim was too small.

    They grow in place, so that memory never holds them twice.
    """
    first = read(min(_STEP, size + 1))
    if len(first) > size or not (piece := read(min(_STEP, size + 1 - len(first)))):
        return first
    gathered = bytearray(first)
    while piece:
        gathered += piece
        piece = read(min(_STEP, size + 1 - len(gathered))) if len(gathered) <= size else b""
    return gathered
