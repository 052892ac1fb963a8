"""Where alignments put their queries, as columns: votes and ambiguity are counted from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64, I64, Bools
from semloc_logs.closures.acceptance.calibration import Model, probability_of
from semloc_logs.closures.closure import Alignment, Alignments, Columns
from semloc_logs.mapping.session_map import SessionMap

FAR = 200.0  # m of road, at voxels of 0.30 m: odometry still ties together what lies so far apart
ARM = 0.015  # of the way: an alignment's error of heading (rad)
# of the way, and voxels: no query lies farther off in its own map
OWN_DRIFT, OWN_SLACK = 0.05, 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Placed(Columns):
    """Alignments (n): which query of which session lies where in which target's map.

    ``query`` (n,) numbers a session's queries, ``road`` and ``target_road`` (n,) are metres along
    the two drives, ``map_T_query`` and ``target_T_query`` (n, 4, 4) the query's base in its own map
    by odometry and in the target's by alignment, ``sigma`` (n,) the standard deviation of the
    latter's position in metres, ``log_odds`` (n,) the odds of its own features. ``posed``: whether
    odometry is known.
    """

    query_session: NDArray[np.object_]
    target_session: NDArray[np.object_]
    query: I64
    road: F64
    target_road: F64
    map_T_query: F64
    target_T_query: F64
    sigma: F64
    log_odds: F64
    posed: Bools

    @property
    def probability_ignoring_rivals(self) -> F64:
        """By its own features (n,), as if no other place fitted."""
        return probability_of(self.log_odds)


def place(alignments: Sequence[Alignment], maps: Mapping[str, SessionMap], model: Model) -> Placed:
    """Where alignments put their queries, and the log-odds that the ``model`` gives them."""
    rows = Alignments.of(alignments)
    n = len(rows)
    road, target_road = np.zeros((2, n))
    map_T_query, target_T_query = np.zeros((2, n, 4, 4))
    posed = np.zeros(n, bool)
    for (query_session, target_session), of_pair in rows.by_pair():
        query, target = (rows.query_keyframe[of_pair], rows.target_keyframe[of_pair])
        session, other = (maps[query_session], maps[target_session])
        road[of_pair] = session.distance[query]
        target_road[of_pair] = other.distance[target]
        map_T_query[of_pair] = session.map_T_base[query]
        target_T_query[of_pair] = other.map_T_base[target] @ rows.target_T_query[of_pair]
        posed[of_pair] = session.posed
    return Placed(
        *rows.sessions(),
        rows.query_keyframe,
        road,
        target_road,
        map_T_query,
        target_T_query,
        rows.sigma(),
        model.own_log_odds(rows.features),
        posed,
    )


Pairs = dict[tuple[str, str], I64]


def pairs_of(placed: Placed) -> Pairs:
    """Rows of each query session and target session, in the order of names.

    They are ordered by query, and then by place.
    """
    names, number = np.unique(
        np.concatenate([placed.query_session, placed.target_session]).astype(str),
        return_inverse=True,
    )
    query = number[: len(placed)]
    target = number[len(placed) :]
    centre = placed.target_T_query[:, :3, 3]
    rows = np.lexsort((centre[:, 2], centre[:, 1], centre[:, 0], placed.query, target, query))
    cuts = np.flatnonzero(np.diff(query[rows] * len(names) + target[rows])) + 1
    return {
        (str(names[query[r[0]]]), str(names[target[r[0]]])): r
        for r in np.split(rows, cuts)
        if len(r)
    }


def posed_pairs(placed: Placed, pairs: Pairs) -> Pairs:
    """The rows of ``pairs`` with odometry, and the pairs that have some."""
    posed = {pair: rows[placed.posed[rows]] for pair, rows in pairs.items()}
    return {pair: rows for pair, rows in posed.items() if len(rows)}


def query_roads(placed: Placed) -> dict[str, F64]:
    """Roads, ascending, of each session's queries that have an alignment with any target."""
    out: dict[str, dict[int, float]] = {}
    for session, query, road in zip(
        placed.query_session, placed.query.tolist(), placed.road.tolist(), strict=True
    ):
        out.setdefault(str(session), {})[query] = road
    return {
        session: np.sort(np.fromiter(roads.values(), float, len(roads)))
        for session, roads in out.items()
    }


def contradicts_odometry(placed: Placed, voxel_size: float) -> Bools:
    """Which alignments of a session with itself (n,) lie farther off than its odometry drifts."""
    own = (placed.query_session == placed.target_session) & placed.posed
    distance = np.linalg.norm(
        placed.map_T_query[:, :3, 3] - placed.target_T_query[:, :3, 3], axis=1
    )
    return np.asarray(
        own
        & (distance > OWN_SLACK * voxel_size + OWN_DRIFT * np.abs(placed.road - placed.target_road))
    )
