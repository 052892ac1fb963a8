"""Closures -> channels of a log."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

import semloc_logs
from semloc_logs.closures.closure_tables import keyframe_at, read_closures
from semloc_logs.errors import WorkspaceError
from semloc_logs.logs.annotation.annotate import (
    AnnotateReport,
    ClosureRecord,
    Results,
    annotate_copy,
    annotate_in_place,
    annotate_sidecar,
    recover,
)
from semloc_logs.logs.containers.open import open_log
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import transform
from semloc_logs.settings import Resolved
from semloc_logs.stages.inputs import session_name
from semloc_logs.workspace import Workspace

SECTIONS = ("fusion", "labels", "descriptor", "query", "closures")


class AnnotationMode(StrEnum):
    """Where the channels go."""

    NONE = "none"
    COPY = "copy"
    IN_PLACE = "in-place"
    SIDECAR = "sidecar"


@dataclass(frozen=True, slots=True)
class Annotation:
    """``output`` is the file of a copy or a sidecar; ``overwrite`` allows to replace it."""

    mode: AnnotationMode
    output: Path | None = None
    overwrite: bool = False


def annotate(
    log: Path,
    work: Workspace,
    settings: Resolved,
    annotation: Annotation,
    *,
    session: str | None = None,
) -> AnnotateReport:
    """Write the closures of the log's session (default: by the log's name) as channels.

    Raises WorkspaceError where the session is missing, or a copy or sidecar has no output.
    """
    recover(log)
    name = session or session_name(log)
    own = SessionMap(work.chosen([name])[0])
    _check_log(log, own)
    results = _results(work, own, name, settings)
    if annotation.mode is AnnotationMode.IN_PLACE:
        return annotate_in_place(log, results)
    if annotation.output is None:
        raise WorkspaceError("Annotating needs an output file.")
    write = annotate_sidecar if annotation.mode is AnnotationMode.SIDECAR else annotate_copy
    return write(log, annotation.output, results, overwrite=annotation.overwrite)


def _check_log(log: Path, own: SessionMap) -> None:
    """WorkspaceError where the log is not one that the session was made from, by its start."""
    with closing(open_log(log)) as opened:
        start_ns = opened.start_ns
    logs = own.json["logs"]
    if start_ns not in [made_from["start_ns"] for made_from in logs]:
        name = own.folder.name
        paths = ", ".join(str(made_from["path"]) for made_from in logs)
        raise WorkspaceError(
            f"{log} is not the log that session '{name}' was made from ({paths}): name its own"
            " with --session."
        )


def _results(work: Workspace, own: SessionMap, name: str, settings: Resolved) -> Results:
    """Every closure that the session takes part in, as query or as target."""
    rows = [
        row
        for row in read_closures(work.closures)
        if name in (row["query_session"], row["target_session"])
    ]
    records = [_record(work, own, name, row) for row in rows]
    log_times = own.frames["log_time_ns"].to_pylist()
    times = dict(zip(own.stamps_ns.tolist(), log_times, strict=True))
    notes = {
        "version": semloc_logs.__version__,
        "settings": settings.fingerprint(*SECTIONS),
        "fusion.voxel_size": str(settings.fusion.voxel_size),
    }
    frame_id = str(own.json.get("session_frame") or "") or None
    memory = settings.logs.memory
    return Results(records, name, notes, times, frame_id=frame_id, memory=memory)


def _record(work: Workspace, own: SessionMap, name: str, row: dict[str, Any]) -> ClosureRecord:
    """A closure as the channels need it: with poses in the frames of the pose streams."""
    target = SessionMap(work.session(row["target_session"]))
    target_end = keyframe_at(target, row["target_stamp_ns"])
    translation = np.array([row["t_x"], row["t_y"], row["t_z"]])
    target_T_query = transform(
        translation, np.array([row["q_x"], row["q_y"], row["q_z"], row["q_w"]])
    )
    session_T_map = np.array(target.json["session_T_map"])
    session_T_query = session_T_map @ target.map_T_base[target_end] @ target_T_query

    is_query = row["query_session"] == name
    own_end = keyframe_at(own, row["query_stamp_ns"] if is_query else row["target_stamp_ns"])
    position = (np.array(own.json["session_T_map"]) @ own.map_T_base[own_end])[:3, 3]
    return ClosureRecord.from_row(
        row,
        session_T_query=session_T_query if is_query else None,
        session_position=position,
    )
