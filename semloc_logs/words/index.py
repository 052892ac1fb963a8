"""Inverted lists over the words of many submaps and the search for the nearest codes in them (paper 3.4).

A query looks into the lists of its nearest cells in two steps. The codes nearest in Hamming distance, with all that are as near as the
last, are found by counting bits. Of these the nearest are told by the *asymmetric* distance (Gordo et al. 2014): a bit that differs
counts as much as the query's projection lies off the cell's threshold, as bits of projections close to it mean little. That finds more
true neighbours than the Hamming distance alone does, for a few microseconds a query; the distance to the centroid of an entry's word
adds nothing to it, so the second level of the vocabulary is not asked (benchmarks/README.md, Words).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from semloc_logs.words.vocabulary import BITS, Vocabulary, codes_of

U64 = NDArray[np.uint64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
F32 = NDArray[np.float32]
AT_ONCE = 64  # codes that are compared before any is looked at
SHORTLIST = 32  # nearest codes in Hamming distance that are compared asymmetrically


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """``query`` (m,) rows of the query, ``entry`` (m,) rows of the database, ``distance`` (m,) Hamming; nearest first for each query,
    by the asymmetric distance."""

    query: I32
    entry: I32
    distance: I32


def _count_bits(_: Any, x: Any) -> Any:
    return types.int64(types.uint64), lambda context, builder, signature, arguments: builder.ctpop(arguments[0])


def _first_bit(_: Any, x: Any) -> Any:
    def instruction(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], context.get_constant(types.boolean, True))  # never asked about 0

    return types.int64(types.uint64), instruction


# instructions of the processor, where it has them, for compiled functions: how many bits of an uint64 are set, and the lowest of them
popcount: Any = intrinsic(_count_bits)
lowest_bit: Any = intrinsic(_first_bit)


@njit(cache=True, nogil=True)
def _shortlist(
    codes: U64, cells: I32, starts: I64, listed: U64, group: I32, allowed: NDArray[np.bool_], size: int, bound: int, entry: I32, probe: I32
) -> tuple[int, int]:
    """Allowed entries in the ``cells`` (p,) of one query with codes (p,) that are no farther than the one that is number ``size``.

    Only those up to ``bound`` are looked at; where they are fewer than ``size`` they are returned all the same. Their rows and probes
    come into ``entry`` and ``probe``, which have room for all; returns how many, and the distance of the farthest.
    """
    count = np.zeros(BITS + 2, np.int64)  # entries found at each distance
    distance = np.empty(AT_ONCE, np.int64)
    within, kept = 0, 0
    for p in range(len(cells)):
        code, end = codes[p], starts[cells[p] + 1]
        for first in range(starts[cells[p]], end, AT_ONCE):
            block = listed[first : min(first + AT_ONCE, end)]
            least = BITS
            for i in range(len(block)):  # without branches: the compiler makes it several at a time
                distance[i] = popcount(code ^ block[i])
                least = min(least, distance[i])
            if least > bound:
                continue
            for i in range(len(block)):
                d = distance[i]
                if d <= bound and allowed[group[first + i]]:
                    count[d] += 1
                    within += 1
                    entry[kept], probe[kept] = first + i, p
                    kept += 1
                    while within - count[bound] >= size:  # enough are nearer than the bound
                        within -= count[bound]
                        bound -= 1
    left = 0
    for i in range(kept):
        if popcount(codes[probe[i]] ^ listed[entry[i]]) <= bound:
            entry[left], probe[left] = entry[i], probe[i]
            left += 1
    return left, bound


@njit(cache=True, nogil=True)
def _nearest(
    margin: F32, codes: U64, cells: I32, starts: I64, listed: U64, group: I32, allowed: NDArray[np.bool_], k: int, size: int
) -> tuple[I32, I32]:
    """The k nearest allowed entries (n, k) of each query, -1 where there are fewer, and their Hamming distances, nearest first.

    ``margin`` (n, p, 64) is how far the query's projections lie off the thresholds of its cells, ``codes`` (n, p) their signs.
    """
    n = len(cells)
    nearest, hamming = np.full((n, k), -1, np.int32), np.zeros((n, k), np.int32)
    entry, probe = np.empty(len(listed), np.int32), np.empty(len(listed), np.int32)
    best = np.empty(k)
    bound = BITS
    for q in range(n):
        best[:] = np.inf
        # a query's last neighbours are about as far as those of the one before; where they are farther, all are looked at
        count, bound = _shortlist(codes[q], cells[q], starts, listed, group, allowed, size, min(bound + 1, BITS), entry, probe)
        if count < size:
            count, bound = _shortlist(codes[q], cells[q], starts, listed, group, allowed, size, BITS, entry, probe)
        for i in range(count):
            different = codes[q, probe[i]] ^ listed[entry[i]]
            bits, distance = popcount(different), 0.0
            while different and distance < best[k - 1]:
                b = lowest_bit(different)
                distance += margin[q, probe[i], b]
                different &= different - np.uint64(1)
            if distance < best[k - 1]:
                j = k - 1
                while j > 0 and best[j - 1] > distance:
                    best[j], nearest[q, j], hamming[q, j] = best[j - 1], nearest[q, j - 1], hamming[q, j - 1]
                    j -= 1
                best[j], nearest[q, j], hamming[q, j] = distance, entry[i], bits
    return nearest, hamming


class Index:
    """Words of a database, sorted by vocabulary cell. ``group`` (n,) is the number of the submap that each word lies in."""

    def __init__(self, vocabulary: Vocabulary, word: NDArray[np.uint16], code: U64, group: NDArray[np.integer]) -> None:
        self.vocabulary = vocabulary
        cell = word.astype(np.int64) // 256
        self.order = np.argsort(cell, kind="stable")
        self._starts = np.searchsorted(cell[self.order], np.arange(len(vocabulary.cells) + 1))
        self._codes = code[self.order]
        self._group = group[self.order].astype(np.int32)

    def search(self, descriptors: F32, k: int, probes: int, allowed: NDArray[np.bool_]) -> Matches:
        """The ``k`` nearest words of each descriptor (n, N) in its ``probes`` nearest cells among the ``allowed`` submaps."""
        if not len(descriptors) or not len(self._codes):
            empty = np.zeros(0, np.int32)
            return Matches(empty, empty, empty)
        cells = self.vocabulary.nearest_cells(descriptors, probes)
        margin = self.vocabulary.margins(descriptors, cells)
        size = max(SHORTLIST, k)
        entry, distance = _nearest(np.abs(margin), codes_of(margin), cells, self._starts, self._codes, self._group, allowed, k, size)
        query, rank = np.nonzero(entry >= 0)
        return Matches(query.astype(np.int32), self.order[entry[query, rank]].astype(np.int32), distance[query, rank])
