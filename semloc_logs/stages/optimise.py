"""Maps and closures -> all sessions in one frame."""

from __future__ import annotations

from dataclasses import dataclass

import pyarrow as pa
import pyarrow.compute as pc

import semloc_logs
from semloc_logs.errors import WorkspaceError
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.pose_graph.assembly import pose_graph_of
from semloc_logs.pose_graph.optimisation import optimise_graph
from semloc_logs.pose_graph.optimized_tables import write_closure_verdicts, write_trajectories
from semloc_logs.settings import Resolved
from semloc_logs.stages.lock import one_writer
from semloc_logs.tables.table import read_metadata, read_table
from semloc_logs.workspace import Workspace


@dataclass(frozen=True, slots=True)
class OptimiseReport:
    """Sessions, closures, how many of these were refused, frames, and the method that decided."""

    sessions: int
    closures: int
    rejected: int
    components: int
    method: str


@one_writer
def optimise(work: Workspace, settings: Resolved) -> OptimiseReport:
    """Write optimized/. WorkspaceError without closures.parquet, SemlocError without GTSAM."""
    sessions = {folder.name: SessionMap(folder) for folder in work.chosen(())}
    if not work.closures.exists():
        raise WorkspaceError(f"{work.path} has no closures yet: run 'semloc close' first.")
    closures = _closures_between(work, sessions)
    graph = pose_graph_of(sessions, closures)
    optimised = optimise_graph(graph, settings.optimize)
    metadata = {
        "schema_version": 1,
        "version": semloc_logs.__version__,
        "closures": read_metadata(work.closures).get("fingerprint"),
        "settings": settings.model_dump(mode="json", include={"optimize"}),
        "method": optimised.method.value,
    }
    write_trajectories(work, sessions, graph, optimised, metadata)
    write_closure_verdicts(work, closures, graph, optimised, metadata)
    return OptimiseReport(
        len(sessions),
        closures.num_rows,
        int((~optimised.kept).sum()),
        int(optimised.component.max(initial=-1)) + 1,
        optimised.method.value,
    )


def _closures_between(work: Workspace, sessions: dict[str, SessionMap]) -> pa.Table:
    """The rows of closures.parquet whose sessions are there."""
    table = read_table(work.closures)
    names = pa.array(list(sessions), pa.string())
    known = (pc.is_in(table[f"{end}_session"], names) for end in ("query", "target"))
    return table.filter(pc.and_(*known))
