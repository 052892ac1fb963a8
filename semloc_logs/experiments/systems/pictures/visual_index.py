"""Retrieval of pictures by visual words with a Hamming embedding (Jegou et al. 2008) and burstiness
weighting (Jegou et al. 2009), as section 4.4 has it for SIFT.

The vocabulary is a tree of 256 x 256 words with 64 bits, as for shapes.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from semloc_logs.arrays import F32, F64, I64, U64
from semloc_logs.numerics.bits import popcount
from semloc_logs.numerics.cells import by_cell
from semloc_logs.words.index import look_ups
from semloc_logs.words.vocabulary import BITS, Vocabulary

WORDS = 2**16
CELLS = 2  # nearest cells of the vocabulary that a feature of a query looks into
FARTHEST = 24  # bits: codes that differ in more do not match
SIGMA = 16.0  # bits, of the weight of a match


class VisualIndex:
    """Words and codes of the features of pictures; pictures are numbered as they are added."""

    def __init__(self, vocabulary: Vocabulary) -> None:
        self._vocabulary = vocabulary
        self._word: list[I64] = []
        self._code: list[U64] = []

    def add(self, descriptors: F32) -> None:
        """Add the unit descriptors (n, 128) of the next picture."""
        word, code = self._vocabulary.words(descriptors)
        self._word.append(word.astype(np.int64))
        self._code.append(code)

    def finish(self) -> None:
        """Sort the words of all pictures, after the last one was added."""
        word = np.concatenate(self._word)
        counts = [len(w) for w in self._word]
        picture = np.repeat(np.arange(len(counts)), counts)
        order, start = by_cell(word, WORDS)
        self._start = start.astype(np.int64)
        self._codes = np.concatenate(self._code)[order]
        self._picture = picture[order]
        # the share of pictures with a word makes its weight
        holding = np.bincount(np.unique(word * len(counts) + picture) // len(counts), None, WORDS)
        self._idf = np.log(len(counts) / np.maximum(holding, 1)) * (holding > 0)
        # with one picture, or words that are in all of them, nothing would count
        self._idf = np.maximum(self._idf, 1e-3)
        squared = np.bincount(picture, self._idf[word] ** 2, len(counts))
        self._norm = np.sqrt(np.maximum(squared, 1e-12))

    def scores(self, descriptors: F32) -> F64:
        """Similarity (pictures,) to a picture with unit descriptors (n, 128)."""
        out = np.zeros(len(self._norm))
        for batch in look_ups(self._vocabulary, descriptors, CELLS):
            _vote(
                batch.word.astype(np.int64),
                batch.word_codes,
                (self._start, self._codes, self._picture),
                self._idf,
                out,
            )
        return np.asarray(out / self._norm)


@njit(cache=True, nogil=True)
def _vote(words: I64, codes: U64, lists: tuple[I64, U64, I64], idf: F64, out: F64) -> None:
    """Add the matches of features with nearest ``words`` (n, w) and ``codes`` (n, w) to ``out``.

    The weight of a match is idf^2 exp(-(h / sigma)^2) (equation 9 of Jegou et al. 2009); matches of
    one feature with several of a picture share it by the root of their sum (intra-image burstiness,
    equation 10), and so do those with many pictures (inter-image burstiness, equation 11).
    """
    start, code, picture = lists
    weight_of = np.exp(-((np.arange(BITS + 1) / SIGMA) ** 2))
    total = np.zeros(len(out))
    touched = np.empty(len(out), np.int64)
    for n in range(len(words)):
        count = 0
        for j in range(words.shape[1]):
            word = words[n, j]
            if word < 0:
                continue
            for k in range(start[word], start[word + 1]):
                h = popcount(codes[n, j] ^ code[k])
                if h > FARTHEST:
                    continue
                p = picture[k]
                if total[p] == 0.0:
                    touched[count] = p
                    count += 1
                total[p] += weight_of[h] * idf[word] ** 2
        everywhere = 0.0
        for p in touched[:count]:
            everywhere += total[p]
        for p in touched[:count]:
            out[p] += np.sqrt(total[p]) * np.sqrt(total[p] / everywhere)
            total[p] = 0.0
