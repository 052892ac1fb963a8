"""Bits counted and found by instructions of the processor, and bytes eight at a time.

For compiled functions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import intrinsic


def _count_bits(_: Any, x: Any) -> Any:
    return types.int64(types.uint64), lambda context, builder, signature, arguments: builder.ctpop(
        arguments[0]
    )


def _first_bit(_: Any, x: Any) -> Any:
    def instruction(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        # undefined for 0, which callers exclude
        return builder.cttz(arguments[0], context.get_constant(types.boolean, True))

    return types.int64(types.uint64), instruction


popcount: Any = intrinsic(_count_bits)  # how many bits of an uint64 are set
lowest_bit: Any = intrinsic(_first_bit)  # and the number of the lowest of them
EACH_BYTE = 0x0101010101010101  # times a byte: a word of eight of them


@njit(cache=True, nogil=True)
def bytes_set(word: np.uint64) -> np.uint64:
    """The highest bit of each byte of a word that is not zero."""
    low = np.uint64(0x7F * EACH_BYTE)
    return (((word & low) + low) | word) & ~low
