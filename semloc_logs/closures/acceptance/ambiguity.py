"""Ambiguous places: where alignments that agree may as well agree in a copy of the place.

Two drives through copies of a street, one block apart, agree in every query, and nothing in them
tells. A third place reveals copies: a session that came through several copies has two places with
support for one query, or the alignments of three sessions contradict each other. Queries without
neighbours, such as single sweeps, are told by the latter alone.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from semloc_logs.alignment.hypotheses import ODOMETRY_DRIFT
from semloc_logs.arrays import F64, I64, Bools
from semloc_logs.closures.acceptance.calibration import position_confidence
from semloc_logs.closures.acceptance.placements import ARM, FAR, Pairs, Placed, contradicts_odometry
from semloc_logs.numerics.transforms import inverse
from semloc_logs.settings import STREET_VOXEL

# m between a place and its copy, at voxels of 0.30 m: nearer ones lie in one view, whose free space
# tells them apart
APART = 20.0
LEAST_SUPPORT = 0.1  # of a second place: less is chance
BEYOND_DOUBT = 0.7  # support of alignments that may contradict others
CHANCE = 0.03  # contradictions of lone queries that are less likely without copies tell of copies


def ambiguity(
    placed: Placed,
    pairs: Pairs,
    roads: Mapping[str, F64],
    support: F64,
    lone: Bools,
    voxel_size: float,
) -> F64:
    """How ambiguous the road around either end of each alignment is (n,), in [0, 1].

    ``support`` (n,) is the probability of an alignment ignoring rivals, times the share of near
    neighbours that agree; ``lone`` (n,) queries have no neighbours, and no support.
    :func:`.placements.query_roads` makes ``roads``.

    It is the mean over the queries about an end of the support of a second place in one session, or
    the share of them that three sessions contradict each other about; the session that shows it
    most counts. Of lone queries it is 1 in a session that copies alone explain.
    """
    known = placed.probability_ignoring_rivals * position_confidence(placed.sigma, voxel_size)
    triples = _contradictions(placed, pairs, np.where(lone, known, support), voxel_size)
    with_lone = lone[triples].any(axis=1)
    reach = FAR * voxel_size / STREET_VOXEL
    # by session: roads of all queries that can show it; where some do, and how much
    shown: dict[str, list[tuple[F64, F64, F64]]] = {}
    for (query, target), rows in pairs.items():
        first, second, weights = _second_places(placed, rows, support, voxel_size)
        shown.setdefault(query, []).append((roads[query], placed.road[first], weights))
        if target != query:  # the target shows it too, at both places
            both = np.concatenate([first, second[weights > 0]])
            shown.setdefault(target, []).append(
                (
                    placed.target_road[first],
                    placed.target_road[both],
                    np.r_[weights, weights[weights > 0]],
                )
            )
    contradicted = triples[~with_lone, 0]
    for session in sorted(set(placed.query_session[contradicted])):
        of_session = contradicted[placed.query_session[contradicted] == session]
        road = np.unique(placed.road[of_session])
        shown.setdefault(session, []).append((roads[session], road, np.ones(len(road))))
    out = np.where(lone & _among_copies(placed, known, triples[with_lone]), 1.0, 0.0)
    for sessions, end_roads in (
        (placed.query_session, placed.road),
        (placed.target_session, placed.target_road),
    ):
        for session in sorted(set(sessions)):
            of_session = np.flatnonzero(sessions == session)
            of_all = _weight_about(roads.get(session, np.zeros(0)), end_roads[of_session], reach)
            for everyone, places, weights in shown.get(session, []):
                share = _weight_about(places, end_roads[of_session], reach, weights) / np.maximum(
                    np.maximum(of_all, _weight_about(everyone, end_roads[of_session], reach)), 1.0
                )
                out[of_session] = np.maximum(out[of_session], np.minimum(share, 1.0))
    return out


def _weight_about(places: F64, road: F64, reach: float, weights: F64 | None = None) -> F64:
    """How many of ``places`` (m,), metres of road, lie within ``reach`` of each ``road`` (n,).

    With ``weights`` (m,) the sums of these.
    """
    order = np.argsort(places, kind="stable")
    sums = np.r_[0.0, np.cumsum(np.ones(len(places)) if weights is None else weights[order])]
    places = places[order]
    return np.asarray(
        sums[np.searchsorted(places, road + reach, "right")]
        - sums[np.searchsorted(places, road - reach, "left")]
    )


def _second_places(
    placed: Placed, rows: I64, support: F64, voxel_size: float
) -> tuple[I64, I64, F64]:
    """Of each query in one target the rows of two places, a view apart, and the second's support.

    The second has as much support as possible. Where a session queries itself, the first place is
    where it is by odometry, so any other one is a second place.
    """
    apart = APART * voxel_size / STREET_VOXEL
    contradicting = contradicts_odometry(placed.part(rows), voxel_size)
    cuts = np.flatnonzero(np.diff(placed.query[rows])) + 1
    chosen = []
    for places, wrong in zip(np.split(rows, cuts), np.split(contradicting, cuts), strict=True):
        position = placed.target_T_query[places, :3, 3]
        road = placed.target_road[places]
        own_support = support[places]
        distance = np.linalg.norm(position[:, None] - position, axis=2)
        held = np.where(own_support >= LEAST_SUPPORT, own_support, 0.0)
        is_second = distance > apart + ODOMETRY_DRIFT * np.abs(road[:, None] - road)
        lesser = np.where(is_second, np.minimum(held[:, None], held), 0.0)
        a, b = np.unravel_index(int(np.argmax(lesser)), lesser.shape)
        best = int(np.argmax(own_support))
        weight = max(float(lesser[a, b]), float(held[wrong].max(initial=0.0)))
        chosen.append(
            (places[a], places[b], weight)
            if lesser[a, b] > 0
            else (places[best], places[best], weight)
        )
    first, second, most = zip(*chosen, strict=True)
    return np.array(first), np.array(second), np.array(most)


def _contradictions(placed: Placed, pairs: Pairs, support: F64, voxel_size: float) -> I64:
    """Rows (m, 3) of alignments of three sessions that contradict each other.

    Of three sessions a, g, h those alignments are compared that hardly anybody doubts: a query of a
    in g, the nearest one of a in h, and the nearest one of g in h; odometry leads from one to the
    next.
    """
    scale = voxel_size / STREET_VOXEL
    sure: Pairs = {}
    for (query, target), rows in pairs.items():
        rows = rows[np.lexsort((-support[rows], placed.query[rows]))]
        rows = rows[np.r_[True, np.diff(placed.query[rows]) != 0]]  # the best of each query
        rows = rows[support[rows] >= BEYOND_DOUBT]
        if query != target and len(rows):
            sure[query, target] = rows[np.argsort(placed.road[rows], kind="stable")]
    targets: dict[str, list[str]] = {}
    for query, target in sure:
        targets.setdefault(query, []).append(target)
    triplets = [np.zeros((0, 3), np.int64)]
    for (a, g), x in sure.items():
        for h in targets[a]:
            if h == g or (g, h) not in sure:
                continue
            y = sure[a, h][_nearest(placed.road[sure[a, h]], placed.road[x])]
            z = sure[g, h][_nearest(placed.road[sure[g, h]], placed.target_road[x])]
            along = (
                np.abs(placed.road[y] - placed.road[x]),
                np.abs(placed.road[z] - placed.target_road[x]),
            )
            g_T_y = (
                placed.target_T_query[x] @ inverse(placed.map_T_query[x]) @ placed.map_T_query[y]
            )
            h_T_y = placed.target_T_query[z] @ inverse(placed.map_T_query[z]) @ g_T_y
            distance = np.linalg.norm(h_T_y[:, :3, 3] - placed.target_T_query[y, :3, 3], axis=1)
            way = along[0] + along[1] + np.abs(placed.target_road[z] - placed.target_road[y])
            wrong = (distance > APART * scale + (ODOMETRY_DRIFT + ARM) * way) & (
                np.maximum(*along) <= FAR * scale
            )
            triplets.append(np.stack([x, y, z], axis=1)[wrong])
    return np.concatenate(triplets)


def _among_copies(placed: Placed, known: F64, triples: I64) -> Bools:
    """Alignments (n,) of sessions whose contradictions chance does not explain.

    One wrong alignment may contradict many right ones; so of each of the ``triples`` (m, 3) the
    least probable alignment is held for wrong, each once, by chance. ``known`` (n,) are the
    probabilities that an alignment is right, and its position within the bound.
    """
    weakest = triples[np.arange(len(triples)), np.argmin(known[triples], axis=1)]
    wrong: dict[str, set[int]] = {}
    for rows, row in zip(triples, weakest.tolist(), strict=True):
        for session in {*placed.query_session[rows], *placed.target_session[rows]}:
            wrong.setdefault(session, set()).add(row)
    copies = [s for s, rows in wrong.items() if np.prod(1 - known[sorted(rows)]) < CHANCE]
    return np.isin(placed.query_session, copies) | np.isin(placed.target_session, copies)


def _nearest(values: F64, wanted: F64) -> I64:
    """Numbers (n,) of the ascending ``values`` nearest to the ``wanted`` ones (n,).

    Of equally near ones it is the first.
    """
    return np.searchsorted((values[1:] + values[:-1]) / 2, wanted)
