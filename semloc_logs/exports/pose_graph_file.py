"""The pose graph of sessions and closures as g2o text, for GTSAM, g2o and Ceres."""

from __future__ import annotations

from typing import Any

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.closures.closure_tables import keyframe_at, read_closures
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import inverse, transform
from semloc_logs.pose_graph.g2o import edge_line, vertex_line
from semloc_logs.workspace import Workspace

# fixed part, and part per metre of road
ODOMETRY_SIGMA_M = (0.02, 0.01)
ODOMETRY_SIGMA_RAD = (0.002, 0.002)


def pose_graph(sessions: dict[str, SessionMap], work: Workspace) -> str:
    """g2o text: keyframes as vertices, odometry between neighbours, closures of closures.parquet.

    Each session is in its own map frame. Information is of (x y z, rotation vector in radians) in
    the axes of the edge's second vertex, as GTSAM and Ceres read it. Odometry has no covariance in
    a workspace; it is given 2 cm + 1 % of the road and 2 mrad + 2 mrad/m.
    """
    lines: list[str] = []
    first: dict[str, int] = {}
    count = 0
    for name, session in sessions.items():
        first[name] = count
        count += len(session.stamps_ns)
        lines.append(f"# {name}: vertices {first[name]} .. {count - 1}")
        lines += [vertex_line(first[name] + i, pose) for i, pose in enumerate(session.map_T_base)]
    for name, session in sessions.items():
        if session.posed:
            lines += _odometry(first[name], session.map_T_base)
    for row in read_closures(work.closures) if work.closures.exists() else []:
        if row["query_session"] in sessions and row["target_session"] in sessions:
            query, target = (
                first[row[f"{end}_session"]]
                + keyframe_at(sessions[row[f"{end}_session"]], row[f"{end}_stamp_ns"])
                for end in ("query", "target")
            )
            lines.append(_closure_edge(target, query, row))
    return "\n".join(lines) + "\n"


def _closure_edge(target: int, query: int, row: dict[str, Any]) -> str:
    """The edge of a row of closures.parquet."""
    translation = np.array([row[f"t_{c}"] for c in "xyz"])
    target_T_query = transform(translation, np.array([row[f"q_{c}"] for c in "xyzw"]))
    # from the target's axes into the query's
    turn = np.kron(np.eye(2), target_T_query[:3, :3].T)
    covariance = turn @ np.array(row["covariance"]).reshape(6, 6) @ turn.T
    return edge_line(target, query, target_T_query, np.linalg.inv(covariance))


def _odometry(first: int, poses: F64) -> list[str]:
    """Edges between neighbouring vertices from ``first`` on, at ``poses`` (n, 4, 4)."""
    edges = []
    for i in range(len(poses) - 1):
        step = inverse(poses[i]) @ poses[i + 1]
        road = float(np.linalg.norm(step[:3, 3]))
        sigma = np.repeat([a + b * road for a, b in (ODOMETRY_SIGMA_M, ODOMETRY_SIGMA_RAD)], 3)
        information = np.linalg.inv(np.diag(sigma**2))
        edges.append(edge_line(first + i, first + i + 1, step, information))
    return edges
