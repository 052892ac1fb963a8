"""Neighbouring queries of a session against each other: together they lie where odometry and one
transform of the sessions put them.

Two alignments of a session with the same target agree when the first one and the odometry between
the two queries predict the second one, to within their standard deviations and what odometry may
drift (pairwise consistency as in Mangelson et al., PCM, ICRA 2018, section III, over a stretch of
road instead of all pairs).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.closures.acceptance.ambiguity import lookalike
from semloc_logs.closures.acceptance.calibration import (
    AGREEMENT,
    may_be_right,
    precise,
    reason,
    shipped,
)
from semloc_logs.closures.acceptance.placements import (
    ARM,
    DRIFT,
    FAR,
    Placed,
    asked_roads,
    features_of,
    pairs_of,
    place,
    strays,
)
from semloc_logs.closures.closure import Agreement, Alignment
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import inverse
from semloc_logs.settings import STREET_VOXEL, Resolved

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

NEAR = 25.0  # m of road from a query to its neighbours, at voxels of 0.30 m
# voxels between two alignments of one place, without and with their standard deviations
SLACK, MOST_SLACK = 1.7, 3.3
# rad, and rad a metre
TURN = np.radians(4.0)
TURN_DRIFT = np.radians(0.02)
LEAST = 0.02  # alignments less probable than this say nothing about others


def agree(placed: Placed, voxel_size: float) -> list[F64]:
    """The columns (7, n) of ``AGREEMENT``; whatever the order of the alignments."""
    out = [placed.alone.copy(), *(np.zeros(len(placed)) for _ in AGREEMENT[1:])]
    support = np.zeros(len(placed))
    pairs = pairs_of(placed)
    asked = asked_roads(placed)
    for (query, _), rows in pairs.items():
        group = placed.part(rows)
        road = asked[query]
        near = NEAR * voxel_size / STREET_VOXEL
        out[1][rows] = (
            np.searchsorted(road, group.road + near, "right")
            - np.searchsorted(road, group.road - near, "left")
            - 1.0
        )
        (out[2][rows], out[3][rows], out[4][rows], out[5][rows]), alike = _sums(
            group, (group.alone, group.unrivalled), voxel_size
        )
        support[rows] = group.unrivalled * alike[0] / np.maximum(out[1][rows], 1)
    out[6] = lookalike(placed, pairs, asked, support, voxel_size)
    return out


def _sums(group: Placed, probabilities: Sequence[F64], voxel_size: float) -> list[F64]:
    """For each of the ``probabilities`` (n,) those of other queries' alignments that agree with
    each and that do not, near it and far from it (4, n); the ``group`` is ordered by query, and so
    by road.

    Of each query the most probable alignment of either kind counts, and as opposing only if it is
    more probable than an agreeing one.
    """
    scale = voxel_size / STREET_VOXEL
    p = np.where(np.array(probabilities) >= LEAST, np.array(probabilities), 0.0)
    loud = np.flatnonzero(p.max(axis=0) >= LEAST)
    v = group.part(loud)
    first = np.searchsorted(v.road, group.road - FAR * scale, "left")
    end = np.searchsorted(v.road, group.road + FAR * scale, "right")
    out = np.zeros((len(p), 4, len(group)))
    target_T_map = group.target_T_query @ inverse(group.map_T_query)  # as each alignment has it
    voices = (
        v.query,
        v.road,
        v.target_road,
        v.map_T_query,
        v.target_T_query,
        v.sigma,
        np.ascontiguousarray(p[:, loud]),
    )
    _add_voices(
        out,
        (group.query, group.road, group.target_road, target_T_map, group.sigma),
        voices,
        first,
        end,
        voxel_size,
        scale,
    )
    return list(out)


@njit(cache=True, nogil=True)
def _add_voices(
    out: F64,
    group: tuple[I64, F64, F64, F64, F64],
    voices: tuple[I64, F64, F64, F64, F64, F64, F64],
    first: I64,
    end: I64,
    voxel_size: float,
    scale: float,
) -> None:
    """Add to ``out`` (probabilities, 4, n) the voices ``first`` to ``end`` of each alignment's
    stretch of road.
    """
    query, road, target_road, target_T_map, sigma = group
    by, at, target_at, map_T_query, target_T_query, doubt, said = voices
    for_it = np.zeros(len(said))
    against = np.zeros(len(said))
    for k in range(len(query)):
        for n in range(first[k], end[k]):
            if by[n] != query[k]:
                along = abs(at[n] - road[k])
                drift = DRIFT * (along + abs(target_at[n] - target_road[k])) + ARM * along
                slack = min(
                    SLACK * voxel_size + 2 * np.hypot(sigma[k], doubt[n]), MOST_SLACK * voxel_size
                )
                agrees = _agrees(
                    target_T_map[k],
                    map_T_query[n],
                    target_T_query[n],
                    slack + drift,
                    TURN + TURN_DRIFT * along / scale,
                )
                for i in range(len(said)):
                    if agrees:
                        for_it[i] = max(for_it[i], said[i, n])
                    else:
                        against[i] = max(against[i], said[i, n])
            if n + 1 == end[k] or by[n + 1] != by[n]:  # the last voice of a query
                far = 2 if abs(at[n] - road[k]) > NEAR * scale else 0
                for i in range(len(said)):
                    out[i, far, k] += for_it[i]
                    out[i, far + 1, k] += against[i] if against[i] > for_it[i] else 0.0
                    for_it[i] = against[i] = 0.0


@njit(cache=True, nogil=True)
def _agrees(
    target_T_map: F64, map_T_query: F64, target_T_query: F64, most: float, turn: float
) -> bool:
    """Whether the query lies where ``target_T_map`` and its odometry put it, to within ``most``
    metres and ``turn`` radians.
    """
    off, trace = 0.0, 0.0
    for i in range(3):
        p = target_T_map[i, 3] - target_T_query[i, 3]
        for m in range(3):
            p += target_T_map[i, m] * map_T_query[m, 3]
            r = 0.0
            for j in range(3):
                r += target_T_map[i, j] * map_T_query[j, m]
            trace += r * target_T_query[i, m]
        off += p * p
    return bool(off <= most * most and np.arccos(min(max((trace - 1) / 2, -1.0), 1.0)) <= turn)


def shares(placed: Placed, voxel_size: float) -> F64:
    """Share (n,) of each alignment in the odds that the poses of its query beside it have alone,
    its own included: one of them is right.

    Neighbours tell which place is right, not which of two poses that they agree with as well: a
    metre along the road, where each camera saw the other sides of things. That only the alignments
    themselves tell.
    """
    alone = np.clip(placed.alone, 0.0, 1 - 1e-6)
    odds = alone / (1 - alone)
    out = np.ones(len(placed))
    for rows in pairs_of(placed).values():
        group = placed.part(rows)
        out[rows] = _shares(
            group.query, group.target_T_query, odds[rows], 2 * MOST_SLACK * voxel_size, 2 * TURN
        )
    return out


@njit(cache=True, nogil=True)
def _shares(query: I64, target_T_query: F64, odds: F64, most: float, turn: float) -> F64:
    """Of alignments ordered by ``query`` (n,); beside each other are those within ``most`` metres
    and ``turn`` radians about z.
    """
    out = np.ones(len(query))
    first = 0
    for k in range(len(query)):
        first = first if query[first] == query[k] else k
        n = first
        total = 0.0
        T = target_T_query[k]
        while n < len(query) and query[n] == query[k]:
            U = target_T_query[n]
            off = np.sqrt(
                (T[0, 3] - U[0, 3]) ** 2 + (T[1, 3] - U[1, 3]) ** 2 + (T[2, 3] - U[2, 3]) ** 2
            )
            turned = np.arctan2(
                T[0, 0] * U[1, 0] - T[1, 0] * U[0, 0], T[0, 0] * U[0, 0] + T[1, 0] * U[1, 0]
            )
            if off <= most and abs(turned) <= turn:
                total += odds[n]
            n += 1
        out[k] = odds[k] / total if total > 0 else 1.0
    return out


def decide(
    alignments: Sequence[Alignment], maps: Mapping[str, SessionMap], settings: Resolved
) -> list[Alignment]:
    """The alignments of all queries, best first for each query: at most one accepted for each
    target session, the others with a reason.
    """
    v = settings.fusion.voxel_size
    least = settings.closures.min_probability
    placed = place(alignments, maps)
    columns = agree(placed, v)
    astray = strays(placed, v)
    fitted = may_be_right(features_of(alignments))
    precision = precise(placed.sigma, v)
    share = shares(placed, v)
    probability = np.where(astray | ~fitted, 0.0, shipped().decided(columns) * precision * share)
    order = sorted(
        range(len(alignments)), key=lambda k: _rank(alignments[k], float(probability[k]))
    )
    answered: set[tuple[str, int, str]] = set()
    out = []
    for k in order:
        a = alignments[k]
        alone, neighbours, *rest = (float(c[k]) for c in columns)
        agreement = Agreement(alone, int(neighbours), *rest)
        asked = (a.query_session, a.query_keyframe, a.target_session)
        p = float(probability[k])
        if astray[k]:
            why = (
                f"probability {p:.3f} below {least:g}: the session's own odometry puts it elsewhere"
            )
        elif not p >= least:  # nor what is no number
            why = reason(
                a.features, p, least, agreement, a.sigma, float(precision[k]), float(share[k])
            )
        else:
            why = "another place of the same session fits better" if asked in answered else ""
        answered.add(asked)
        out.append(replace(a, probability=p, agreement=agreement, reason=why))
    return out


def _rank(a: Alignment, probability: float) -> tuple[str, int, float, float, str, int]:
    """Order of the alignments: by query, then the most probable first."""
    return (
        a.query_session,
        a.query_stamp_ns,
        -probability,
        -a.features.structure,
        a.target_session,
        a.target_stamp_ns,
    )
