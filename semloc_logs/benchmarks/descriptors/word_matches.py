"""Recall of word matches between two maps whose true alignment is known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.benchmarks.descriptors.places import Place, Street, map_place, turned_place
from semloc_logs.closures.query import build_query, query_keyframes, query_members
from semloc_logs.evaluation.truth import TrueTrack
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import apply, inverse
from semloc_logs.settings import Resolved
from semloc_logs.subvolumes.describe import Windows, describe_map
from semloc_logs.subvolumes.network import Encoder
from semloc_logs.subvolumes.submap_descriptors import describe_submap
from semloc_logs.voxels.store import blocks_path, read_blocks
from semloc_logs.words.index import Allowed, Index
from semloc_logs.words.vocabulary import Vocabulary, train_vocabulary

NEAR = 10.0  # m from the target's road
FAR = 1e6  # m from every simulated street
RADIUS = 1.5  # m between a query word's true place and a database word that counts
NEAREST = 5  # database words of a query word that count


@dataclass(frozen=True, slots=True)
class WordRecall:
    """Share of query words with a true place among their 5 nearest database words.

    ``exact`` by descriptor, ``coded`` by vocabulary and code; of ``words`` query words that have
    one of ``database`` words within 1.5 m of their true place.
    """

    exact: float
    coded: float
    words: int
    database: int


@dataclass(frozen=True, slots=True, eq=False)
class TrueQuery:
    """The query at ``keyframe`` of a session and its true place in the target's map, (4, 4)."""

    query: SessionMap
    keyframe: int
    target: SessionMap
    targetmap_T_querymap: F64


def word_recall(
    true: TrueQuery, settings: Resolved, encoder: Encoder, vocabulary: Vocabulary | None
) -> WordRecall:
    """Recall of the words of a query, in the search's heading nearest to the true one.

    Without a ``vocabulary`` one is trained on the database's own descriptors.
    """
    v = settings.fusion.voxel_size
    centre, descriptor = _database_words(true.target, settings, encoder)
    place = query_place(true.query, true.keyframe, true.targetmap_T_querymap, settings)
    d = settings.descriptor
    words = describe_map(
        place.state, place.low, place.ground_z, encoder, Windows(v, d.query_stride, d.min_occupied)
    )
    true_centre = apply(place.common_T_map, words.centre.astype(np.float64) * v)
    distance = np.linalg.norm(true_centre[:, None, :] - centre[None], axis=2)
    possible = distance.min(1) < RADIUS
    if not possible.any():
        return WordRecall(0.0, 0.0, 0, len(centre))

    similarity = words.descriptor @ descriptor.T
    nearest = np.argsort(-similarity, axis=1, kind="stable")[:, :NEAREST]
    exact = np.asarray((np.take_along_axis(distance, nearest, 1) < RADIUS).any(1))

    vocabulary = vocabulary or train_vocabulary(descriptor)
    index = Index.of_words(
        vocabulary, *vocabulary.words(descriptor), np.zeros(len(centre), np.int64)
    )
    matches = index.search(
        words.descriptor, NEAREST, settings.closures.probes, Allowed(np.ones(1, bool))
    )
    coded = np.zeros(len(true_centre), bool)
    np.logical_or.at(coded, matches.query, distance[matches.query, matches.entry] < RADIUS)
    return WordRecall(
        float(exact[possible].mean()),
        float(coded[possible].mean()),
        int(possible.sum()),
        len(centre),
    )


def _database_words(
    target: SessionMap, settings: Resolved, encoder: Encoder
) -> tuple[F64, NDArray[np.float32]]:
    """Centres (n, 3) in metres and descriptors (n, d) of all submaps."""
    parts = [
        words
        for s in target.submaps
        for words in describe_submap(
            blocks_path(target.folder.blocks, s["id"]),
            s["ground_z"],
            target.road(s),
            encoder,
            settings,
        )
    ]
    centre = np.concatenate([part.centre for part in parts]) * settings.fusion.voxel_size
    return centre, np.concatenate([part.descriptor for part in parts])


def query_place(
    query: SessionMap, keyframe: int, targetmap_T_querymap: F64, settings: Resolved
) -> Place:
    """The query at ``keyframe`` in the target's map, turned to the search's nearest heading."""
    blocks = build_query(query, keyframe, settings)[0].blocks
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
    return turned_place(blocks, track, ground, targetmap_T_querymap @ querymap_T_query, settings)


def true_queries(
    query: SessionMap, target: SessionMap, tracks: Mapping[str, TrueTrack], settings: Resolved
) -> list[TrueQuery]:
    """The queries within 10 m of the target's road.

    Maps drift: their place is relative to the target's nearest keyframe.
    """
    common_T_query, common_T_target = (
        tracks[m.folder.name].at(m.stamps_ns)[0] for m in (query, target)
    )
    queries = []
    for k in query_keyframes(query, settings):
        common_T_base = common_T_query[k]
        away = np.linalg.norm(common_T_target[:, :3, 3] - common_T_base[:3, 3], axis=1)
        nearest = int(np.argmin(away))
        if away[nearest] < NEAR:
            targetmap_T_common = target.map_T_base[nearest] @ inverse(common_T_target[nearest])
            targetmap_T_querymap = targetmap_T_common @ common_T_base @ inverse(query.map_T_base[k])
            queries.append(TrueQuery(query, k, target, targetmap_T_querymap))
    return queries


def real_street(
    query: SessionMap,
    target: SessionMap,
    tracks: Mapping[str, TrueTrack],
    name: str,
    settings: Resolved,
) -> Street:
    """The submaps of ``target`` as a database and the queries of ``query``, both called ``name``.

    Their common frame is far away from every simulated street.
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
        query_place(query, true.keyframe, common_T_map @ true.targetmap_T_querymap, settings)
        for true in true_queries(query, target, tracks, settings)
    ]
    return Street(database, {name: places})
