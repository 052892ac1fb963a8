"""The tables of alignments: WORK/alignments/query=A/target=B, and the parts they are made of.

A part holds what one task has found: some queries of a session in several targets. When all queries
are done, the parts become one table for each target.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from semloc_logs.closures.closure import FEATURES, Alignment, Alignments, Features
from semloc_logs.errors import WorkspaceError
from semloc_logs.tables import contracts
from semloc_logs.tables.table import read_metadata, read_table, write_table
from semloc_logs.voxels.store import pose_columns, poses_of

TARGET = "target_session"  # a column of parts


def alignment_table(alignments: Sequence[Alignment]) -> pa.Table:
    """The rows of alignments, in their order."""
    columns: dict[str, Any] = {
        name: [getattr(a, name) for a in alignments]
        for name in (
            "query_keyframe",
            "target_keyframe",
            "query_stamp_ns",
            "target_stamp_ns",
            "overlap",
            "inliers",
            "words",
        )
    }
    poses = np.array([a.target_T_query for a in alignments]).reshape(-1, 4, 4)
    columns |= pose_columns(poses)
    columns["covariance"] = [a.covariance.ravel().tolist() for a in alignments]
    columns |= {name: [getattr(a.features, name) for a in alignments] for name in FEATURES}
    return contracts.table("alignments", columns)


def read_alignments(path: Path, query: str, target: str) -> Alignments:
    """The alignments of session ``query`` in ``target``."""
    table = read_table(path)
    n = len(table)

    def column(name: str, kind: type) -> NDArray[Any]:
        return np.asarray(table[name].to_numpy(), kind)

    names = (
        "query_keyframe",
        "target_keyframe",
        "query_stamp_ns",
        "target_stamp_ns",
        "inliers",
        "words",
    )
    whole: dict[str, Any] = {name: column(name, np.int64) for name in names}
    covariance = table["covariance"].combine_chunks().flatten().to_numpy()
    return Alignments(
        pairs=[(query, target)],
        pair=np.zeros(n, np.int64),
        target_T_query=poses_of(table),
        covariance=np.asarray(covariance, float).reshape(n, 6, 6),
        overlap=column("overlap", float),
        features=Features(*(column(name, float) for name in FEATURES)),
        **whole,
    )


@dataclass(frozen=True, slots=True)
class Part:
    """What one task has found; ``targets`` are fingerprints by session."""

    path: Path
    keyframes: tuple[int, ...]
    targets: dict[str, str]


def write_part(
    path: Path,
    keyframes: Sequence[int],
    targets: dict[str, str],
    alignments: Sequence[Alignment],
) -> None:
    """The alignments of the queries at ``keyframes`` in all ``targets``."""
    table = alignment_table(alignments)
    names = pa.array([a.target_session for a in alignments], pa.string())
    metadata = {"keyframes": list(keyframes), "targets": targets}
    write_table(path, table.append_column(TARGET, names), metadata)


def read_parts(paths: Iterable[Path]) -> list[Part]:
    """Parts by their files; damaged ones are left out."""
    parts = []
    for path in paths:
        try:
            metadata = read_metadata(path)
            parts.append(Part(path, tuple(metadata["keyframes"]), dict(metadata["targets"])))
        except (WorkspaceError, KeyError, TypeError):
            continue
    return parts


def by_target(path: Path) -> dict[str, pa.Table]:
    """The alignments of a part with each of its targets that have some."""
    table = read_table(path).replace_schema_metadata(None)
    names = table[TARGET].to_numpy(zero_copy_only=False)
    alignments = table.drop_columns([TARGET])
    return {str(name): alignments.take(np.flatnonzero(names == name)) for name in np.unique(names)}


def joined(tables: Iterable[pa.Table]) -> pa.Table:
    """The alignments of all ``tables`` with one target, in their order."""
    empty = contracts.schema("alignments").empty_table().replace_schema_metadata(None)
    return pa.concat_tables([empty, *tables])
