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
from semloc_logs.closures.acceptance import AGREEMENT, Agreement, may_be_right, own_values, reason, shipped, unrivalled
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
BEYOND_DOUBT = 0.7  # support of alignments that may contradict others
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
    pairs = _pairs(placed)
    asked = _asked(placed)
    for (query, _), rows in pairs.items():
        group, road = placed.part(rows), asked[query]
        near = NEAR * voxel_size / STREET_VOXEL
        out[1][rows] = np.searchsorted(road, group.road + near, "right") - np.searchsorted(road, group.road - near, "left") - 1.0
        (out[2][rows], out[3][rows], out[4][rows], out[5][rows]), alike = _sums(group, (group.alone, group.unrivalled), voxel_size)
        support[rows] = group.unrivalled * alike[0] / np.maximum(out[1][rows], 1)
    out[6] = _lookalike(placed, pairs, asked, support, voxel_size)
    return out


Pairs = dict[tuple[str, str], I64]


def _pairs(placed: Placed) -> Pairs:
    """Rows of each query session and target session with odometry, by query and then by place, in the order of names."""
    names, number = np.unique(np.concatenate([placed.query_session, placed.target_session]).astype(str), return_inverse=True)
    query, target = number[: len(placed)], number[len(placed) :]
    at = placed.target_T_query[:, :3, 3]
    rows = np.lexsort((at[:, 2], at[:, 1], at[:, 0], placed.query, target, query))
    rows = rows[placed.posed[rows]]
    cuts = np.flatnonzero(np.diff(query[rows] * len(names) + target[rows])) + 1
    return {(str(names[query[r[0]]]), str(names[target[r[0]]])): r for r in np.split(rows, cuts) if len(r)}


def _asked(placed: Placed) -> dict[str, F64]:
    """The roads, ascending, of the queries of each session that have an alignment with any target."""
    out: dict[str, dict[int, float]] = {}
    for session, query, road in zip(placed.query_session, placed.query.tolist(), placed.road.tolist(), strict=True):
        out.setdefault(str(session), {})[query] = road
    return {session: np.sort(np.fromiter(found.values(), float, len(found))) for session, found in out.items()}


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


def strays(placed: Placed, voxel_size: float) -> Bools:
    """Which alignments of a session with itself (n,) are farther from where the odometry is than it can have drifted."""
    own = (placed.query_session == placed.target_session) & placed.posed
    off = np.linalg.norm(placed.map_T_query[:, :3, 3] - placed.target_T_query[:, :3, 3], axis=1)
    return np.asarray(own & (off > OWN_SLACK * voxel_size + OWN_DRIFT * np.abs(placed.road - placed.target_road)))


def _lookalike(placed: Placed, pairs: Pairs, asked: Mapping[str, F64], support: F64, voxel_size: float) -> F64:
    """How much the streets about either end of each alignment look like others (n,), in [0, 1]; ``support`` (n,) is how probable an
    alignment would be without rivals, times the share of near neighbours that agree.

    Two drives through copies of a street, one block apart, agree in every query, and nothing in them tells. What gives copies away is a
    third place: a session that came through several copies has two places with support for one query, or what three sessions say of
    each other does not close. Both are means over the queries about an end; the session that shows it most counts.
    """
    reach = FAR * voxel_size / STREET_VOXEL
    shown: dict[str, list[tuple[F64, F64, F64]]] = {}  # by session: roads of all queries that can show it; where some do, and how much
    for (query, target), rows in pairs.items():
        first, second, much = _second_places(placed, rows, support, voxel_size)
        shown.setdefault(query, []).append((asked[query], placed.road[first], much))
        if target != query:  # of what it was asked too: at both places
            both = np.concatenate([first, second[much > 0]])
            shown.setdefault(target, []).append((placed.target_road[first], placed.target_road[both], np.r_[much, much[much > 0]]))
    for session, road in _contradicted(placed, pairs, support, voxel_size).items():
        shown.setdefault(session, []).append((asked[session], road, np.ones(len(road))))
    out = np.zeros(len(placed))
    for sessions, roads in ((placed.query_session, placed.road), (placed.target_session, placed.target_road)):
        for session in sorted(set(sessions)):
            mine = np.flatnonzero(sessions == session)
            of_all = _about(asked.get(session, np.zeros(0)), roads[mine], reach)
            for everyone, at, much in shown.get(session, []):
                share = _about(at, roads[mine], reach, much) / np.maximum(np.maximum(of_all, _about(everyone, roads[mine], reach)), 1.0)
                out[mine] = np.maximum(out[mine], np.minimum(share, 1.0))
    return out


