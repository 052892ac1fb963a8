"""The paper's vocabulary (3.4): words by the Euclidean distance of descriptors of any length.

A vocabulary takes unit vectors, whose nearest neighbours by angle and by distance are the same. A
descriptor x becomes the unit vector (s x, sqrt(1 - s^2 x^2)): squared distances of two of them are
s^2 times the descriptors' own, and a little more where their lengths differ, at most by the share
l^2 / (1 - l^2), where l is the greater of s times both lengths.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from semloc_logs.arrays import F32
from semloc_logs.errors import SettingsError
from semloc_logs.subvolumes.cut import plain_name
from semloc_logs.words.vocabulary import (
    Vocabulary,
    cells_of,
    load_vocabulary,
    save_vocabulary,
    train_vocabulary,
)

USUAL_LENGTH = 0.5  # of s times a descriptor: nearly all are shorter
QUANTILE = 0.99
PER_WORD = 4  # descriptors of a word, on average, of few descriptors
LONGEST = 0.95  # longer ones are cut to it


def lifted(descriptors: NDArray[np.floating], scale: float) -> F32:
    """Unit vectors (n, N + 1) of descriptors (n, N)."""
    scaled = np.asarray(descriptors, np.float32) * np.float32(scale)
    length = np.linalg.norm(scaled, axis=1, keepdims=True)
    scaled *= np.minimum(1.0, LONGEST / np.maximum(length, 1e-9))
    length = np.minimum(length, LONGEST)
    return np.concatenate([scaled, np.sqrt(1 - length**2)], axis=1).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class PlainVocabulary:
    """A ``vocabulary`` of descriptors that are lifted by ``scale``."""

    vocabulary: Vocabulary
    scale: float

    def lifted(self, descriptors: NDArray[np.floating]) -> F32:
        """Descriptors (n, N) as the vocabulary takes them."""
        return lifted(descriptors, self.scale)


def train_plain_vocabulary(
    descriptors: NDArray[np.floating], cells: int = 256, children: int = 256, seed: int = 0
) -> PlainVocabulary:
    """A vocabulary of ``cells`` x ``children`` words from descriptors (n, N) of any length.

    Fewer than ``PER_WORD`` descriptors to a word give fewer children, a power of two. Raises
    SettingsError where there are too few.
    """
    length = np.linalg.norm(np.asarray(descriptors, np.float32), axis=1)
    longest = float(np.quantile(length, QUANTILE)) if len(length) else 1.0
    scale = USUAL_LENGTH / max(longest, 1e-9)
    enough = max(1, len(length) // (PER_WORD * cells_of(len(length), cells)))
    children = min(children, 1 << (enough.bit_length() - 1))
    return PlainVocabulary(
        train_vocabulary(lifted(descriptors, scale), cells, children, seed), scale
    )


def save_plain_vocabulary(path: Path, words: PlainVocabulary, card: dict[str, str]) -> None:
    """Write it as any vocabulary, with the scale in its card."""
    save_vocabulary(path, words.vocabulary, {**card, "scale": repr(words.scale)})


@lru_cache(maxsize=8)
def load_plain_vocabulary(variant: str, path: Path | None = None) -> PlainVocabulary:
    """The vocabulary of a file, or the shipped one; SettingsError when the file does not hold one
    of the paper's method.
    """
    shipped = files("semloc_logs.words") / "vocabularies" / f"{plain_name(variant)}.safetensors"
    with nullcontext(path) if path is not None else as_file(shipped) as file:
        vocabulary = load_vocabulary(variant, file)
        try:
            with safe_open(file, "np") as handle:
                return PlainVocabulary(vocabulary, float((handle.metadata() or {})["scale"]))
        except (OSError, SafetensorError, KeyError, ValueError):
            raise SettingsError(
                f"{file} is not a vocabulary of the paper's method: make one with"
                " 'semloc vocabulary --method paper'."
            ) from None
