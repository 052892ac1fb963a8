"""The memory that one log may take: the setting ``logs.memory``."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from semloc_logs.errors import LogError

DEFAULT = 2 << 30  # bytes, as the setting's
_MOST_PLAUSIBLE = 1 << 34  # bytes of a chunk or of a message
_MOST_WASTE = 1.5  # a spare buffer is used for a piece that is smaller by this factor at most
_SPARES = 32  # spare buffers take at most this part of the limit


class Memory:
    """Counts the bytes of a log that are in memory at once; ``limit`` is the most of all.

    The shares leave room for a second copy of the largest piece, which decompression, sqlite or a
    reader of the messages may need.
    """

    def __init__(self, limit: int = DEFAULT) -> None:
        self.limit = limit
        self.used = 0
        self._spare: list[bytearray] = []
        self._lock = threading.Lock()  # of the spare buffers

    @property
    def most_of_one(self) -> int:
        """Bytes of a chunk or of a message, decompressed."""
        return self.limit // 4

    @property
    def most_of_overlapping(self) -> int:
        """Bytes of chunks that are kept while others with the same times are read."""
        return self.limit // 4

    @property
    def most_of_copies(self) -> int:
        """Bytes of messages that are copied from chunks which are not kept."""
        return self.limit // 8

    @property
    def most_of_definitions(self) -> int:
        """Bytes of schemas, channels and connections; of an index."""
        return self.limit // 16

    def too_much(self, size: int) -> str:
        """The end of a sentence about a piece of ``size`` bytes."""
        claim = f"claims {size} bytes, and at most {self.most_of_one} are read at once"
        if size > _MOST_PLAUSIBLE:
            return claim
        return f"{claim}; if it is right, set logs.memory to {4 * size} or more"

    def check(self, size: int) -> None:
        """LogError where a piece of ``size`` bytes is too large, before it is made."""
        if size > self.most_of_one:
            raise LogError(f"it {self.too_much(size)}")

    def buffer(self, size: int) -> memoryview:
        """Room for ``size`` bytes: one that was :meth:`counted` and is free again, where one fits.

        New memory would cost as much as a third of decompression, until its pages are there.
        """
        with self._lock:
            for place, spare in enumerate(self._spare):
                if size <= len(spare) <= _MOST_WASTE * size:
                    return memoryview(self._spare.pop(place))[:size]
        return memoryview(bytearray(size))

    def counted(self, data: bytes | bytearray | memoryview) -> memoryview:
        """A view of ``data`` that counts as used as long as it, or a slice of it, is alive."""
        array = np.frombuffer(data, np.uint8)
        self.used += len(data)
        buffer = data.obj if isinstance(data, memoryview) else None
        weakref.finalize(array, self._free, len(data), buffer).atexit = False
        return memoryview(array)  # type: ignore[arg-type]  # before Python 3.12

    @contextmanager
    def held(self, size: int) -> Iterator[None]:
        """Counts ``size`` bytes as used during the block."""
        self.used += size
        try:
            yield
        finally:
            self.used -= size

    def _free(self, size: int, buffer: object) -> None:
        self.used -= size
        if isinstance(buffer, bytearray) and len(buffer) <= self.limit // _SPARES:
            with self._lock:
                self._spare.append(buffer)
                # the oldest go first: the sizes of chunks may have changed
                while sum(map(len, self._spare)) > self.limit // _SPARES:
                    del self._spare[0]
