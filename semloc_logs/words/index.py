"""Inverted lists over the words of many submaps and the search for the nearest codes in them (paper 3.4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.words.vocabulary import Vocabulary

U64 = NDArray[np.uint64]
I32 = NDArray[np.int32]
F32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """``query`` (m,) rows of the query, ``entry`` (m,) rows of the database, ``distance`` (m,) Hamming."""

    query: I32
    entry: I32
    distance: I32


@njit(cache=True, nogil=True)
def _popcount(x: np.uint64) -> int:
    x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return int((x * np.uint64(0x0101010101010101)) >> np.uint64(56))


@njit(cache=True, nogil=True)
def _nearest(
    codes: U64, cells: I32, starts: NDArray[np.int64], listed: U64, group: I32, allowed: NDArray[np.bool_], k: int
) -> tuple[I32, I32]:
    """The k nearest allowed entries (n, k) of each query, -1 where there are fewer, and their distances, nearest first."""
    n, probes = cells.shape
    entry = np.full((n, k), -1, np.int32)
    distance = np.full((n, k), 65, np.int32)
    for q in range(n):
        for p in range(probes):
            cell = cells[q, p]
            code = codes[q, p]
            for e in range(starts[cell], starts[cell + 1]):
                if not allowed[group[e]]:
                    continue
                d = _popcount(code ^ listed[e])
                if d < distance[q, k - 1]:
                    i = k - 1
                    while i > 0 and distance[q, i - 1] > d:
                        distance[q, i] = distance[q, i - 1]
                        entry[q, i] = entry[q, i - 1]
                        i -= 1
                    distance[q, i] = d
                    entry[q, i] = e
    return entry, distance


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
        """The ``k`` nearest words of each descriptor (n, 256) in its ``probes`` nearest cells among the ``allowed`` submaps."""
        if not len(descriptors) or not len(self._codes):
            empty = np.zeros(0, np.int32)
            return Matches(empty, empty, empty)
        cells = self.vocabulary.nearest_cells(descriptors, probes)
        codes = self.vocabulary.codes(descriptors, cells)
        entry, distance = _nearest(codes, cells, self._starts, self._codes, self._group, allowed, k)
        query, rank = np.nonzero(entry >= 0)
        return Matches(query.astype(np.int32), self.order[entry[query, rank]].astype(np.int32), distance[query, rank])
