"""Lines of g2o text.

Information is of (x y z, rotation vector in radians) in the axes of the edge's second vertex, as
GTSAM and Ceres read it.
"""

from __future__ import annotations

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.numerics.transforms import translation_quaternion
from semloc_logs.pose_graph.problem import Edges


def vertex_line(number: int, pose: F64) -> str:
    """VERTEX_SE3:QUAT of a pose (4, 4)."""
    return f"VERTEX_SE3:QUAT {number} {_pose_text(pose)}"


def edge_line(a: int, b: int, a_T_b: F64, information: F64) -> str:
    """EDGE_SE3:QUAT of a relative pose (4, 4) and its information (6, 6)."""
    upper = information[np.triu_indices(6)]
    return f"EDGE_SE3:QUAT {a} {b} {_pose_text(a_T_b)} " + " ".join(f"{x:.9g}" for x in upper)


def edge_lines(edges: Edges, first: int) -> list[str]:
    """Lines of edges between vertices that are numbered from ``first`` on."""
    information = np.swapaxes(edges.root, 1, 2) @ edges.root
    return [
        edge_line(first + int(a), first + int(b), pose, matrix)
        for a, b, pose, matrix in zip(edges.a, edges.b, edges.a_T_b, information, strict=True)
    ]


def _pose_text(pose: F64) -> str:
    t, q = translation_quaternion(pose)
    return " ".join(f"{x:.9g}" for x in (*t, *q))
