"""Does the descriptor earn its place? Recall of word matches between two maps whose true alignment is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semloc_logs.closures.queries import SessionMap, build_query
from semloc_logs.geometry import inverse, yaw_transform
from semloc_logs.settings import Settings
from semloc_logs.subvolumes.cut import turn
from semloc_logs.subvolumes.describe import Described, describe_map
from semloc_logs.subvolumes.describing import describe_submap
from semloc_logs.subvolumes.network import Encoder
from semloc_logs.words.index import Index
from semloc_logs.words.vocabulary import Vocabulary, train_vocabulary

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class WordRecall:
    """Share of query words with a true place among their 5 nearest database words: by descriptor (``exact``) and by vocabulary and
    code (``coded``); of ``words`` query words that have a database word within ``radius`` metres of their true place."""

    exact: float
    coded: float
    words: int
    database: int
    radius: float


def word_recall(
    query: SessionMap,
    keyframe: int,
    target: SessionMap,
    targetmap_T_querymap: F64,
    settings: Settings,
    encoder: Encoder,
    vocabulary: Vocabulary | None,
    radius: float = 1.5,
    k: int = 5,
) -> WordRecall:
    """Recall at ``k`` of the words of the query at ``keyframe``, in the search's heading nearest to the true one.

    Without a ``vocabulary`` one is trained on the database's own descriptors.
    """
    v = settings.fusion.voxel_size
    parts = [describe_submap(target.folder, s["id"], s["ground_z"], target.road(s), encoder, settings) for s in target.submaps]
    centre = np.concatenate([p.centre for p in parts]) * v
    descriptor = np.concatenate([p.descriptor for p in parts])
    asked, target_T_asked = _query_words(query, keyframe, targetmap_T_querymap, settings, encoder)
    true = asked.centre * v @ target_T_asked[:3, :3].T + target_T_asked[:3, 3]
    distance = np.linalg.norm(true[:, None, :] - centre[None], axis=2)
    possible = distance.min(1) < radius
    if not possible.any():
        return WordRecall(0.0, 0.0, 0, len(centre), radius)
    similarity = asked.descriptor @ descriptor.T
    nearest = np.argsort(-similarity, axis=1, kind="stable")[:, :k]
    exact = np.asarray((np.take_along_axis(distance, nearest, 1) < radius).any(1))
    words = vocabulary or train_vocabulary(descriptor)
    index = Index(words, *words.words(descriptor), np.zeros(len(centre), np.int64))
    matches = index.search(asked.descriptor, k, settings.closures.probes, np.ones(1, bool))
    coded = np.zeros(len(true), bool)
    np.logical_or.at(coded, matches.query, distance[matches.query, matches.entry] < radius)
    return WordRecall(float(exact[possible].mean()), float(coded[possible].mean()), int(possible.sum()), len(centre), radius)


def _query_words(
    query: SessionMap, keyframe: int, targetmap_T_querymap: F64, settings: Settings, encoder: Encoder
) -> tuple[Described, F64]:
    """Words of the query turned to the nearest heading of the search, and the transform of their frame into the target's map frame."""
    v = settings.fusion.voxel_size
    asked, _ = build_query(query, keyframe, settings)
    querymap_T_query = np.eye(4)
    querymap_T_query[:3, 3] = query.map_T_base[keyframe][:3, 3]
    target_T_query = targetmap_T_querymap @ querymap_T_query
    step = 2 * np.pi / settings.closures.headings
    yaw = step * round(float(np.arctan2(target_T_query[1, 0], target_T_query[0, 0])) / step)
    low, high = asked.blocks.bounds()
    half = -(-int((settings.query.radius or 24.0) / v + 16) // 8) * 8
    box = np.empty((2 * half, 2 * half, int(high[2] - low[2])), np.uint8)
    state = asked.blocks.dense(low, tuple((high - low).tolist()))
    turn(state, low.astype(np.int64), -yaw, np.array([0.0, 0.0, (low[2] + high[2]) / 2]), box)
    ground = float(query.ground_z[keyframe] - query.map_T_base[keyframe][2, 3])
    d = settings.descriptor
    described = describe_map(box, np.array([-half, -half, low[2]]), ground, v, encoder, d.query_stride, d.min_occupied)
    return described, target_T_query @ inverse(yaw_transform(yaw))
