"""optimized/: trajectories in common frames, and what became of each closure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import inverse
from semloc_logs.pose_graph.carried_poses import SolvedPoses
from semloc_logs.pose_graph.graph import PoseGraph
from semloc_logs.pose_graph.optimisation import Optimised, Verdict
from semloc_logs.tables import contracts
from semloc_logs.tables.table import read_table, write_table
from semloc_logs.voxels.store import pose_columns, poses_of
from semloc_logs.workspace import Workspace

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


def write_trajectories(
    work: Workspace,
    sessions: Mapping[str, SessionMap],
    graph: PoseGraph,
    optimised: Optimised,
    metadata: Mapping[str, Any],
) -> None:
    """optimized/SESSION.parquet of every session that has poses in a common frame."""
    frames = _frames(graph, optimised)
    chains: dict[str, list[int]] = {}
    for k, chain in enumerate(graph.chains):
        chains.setdefault(chain.name, []).append(k)
    for name, session in sessions.items():
        stamps_ns, poses = _session_poses(session, graph, optimised, chains.get(name, []))
        component = int(optimised.component[chains[name][0]]) if name in chains else -1
        content = {**metadata, "component": component, "frame": frames.get(component, name)}
        table = contracts.table("optimized", {"stamp_ns": stamps_ns, **pose_columns(poses)})
        write_table(work.optimized_trajectory(name), table, content, ("stamp_ns",))


def _frames(graph: PoseGraph, optimised: Optimised) -> dict[int, str]:
    """The session whose map frame each component has."""
    frames: dict[int, str] = {}
    for chain, component in zip(graph.chains, optimised.component, strict=True):
        frames.setdefault(int(component), chain.name)
    return frames


def _session_poses(
    session: SessionMap, graph: PoseGraph, optimised: Optimised, chains: list[int]
) -> tuple[I64, F64]:
    """Stamps (n,) and poses (n, 4, 4) of a session: its whole trajectory, or its keyframes."""
    rows = [graph.first[k] + np.arange(len(graph.chains[k])) for k in chains]
    vertices = np.concatenate([np.zeros(0, np.int64), *rows])
    solved = optimised.common_T_base[vertices]
    stamps_ns = np.concatenate(
        [np.zeros(0, np.int64), *(graph.chains[k].stamps_ns for k in chains)]
    )
    table = read_table(session.folder.trajectory)
    if not session.posed or not table.num_rows or not len(vertices):
        return stamps_ns, solved
    map_T_session = inverse(np.array(session.json["session_T_map"], float))
    known_ns, rows_of = np.unique(stamps_ns, return_index=True)
    keyframes = SolvedPoses(
        (known_ns - known_ns[0]) * 1e-9, session.map_T_base[rows_of], solved[rows_of]
    )
    trajectory_ns = np.asarray(table["stamp_ns"].to_numpy())
    seconds = (trajectory_ns - known_ns[0]) * 1e-9
    return trajectory_ns, keyframes.carried(seconds, map_T_session @ poses_of(table))


def write_closure_verdicts(
    work: Workspace,
    closures: pa.Table,
    graph: PoseGraph,
    optimised: Optimised,
    metadata: Mapping[str, Any],
) -> None:
    """optimized/graph/closures.parquet: one row for each of ``closures``."""
    loops = graph.loops
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
    write_table(work.graph_closures, contracts.table("graph_closures", columns), dict(metadata))


def _reason(verdict: Verdict) -> str:
    return "" if verdict is Verdict.KEPT else verdict.value
