"""The paper's pipeline with another descriptor in place of ours (section 4.4, FPFH to 3DMatch).

Keypoints, vocabulary, Hamming embedding, K = 5 matches and verification are the same for all of
them. A keypoint is the occupied voxel nearest to the middle of a cell of 8 voxels. Descriptors that
do not depend on the heading leave it open: each match then stands for one hypothesis a heading.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F32, F64, I64
from semloc_logs.experiments.kept_files import kept_file
from semloc_logs.experiments.system import Query, RankedPose, View
from semloc_logs.experiments.systems.level_maps import LevelMap, database_map, query_map
from semloc_logs.experiments.systems.shapes.training_views import Training
from semloc_logs.experiments.systems.shapes.voxel_verification import Verifier
from semloc_logs.numerics.transforms import turned_about_z
from semloc_logs.settings import Resolved
from semloc_logs.words.index import Allowed, Index
from semloc_logs.words.vocabulary import (
    BITS,
    Vocabulary,
    load_vocabulary,
    save_vocabulary,
    train_vocabulary,
)

HEADINGS = 18  # of the paper
STRIDE = 8  # voxels between keypoints
TRAINING_KEYPOINTS = 200_000  # that a vocabulary is trained on, at most


class Described(NamedTuple):
    """``position`` (n, 3) of keypoints, metres of the map, and their ``descriptor`` (n, d)."""

    position: F64
    descriptor: F32


class ShapeDescriptor(Protocol):
    """A descriptor of the surroundings of keypoints."""

    turns: bool  # whether it depends on the heading, so that queries are described in all headings

    def fit(self, training: Training, settings: Resolved) -> None:
        """Learn, where there is anything to learn."""
        ...

    def describe(self, level_map: LevelMap, yaw: float) -> Described:
        """Keypoints of a map, described as the map turned by -``yaw`` about z shows them."""
        ...


class ShapeSystem:
    """Places found by words of a ``descriptor``, and verified on voxels.

    Descriptor and words are learnt from ``training``, not from the database; the words are kept in
    ``folder``.
    """

    def __init__(
        self,
        name: str,
        descriptor: ShapeDescriptor,
        settings: Resolved,
        training: Training,
        folder: Path,
    ) -> None:
        self.name = name
        self._descriptor = descriptor
        self._settings = settings
        self._training = training
        self._folder = folder
        self._index: Index | None = None
        self._positions = np.zeros((0, 3))

    def fit(self, database: Sequence[View]) -> None:
        self._descriptor.fit(self._training, self._settings)
        vocabulary = self._vocabulary()
        level_map = database_map(database, self._settings)
        self._index = None
        if not len(level_map.points):
            return
        described = self._descriptor.describe(level_map, 0.0)
        word, code = vocabulary.words(unit_vectors(described.descriptor))
        self._index = Index.of_words(vocabulary, word, code, np.zeros(len(word), np.int64))
        self._positions = described.position
        kappa = self._settings.closures.kappa * level_map.voxel_size
        self._verifier = Verifier(level_map, kappa)

    def _vocabulary(self) -> Vocabulary:
        """The words of the descriptor: read from the folder, or learnt."""
        key = f"{self._training.key}-{self._settings.fingerprint('fusion')}"

        def make(temporary: Path) -> None:
            trained_on = database_map(self._training.views(), self._settings)
            words = unit_vectors(self._descriptor.describe(trained_on, 0.0).descriptor)
            rng = np.random.default_rng(0)
            some = np.sort(rng.permutation(len(words))[:TRAINING_KEYPOINTS])
            save_vocabulary(temporary, train_vocabulary(words[some]), {"training": key})

        path = self._folder / f"{self.name}-words-{key}.safetensors"
        return load_vocabulary(self.name, kept_file(path, make))

    def localise(self, query: Query) -> list[RankedPose]:
        if self._index is None:
            return []
        level_map, query_T_base = query_map(query, self._settings)
        poses = self._hypotheses(level_map)
        return [
            RankedPose(rated.world_T_query @ query_T_base, rated.tau)
            for rated in self._verifier.ranked(level_map, poses)
        ]

    def _hypotheses(self, level_map: LevelMap) -> F64:
        """Hypotheses (n, 4), (yaw, x, y, z) of world_T_query: one for each match and heading."""
        headings = 2 * np.pi * np.arange(HEADINGS) / HEADINGS
        if not self._descriptor.turns:
            described = self._descriptor.describe(level_map, 0.0)
            query, entry = self._matches(described.descriptor)
            return np.concatenate(
                [self._from_matches(described.position[query], entry, yaw) for yaw in headings]
            )
        parts = []
        for yaw in headings:
            # the map turned by yaw is described; the database is not turned
            described = self._descriptor.describe(level_map, -yaw)
            query, entry = self._matches(described.descriptor)
            parts.append(self._from_matches(described.position[query], entry, yaw))
        return np.concatenate(parts)

    def _matches(self, descriptor: F32) -> tuple[I64, I64]:
        assert self._index is not None
        closures = self._settings.closures
        matches = self._index.search(
            unit_vectors(descriptor),
            closures.neighbours,
            closures.probes,
            Allowed(np.ones(1, bool)),
        )
        return matches.query.astype(np.int64), matches.entry

    def _from_matches(self, position: F64, entry: I64, yaw: float) -> F64:
        turned = turned_about_z(position, np.full(len(position), yaw))
        return np.asarray(np.c_[np.full(len(entry), yaw), self._positions[entry] - turned])


def unit_vectors(descriptor: NDArray[np.floating]) -> F32:
    """Descriptors (n, d) of unit length, with zeros up to the 64 dimensions that codes need."""
    out = np.zeros((len(descriptor), max(BITS, descriptor.shape[1])), np.float32)
    length = np.linalg.norm(descriptor, axis=1, keepdims=True)
    out[:, : descriptor.shape[1]] = descriptor / np.maximum(length, 1e-9)
    return out


def keypoints_of(points: F64, spacing: float) -> I64:
    """Rows of the ``points`` (n, 3) nearest to the middle of each cell of ``spacing`` metres."""
    if not len(points):
        return np.zeros(0, np.int64)
    cell = np.floor(points / spacing)
    off = np.linalg.norm(points - (cell + 0.5) * spacing, axis=1)
    cells = np.unique(cell.astype(np.int64), axis=0, return_inverse=True)[1].reshape(-1)
    order = np.lexsort((off, cells))
    first = np.flatnonzero(np.r_[True, np.diff(cells[order]) > 0])
    return np.asarray(order[first], np.int64)
