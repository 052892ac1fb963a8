"""Closures of all queries together: each place once, as tables, and as rows for the log's channels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semloc_logs.alignment.verify import FEATURES
from semloc_logs.closures.acceptance.calibration import AGREEMENT
from semloc_logs.closures.closure import Alignment
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.tables import contracts
from semloc_logs.tables.table import read_table, write_table
from semloc_logs.voxels.store import pose_columns


def unique_closures(
    accepted: Sequence[Alignment], road: dict[str, NDArray[np.float64]], spacing: float
) -> list[Alignment]:
    """Accepted alignments without those found from both ends, sorted by query session and time.

    Two are the same when their ends are the same two places to within ``spacing`` metres along the
    road; the more probable one stays. ``road`` gives the keyframes' distances (n,), metres
    travelled, by session: of a drive with itself both ends lie at one place, and only the way
    between tells them apart.
    """
    kept: list[Alignment] = []
    by_ends: dict[tuple[str, str, int], list[Alignment]] = {}
    for a in sorted(
        accepted,
        key=lambda a: (-a.probability, -a.features.structure, a.query_session, a.query_stamp_ns),
    ):
        asking = road[a.query_session]
        asked = road[a.target_session]
        q = asking[a.query_keyframe]
        t = asked[a.target_keyframe]
        near = range(
            np.searchsorted(asking, q - spacing, "right"),
            np.searchsorted(asking, q + spacing, "left"),
        )
        twins = (o for k in near for o in by_ends.get((a.target_session, a.query_session, k), ()))
        if any(abs(asked[o.query_keyframe] - t) < spacing for o in twins):
            continue
        by_ends.setdefault((a.query_session, a.target_session, a.target_keyframe), []).append(a)
        kept.append(a)
    return sorted(
        kept, key=lambda a: (a.query_session, a.query_stamp_ns, a.target_session, a.target_stamp_ns)
    )


def _columns(rows: Sequence[Alignment]) -> dict[str, Any]:
    return {
        "query_session": [a.query_session for a in rows],
        "target_session": [a.target_session for a in rows],
        "query_stamp_ns": [a.query_stamp_ns for a in rows],
        "target_stamp_ns": [a.target_stamp_ns for a in rows],
        **pose_columns(np.array([a.target_T_query for a in rows])),
        "overlap": [a.overlap for a in rows],
        "probability": [a.probability for a in rows],
        "inliers": [a.inliers for a in rows],
        "words": [a.words for a in rows],
    }


def write_closures(path: Path, rows: Sequence[Alignment], metadata: dict[str, Any]) -> None:
    """closures.parquet."""
    columns = _columns(rows) | {"covariance": [a.covariance.ravel().tolist() for a in rows]}
    write_table(
        path, contracts.table("closures", columns), metadata, ("query_session", "query_stamp_ns")
    )


def write_rejected(path: Path, rows: Sequence[Alignment], metadata: dict[str, Any]) -> None:
    """rejected.parquet: also the reason and the features that acceptance looked at."""
    ordered = sorted(
        rows,
        key=lambda a: (
            a.query_session,
            a.query_stamp_ns,
            -a.probability,
            a.target_session,
            a.target_stamp_ns,
        ),
    )
    columns = _columns(ordered) | {n: [getattr(a, n) for a in ordered] for n in ("sigma", "reason")}
    columns |= {n: [getattr(a.features, n) for a in ordered] for n in FEATURES}
    columns |= {n: [getattr(a.agreement, n) for a in ordered] for n in AGREEMENT}
    write_table(
        path, contracts.table("rejected", columns), metadata, ("query_session", "query_stamp_ns")
    )


def read_closures(path: Path) -> list[dict[str, Any]]:
    """Rows of closures.parquet."""
    rows: list[dict[str, Any]] = read_table(path).to_pylist()
    return rows


def keyframe_at(session: SessionMap, stamp_ns: int) -> int:
    """The keyframe with this stamp, or the nearest."""
    return int(np.argmin(np.abs(session.stamps_ns - stamp_ns)))
