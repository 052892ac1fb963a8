"""The semantic vocabulary (paper 3.4): hierarchical k-means over descriptors with a 64-bit Hamming embedding (Jegou et al. 2008).

The first level has up to 256 cells in the space of the descriptors, the second up to 256 children of each in the 64 projected
dimensions that the codes are made of. Thresholds of the code are the medians of each cell, so within a cell half of all bits are set.

Descriptors and directions are of unit length and rounded to multiples of 2^-11: their products are multiples of 2^-22 whose partial sums
stay below 2, which float32 holds exactly. So words do not depend on the order in which a BLAS with so many threads adds.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from semloc_logs.errors import SettingsError
from semloc_logs.tables import replacing_file

BITS = 64
F32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Vocabulary:
    """``cells`` (c, 256) unit centroids, ``projection`` (64, 256), ``thresholds`` (c, 64), ``children`` (c, k, 64) centroids;
    multiples of 2^-11, all but the thresholds."""

    cells: F32
    projection: F32
    thresholds: F32
    children: F32

    def nearest_cells(self, descriptors: F32, probes: int) -> NDArray[np.int32]:
        """The ``probes`` nearest cells (n, probes) of descriptors (n, 256), nearest first."""
        similarity = _grid(descriptors) @ self.cells.T
        probes = min(probes, len(self.cells))
        part = np.argpartition(-similarity, probes - 1, axis=1)[:, :probes]
        order = np.argsort(-np.take_along_axis(similarity, part, 1), axis=1, kind="stable")
        return np.take_along_axis(part, order, 1).astype(np.int32)

    def codes(self, descriptors: F32, cell: NDArray[np.integer]) -> NDArray[np.uint64]:
        """64-bit codes of descriptors (n, 256) under the thresholds of ``cell`` (n,) or (n, p), in its shape; bit b is projection b."""
        projected = (_grid(descriptors) @ self.projection.T).reshape(len(descriptors), *[1] * (cell.ndim - 1), BITS)
        bits = np.packbits(projected > self.thresholds[cell], axis=-1, bitorder="little")
        return np.ascontiguousarray(bits).view("<u8").astype(np.uint64).reshape(cell.shape)

    def words(self, descriptors: F32) -> tuple[NDArray[np.uint16], NDArray[np.uint64]]:
        """Word (cell * 256 + child) and code of each descriptor (n, 256)."""
        if not len(descriptors):
            return np.zeros(0, np.uint16), np.zeros(0, np.uint64)
        cell = self.nearest_cells(descriptors, 1)[:, 0]
        projected = _grid(_grid(descriptors) @ self.projection.T)
        child = np.zeros(len(cell), np.int64)
        for c in np.unique(cell):
            mine = cell == c
            k = self.children[c]
            child[mine] = np.argmin((k**2).sum(1) - 2 * projected[mine] @ k.T, axis=1)
        return (cell.astype(np.int64) * 256 + child).astype(np.uint16), self.codes(descriptors, cell)


def _grid(a: NDArray[np.floating]) -> F32:
    return (np.round(np.asarray(a, np.float32) * 2048) / 2048).astype(np.float32)


def _kmeans(data: F32, k: int, rng: np.random.Generator, rounds: int = 15) -> F32:
    """Lloyd's algorithm from distinct random points; an empty cluster takes the point farthest from its centroid."""
    centroids, square = data[rng.choice(len(data), k, replace=False)].copy(), (data**2).sum(1)
    for _ in range(rounds):
        distance = square[:, None] - 2 * data @ centroids.T + (centroids**2).sum(1)
        nearest = distance.argmin(1)
        count = np.bincount(nearest, minlength=k)
        sums = np.zeros_like(centroids)
        np.add.at(sums, nearest, data)
        full = count > 0
        centroids[full] = sums[full] / count[full, None]
        if not full.all():
            worst = np.argsort(-distance[np.arange(len(data)), nearest])
            centroids[~full] = data[worst[: int((~full).sum())]]
    return centroids


def train_vocabulary(descriptors: F32, cells: int = 256, children: int = 16, seed: int = 0) -> Vocabulary:
    """A vocabulary of ``cells`` x ``children`` words from unit descriptors (n, 256); fewer where there are not enough.

    Raises SettingsError below 256 descriptors.
    """
    n = len(descriptors)
    if n < 256:
        raise SettingsError(f"A vocabulary needs at least 256 descriptors, not {n}: describe more sessions.")
    rng = np.random.default_rng(seed)
    cells = int(min(cells, max(8, n // 64)))
    centroids = _kmeans(descriptors, cells, rng)
    centroids = _grid(centroids / np.maximum(np.linalg.norm(centroids, axis=1, keepdims=True), 1e-9))
    cell = (descriptors @ centroids.T).argmax(1)
    # principal directions of what is left within the cells, rotated at random so that every bit says equally much
    rest = descriptors - centroids[cell]
    directions = np.linalg.eigh(rest.T @ rest)[1][:, ::-1][:, :BITS]
    rotation = np.linalg.qr(rng.standard_normal((BITS, BITS)))[0]
    projection = _grid((directions @ rotation).T)
    projected = descriptors @ projection.T
    overall = np.median(projected, axis=0)
    thresholds = np.tile(overall, (cells, 1)).astype(np.float32)
    kids = np.zeros((cells, children, BITS), np.float32)
    for c in range(cells):
        mine = projected[cell == c]
        if len(mine) >= 8:
            thresholds[c] = np.median(mine, axis=0)
        if len(mine) >= children:
            kids[c] = _kmeans(mine, children, rng, 8)
        elif len(mine):
            kids[c] = mine[rng.choice(len(mine), children)]
    return Vocabulary(centroids, projection, thresholds, _grid(kids))


def save_vocabulary(path: Path, vocabulary: Vocabulary, card: dict[str, str]) -> None:
    """Half precision safetensors; ``card`` says what it was trained on."""
    # safetensors writes the memory as it lies, whatever the strides say: a transposed array would come back scrambled
    arrays = {k: np.ascontiguousarray(getattr(vocabulary, k), np.float16) for k in ("cells", "projection", "thresholds", "children")}
    with replacing_file(path) as temporary:
        save_file(arrays, temporary, metadata=card)


@lru_cache(maxsize=8)
def load_vocabulary(variant: str, path: Path | None = None) -> Vocabulary:
    """The shipped vocabulary of ``variant``, or that of a file. Raises SettingsError when the file does not hold one."""
    try:
        if path is not None:
            arrays = load_file(path)
        else:
            with as_file(files("semloc_logs.words") / "vocabularies" / f"{variant}.safetensors") as shipped:
                arrays = load_file(shipped)
        cells, projection, thresholds, children = (arrays[k].astype(np.float32) for k in ("cells", "projection", "thresholds", "children"))
        c, k = len(cells), children.shape[1]
        shapes = (cells.shape, projection.shape, thresholds.shape, children.shape)
        if shapes != ((c, 256), (BITS, 256), (c, BITS), (c, k, BITS)) or not (0 < c <= 256 and 0 < k <= 256):
            raise ValueError(f"shapes {shapes}")
        return Vocabulary(_grid(cells), _grid(projection), thresholds, _grid(children))
    except (OSError, SafetensorError, KeyError, IndexError, ValueError) as problem:
        raise SettingsError(f"{path or 'The shipped vocabulary'}: no vocabulary of the {variant} variant ({problem}).") from None
