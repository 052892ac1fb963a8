"""Does the descriptor earn its place? Recall of word matches between two maps whose true alignment
is known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semloc_logs.benchmarks.descriptors.places import Place, Street, asked_place, map_place
from semloc_logs.closures.query import build_query, query_keyframes, query_members
from semloc_logs.evaluation.truth import TrueTrack
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import apply, inverse
from semloc_logs.settings import Resolved
from semloc_logs.subvolumes.describe import describe_map
from semloc_logs.subvolumes.network import Encoder
from semloc_logs.subvolumes.submap_descriptors import describe_submap
from semloc_logs.voxels.store import blocks_path, read_blocks
from semloc_logs.words.index import Allowed, Index
from semloc_logs.words.vocabulary import Vocabulary, train_vocabulary

F64 = NDArray[np.float64]
NEAR = 10.0  # m from the target's road
FAR = 1e6


@dataclass(frozen=True, slots=True)
class WordRecall:
    """Share of query words with a true place among their 5 nearest database words: by descriptor
    (``exact``) and by vocabulary and code (``coded``); of ``words`` query words that have a
    database word within ``radius`` metres of their true place.
    """

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
    settings: Resolved,
    encoder: Encoder,
    vocabulary: Vocabulary | None,
    radius: float = 1.5,
    k: int = 5,
) -> WordRecall:
    """Recall at ``k`` of the words of the query at ``keyframe``, in the search's heading nearest to
    the true one.

    Without a ``vocabulary`` one is trained on the database's own descriptors.
    """
    v = settings.fusion.voxel_size
    parts = [
        d
        for s in target.submaps
        for d in describe_submap(
            target.folder, s["id"], s["ground_z"], target.road(s), encoder, settings
        )
    ]
    centre = np.concatenate([p.centre for p in parts]) * v
    descriptor = np.concatenate([p.descriptor for p in parts])
    place = query_place(query, keyframe, targetmap_T_querymap, settings)
    d = settings.descriptor
    asked = describe_map(
        place.state, place.low, place.ground_z, v, encoder, d.query_stride, d.min_occupied
    )
    true = apply(place.common_T_map, asked.centre.astype(np.float64) * v)
    distance = np.linalg.norm(true[:, None, :] - centre[None], axis=2)
    possible = distance.min(1) < radius
    if not possible.any():
        return WordRecall(0.0, 0.0, 0, len(centre), radius)
    similarity = asked.descriptor @ descriptor.T
    nearest = np.argsort(-similarity, axis=1, kind="stable")[:, :k]
    exact = np.asarray((np.take_along_axis(distance, nearest, 1) < radius).any(1))
    words = vocabulary or train_vocabulary(descriptor)
    index = Index.of_words(words, *words.words(descriptor), np.zeros(len(centre), np.int64))
    matches = index.search(asked.descriptor, k, settings.closures.probes, Allowed(np.ones(1, bool)))
    coded = np.zeros(len(true), bool)
    np.logical_or.at(coded, matches.query, distance[matches.query, matches.entry] < radius)
    return WordRecall(
        float(exact[possible].mean()),
        float(coded[possible].mean()),
        int(possible.sum()),
        len(centre),
        radius,
    )


def query_place(
    query: SessionMap, keyframe: int, targetmap_T_querymap: F64, settings: Resolved
) -> Place:
    """The query at ``keyframe``, turned to the nearest heading of the search, and its place in the
    target's map frame.
    """
    asked = build_query(query, keyframe, settings)[0].blocks
    querymap_T_query = np.eye(4)
    querymap_T_query[:3, 3] = query.map_T_base[keyframe][:3, 3]
    ground = float(query.ground_z[keyframe] - query.map_T_base[keyframe][2, 3])
    members = query_members(query, keyframe, settings)
    track = np.stack(
        [
            apply(inverse(querymap_T_query) @ query.map_T_base[i], query.origins[i][None])[0]
            for i in members
        ]
    )
    return asked_place(asked, track, ground, targetmap_T_querymap @ querymap_T_query, settings)


def true_queries(
    query: SessionMap, target: SessionMap, tracks: Mapping[str, TrueTrack], settings: Resolved
) -> list[tuple[int, F64]]:
    """Keyframes of ``query`` that ask within 10 m of the target's road, each with the true
    ``targetmap_T_querymap`` (4, 4) there.

    Maps drift: the transform is that of the target's keyframe that is nearest.
    """
    common = [tracks[m.folder.name].at(m.stamps_ns)[0] for m in (query, target)]
    out = []
    for k in query_keyframes(query, settings):
        here = common[0][k]
        away = np.linalg.norm(common[1][:, :3, 3] - here[:3, 3], axis=1)
        near = int(np.argmin(away))
        if away[near] < NEAR:
            targetmap_T_common = target.map_T_base[near] @ inverse(common[1][near])
            out.append((k, targetmap_T_common @ here @ inverse(query.map_T_base[k])))
    return out


def real_street(
    query: SessionMap,
    target: SessionMap,
    tracks: Mapping[str, TrueTrack],
    name: str,
    settings: Resolved,
) -> Street:
    """The submaps of ``target`` as a database and the queries of ``query``, both called ``name``;
    far away from every simulated street.
    """
    common_T_map = np.eye(4)
    common_T_map[1, 3] = -FAR
    database = []
    for submap in target.submaps:
        blocks = read_blocks(blocks_path(target.folder.blocks, submap["id"]), states_only=True)
        frames = range(submap["first"], submap["last"] + 1)
        track = np.stack([apply(target.map_T_base[i], target.origins[i][None])[0] for i in frames])
        database.append((name, map_place(blocks, track, submap["ground_z"], common_T_map)))
    places = [
        query_place(query, k, common_T_map @ T, settings)
        for k, T in true_queries(query, target, tracks, settings)
    ]
    return Street(database, {name: places})
