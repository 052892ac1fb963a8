"""Memory for chunks that is used again, so that the system need not clear it for each of them."""

from __future__ import annotations

from collections import deque
from threading import Lock

_SPARE = 1024  # bytes; a look whether an array is free takes one of them


class Buffers:
    """Byte arrays for threads to fill; an array comes back only when nobody looks at it any more.

    Python refuses to resize an array while any view of it, a numpy array for example, is alive:
    that tells whether it is free.
    """

    def __init__(self, most: int = 4) -> None:
        self._idle: deque[bytearray] = deque(maxlen=most)
        self._lock = Lock()

    def take(self, size: int) -> bytearray:
        """An array of at least ``size`` bytes, with any content."""
        with self._lock:
            for buffer in self._idle:
                if len(buffer) >= size and _is_free(buffer):
                    self._idle.remove(buffer)
                    return buffer
        return bytearray(size + _SPARE)

    def give(self, buffer: bytearray) -> None:
        """Gives an array back; views of it may still be alive."""
        with self._lock:
            self._idle.append(buffer)


def _is_free(buffer: bytearray) -> bool:
    try:
        buffer.pop()
    except BufferError:
        return False
    return True
