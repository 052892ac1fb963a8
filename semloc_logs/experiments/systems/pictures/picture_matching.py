"""Localisation by pictures (section 4.4): retrieval, two-view verification of the top retrievals,
and the pose from 2D-3D matches with each of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F32, F64, U8
from semloc_logs.experiments.system import MOST_POSES, Picture, Query, RankedPose, View
from semloc_logs.experiments.systems.catalogue import SystemOptions
from semloc_logs.experiments.systems.pictures.kept_features import Extract, kept_features
from semloc_logs.experiments.systems.pictures.local_features import Features, unit_descriptors
from semloc_logs.experiments.systems.pictures.picture_pose import (
    base_pose,
    mutual_matches,
    pose_of_points,
    two_view_inliers,
)
from semloc_logs.experiments.systems.pictures.visual_index import VisualIndex
from semloc_logs.words.vocabulary import train_vocabulary

VERIFIED = 30  # top retrievals that are verified
TRAINING_FEATURES = 1_000_000  # that the vocabulary is trained on, at most
LEAST_FEATURES = 256  # that a vocabulary needs


@dataclass(frozen=True, slots=True, eq=False)
class StoredPicture:
    """A picture of the database: the file of its features and points, its ``view`` of the
    ``database``, and where the vehicle was.
    """

    path: Path
    database: Sequence[View]
    view: int
    world_T_base: F64

    def features(self) -> Features:
        """Its features, from the file."""
        return Features(*self._arrays()[:2])

    def points(self) -> F32:
        """The points (n, 3) of its features, base frame, NaN where the depth is unknown."""
        return np.asarray(self._arrays()[2])

    def image(self) -> U8:
        """The picture, loaded again."""
        picture = self.database[self.view].picture
        assert picture is not None
        return picture.image

    def _arrays(self) -> list[NDArray[Any]]:
        with np.load(self.path) as arrays:
            return [arrays[name] for name in arrays.files]


class Retrieval(Protocol):
    """Ranks the pictures of the database by their similarity to a query."""

    def fit(self, pictures: Sequence[StoredPicture]) -> None:
        """Learn the pictures of a database."""
        ...

    def scores(self, image: U8, features: Features) -> F64:
        """Similarity of each picture of the database, greater is better."""
        ...


class WordRetrieval:
    """The inverted lists of visual words."""

    def __init__(self) -> None:
        self._index: VisualIndex | None = None

    def fit(self, pictures: Sequence[StoredPicture]) -> None:
        rng = np.random.default_rng(0)
        share = TRAINING_FEATURES // max(len(pictures), 1)
        parts = []
        for stored in pictures:
            descriptor = stored.features().descriptor
            parts.append(descriptor[rng.permutation(len(descriptor))[:share]])
        training = np.concatenate(parts) if parts else np.zeros((0, 128), np.uint8)
        self._index = None
        if len(training) < LEAST_FEATURES:
            return
        self._index = VisualIndex(train_vocabulary(unit_descriptors(training)))
        for stored in pictures:
            self._index.add(stored.features().vectors())
        self._index.finish()

    def scores(self, image: U8, features: Features) -> F64:
        if self._index is None:
            return np.zeros(0)
        return self._index.scores(features.vectors())


def features_folder(options: SystemOptions) -> Path:
    """The folder of features, which systems share."""
    return options.folder.parent / "features"


class PictureSystem:
    """Features by ``extract``, candidates by ``retrieval``, poses by the points of their depth.

    Features of the database lie in files of ``folder``, also for other databases and systems, so
    that memory does not grow with them.
    """

    def __init__(self, name: str, extract: Extract, retrieval: Retrieval, folder: Path) -> None:
        self.name = name
        self._extract = extract
        self._kept = kept_features(extract, folder)
        self._retrieval = retrieval
        self._stored: list[StoredPicture] = []

    def fit(self, database: Sequence[View]) -> None:
        self._stored = []
        for number in range(len(database)):
            view = database[number]
            if view.picture is None:
                continue
            path = self._kept(view.picture)
            self._stored.append(StoredPicture(path, database, number, view.world_T_base))
        self._retrieval.fit(self._stored)

    def localise(self, query: Query) -> list[RankedPose]:
        picture = query.views[-1].picture
        if picture is None or not self._stored:
            return []
        features = self._extract(picture.image)
        vectors = features.vectors()
        scores = self._retrieval.scores(picture.image, features)
        answers = []
        for number in np.argsort(-scores, kind="stable")[:VERIFIED]:
            pose = self._pose(picture, features, vectors, self._stored[number])
            if pose is not None:
                answers.append(pose)
        return sorted(answers, key=lambda pose: -pose.score)[:MOST_POSES]

    def _pose(
        self, picture: Picture, features: Features, vectors: F32, stored: StoredPicture
    ) -> RankedPose | None:
        """The pose by one picture of the database; its score is the number of inliers."""
        other = stored.features()
        points = stored.points()
        matches = mutual_matches(vectors, other.vectors(), other.xy)
        kept = two_view_inliers(features.xy[matches[:, 0]], other.xy[matches[:, 1]])
        matches = matches[kept]
        matches = matches[np.isfinite(points[matches[:, 1]]).all(1)]
        pose = pose_of_points(features.xy[matches[:, 0]], points[matches[:, 1]], picture.intrinsics)
        if pose is None:
            return None
        return RankedPose(stored.world_T_base @ base_pose(pose, picture), float(pose.inliers))
