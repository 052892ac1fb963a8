"""DenseVLAD (Torii et al., CVPR 2015): one vector a picture, of dense RootSIFT at four scales.

A vocabulary of 128 words, residuals added up for each word (VLAD) and scaled to unit length, then
the whole; principal components to 4096 dimensions, or as many as there are pictures. The database
is compared exhaustively. The DSP-SIFT pipeline finds the poses.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from semloc_logs.arrays import F32, F64, U8
from semloc_logs.experiments.systems.catalogue import SystemOptions
from semloc_logs.experiments.systems.pictures.local_features import (
    DENSE_STEP,
    Features,
    dense_sift,
    dsp_sift,
)
from semloc_logs.experiments.systems.pictures.picture_matching import (
    PictureSystem,
    StoredPicture,
    features_folder,
)
from semloc_logs.words.kmeans import grid, kmeans, nearest_centroids

WORDS = 128
DIMENSIONS = 4096
TRAINING_FEATURES = 200_000  # that the words are made of, at most
ROUNDS = 20
QUICK_STEP = 2 * DENSE_STEP  # pixels between features in a small scene: a quarter of them


class DenseVlad:
    """The vectors of the database's pictures, of features every ``step`` pixels."""

    def __init__(self, step: int = DENSE_STEP) -> None:
        self._step = step
        self._words = np.zeros((0, 128), np.float32)
        self._mean = np.zeros(0, np.float32)
        self._axes = np.zeros((0, 0), np.float32)
        self._vectors = np.zeros((0, 0), np.float32)

    def fit(self, pictures: Sequence[StoredPicture]) -> None:
        self._vectors = np.zeros((0, 0), np.float32)
        if not pictures:
            return
        rng = np.random.default_rng(0)
        share = max(1, TRAINING_FEATURES // len(pictures))
        parts = []
        for stored in pictures:
            features = dense_sift(stored.image(), self._step)
            rows = rng.permutation(len(features.xy))[:share]
            parts.append(features.vectors()[rows])
        training = np.concatenate(parts)
        self._words = kmeans(training, min(WORDS, len(training)), rng, ROUNDS)
        vectors = np.stack([self._vlad(stored.image()) for stored in pictures])
        self._mean = vectors.mean(0)
        self._axes = principal_axes_of(vectors - self._mean, DIMENSIONS)
        self._vectors = self._projected(vectors)

    def scores(self, image: U8, features: Features) -> F64:
        if not len(self._vectors):
            return np.zeros(0)
        return np.asarray(self._vectors @ self._projected(self._vlad(image)[None])[0], np.float64)

    def _vlad(self, image: U8) -> F32:
        descriptors = grid(dense_sift(image, self._step).vectors())
        word, _ = nearest_centroids(descriptors, self._words)
        out = np.zeros_like(self._words)
        np.add.at(out, word, descriptors - self._words[word])
        return np.asarray(_unit(_unit(out).reshape(1, -1))[0])

    def _projected(self, vectors: F32) -> F32:
        return _unit(np.asarray((vectors - self._mean) @ self._axes.T, np.float32))


def principal_axes_of(centred: F32, most: int) -> F32:
    """At most ``most`` principal axes (k, d) of rows (n, d), by the products of the rows, which are
    fewer than the dimensions.
    """
    values, vectors = np.linalg.eigh((centred @ centred.T).astype(np.float64))
    kept = np.flatnonzero(values > 1e-6 * max(values.max(), 1e-12))[::-1][:most]
    axes = vectors[:, kept].T @ centred / np.sqrt(values[kept])[:, None]
    return np.asarray(axes, np.float32)


def _unit(rows: F32) -> F32:
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.asarray(rows / np.maximum(length, 1e-9), np.float32)


def make_dense_vlad(options: SystemOptions) -> PictureSystem:
    """DenseVLAD in place of the visual words."""
    retrieval = DenseVlad(QUICK_STEP if options.quick else DENSE_STEP)
    return PictureSystem("dense-vlad", dsp_sift, retrieval, features_folder(options))
