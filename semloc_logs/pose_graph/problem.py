"""The graph that is solved: vertices every few metres of road, and not every keyframe.

A closure is moved to the nearest vertex along its session's odometry.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64, I64
from semloc_logs.numerics.transforms import inverse
from semloc_logs.pose_graph.graph import (
    NO_POSITIONS,
    Loops,
    PoseGraph,
    Positions,
    turned_covariance,
)
from semloc_logs.pose_graph.odometry_noise import OdometryNoise
from semloc_logs.settings import ResolvedOptimize

COARSE = 4
MOST_COARSE = 10_000  # vertices of a coarse problem, but for the ends of sessions


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """Relative poses ``a_T_b`` (m, 4, 4) of the vertices ``b`` in the vertices ``a``.

    ``root`` (m, 6, 6) are square roots of their information: ``root @ error`` has unit variance,
    for errors (x y z rotation-x rotation-y rotation-z) in the axes of ``b``.
    """

    a: I64
    b: I64
    a_T_b: F64
    root: F64

    def __len__(self) -> int:
        return len(self.a)

    def part(self, rows: NDArray[np.bool_]) -> Edges:
        """Some of the edges."""
        return Edges(self.a[rows], self.b[rows], self.a_T_b[rows], self.root[rows])

    def joined(self, others: Edges) -> Edges:
        """These edges, then the others."""
        return Edges(
            np.concatenate([self.a, others.a]),
            np.concatenate([self.b, others.b]),
            np.concatenate([self.a_T_b, others.a_T_b]),
            np.concatenate([self.root, others.root]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Directions:
    """Where up is in the base frames (g, 3) of some ``vertices`` (g,), to ``sigma`` radians."""

    vertices: I64
    up: F64
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """``kept`` are the graph's vertices (v,) that are solved for, ``chain`` (v,) their sessions.

    ``odometry`` connects neighbours of a chain, ``loops`` are in the order of the closures.
    ``spacing`` is the setting of the spacing of vertices, metres; ``fixes`` hold some vertices.
    """

    kept: I64
    chain: I64
    odometry: Edges
    loops: Edges
    up: Directions
    spacing: float
    fixes: Positions = NO_POSITIONS


def with_fixes(problem: Problem, graph: PoseGraph, settings: ResolvedOptimize) -> Problem:
    """``problem`` with the fixes of ``graph``, moved to the nearest vertices; one for each."""
    fixes = graph.fixes
    vertex = nearest_kept(graph, problem.kept, fixes.vertices)
    road = np.abs(graph.distance[problem.kept[vertex]] - graph.distance[fixes.vertices])
    order = np.lexsort((road, vertex))
    _, first = np.unique(vertex[order], return_index=True)
    rows = order[first]
    own_T_keyframe = (
        inverse(graph.map_T_base[problem.kept[vertex[rows]]])
        @ graph.map_T_base[fixes.vertices[rows]]
    )
    antenna = np.einsum("nij,nj->ni", own_T_keyframe[:, :3, :3], fixes.antenna[rows])
    antenna += own_T_keyframe[:, :3, 3]
    drift = OdometryNoise.of(settings).position_variance(road[rows])
    sigma = np.sqrt(fixes.sigma[rows] ** 2 + drift[:, None])
    return replace(problem, fixes=Positions(vertex[rows], antenna, fixes.position[rows], sigma))


def coarse_problem(graph: PoseGraph, settings: ResolvedOptimize) -> Problem:
    """Thin ``graph`` to vertices that are COARSE times the vertex spacing apart, or farther.

    It is small enough for many solutions.
    """
    road = sum(float(chain.distance[-1]) for chain in graph.chains if len(chain))
    spacing = max(COARSE * settings.vertex_spacing, road / MOST_COARSE)
    return _problem(graph, settings, _kept(graph, spacing))


def fine_problem(graph: PoseGraph, settings: ResolvedOptimize) -> Problem:
    """Thin ``graph`` to a vertex where closures end, at most one in ``vertex_spacing`` metres.

    Elsewhere there is one in COARSE times as much road.
    """
    kept = _kept(graph, COARSE * settings.vertex_spacing)
    narrow = _starts(graph, settings.vertex_spacing)
    ends = np.concatenate([graph.loops.target, graph.loops.query])
    return _problem(
        graph, settings, np.union1d(kept, narrow[np.searchsorted(narrow, ends, "right") - 1])
    )


def _problem(graph: PoseGraph, settings: ResolvedOptimize, kept: I64) -> Problem:
    noise = OdometryNoise.of(settings)
    odometry = _odometry(graph, kept, noise)
    loops = _moved_loops(graph, kept, noise, settings)
    up = _up(graph, kept, settings)
    return Problem(kept, graph.chain_of[kept], odometry, loops, up, settings.vertex_spacing)


def _kept(graph: PoseGraph, spacing: float) -> I64:
    """The first vertex of each ``spacing`` metres of road, and the last one of each session."""
    last = graph.first + np.array([len(chain) for chain in graph.chains], np.int64) - 1
    return np.union1d(_starts(graph, spacing), last)


def _starts(graph: PoseGraph, spacing: float) -> I64:
    """The first vertex of each ``spacing`` metres of road of each session."""
    stretch = np.floor(graph.distance / spacing)
    is_new = np.diff(stretch, prepend=-1) != 0
    is_first = np.diff(graph.chain_of, prepend=-1) != 0
    return np.flatnonzero(is_new | is_first)


def _odometry(graph: PoseGraph, kept: I64, noise: OdometryNoise) -> Edges:
    chain = graph.chain_of[kept]
    a = np.flatnonzero(chain[1:] == chain[:-1])
    b = a + 1
    poses = graph.map_T_base[kept]
    road = graph.distance[kept[b]] - graph.distance[kept[a]]
    root = np.zeros((len(a), 6, 6))
    axis = np.arange(3)
    root[:, axis, axis] = (1.0 / np.sqrt(noise.position_variance(road)))[:, None]
    root[:, axis + 3, axis + 3] = (1.0 / np.sqrt(noise.turn_variance(road)))[:, None]
    return Edges(a, b, inverse(poses[a]) @ poses[b], root)


def _moved_loops(
    graph: PoseGraph, kept: I64, noise: OdometryNoise, settings: ResolvedOptimize
) -> Edges:
    """The closures, moved along the road to the nearest vertices that are kept."""
    loops = graph.loops
    target = nearest_kept(graph, kept, loops.target)
    query = nearest_kept(graph, kept, loops.query)
    poses = graph.map_T_base
    to_target = inverse(poses[kept[target]]) @ poses[loops.target]
    to_query = inverse(poses[loops.query]) @ poses[kept[query]]
    covariance = _in_axes_of_query(loops) + _floor(settings)
    moved = np.abs(graph.distance[kept[target]] - graph.distance[loops.target])
    moved = moved + np.abs(graph.distance[kept[query]] - graph.distance[loops.query])
    axis = np.arange(3)
    covariance[:, axis, axis] += noise.position_variance(moved)[:, None]
    covariance[:, axis + 3, axis + 3] += noise.turn_variance(moved)[:, None]
    # into the axes of the vertex
    covariance = turned_covariance(np.swapaxes(to_query[:, :3, :3], 1, 2), covariance)
    root = np.swapaxes(np.linalg.cholesky(np.linalg.inv(covariance)), 1, 2)
    return Edges(target, query, to_target @ loops.target_T_query @ to_query, root)


def _floor(settings: ResolvedOptimize) -> F64:
    """What maps and poses of a place add to the covariance of a closure (6, 6)."""
    sigma = [settings.closure_sigma] * 3 + [float(np.radians(settings.closure_sigma_deg))] * 3
    return np.diag(np.square(sigma))


def _in_axes_of_query(loops: Loops) -> F64:
    """Covariances (m, 6, 6) with increments in the query's axes instead of the target's."""
    query_R_target = np.swapaxes(loops.target_T_query[:, :3, :3], 1, 2)
    return turned_covariance(query_R_target, loops.covariance)


def nearest_kept(graph: PoseGraph, kept: I64, vertices: I64) -> I64:
    """Index into ``kept`` of the vertex of the same session that is nearest along the road."""
    after = np.clip(np.searchsorted(kept, vertices), 0, len(kept) - 1)
    before = np.clip(np.searchsorted(kept, vertices, "right") - 1, 0, len(kept) - 1)
    same_after = graph.chain_of[kept[after]] == graph.chain_of[vertices]
    to_after = np.abs(graph.distance[kept[after]] - graph.distance[vertices])
    to_before = np.abs(graph.distance[kept[before]] - graph.distance[vertices])
    return np.where(same_after & (to_after < to_before), after, before)


def _up(graph: PoseGraph, kept: I64, settings: ResolvedOptimize) -> Directions:
    level = np.array([chain.level for chain in graph.chains], bool)
    vertices = np.flatnonzero(level[graph.chain_of[kept]])
    up = graph.map_T_base[kept[vertices]][:, 2, :3]
    return Directions(vertices, up, float(np.radians(settings.gravity_sigma_deg)))
