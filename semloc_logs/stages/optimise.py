"""Maps and closures -> all sessions in one frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from semloc_logs.arrays import I64
from semloc_logs.errors import WorkspaceError
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.pose_graph.assembly import pose_graph_of
from semloc_logs.pose_graph.merged_map import write_merged_map
from semloc_logs.pose_graph.optimisation import optimise_graph
from semloc_logs.pose_graph.optimized_tables import (
    EarlierTables,
    GroupTables,
    read_earlier,
    tables_of,
    write_graph,
    write_trajectories,
)
from semloc_logs.pose_graph.problem import fine_problem
from semloc_logs.progress import report as report_progress
from semloc_logs.settings import Resolved
from semloc_logs.stages.inputs import fingerprint_of, recorded_fingerprint
from semloc_logs.stages.lock import one_writer
from semloc_logs.tables.metadata import origin
from semloc_logs.tables.table import read_metadata, read_table
from semloc_logs.workspace import Workspace

Sessions = dict[str, SessionMap]


@dataclass(frozen=True, slots=True)
class OptimiseReport:
    """Numbers of sessions, closures, refused closures and frames.

    ``solved`` names the sessions whose poses are new; the others were up to date.
    """

    sessions: int
    closures: int
    rejected: int
    frames: int
    solved: list[str]


@dataclass(frozen=True, slots=True)
class MergedFrame:
    """A map of several sessions: the frame, and how many voxels it has and changed."""

    frame: str
    voxels: int
    changed: int


@dataclass(frozen=True, slots=True, eq=False)
class _Group:
    """Sessions that closures connect, the rows (m,) of these, and what the result depends on."""

    sessions: Sessions
    rows: I64
    closures: pa.Table
    fingerprint: str


@one_writer
def optimise(
    work: Workspace, settings: Resolved, *, covariances: bool = False, overwrite: bool = False
) -> OptimiseReport:
    """Write optimized/. Sessions whose closures did not change keep their poses.

    Raises WorkspaceError without closures.parquet, SemlocError without GTSAM.
    """
    sessions = {folder.name: SessionMap(folder) for folder in work.chosen(())}
    if not work.closures.exists():
        raise WorkspaceError(f"{work.path} has no closures yet: run 'semloc close' first.")
    closures = _closures_between(work, sessions)
    groups = _groups(sessions, closures, settings, covariances=covariances)
    earlier = None if overwrite else read_earlier(work)
    metadata = {
        **origin(),
        "settings": settings.model_dump(mode="json", include={"optimize"}),
    }
    tables = []
    solved: list[str] = []
    for k, group in enumerate(groups):
        if earlier is not None and _is_up_to_date(work, group, earlier):
            graph = pose_graph_of(group.sessions, group.closures, settings.optimize)
            tables.append(earlier.rows_of(graph, fine_problem(graph, settings.optimize)))
        else:
            tables.append(_solve(work, group, settings, metadata, covariances=covariances))
            solved += group.sessions
        report_progress("optimize", ", ".join(group.sessions), k + 1, len(groups), "groups")

    order = np.argsort(np.concatenate([np.zeros(0, np.int64), *(g.rows for g in groups)]))
    content = {**metadata, "groups": sorted(group.fingerprint for group in groups)}
    write_graph(work, tables, order, content)
    _remove_others(work, sessions)
    kept = sum(pc.sum(t.closures["kept"]).as_py() or 0 for t in tables)
    frames = {read_metadata(work.optimized_trajectory(name))["frame"] for name in sessions}
    return OptimiseReport(
        len(sessions), closures.num_rows, closures.num_rows - kept, len(frames), solved
    )


@one_writer
def merge_maps(work: Workspace) -> list[MergedFrame]:
    """Write the map of each frame and its changes. WorkspaceError before ``optimise``."""
    frames: dict[str, list[SessionMap]] = {}
    for folder in work.chosen(()):
        frame = str(read_metadata(work.optimized_trajectory(folder.name))["frame"])
        frames.setdefault(frame, []).append(SessionMap(folder))
    merged = []
    for done, (frame, sessions) in enumerate(sorted(frames.items())):
        _check_one_voxel_size(sessions)
        metadata = {
            **origin(),
            "voxel_size": sessions[0].json["voxel_size"],
            "frame": frame,
            "sessions": [session.folder.name for session in sessions],
        }
        voxels, changed = write_merged_map(work, frame, sessions, metadata)
        merged.append(MergedFrame(frame, voxels, changed))
        report_progress("optimize", frame, done + 1, len(frames), "maps")
    return merged


def _check_one_voxel_size(sessions: Sequence[SessionMap]) -> None:
    sizes = {float(session.json["voxel_size"]) for session in sessions}
    if len(sizes) > 1:
        listed = ", ".join(f"{size:g}" for size in sorted(sizes))
        raise WorkspaceError(
            f"Sessions have voxels of {listed} m, which do not make one map: fuse them again with"
            " one fusion.voxel_size."
        )


def _solve(
    work: Workspace,
    group: _Group,
    settings: Resolved,
    metadata: dict[str, object],
    *,
    covariances: bool,
) -> GroupTables:
    graph = pose_graph_of(group.sessions, group.closures, settings.optimize)
    optimised = optimise_graph(graph, settings.optimize, covariances=covariances)
    content = {**metadata, "fingerprint": group.fingerprint, "method": optimised.method.value}
    write_trajectories(work, group.sessions, optimised, content)
    return tables_of(optimised, group.closures)


def _is_up_to_date(work: Workspace, group: _Group, earlier: EarlierTables) -> bool:
    if group.fingerprint not in earlier.fingerprints:
        return False
    try:
        written = [read_metadata(work.optimized_trajectory(name)) for name in group.sessions]
    except WorkspaceError:
        return False
    return all(metadata.get("fingerprint") == group.fingerprint for metadata in written)


def _remove_others(work: Workspace, sessions: Sequence[str] | Sessions) -> None:
    """Trajectories of sessions that were removed or renamed."""
    for path in sorted(work.optimized.glob("*.parquet")):
        if path.stem not in sessions:
            path.unlink()


def _closures_between(work: Workspace, sessions: Sessions) -> pa.Table:
    """The rows of closures.parquet whose sessions are there."""
    table = read_table(work.closures)
    names = pa.array(list(sessions), pa.string())
    known = (pc.is_in(table[f"{end}_session"], names) for end in ("query", "target"))
    return table.filter(pc.and_(*known)).combine_chunks()


def _groups(
    sessions: Sessions, closures: pa.Table, settings: Resolved, *, covariances: bool
) -> list[_Group]:
    """Sessions that any closures connect, in the order of their first."""
    names = list(sessions)
    number = {name: k for k, name in enumerate(names)}
    query, target = (
        np.array([number[n] for n in closures[f"{end}_session"].to_pylist()], np.int64)
        for end in ("query", "target")
    )
    links = coo_matrix((np.ones(len(query)), (query, target)), (len(names), len(names)))
    _, label = connected_components(links, directed=False)
    _, firsts = np.unique(label, return_index=True)
    groups = []
    for first in sorted(firsts.tolist()):
        members = np.flatnonzero(label == label[first])
        rows = np.flatnonzero(label[query] == label[first])
        own = {names[k]: sessions[names[k]] for k in members}
        part = closures.take(rows)
        groups.append(_Group(own, rows, part, _fingerprint(own, part, settings, covariances)))
    return groups


def _fingerprint(
    sessions: Sessions, closures: pa.Table, settings: Resolved, covariances: bool
) -> str:
    fused = [f"{n} {recorded_fingerprint(s.folder.session_json)}" for n, s in sessions.items()]
    rows = [repr(row) for row in closures.to_pylist()]
    return fingerprint_of((settings.fingerprint("optimize"), str(covariances), *fused, *rows))
