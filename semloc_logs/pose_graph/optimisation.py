"""All sessions in one frame: consistent sets, initial poses, a robust solution, and what it says
of each closure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from semloc_logs.arrays import F64, I64, Bools
from semloc_logs.numerics.transforms import inverse
from semloc_logs.pose_graph.carried_poses import SolvedPoses
from semloc_logs.pose_graph.consistent_sets import ConsistentSet, consistent_sets
from semloc_logs.pose_graph.earth_frame import LEAST_FIXES, enu_T_frame
from semloc_logs.pose_graph.graph import PoseGraph, turned_covariance
from semloc_logs.pose_graph.initial_poses import place_sessions
from semloc_logs.pose_graph.problem import Problem, coarse_problem, fine_problem, with_fixes
from semloc_logs.pose_graph.solver import BOUND, Method, Solution, Solver
from semloc_logs.settings import ResolvedOptimize

# closures of two sessions that agree, from which on the ones that do not are doubted
CONFIRMED = 3
SAME_PLACE_M = 1e-6  # keeps keyframes of one place in order
READMISSIONS = 3  # times that refused closures which fit the solution come back


class Verdict(Enum):
    """What became of a closure."""

    KEPT = "kept"
    INCONSISTENT = "contradicts the other closures of these two sessions"
    OUTLIER = "contradicts the other sessions and closures"


@dataclass(frozen=True, slots=True, eq=False)
class Optimised:
    """Poses ``solved`` (v, 4, 4) of the vertices of ``problem``, which thins ``graph``.

    ``component`` (k,) tells which chains share a frame: the map frame of their first, or where
    ``is_enu`` (k,) east, north, up of the graph's datum. ``verdict``
    (m,) and ``squared_error`` (m,), whitened, are of the closures, ``covariance`` (v, 6, 6) of the
    poses, if it was requested.
    """

    graph: PoseGraph
    problem: Problem
    solved: F64
    component: I64
    is_enu: Bools
    verdict: list[Verdict]
    squared_error: F64
    method: Method
    covariance: F64 | None = None

    @property
    def kept(self) -> Bools:
        """Which closures (m,) hold."""
        return np.array([verdict is Verdict.KEPT for verdict in self.verdict], bool)

    @property
    def common_T_base(self) -> F64:
        """Poses (n, 4, 4) of all vertices of the graph."""
        return _all_poses(self.graph, self.problem, self.solved)


def optimise_graph(
    graph: PoseGraph, settings: ResolvedOptimize, *, covariances: bool = False
) -> Optimised:
    """Solve ``graph``. SemlocError where GTSAM is not installed."""
    sets = consistent_sets(graph, settings)
    consistent = _consistent(graph, sets)
    placement = place_sessions(graph, sets)
    placed = placement.common_T_map[graph.chain_of] @ graph.map_T_base

    # a coarse graph tells closures apart, a fine one has the poses
    coarse = coarse_problem(graph, settings)
    solver = Solver(coarse, placement.component[coarse.chain], placed[coarse.kept])
    rough = solver.solve(placed[coarse.kept], consistent.astype(float), settings.seconds)
    carried = _all_poses(graph, coarse, rough.common_T_base)
    located = _located(graph, carried, placement.component)
    carried = located.poses
    problem = with_fixes(fine_problem(graph, settings), located.graph, settings)
    solver = Solver(problem, placement.component[problem.chain], carried[problem.kept])
    solution = solver.refined(carried[problem.kept], rough.weight)
    solution = _readmitted(solver, solution)
    kept = solution.weight > 0.5
    verdict = [
        Verdict.KEPT if k else Verdict.OUTLIER if c else Verdict.INCONSISTENT
        for k, c in zip(kept, consistent, strict=True)
    ]
    component = _components(graph, kept)
    is_enu = _have_fixes(located.graph, component)
    common_T_solved = _to_own_frames(graph, problem, solution.common_T_base, component)
    common_T_solved[is_enu[problem.chain]] = np.eye(4)
    covariance = None
    if covariances:
        marginal = solver.covariances(solution.common_T_base, solution.weight)
        covariance = turned_covariance(common_T_solved[:, :3, :3], marginal)
    return Optimised(
        graph,
        problem,
        common_T_solved @ solution.common_T_base,
        component,
        is_enu,
        verdict,
        solution.squared_error,
        rough.method,
        covariance,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Located:
    """The graph with the fixes of frames that satellites align, and poses (n, 4, 4) in these."""

    graph: PoseGraph
    poses: F64


def _located(graph: PoseGraph, poses: F64, component: I64) -> _Located:
    """Frames of components onto east, north, up, where fixes tell their heading."""
    out = poses.copy()
    of_vertex = component[graph.chain_of]
    of_fix = of_vertex[graph.fixes.vertices]
    is_used = np.zeros(len(graph.fixes), bool)
    for number in np.unique(of_fix):
        own = of_fix == number
        enu_T_common = enu_T_frame(poses, graph.fixes.part(own))
        if enu_T_common is not None:
            is_used |= own
            out[of_vertex == number] = enu_T_common @ poses[of_vertex == number]
    return _Located(replace(graph, fixes=graph.fixes.part(is_used)), out)


def _have_fixes(graph: PoseGraph, component: I64) -> Bools:
    """Chains (k,) whose component has enough fixes to lie in east, north, up."""
    of_fix = component[graph.chain_of[graph.fixes.vertices]]
    counts = np.bincount(of_fix, minlength=int(component.max(initial=-1)) + 1)
    return np.asarray(counts[component] >= LEAST_FIXES)


def _consistent(graph: PoseGraph, sets: list[ConsistentSet]) -> Bools:
    """The closures (m,) of each pair of sessions that do not contradict several others of it."""
    consistent = np.ones(len(graph.loops), bool)
    for pair in sets:
        if len(pair.members) >= CONFIRMED:
            consistent[pair.others] = False
    return consistent


def _readmitted(solver: Solver, solution: Solution) -> Solution:
    """The solution with every closure that fits it, and without those that do not any more."""
    for _ in range(READMISSIONS):
        fits = solution.squared_error <= BOUND
        if np.array_equal(fits, solution.weight > 0.5):
            break
        solution = solver.refined(solution.common_T_base, fits.astype(float))
    return solution


def _components(graph: PoseGraph, kept: Bools) -> I64:
    """Chains (k,) that closures connect, numbered by their first."""
    count = len(graph.chains)
    a = graph.chain_of[graph.loops.target[kept]]
    b = graph.chain_of[graph.loops.query[kept]]
    links = coo_matrix((np.ones(len(a)), (a, b)), (count, count))
    _, labels = connected_components(links, directed=False)
    _, first, numbers = np.unique(labels, return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(first))[numbers], np.int64)


def _to_own_frames(graph: PoseGraph, problem: Problem, poses: F64, component: I64) -> F64:
    """Transforms (v, 4, 4) of solved poses into the map frame of their component's first chain."""
    out = np.empty_like(poses)
    of_vertex = component[problem.chain]
    for number in np.unique(of_vertex):
        rows = np.flatnonzero(of_vertex == number)
        first = rows[0]
        out[rows] = graph.map_T_base[problem.kept[first]] @ inverse(poses[first])
    return out


def _all_poses(graph: PoseGraph, problem: Problem, poses: F64) -> F64:
    """Poses (n, 4, 4) of all vertices of the graph."""
    out = np.empty((graph.vertices, 4, 4))
    bounds = np.searchsorted(problem.kept, [*graph.first, graph.vertices])
    for k, (first, chain) in enumerate(zip(graph.first, graph.chains, strict=True)):
        rows = slice(bounds[k], bounds[k + 1])
        known = problem.kept[rows] - first
        # keyframes of several sensors, or of a vehicle that stands, are at one place of the road
        place = chain.distance + SAME_PLACE_M * np.arange(len(chain))
        solved = SolvedPoses(place[known], chain.map_T_base[known], poses[rows])
        out[first : first + len(chain)] = solved.carried(place, chain.map_T_base)
    return out
