"""The semantic vocabulary: hierarchical k-means with a Hamming embedding (paper 3.4).

Codes have 64 bits (Jegou et al. 2008). The first level has up to 256 cells in the space of the
descriptors, the second up to 256 children of each in the 64 projected dimensions that the codes are
made of: 2^16 words in 4.3 MB, as the children are stored in steps of 2^-8, one byte a dimension.

Thresholds of the code are the medians of each *cell*, so within a cell half of all bits are set.
Jegou et al. have them for every word; here a word has a handful of descriptors to take a median of,
and thresholds at the words' centroids find no more true neighbours than thresholds of cells do
(docs/benchmarks.md, Words), while every word of a cell would need codes of its own of the query.

Descriptors, directions and centroids are multiples of 2^-11 (children of 2^-8), so that words do
not depend on the order in which a BLAS with so many threads adds: see
:mod:`semloc_logs.words.kmeans`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from semloc_logs.arrays import F32
from semloc_logs.errors import SettingsError
from semloc_logs.numerics.cells import by_cell
from semloc_logs.tables.atomic_files import replacing_file
from semloc_logs.words.kmeans import BLOCK, grid, kmeans, nearest_centroids

BITS = 64
# of the children's coordinates, which int8 holds up to 127 / 256: three times their spread and more
CHILD_STEP = 2.0**-8
PER_CELL = 256  # descriptors for each cell that the cells are found from


@dataclass(frozen=True, eq=False)
class Vocabulary:
    """Cells, and children of cells, for descriptors of N >= 64 dimensions.

    ``cells`` (c, N) unit centroids and ``projection`` (64, N), multiples of 2^-11, ``thresholds``
    (c, 64), ``children`` (c, k, 64) centroids, multiples of 2^-8.
    """

    cells: F32
    projection: F32
    thresholds: F32
    children: F32

    @cached_property
    def squares(self) -> F32:
        """The square (c, k) of the length of each child."""
        return np.asarray(np.square(self.children).sum(2))

    def nearest_cells(self, descriptors: F32, probes: int) -> NDArray[np.int32]:
        """The ``probes`` nearest cells (n, probes) of descriptors (n, N), nearest first.

        Of equals the first.
        """
        out = np.zeros((len(descriptors), min(probes, len(self.cells))), np.int32)
        for i in range(0, len(descriptors), BLOCK):
            _largest(grid(descriptors[i : i + BLOCK]) @ self.cells.T, out[i : i + BLOCK])
        return out

    def projected(self, descriptors: F32) -> F32:
        """Descriptors (n, N) in the dimensions of the code (n, 64)."""
        return np.asarray(grid(descriptors) @ self.projection.T)

    def margins(self, descriptors: F32, cell: NDArray[np.integer]) -> F32:
        """How far the projections of descriptors (n, N) lie above the thresholds of ``cell``.

        ``cell`` is (n,) or (n, p); the margins are (n, 64) or (n, p, 64).
        """
        projected = self.projected(descriptors).reshape(
            len(descriptors), *[1] * (cell.ndim - 1), BITS
        )
        return np.asarray(projected - self.thresholds[cell])

    def codes(self, descriptors: F32, cell: NDArray[np.integer]) -> NDArray[np.uint64]:
        """64-bit codes of descriptors (n, N) under the thresholds of ``cell`` (n,) or (n, p).

        They have its shape; bit b is projection b.
        """
        return codes_of(self.margins(descriptors, cell))

    def words(self, descriptors: F32) -> tuple[NDArray[np.uint16], NDArray[np.uint64]]:
        """Word (cell * 256 + child) and code of each descriptor (n, N)."""
        if not len(descriptors):
            return np.zeros(0, np.uint16), np.zeros(0, np.uint64)
        cell = self.nearest_cells(descriptors, 1)[:, 0]
        order, starts = by_cell(cell, len(self.cells))
        projected = grid(self.projected(descriptors))
        child = np.zeros(len(cell), np.int64)
        for c in np.flatnonzero(np.diff(starts)):
            rows = order[starts[c] : starts[c + 1]]
            child[rows] = nearest_centroids(projected[rows], self.children[c])[0]
        return (cell.astype(np.int64) * 256 + child).astype(np.uint16), self.codes(
            descriptors, cell
        )


def codes_of(margins: F32) -> NDArray[np.uint64]:
    """Codes (...) of ``margins`` (..., 64): bit b is whether margin b is above 0."""
    bits = np.packbits(margins > 0, axis=-1, bitorder="little")
    return np.ascontiguousarray(bits).view("<u8").astype(np.uint64)[..., 0]


@njit(cache=True, nogil=True)
def _largest(similarity: F32, out: NDArray[np.int32]) -> None:
    """Columns of the largest values of each row of ``similarity`` (n, c) into ``out`` (n, k).

    The largest come first.
    """
    k = out.shape[1]
    best = np.empty(k, np.float32)
    for i in range(len(similarity)):
        best[:] = -np.inf
        for c in range(similarity.shape[1]):
            s = similarity[i, c]
            if s > best[k - 1]:
                j = k - 1
                while j > 0 and best[j - 1] < s:
                    best[j] = best[j - 1]
                    out[i, j] = out[i, j - 1]
                    j -= 1
                best[j] = s
                out[i, j] = c


def _directions(descriptors: F32, cells: F32, rng: np.random.Generator) -> F32:
    """Principal directions (64, N) of the offsets from the cells, rotated at random.

    The rotation makes all bits equally informative.
    """
    rest = (descriptors - cells[nearest_centroids(descriptors, cells)[0]]).astype(np.float64)
    directions = np.linalg.eigh(rest.T @ rest)[1][:, ::-1][:, :BITS]
    # an eigenvector's sign is the library's choice: the largest component is made positive
    directions = directions * np.sign(directions[np.abs(directions).argmax(0), np.arange(BITS)])
    q, r = np.linalg.qr(rng.standard_normal((BITS, BITS)))
    return grid((directions @ (q * np.sign(np.diag(r)))).T)


def cells_of(descriptors: int, most: int) -> int:
    """How many cells a vocabulary of so many descriptors has."""
    return min(most, max(8, descriptors // 64))


def train_vocabulary(
    descriptors: NDArray[np.floating], cells: int = 256, children: int = 256, seed: int = 0
) -> Vocabulary:
    """A vocabulary of ``cells`` x ``children`` words from unit descriptors (n, N).

    There are at least 64 descriptors to a cell, so fewer than 16,384 give fewer cells; a cell has
    at most one word for two descriptors, and its last rows repeat the first, which no descriptor is
    given then. Raises SettingsError below 256 descriptors and 64 dimensions.
    """
    n = len(descriptors)
    if n < 256 or descriptors.shape[1] < BITS:
        raise SettingsError(
            f"A vocabulary needs at least 256 descriptors of {BITS} dimensions, not {n} of "
            f"{descriptors.shape[1]}: describe more sessions."
        )
    rng = np.random.default_rng(seed)
    cells = cells_of(n, cells)
    some = grid(descriptors[np.sort(rng.choice(n, min(n, PER_CELL * cells), replace=False))])
    centroids = kmeans(some, cells, rng, 15)
    centroids = grid(centroids / np.maximum(np.linalg.norm(centroids, axis=1, keepdims=True), 1e-9))
    projection = _directions(some, centroids, rng)
    cell = np.zeros(n, np.int32)
    projected = np.zeros((n, BITS), np.float32)
    for i in range(0, n, BLOCK):
        block = grid(descriptors[i : i + BLOCK])
        projected[i : i + BLOCK] = block @ projection.T
        _largest(block @ centroids.T, cell[i : i + BLOCK, None])
    order, starts = by_cell(cell, cells)
    thresholds = np.tile(np.median(projected, axis=0), (cells, 1)).astype(np.float32)
    kids = np.zeros((cells, children, BITS), np.float32)
    for c in range(cells):
        members = projected[order[starts[c] : starts[c + 1]]]
        if len(members) >= 8:
            thresholds[c] = np.median(members, axis=0)
        if len(members):
            # single descriptors lie farther from others than their mean does
            k = min(children, max(1, len(members) // 2))
            kids[c, :k] = kmeans(members, k, rng, 8)
            kids[c, k:] = kids[c, 0]
    return Vocabulary(
        centroids, projection, thresholds, _bytes(kids).astype(np.float32) * np.float32(CHILD_STEP)
    )


def _bytes(children: F32) -> NDArray[np.int8]:
    return np.clip(np.round(children / CHILD_STEP), -127, 127).astype(np.int8)


def save_vocabulary(path: Path, vocabulary: Vocabulary, card: dict[str, str]) -> None:
    """Write safetensors, half precision, children in bytes; ``card`` describes the training."""
    # safetensors writes the memory without regard to strides: a transposed array would come back
    # scrambled
    arrays = {
        k: np.ascontiguousarray(getattr(vocabulary, k), np.float16)
        for k in ("cells", "projection", "thresholds")
    }
    with replacing_file(path) as temporary:
        save_file(arrays | {"children": _bytes(vocabulary.children)}, temporary, metadata=card)


@lru_cache(maxsize=8)
def load_vocabulary(variant: str, path: Path | None = None) -> Vocabulary:
    """The shipped vocabulary of ``variant``, or the vocabulary of a file.

    SettingsError when the file does not hold one.
    """
    try:
        if path is not None:
            arrays = load_file(path)
        else:
            with as_file(
                files("semloc_logs.words") / "vocabularies" / f"{variant}.safetensors"
            ) as shipped:
                arrays = load_file(shipped)
        if arrays["children"].dtype == np.float16:  # files before there were 2^16 words
            arrays["children"] = _bytes(arrays["children"].astype(np.float32))
        cells, projection, thresholds, children = (
            arrays[k] for k in ("cells", "projection", "thresholds", "children")
        )
        c = len(cells)
        k = children.shape[1]
        n = projection.shape[1]
        shapes = (cells.shape, projection.shape, thresholds.shape, children.shape)
        if (
            shapes != ((c, n), (BITS, n), (c, BITS), (c, k, BITS))
            or not (0 < c <= 256 and 0 < k <= 256)
            or children.dtype != np.int8
        ):
            raise ValueError(f"shapes {shapes}, children {children.dtype}")
        if not all(np.isfinite(a).all() for a in (cells, projection, thresholds)):
            raise ValueError("values that are not finite")
        step = np.float32(CHILD_STEP)
        return Vocabulary(
            grid(cells),
            grid(projection),
            thresholds.astype(np.float32),
            children.astype(np.float32) * step,
        )
    except (OSError, SafetensorError, KeyError, IndexError, ValueError) as problem:
        raise SettingsError(
            f"{path or 'The shipped vocabulary'}: no vocabulary of the {variant} variant "
            f"({problem})."
        ) from None
