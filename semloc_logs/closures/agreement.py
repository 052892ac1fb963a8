"""Neighbouring queries of a session against each other: together they lie where odometry and one transform of the sessions put them.

Two alignments of a session with the same target agree when the first one and the odometry between the two queries predict the
second one, to within their standard deviations and what odometry may drift (pairwise consistency as in Mangelson et al., PCM, ICRA
2018, section III, over a stretch of road instead of all pairs).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from semloc_logs.closures.acceptance import AGREEMENT, Agreement, may_be_right, precise, reason, shipped
from semloc_logs.closures.closing import Alignment
from semloc_logs.closures.lookalike import lookalike
from semloc_logs.closures.placing import ARM, DRIFT, FAR, Placed, asked_roads, features_of, pairs_of, place, strays
from semloc_logs.closures.queries import SessionMap
from semloc_logs.geometry import inverse
from semloc_logs.settings import STREET_VOXEL, Settings

F64 = NDArray[np.float64]
Bools = NDArray[np.bool_]

NEAR = 25.0  # m of road from a query to its neighbours, at voxels of 0.30 m
SLACK, MOST_SLACK = 1.7, 3.3  # voxels between two alignments of one place, without and with their standard deviations
TURN, TURN_DRIFT = np.radians(4.0), np.radians(0.02)  # rad, and rad a metre
LEAST = 0.02  # alignments less probable than this say nothing about others


def agree(placed: Placed, voxel_size: float) -> list[F64]:
    """The columns (7, n) of ``AGREEMENT``; whatever the order of the alignments."""
    out = [placed.alone.copy(), *(np.zeros(len(placed)) for _ in AGREEMENT[1:])]
    support = np.zeros(len(placed))
    pairs = pairs_of(placed)
    asked = asked_roads(placed)
    for (query, _), rows in pairs.items():
        group, road = placed.part(rows), asked[query]
        near = NEAR * voxel_size / STREET_VOXEL
        out[1][rows] = np.searchsorted(road, group.road + near, "right") - np.searchsorted(road, group.road - near, "left") - 1.0
        (out[2][rows], out[3][rows], out[4][rows], out[5][rows]), alike = _sums(group, (group.alone, group.unrivalled), voxel_size)
        support[rows] = group.unrivalled * alike[0] / np.maximum(out[1][rows], 1)
    out[6] = lookalike(placed, pairs, asked, support, voxel_size)
    return out


def _sums(group: Placed, probabilities: Sequence[F64], voxel_size: float) -> list[F64]:
    """For each of the ``probabilities`` (n,) those of other queries' alignments that agree with each and that do not, near it and far
    from it (4, n).

    Of each query the most probable alignment of either kind counts, and as opposing only if it is more probable than an agreeing one.
    """
    scale = voxel_size / STREET_VOXEL
    loud = np.max(probabilities, axis=0) >= LEAST
    voices, said = group.part(loud), [np.where(p >= LEAST, p, 0.0)[loud] for p in probabilities]
    out = [np.zeros((4, len(group))) for _ in probabilities]
    for k in range(len(group)):
        along = np.abs(voices.road - group.road[k])
        there = np.flatnonzero((along <= FAR * scale) & (voices.query != group.query[k]))
        if not len(there):
            continue
        heard, along = voices.part(there), along[there]
        agrees = _agrees(group.part(np.array([k])), heard, along, voxel_size)
        _, first, number = np.unique(heard.query, return_index=True, return_inverse=True)
        near = along[first] <= NEAR * scale
        for sums, p in zip(out, said, strict=True):
            for_it, against = np.zeros(len(first)), np.zeros(len(first))
            np.maximum.at(for_it, number, np.where(agrees, p[there], 0.0))
            np.maximum.at(against, number, np.where(agrees, 0.0, p[there]))
            against[against <= for_it] = 0.0
            sums[:, k] = [for_it[near].sum(), against[near].sum(), for_it[~near].sum(), against[~near].sum()]
    return out


def _agrees(one: Placed, others: Placed, along: F64, voxel_size: float) -> Bools:
    """Whether ``one`` and the odometry predict ``others`` (m), which lie ``along`` metres of road away."""
    predicted = one.target_T_query[0] @ inverse(one.map_T_query[0]) @ others.map_T_query
    off = np.linalg.norm(predicted[:, :3, 3] - others.target_T_query[:, :3, 3], axis=1)
    trace = np.einsum("nij,nij->n", predicted[:, :3, :3], others.target_T_query[:, :3, :3])
    turn = np.arccos(np.clip((trace - 1) / 2, -1, 1))
    sigma = np.hypot(one.sigma[0], others.sigma)
    allowed = np.minimum(SLACK * voxel_size + 2 * sigma, MOST_SLACK * voxel_size)
    drift = DRIFT * (along + np.abs(others.target_road - one.target_road[0])) + ARM * along
    return np.asarray((off <= allowed + drift) & (turn <= TURN + TURN_DRIFT * along * STREET_VOXEL / voxel_size))


def decide(alignments: Sequence[Alignment], maps: Mapping[str, SessionMap], settings: Settings) -> list[Alignment]:
    """The alignments of all queries, best first for each query: at most one accepted for each target session, the others with a reason."""
    v, least = settings.fusion.voxel_size, settings.closures.min_probability
    placed = place(alignments, maps)
    columns = agree(placed, v)
    astray = strays(placed, v)
    fitted = may_be_right(features_of(alignments))
    precision = precise(placed.sigma, v)
    probability = np.where(astray | ~fitted, 0.0, shipped().decided(columns) * precision)
    order = sorted(range(len(alignments)), key=lambda k: _rank(alignments[k], float(probability[k])))
    answered: set[tuple[str, int, str]] = set()
    out = []
    for k in order:
        a = alignments[k]
        alone, neighbours, *rest = (float(c[k]) for c in columns)
        agreement = Agreement(alone, int(neighbours), *rest)
        asked = (a.query_session, a.query_keyframe, a.target_session)
        p = float(probability[k])
        if astray[k]:
            why = f"probability {p:.3f} below {least:g}: the session's own odometry puts it elsewhere"
        elif not p >= least:  # nor what is no number
            why = reason(a.features, p, least, agreement, a.sigma, float(precision[k]))
        else:
            why = "another place of the same session fits better" if asked in answered else ""
        answered.add(asked)
        out.append(replace(a, probability=p, agreement=agreement, reason=why))
    return out


def _rank(a: Alignment, probability: float) -> tuple[str, int, float, float, str, int]:
    """Order of the alignments: by query, then the most probable first."""
    return a.query_session, a.query_stamp_ns, -probability, -a.features.structure, a.target_session, a.target_stamp_ns
