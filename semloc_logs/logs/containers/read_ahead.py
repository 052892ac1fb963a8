"""Chunks that are read and decompressed by threads before their time has come.

Decompression takes most of the time of reading, and needs no interpreter: the messages of one chunk
are used while the next ones are made ready.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Generic, Self, TypeVar

from semloc_logs.errors import LogError
from semloc_logs.logs.containers.base import Bytes
from semloc_logs.logs.containers.memory import Memory

THREADS = 2
AHEAD = 3
LARGEST = 1 << 24  # bytes of a chunk; recorders make smaller ones

Part = TypeVar("Part")


class ReadAhead(Generic[Part]):
    """Unpacks ``parts`` in their order, the next ones in threads while they fit into ``memory``.

    ``size_of`` a part, unpacked; ``unpack`` is called from several threads. A part that is taken
    out of order, or again, is unpacked at once.
    """

    def __init__(
        self,
        parts: Sequence[Part],
        size_of: Callable[[Part], int],
        unpack: Callable[[Part], Bytes],
        memory: Memory,
    ) -> None:
        self._parts = parts
        self._size_of = size_of
        self._unpack = unpack
        self._memory = memory
        self._places = {id(part): place for place, part in enumerate(parts)}
        self._next = 0  # the first part that was not begun
        self._begun: dict[int, tuple[Future[Bytes], int]] = {}
        self._threads: ThreadPoolExecutor | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._threads is not None:
            self._threads.shutdown(wait=True, cancel_futures=True)
        for _, size in self._begun.values():
            self._memory.used -= size
        self._begun.clear()

    def take(self, part: Part) -> Bytes:
        """The part, unpacked. Raises what ``unpack`` raises."""
        place = self._places[id(part)]
        self._next = max(self._next, place + 1)
        future, size = self._begun.pop(place, (None, 0))
        self._begin(place)
        if future is None:
            return self._unpack(part)
        try:
            return future.result()
        finally:
            self._memory.used -= size

    def _begin(self, place: int) -> None:
        """Begins the parts behind a place that fit into memory."""
        while self._next < min(place + 1 + AHEAD, len(self._parts)):
            part = self._parts[self._next]
            try:
                size = self._size_of(part)
            except (LogError, OSError):
                return  # it is met again when its time has come
            room = self._memory.most_of_overlapping - self._memory.used
            if size > min(LARGEST, room // 2):
                return
            if self._threads is None:
                self._threads = ThreadPoolExecutor(THREADS, "semloc-read")
            self._memory.used += size
            self._begun[self._next] = self._threads.submit(self._unpack, part), size
            self._next += 1
