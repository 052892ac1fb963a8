"""An open hash table of integers for compiled functions: linear probing, half empty at least.

The table is an array of keys, as long as a power of two. What belongs to a key is kept in other
arrays, at the same place.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from semloc_logs.arrays import I64

EMPTY = -(1 << 63)  # in place of a key; no caller has it as a key
LEAST_PLACES = 1024
# the golden ratio times 2^59, odd: Fibonacci hashing (Knuth, The Art of Computer Programming, 6.4)
MULTIPLIER = 0x9E3779B97F4A7C1
SHIFT = 20  # the lower bits of the product depend on the lower bits of the key only


@njit(cache=True, nogil=True)
def table_size(keys: int) -> int:
    """Places of a table for so many ``keys``, of which at least half stay empty."""
    size = LEAST_PLACES
    while size < 2 * keys:
        size *= 2
    return size


@njit(cache=True, nogil=True)
def empty_table(keys: int) -> I64:
    """A table for so many ``keys``."""
    return np.full(table_size(keys), EMPTY, np.int64)


@njit(cache=True, nogil=True)
def place_of(table: I64, key: int | np.int64) -> int:
    """Where ``key`` is in ``table``, or the empty place for it."""
    mask = len(table) - 1
    place = int(((key * MULTIPLIER) >> SHIFT) & mask)
    while table[place] != EMPTY and table[place] != key:
        place = (place + 1) & mask
    return place
