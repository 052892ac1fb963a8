"""Closures of all queries together: each place once, and the tables of closures and rejections."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from semloc_logs.closures.closure import FEATURES, Closure, Rejected
from semloc_logs.errors import WorkspaceError
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.tables import contracts
from semloc_logs.tables.table import read_table, write_table
from semloc_logs.voxels.store import pose_columns

ROWS_AT_ONCE = 8192  # that are made into objects when a table is written
# columns of rejected.parquet and the fields of Agreement that they hold
AGREEMENT_COLUMNS = {
    "alone": "own_probability",
    "neighbours": "neighbours",
    "agreeing": "support",
    "opposing": "conflict",
    "far_agreeing": "far_support",
    "far_opposing": "far_conflict",
    "lookalike": "ambiguity",
}


def unique_closures(
    accepted: Sequence[Closure], road: dict[str, NDArray[np.float64]], spacing: float
) -> list[Closure]:
    """Closures without those found from both ends, sorted by query session and time.

    Two are the same when their ends are the same two places to within ``spacing`` metres along the
    road; the more probable one stays. ``road`` gives the keyframes' distances (n,), metres
    travelled, by session: of a drive with itself both ends lie at one place, and only the road
    between tells them apart.
    """
    kept: list[Closure] = []
    by_ends: dict[tuple[str, str, int], list[Closure]] = {}
    for closure in sorted(accepted, key=_best_first):
        a = closure.alignment
        query_road = road[a.query_session]
        target_road = road[a.target_session]
        query_distance = query_road[a.query_keyframe]
        target_distance = target_road[a.target_keyframe]

        # closures of the opposite direction that end near this query, and begin near its target
        keyframes = range(
            np.searchsorted(query_road, query_distance - spacing, "right"),
            np.searchsorted(query_road, query_distance + spacing, "left"),
        )
        opposite = (
            other.alignment
            for k in keyframes
            for other in by_ends.get((a.target_session, a.query_session, k), ())
        )
        if any(abs(target_road[o.query_keyframe] - target_distance) < spacing for o in opposite):
            continue

        ends = (a.query_session, a.target_session, a.target_keyframe)
        by_ends.setdefault(ends, []).append(closure)
        kept.append(closure)
    return sorted(kept, key=_by_time)


def _best_first(closure: Closure) -> tuple[float, float, str, int]:
    a = closure.alignment
    return -closure.decision.probability, -a.features.structure, a.query_session, a.query_stamp_ns


def _by_time(closure: Closure) -> tuple[str, int, str, int]:
    a = closure.alignment
    return a.query_session, a.query_stamp_ns, a.target_session, a.target_stamp_ns


def _columns(rows: Sequence[Closure] | Sequence[Rejected]) -> dict[str, Any]:
    alignments = [row.alignment for row in rows]
    return {
        "query_session": [a.query_session for a in alignments],
        "target_session": [a.target_session for a in alignments],
        "query_stamp_ns": [a.query_stamp_ns for a in alignments],
        "target_stamp_ns": [a.target_stamp_ns for a in alignments],
        **pose_columns(np.array([a.target_T_query for a in alignments]).reshape(-1, 4, 4)),
        "overlap": [a.overlap for a in alignments],
        "probability": [row.decision.probability for row in rows],
        "inliers": [a.inliers for a in alignments],
        "words": [a.words for a in alignments],
    }


def write_closures(path: Path, rows: Sequence[Closure], metadata: dict[str, Any]) -> None:
    """closures.parquet."""
    columns = _columns(rows)
    columns["covariance"] = [row.alignment.covariance.ravel().tolist() for row in rows]
    write_table(
        path, contracts.table("closures", columns), metadata, ("query_session", "query_stamp_ns")
    )


def write_rejected(path: Path, rows: Sequence[Rejected], metadata: dict[str, Any]) -> None:
    """rejected.parquet: also the reason and the features that acceptance looks at."""
    order = _query_then_best(rows)
    tables = [contracts.table("rejected", _rejected_columns([]))]
    for first in range(0, len(order), ROWS_AT_ONCE):
        some = [rows[k] for k in order[first : first + ROWS_AT_ONCE].tolist()]
        tables.append(contracts.table("rejected", _rejected_columns(some)))
    write_table(path, pa.concat_tables(tables), metadata, ("query_session", "query_stamp_ns"))


def _rejected_columns(rows: Sequence[Rejected]) -> dict[str, Any]:
    alignments = [row.alignment for row in rows]
    agreements = [row.decision.agreement for row in rows]
    columns = _columns(rows)
    columns["sigma"] = [a.sigma for a in alignments]
    columns["reason"] = [row.sentence for row in rows]
    columns |= {name: [getattr(a.features, name) for a in alignments] for name in FEATURES}
    columns |= {
        column: [getattr(agreement, name) for agreement in agreements]
        for column, name in AGREEMENT_COLUMNS.items()
    }
    columns["neighbours"] = [int(agreement.neighbours) for agreement in agreements]
    return columns


def _query_then_best(rows: Sequence[Rejected]) -> NDArray[np.int64]:
    """Numbers (n,) of the rows by query, then the most probable first."""
    numbers: dict[str, int] = {}
    keys = np.zeros((len(rows), 4), np.int64)
    probability = np.zeros(len(rows))
    for k, row in enumerate(rows):
        a = row.alignment
        session, other = (
            numbers.setdefault(name, len(numbers)) for name in (a.query_session, a.target_session)
        )
        keys[k] = (session, a.query_stamp_ns, other, a.target_stamp_ns)
        probability[k] = row.decision.probability
    rank = np.zeros(len(numbers), np.int64)
    rank[[numbers[name] for name in sorted(numbers)]] = np.arange(len(numbers))
    columns = keys.T
    return np.lexsort((columns[3], rank[columns[2]], -probability, columns[1], rank[columns[0]]))


def read_closures(path: Path) -> list[dict[str, Any]]:
    """Rows of closures.parquet. WorkspaceError where it is missing or damaged."""
    if not path.exists():
        raise WorkspaceError(f"{path.parent} has no closures yet: run 'semloc close' first.")
    rows: list[dict[str, Any]] = read_table(path).to_pylist()
    return rows


def keyframe_at(session: SessionMap, stamp_ns: int) -> int:
    """The keyframe with this stamp, or the nearest."""
    return int(np.argmin(np.abs(session.stamps_ns - stamp_ns)))
