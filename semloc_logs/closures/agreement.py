"""Neighbouring queries of a session against each other: together they lie where odometry and one transform of the sessions put them.

Two alignments of a session with the same target agree when the first one and the odometry between the two queries predict the
second one, to within their standard deviations and what odometry may drift (pairwise consistency as in Mangelson et al., PCM, ICRA
2018, section III, over a stretch of road instead of all pairs).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semloc_logs.alignment.verify import FEATURES
from semloc_logs.closures.acceptance import AGREEMENT, Agreement, own_values, reason, shipped, unrivalled
from semloc_logs.closures.closing import Alignment
from semloc_logs.closures.queries import SessionMap
from semloc_logs.geometry import inverse
from semloc_logs.settings import STREET_VOXEL, Settings

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Bools = NDArray[np.bool_]

NEAR, FAR = 25.0, 200.0  # m of road from a query to its neighbours, at voxels of 0.30 m
SLACK, MOST_SLACK = 1.7, 3.3  # voxels between two alignments of one place, without and with their standard deviations
DRIFT, ARM = 0.01, 0.015  # of the way: odometry, and an alignment's error of heading (rad)
TURN, TURN_DRIFT = np.radians(4.0), np.radians(0.02)  # rad, and rad a metre
LEAST = 0.02  # alignments less probable than this say nothing about others
APART = 20.0  # m between a place and its copy, at voxels of 0.30 m: nearer ones lie in one view, whose free space tells them apart
OWN_DRIFT, OWN_SLACK = 0.05, 10.0  # of the way, and voxels: farther off in its own map no query can be


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """Alignments (n) as agreement sees them: which query of which session lies where in which target's map.

    ``query`` (n,) numbers a session's queries, ``road`` and ``target_road`` (n,) are metres along the two drives, ``map_T_query`` and
    ``target_T_query`` (n, 4, 4) the query's base in its own map by odometry and in the target's by alignment, ``sigma`` (n,) the standard
    deviation of the latter's position in metres, ``alone`` (n,) its probability by itself and ``unrivalled`` (n,) the same if no other
    place fitted nearly as well. ``posed``: whether odometry is known.
    """

    query_session: NDArray[np.object_]
    target_session: NDArray[np.object_]
    query: I64
    road: F64
    target_road: F64
    map_T_query: F64
    target_T_query: F64
    sigma: F64
    alone: F64
    unrivalled: F64
    posed: Bools

    def __len__(self) -> int:
        return len(self.query)

    def part(self, index: I64 | Bools) -> Placed:
        """Some of them."""
        return Placed(*(getattr(self, name)[index] for name in self.__slots__))


def place(alignments: Sequence[Alignment], maps: Mapping[str, SessionMap]) -> Placed:
    """Where alignments put their queries."""
    ends = [(maps[a.query_session], a.query_keyframe, maps[a.target_session], a.target_keyframe) for a in alignments]

    def stack(poses: list[F64]) -> F64:
        return np.array(poses).reshape(-1, 4, 4)

    return Placed(
        np.array([a.query_session for a in alignments], object),
        np.array([a.target_session for a in alignments], object),
        np.array([a.query_keyframe for a in alignments], np.int64),
        np.array([q.distance[k] for q, k, _, _ in ends], float),
        np.array([t.distance[k] for _, _, t, k in ends], float),
        stack([q.map_T_base[k] for q, k, _, _ in ends]),
        stack([t.map_T_base[k] @ a.target_T_query for a, (_, _, t, k) in zip(alignments, ends, strict=True)]),
        np.array([a.sigma for a in alignments], float),
        np.array([a.agreement.alone for a in alignments], float),
        unrivalled(shipped().own, np.array([own_values(a.features) for a in alignments]).reshape(-1, len(FEATURES))),
        np.array([q.posed for q, _, _, _ in ends], bool),
    )


def agree(placed: Placed, voxel_size: float) -> list[F64]:
    """The columns (7, n) of ``AGREEMENT``; whatever the order of the alignments."""
    out = [placed.alone.copy(), *(np.zeros(len(placed)) for _ in AGREEMENT[1:])]
    support = np.zeros(len(placed))
    pairs = sorted(set(zip(placed.query_session, placed.target_session, strict=True)))
    for query, target in pairs:
        mine = np.flatnonzero((placed.query_session == query) & (placed.target_session == target) & placed.posed)
        group = placed.part(mine)
        out[1][mine] = _neighbours(group, NEAR * voxel_size / STREET_VOXEL)
        out[2][mine], out[3][mine], out[4][mine], out[5][mine] = _sums(group, group.alone, voxel_size)
        agreeing = _sums(group, group.unrivalled, voxel_size)[0]
        support[mine] = group.unrivalled * agreeing / np.maximum(out[1][mine], 1)
    out[6] = _lookalike(placed, support, voxel_size)
    return out


def _neighbours(group: Placed, near: float) -> F64:
    """How many other queries of the pair of sessions lie within ``near`` metres of road (n,)."""
    _, first, inverse_ = np.unique(group.query, return_index=True, return_inverse=True)
    road = group.road[first]
    ordered = np.sort(road)
    count = np.searchsorted(ordered, road + near, "right") - np.searchsorted(ordered, road - near, "left") - 1
    return count[inverse_].astype(float)


def _sums(group: Placed, p: F64, voxel_size: float) -> F64:
    """Probabilities ``p`` (n,) of other queries' alignments that agree with each (4, n) and that do not, near it and far from it.

    Of each query the most probable alignment of either kind counts, and as opposing only if it is more probable than an agreeing one.
    """
    scale = voxel_size / STREET_VOXEL
    loud = p >= LEAST
    voices, p = group.part(loud), p[loud]
    out = np.zeros((4, len(group)))
    for k in range(len(group)):
        along = np.abs(voices.road - group.road[k])
        there = np.flatnonzero((along <= FAR * scale) & (voices.query != group.query[k]))
        if not len(there):
            continue
        heard, along, said = voices.part(there), along[there], p[there]
        agrees = _agrees(group.part(np.array([k])), heard, along, voxel_size)
        _, first, number = np.unique(heard.query, return_index=True, return_inverse=True)
        for_it, against = np.zeros(len(first)), np.zeros(len(first))
        np.maximum.at(for_it, number, np.where(agrees, said, 0.0))
        np.maximum.at(against, number, np.where(agrees, 0.0, said))
        against[against <= for_it] = 0.0
        near = along[first] <= NEAR * scale
        out[:, k] = [for_it[near].sum(), against[near].sum(), for_it[~near].sum(), against[~near].sum()]
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


def strays(placed: Placed, voxel_size: float) -> Bools:
    """Which alignments of a session with itself (n,) are farther from where the odometry is than it can have drifted."""
    own = (placed.query_session == placed.target_session) & placed.posed
    off = np.linalg.norm(placed.map_T_query[:, :3, 3] - placed.target_T_query[:, :3, 3], axis=1)
    return np.asarray(own & (off > OWN_SLACK * voxel_size + OWN_DRIFT * np.abs(placed.road - placed.target_road)))


def _lookalike(placed: Placed, support: F64, voxel_size: float) -> F64:
    """How much the streets about either end of each alignment look like others (n,), in [0, 1].

    A query looks like another place as far as two places of one target session, or one of its own where odometry says that it is not,
    have ``support`` (n,) of it and its neighbours. Two drives through copies of a street see nothing that tells, but where one of them
    came through several copies, or another session did, it shows. Hence the mean over the queries about either end, in the target
    session that shows it most.
    """
    scale = voxel_size / STREET_VOXEL
    by_target: dict[tuple[str, str], dict[int, list[int]]] = {}
    for k, (session, target, query) in enumerate(zip(placed.query_session, placed.target_session, placed.query.tolist(), strict=True)):
        by_target.setdefault((session, target), {}).setdefault(query, []).append(k)
    astray = strays(placed, voxel_size)
    out = np.zeros(len(placed))
    for (session, _), queries in by_target.items():
        road, much = np.zeros(len(queries)), np.zeros(len(queries))
        for i, rows in enumerate(queries.values()):
            road[i] = placed.road[rows[0]]
            second = _second(placed.part(np.array(rows)), support[rows], voxel_size)
            much[i] = max([second, *support[[k for k in rows if astray[k]]].tolist()])
        for sessions, at in ((placed.query_session, placed.road), (placed.target_session, placed.target_road)):
            for k in np.flatnonzero(sessions == session).tolist():
                about = np.abs(road - at[k]) <= FAR * scale
                out[k] = max(out[k], float(much[about].mean()) if about.any() else 0.0)
    return out


def _second(places: Placed, support: F64, voxel_size: float) -> float:
    """The support that the second place of one query in one target has."""
    best = 0.0
    for a in range(len(support)):
        off = np.linalg.norm(places.target_T_query[:, :3, 3] - places.target_T_query[a, :3, 3], axis=1)
        apart = off > APART * voxel_size / STREET_VOXEL + OWN_DRIFT * np.abs(places.target_road - places.target_road[a])
        best = max(best, float(np.minimum(support[apart], support[a]).max(initial=0.0)))
    return best


def decide(alignments: Sequence[Alignment], maps: Mapping[str, SessionMap], settings: Settings) -> list[Alignment]:
    """The alignments of all queries, best first for each query: at most one accepted for each target session, the others with a reason."""
    v, least = settings.fusion.voxel_size, settings.closures.min_probability
    placed = place(alignments, maps)
    columns = agree(placed, v)
    astray = strays(placed, v)
    probability = np.where(astray, 0.0, shipped().decided(columns))
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
            why = reason(a.features, p, least, agreement)
        else:
            why = "another place of the same session fits better" if asked in answered else ""
        answered.add(asked)
        out.append(replace(a, probability=p, agreement=agreement, reason=why))
    return out


def _rank(a: Alignment, probability: float) -> tuple[str, int, float, float, str, int]:
    """Order of the alignments: by query, then the most probable first."""
    return a.query_session, a.query_stamp_ns, -probability, -a.features.structure, a.target_session, a.target_stamp_ns
