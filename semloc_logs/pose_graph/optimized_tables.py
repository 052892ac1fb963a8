"""optimized/: trajectories in common frames, the graph, and what became of each closure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64, I64
from semloc_logs.errors import WorkspaceError
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import inverse
from semloc_logs.pose_graph.carried_poses import SolvedPoses
from semloc_logs.pose_graph.g2o import edge_lines, vertex_line
from semloc_logs.pose_graph.graph import PoseGraph
from semloc_logs.pose_graph.optimisation import Optimised, Verdict
from semloc_logs.pose_graph.problem import Problem
from semloc_logs.tables import contracts
from semloc_logs.tables.atomic_files import replacing_file
from semloc_logs.tables.table import read_metadata, read_table, write_table
from semloc_logs.voxels.store import pose_columns, poses_of
from semloc_logs.workspace import Workspace

Metadata = Mapping[str, Any]
DATUM = "datum_lat_lon_height"


@dataclass(frozen=True, slots=True, eq=False)
class GroupTables:
    """The graph of sessions that closures connect, and the rows that tables have of it.

    ``vertices`` are without their numbers, ``closures`` in the order of closures.parquet.
    """

    graph: PoseGraph
    problem: Problem
    vertices: pa.Table
    closures: pa.Table


def tables_of(optimised: Optimised, closures: pa.Table) -> GroupTables:
    """The rows of a group that was solved, from its rows of closures.parquet."""
    graph = optimised.graph
    chains = graph.chain_of[optimised.problem.kept]
    covariance = optimised.covariance
    if covariance is None:
        covariance = np.full((len(chains), 6, 6), np.nan)
    stamps_ns = np.concatenate([np.zeros(0, np.int64), *(c.stamps_ns for c in graph.chains)])
    vertices = {
        "vertex": np.zeros(len(chains), np.int32),
        "session": [graph.chains[k].name for k in chains],
        "stamp_ns": stamps_ns[optimised.problem.kept],
        **pose_columns(optimised.solved),
        "covariance": [*covariance.reshape(-1, 36)],
    }
    return GroupTables(
        graph,
        optimised.problem,
        contracts.table("vertices", vertices),
        _closure_rows(optimised, closures),
    )


def _closure_rows(optimised: Optimised, closures: pa.Table) -> pa.Table:
    loops = optimised.graph.loops
    poses = optimised.common_T_base
    error = inverse(loops.target_T_query) @ inverse(poses[loops.target]) @ poses[loops.query]
    turns = Rotation.from_matrix(error[:, :3, :3].reshape(-1, 3, 3)).magnitude()
    names = ("query_session", "target_session", "query_stamp_ns", "target_stamp_ns")
    columns = {
        **{name: closures[name].combine_chunks() for name in names},
        "kept": optimised.kept,
        "reason": [_reason(verdict) for verdict in optimised.verdict],
        "error_m": np.linalg.norm(error[:, :3, 3], axis=1),
        "error_deg": np.degrees(turns),
        "squared_error": optimised.squared_error,
    }
    return contracts.table("graph_closures", columns)


def _reason(verdict: Verdict) -> str:
    return "" if verdict is Verdict.KEPT else verdict.value


def write_graph(
    work: Workspace, groups: Sequence[GroupTables], order: I64, metadata: Metadata
) -> None:
    """optimized/graph/ and graph.g2o of all groups.

    ``order`` sorts the closures of all groups, one group after the other, as closures.parquet.
    """
    first = 0
    vertices = []
    lines = []
    edges = []
    for group in groups:
        count = group.vertices.num_rows
        numbers = pa.array(np.arange(first, first + count), pa.int32())
        vertices.append(group.vertices.set_column(0, group.vertices.schema.field(0), numbers))
        poses = poses_of(group.vertices)
        lines += [vertex_line(first + k, pose) for k, pose in enumerate(poses)]
        edges += edge_lines(group.problem.odometry, first)
        kept = np.array(group.closures["kept"].to_pylist(), bool)
        edges += edge_lines(group.problem.loops.part(kept), first)
        first += count
    text = "\n".join([*lines, *edges, ""])
    with replacing_file(work.graph_file) as temporary:
        temporary.write_text(text)
    closures = _joined("graph_closures", [group.closures for group in groups]).take(order)
    write_table(work.graph_vertices, _joined("vertices", vertices), dict(metadata))
    # it comes last: with its fingerprints it vouches for the others
    write_table(work.graph_closures, closures, dict(metadata))


def _joined(name: str, parts: Sequence[pa.Table]) -> pa.Table:
    return pa.concat_tables([contracts.schema(name).empty_table(), *parts]).combine_chunks()


@dataclass(frozen=True, slots=True, eq=False)
class EarlierTables:
    """What the optimisation before wrote, and the ``fingerprints`` of its groups."""

    fingerprints: frozenset[str]
    vertices: pa.Table
    closures: pa.Table

    def rows_of(self, graph: PoseGraph, problem: Problem) -> GroupTables:
        """The rows of a group that did not change."""
        names = pa.array(sorted({chain.name for chain in graph.chains}), pa.string())
        vertices = self.vertices.filter(pc.is_in(self.vertices["session"], names))
        closures = self.closures.filter(pc.is_in(self.closures["query_session"], names))
        return GroupTables(graph, problem, vertices, closures)


def read_earlier(work: Workspace) -> EarlierTables | None:
    """The tables of the optimisation before; None where they are missing or damaged."""
    try:
        metadata = read_metadata(work.graph_closures)
        return EarlierTables(
            frozenset(metadata["groups"]),
            read_table(work.graph_vertices),
            read_table(work.graph_closures),
        )
    except (WorkspaceError, KeyError):
        return None


def write_trajectories(
    work: Workspace,
    sessions: Mapping[str, SessionMap],
    optimised: Optimised,
    metadata: Metadata,
) -> None:
    """optimized/SESSION.parquet of the ``sessions``; its ``frame`` names whose map frame it is.

    Where satellites place the frame, it is east, north, up of ``datum_lat_lon_height`` instead.
    """
    in_enu = set(optimised.component[optimised.is_enu].tolist())
    graph = optimised.graph
    poses = optimised.common_T_base
    frames: dict[int, str] = {}
    rows: dict[str, list[I64]] = {}
    component: dict[str, int] = {}
    for k, chain in enumerate(graph.chains):
        number = int(optimised.component[k])
        frames.setdefault(number, chain.name)
        # keyframes without odometry between them may lie in several frames: the first one's count
        if component.setdefault(chain.name, number) == number:
            vertices = graph.first[k] + np.arange(len(chain))
            rows.setdefault(chain.name, []).append(vertices)
    stamps_ns = np.concatenate([np.zeros(0, np.int64), *(c.stamps_ns for c in graph.chains)])
    for name, session in sessions.items():
        own = np.concatenate([np.zeros(0, np.int64), *rows.get(name, [])])
        stamps, placed = _trajectory(session, stamps_ns[own], poses[own])
        number = component.get(name, -1)
        datum = graph.datum if number in in_enu else None
        content = {**metadata, "frame": frames.get(number, name), DATUM: datum}
        table = contracts.table("optimized", {"stamp_ns": stamps, **pose_columns(placed)})
        write_table(work.optimized_trajectory(name), table, content, ("stamp_ns",))


def _trajectory(session: SessionMap, stamps_ns: I64, solved: F64) -> tuple[I64, F64]:
    """Stamps (n,) and poses (n, 4, 4): the whole trajectory, or without odometry the keyframes."""
    table = read_table(session.folder.trajectory)
    if not session.posed or not table.num_rows or not len(stamps_ns):
        return stamps_ns, solved
    map_T_session = inverse(np.array(session.json["session_T_map"], float))
    known_ns, rows = np.unique(stamps_ns, return_index=True)
    place = (known_ns - known_ns[0]) * 1e-9
    keyframes = SolvedPoses(place, session.map_T_base[rows], solved[rows])
    trajectory_ns = np.asarray(table["stamp_ns"].to_numpy())
    seconds = (trajectory_ns - known_ns[0]) * 1e-9
    return trajectory_ns, keyframes.carried(seconds, map_T_session @ poses_of(table))