def _about(at: F64, road: F64, reach: float, much: F64 | None = None) -> F64:
    """How many of ``at`` (m,), metres of road, lie within ``reach`` of each ``road`` (n,); or the sums of how ``much`` (m,) they show."""
    order = np.argsort(at, kind="stable")
    sums, at = np.r_[0.0, np.cumsum(np.ones(len(at)) if much is None else much[order])], at[order]
    return np.asarray(sums[np.searchsorted(at, road + reach, "right")] - sums[np.searchsorted(at, road - reach, "left")])


def _second_places(placed: Placed, rows: I64, support: F64, voxel_size: float) -> tuple[I64, I64, F64]:
    """Of each query in one target the rows of two places, a view apart, of which the second has as much support as possible, and how much.

    Where a session is asked about itself, the first place is where it is by odometry, so any other one is a second place.
    """
    apart = APART * voxel_size / STREET_VOXEL
    astray = strays(placed.part(rows), voxel_size)
    cuts = np.flatnonzero(np.diff(placed.query[rows])) + 1
    found = []
    for places, wrong in zip(np.split(rows, cuts), np.split(astray, cuts), strict=True):
        at, road, mine = placed.target_T_query[places, :3, 3], placed.target_road[places], support[places]
        off = np.linalg.norm(at[:, None] - at, axis=2)
        lesser = np.where(off > apart + DRIFT * np.abs(road[:, None] - road), np.minimum(mine[:, None], mine), 0.0)
        a, b = np.unravel_index(int(np.argmax(lesser)), lesser.shape)
        best = int(np.argmax(mine))
        much = max(float(lesser[a, b]), float(mine[wrong].max(initial=0.0)))
        found.append((places[a], places[b], much) if lesser[a, b] > 0 else (places[best], places[best], much))
    first, second, most = zip(*found, strict=True)
    return np.array(first), np.array(second), np.array(most)


def _contradicted(placed: Placed, pairs: Pairs, support: F64, voxel_size: float) -> dict[str, F64]:
    """Roads of the queries whose place in one session is not where it has to be by another's: by what the latter says of the former.

    Of three sessions a, g, h those alignments are compared that hardly anybody doubts: a query of a in g, the nearest one of a in h, and
    the nearest one of g in h; odometry leads from one to the next.
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
    found: dict[str, set[float]] = {}
    for (a, g), x in sure.items():
        for h in targets[a]:
            if h == g or (g, h) not in sure:
                continue
            y = sure[a, h][_nearest(placed.road[sure[a, h]], placed.road[x])]
            z = sure[g, h][_nearest(placed.road[sure[g, h]], placed.target_road[x])]
            along = np.abs(placed.road[y] - placed.road[x]), np.abs(placed.road[z] - placed.target_road[x])
            g_T_y = placed.target_T_query[x] @ inverse(placed.map_T_query[x]) @ placed.map_T_query[y]
            h_T_y = placed.target_T_query[z] @ inverse(placed.map_T_query[z]) @ g_T_y
            off = np.linalg.norm(h_T_y[:, :3, 3] - placed.target_T_query[y, :3, 3], axis=1)
            way = along[0] + along[1] + np.abs(placed.target_road[z] - placed.target_road[y])
            wrong = (off > APART * scale + (DRIFT + ARM) * way) & (np.maximum(*along) <= FAR * scale)
            found.setdefault(a, set()).update(placed.road[x[wrong]].tolist())
    return {session: np.sort(np.fromiter(roads, float, len(roads))) for session, roads in found.items()}


def _nearest(values: F64, wanted: F64) -> I64:
    """Numbers (n,) of the ascending ``values`` nearest to the ``wanted`` ones (n,)."""
    after = np.clip(np.searchsorted(values, wanted), 1, max(len(values) - 1, 1))
    before = after - 1
    return np.asarray(
        np.where(np.abs(values[np.minimum(after, len(values) - 1)] - wanted) < np.abs(values[before] - wanted), after, before)
    )


def decide(alignments: Sequence[Alignment], maps: Mapping[str, SessionMap], settings: Settings) -> list[Alignment]:
    """The alignments of all queries, best first for each query: at most one accepted for each target session, the others with a reason."""
    v, least = settings.fusion.voxel_size, settings.closures.min_probability
    placed = place(alignments, maps)
    columns = agree(placed, v)
    astray = strays(placed, v)
    fitted = may_be_right(np.array([own_values(a.features) for a in alignments]).reshape(-1, len(FEATURES)))
    probability = np.where(astray | ~fitted, 0.0, shipped().decided(columns))
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
