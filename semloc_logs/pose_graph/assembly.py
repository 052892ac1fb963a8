"""The pose graph of a workspace, from its keyframes and its closures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from semloc_logs.closures.closure_tables import keyframe_at
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.pose_graph.graph import (
    NO_POSITIONS,
    Chain,
    Datum,
    Loops,
    PoseGraph,
    Positions,
)
from semloc_logs.pose_graph.satellite_fixes import datum_of, positions_of, read_fixes
from semloc_logs.settings import ResolvedOptimize
from semloc_logs.voxels.store import poses_of


def pose_graph_of(
    sessions: Mapping[str, SessionMap], closures: pa.Table, settings: ResolvedOptimize
) -> PoseGraph:
    """The graph of ``sessions`` with the rows of closures.parquet between them.

    Of a session without poses, the keyframes that have a closure are chains of their own. Satellite
    fixes are relative to the first one of the first session that has any.
    """
    ends = {end: _keyframes(sessions, closures, end) for end in ("target", "query")}
    chains: list[Chain] = []
    vertex: dict[tuple[str, int], int] = {}
    for name, session in sessions.items():
        used = sorted({k for pairs in ends.values() for n, k in pairs if n == name})
        first = len(vertex)
        if session.posed:
            chains.append(_chain(name, session, np.arange(len(session.stamps_ns))))
            used = list(range(len(session.stamps_ns)))
        else:
            chains += [_chain(name, session, np.array([k])) for k in used]
        vertex |= {(name, k): first + i for i, k in enumerate(used)}
    loops = Loops(
        np.array([vertex[end] for end in ends["target"]], np.int64),
        np.array([vertex[end] for end in ends["query"]], np.int64),
        poses_of(closures),
        np.array(closures["covariance"].to_pylist(), float).reshape(-1, 6, 6),
        np.asarray(closures["probability"].to_numpy()),
    )
    graph = PoseGraph(chains, loops)
    return _with_fixes(graph, sessions, settings) if settings.gnss else graph


def _with_fixes(
    graph: PoseGraph, sessions: Mapping[str, SessionMap], settings: ResolvedOptimize
) -> PoseGraph:
    datum: Datum | None = None
    parts = [NO_POSITIONS]
    for first, chain in zip(graph.first, graph.chains, strict=True):
        fixes = read_fixes(sessions[chain.name])
        if fixes is None:
            continue
        datum = datum or datum_of(fixes)
        own = positions_of(sessions[chain.name], fixes, datum, settings.gnss_sigma)
        parts.append(replace(own, vertices=own.vertices + first))
    joined = Positions(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.antenna for part in parts]),
        np.concatenate([part.position for part in parts]),
        np.concatenate([part.sigma for part in parts]),
    )
    return replace(graph, fixes=joined, datum=datum)


def _keyframes(
    sessions: Mapping[str, SessionMap], closures: pa.Table, end: str
) -> list[tuple[str, int]]:
    """Session and keyframe at one end of each closure."""
    names = closures[f"{end}_session"].to_pylist()
    stamps_ns = closures[f"{end}_stamp_ns"].to_pylist()
    return [(n, keyframe_at(sessions[n], t)) for n, t in zip(names, stamps_ns, strict=True)]


def _chain(name: str, session: SessionMap, keyframes: NDArray[np.int64]) -> Chain:
    return Chain(
        name,
        session.stamps_ns[keyframes],
        session.map_T_base[keyframes],
        session.distance[keyframes],
        level=not session.json["gravity"]["assumed"],
    )
