"""RVL, the run-length code of ROS's compressedDepth.

Runs of zeros, then runs of differences as variable-length numbers.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from semloc_logs.logs.messages.definitions import UndecodableError

# four times the largest depth camera; an empty picture is a dozen bytes whatever its size
_MAX_PIXELS = 1 << 24


def decode_rvl(data: bytes | memoryview) -> NDArray[np.uint16]:
    """The picture (h, w): width and height, then the code. UndecodableError when it is damaged."""
    if len(data) < 8:
        raise UndecodableError("its RVL picture is cut off")
    width, height = struct.unpack_from("<II", data)
    pixels = width * height
    if pixels > _MAX_PIXELS:
        raise UndecodableError(f"its RVL picture claims {width} x {height} pixels")
    # a pixel needs two numbers at most, of a nibble or many
    numbers = _numbers(data[8 : 8 + 16 * pixels + 4])
    starts, firsts, counts = (np.array(part, np.int64) for part in _runs(numbers, pixels))
    # 0, 1, ... within each run
    inside = np.arange(int(counts.sum())) - np.repeat(np.cumsum(counts) - counts, counts)
    coded = numbers[np.repeat(firsts, counts) + inside]
    out = np.zeros(pixels, np.uint16)
    # the last bit is the sign of the difference, which is to the value before, also across the
    # zeros between two runs
    out[np.repeat(starts, counts) + inside] = np.cumsum((coded >> 1) ^ -(coded & 1)).astype(
        np.uint16
    )
    return out.reshape(height, width)


def _runs(numbers: NDArray[np.int64], pixels: int) -> tuple[list[int], list[int], list[int]]:
    """For each run of values its first pixel, the index of its first number, and its length."""
    starts: list[int] = []
    firsts: list[int] = []
    counts: list[int] = []
    index = 0  # of the numbers
    position = 0  # of the pixels
    while position < pixels:
        if index + 2 > len(numbers):
            raise UndecodableError("its RVL picture is cut off")
        zeros = int(numbers[index])
        values = int(numbers[index + 1])
        position += zeros
        if zeros + values == 0 or position + values > pixels or index + 2 + values > len(numbers):
            raise UndecodableError("its RVL picture is damaged")
        starts.append(position)
        firsts.append(index + 2)
        counts.append(values)
        position += values
        index += 2 + values
    return starts, firsts, counts


def _numbers(code: bytes | memoryview) -> NDArray[np.int64]:
    """All numbers of the code: 3 bits a nibble, low ones first, the fourth marks a continuation."""
    words = np.frombuffer(code, "<u4", count=len(code) // 4)
    shifts = np.arange(28, -1, -4, dtype=np.uint32)  # the first nibble of a word is its highest
    nibbles = ((words[:, None] >> shifts) & 15).astype(np.int64).reshape(-1)
    last = np.flatnonzero(nibbles < 8)
    if not len(last):
        return np.zeros(0, np.int64)
    first = np.concatenate(([0], last[:-1] + 1))
    lengths = last - first + 1
    if int(lengths.max()) > 11:  # 33 bits: no number of a picture is that large
        raise UndecodableError("its RVL picture is damaged")
    place = np.arange(last[-1] + 1) - np.repeat(first, lengths)
    return np.asarray(
        np.add.reduceat((nibbles[: last[-1] + 1] & 7) << (3 * place), first), np.int64
    )
