"""What a workspace holds: its sessions listed, renamed and removed."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from dataclasses import dataclass

import pyarrow.parquet as pq

from semloc_logs.closures.exclusions import Exclusions
from semloc_logs.closures.session_pairs import forget, known_pairs
from semloc_logs.errors import WorkspaceError
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.stages.close import decide_all
from semloc_logs.stages.lock import one_writer
from semloc_logs.stages.state import read_kept
from semloc_logs.tables.atomic_files import make_folder, sync_folder
from semloc_logs.tables.table import read_json, write_json
from semloc_logs.workspace import Workspace


@dataclass(frozen=True, slots=True)
class SessionSummary:
    """A session of a workspace; ``searched`` counts the sessions that it was compared with.

    ``drift_percent`` of its poses over some ten metres, None where its clouds do not show it.
    """

    name: str
    logs: tuple[str, ...]
    start_ns: int
    duration_s: float
    road_m: float
    keyframes: int
    submaps: int
    drift_percent: float | None
    label_source: str
    described: bool
    searched: int
    closures: int


def list_sessions(work: Workspace, names: Iterable[str] = ()) -> list[SessionSummary]:
    """The sessions in the order of their recording. WorkspaceError where one is missing."""
    folders = work.chosen(list(names))
    pairs = known_pairs(work)
    counts = _closure_counts(work)
    summaries = []
    for folder in folders:
        session = SessionMap(folder)
        stamps_ns = session.stamps_ns
        drift = session.measured_drift
        summary = SessionSummary(
            name=folder.name,
            logs=tuple(str(log["path"]) for log in session.json["logs"]),
            start_ns=int(stamps_ns[0]),
            duration_s=float(stamps_ns[-1] - stamps_ns[0]) / 1e9,
            road_m=float(session.distance[-1]),
            keyframes=len(stamps_ns),
            submaps=len(session.submaps),
            drift_percent=None if drift is None else round(drift.percent, 2),
            label_source=session.label_source,
            described=folder.words_json.exists(),
            searched=sum(folder.name in (p.query, p.target) for p in pairs),
            closures=counts.get(folder.name, 0),
        )
        summaries.append(summary)
    return sorted(summaries, key=lambda s: (s.start_ns, s.name))


@one_writer
def rename_session(work: Workspace, name: str, new_name: str) -> None:
    """Give a session another name; its words and alignments stay.

    Raises WorkspaceError where it is missing, or the other name is taken.
    """
    folder = work.chosen([name])[0]
    if work.session(new_name).path.exists():
        raise WorkspaceError(f"{work.path} has a session {new_name} already: choose another name.")
    moved = [p for p in known_pairs(work) if name in (p.query, p.target)]
    os.replace(folder.path, work.session(new_name).path)
    sync_folder(folder.path.parent)
    renamed = work.session(new_name)
    write_json(renamed.session_json, read_json(renamed.session_json) | {"name": new_name})
    for pair in moved:
        query, target = (new_name if end == name else end for end in (pair.query, pair.target))
        old = work.alignments(pair.query, pair.target)
        new = work.alignments(query, target)
        make_folder(new.parent)
        os.replace(old, new)
        sync_folder(new.parent)
    shutil.rmtree(work.alignments_of_query(name), ignore_errors=True)
    _clear_targets(work, name)
    work.session_lock(name).unlink(missing_ok=True)
    _decide(work)


@one_writer
def remove_session(work: Workspace, name: str) -> None:
    """Remove a session with its alignments, and decide again about the others."""
    folder = work.chosen([name])[0]
    forget(work, [p for p in known_pairs(work) if name in (p.query, p.target)])
    shutil.rmtree(work.search_parts(name), ignore_errors=True)
    folder.session_json.unlink()  # without it the rest is nothing
    shutil.rmtree(folder.path)
    sync_folder(folder.path.parent)
    work.session_lock(name).unlink(missing_ok=True)
    _decide(work)


def _decide(work: Workspace) -> None:
    """The tables of closures again, where there are any."""
    if not work.sessions():
        for path in (work.closures, work.rejected, work.picture):
            path.unlink(missing_ok=True)
    settings = read_kept(work)
    if settings is not None and work.closures.exists():
        maps = {folder.name: SessionMap(folder) for folder in work.sessions()}
        resolved = settings.resolved()
        decide_all(work, maps, resolved, Exclusions.of(maps, resolved))


def _clear_targets(work: Workspace, name: str) -> None:
    for folder in work.alignments_in_target(name):
        shutil.rmtree(folder, ignore_errors=True)


def _closure_counts(work: Workspace) -> dict[str, int]:
    """Closures of each session, at either end."""
    counts: dict[str, int] = {}
    if work.closures.exists():
        columns = ["query_session", "target_session"]
        table = pq.read_table(work.closures, columns=columns)
        for pair in map(tuple, zip(*(table[c].to_pylist() for c in columns), strict=True)):
            for name in set(pair):
                counts[name] = counts.get(name, 0) + 1
    return counts
