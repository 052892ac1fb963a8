"""Robust least squares over the graph by GTSAM: graduated non-convexity, or Cauchy weights.

Yang, Antonante, Tzoumas, Carlone: Graduated Non-Convexity for Robust Spatial Perception, RA-L 2020,
with truncated least squares (their equations 14 and 15). Each step of the schedule solves the
weighted problem from the poses of the step before, so a time limit can end it between two steps.
"""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from enum import Enum
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from semloc_logs.errors import SemlocError
from semloc_logs.numerics.transforms import inverse
from semloc_logs.pose_graph.graph import turned_covariance
from semloc_logs.pose_graph.problem import Edges, Problem

LOGGER = logging.getLogger(__name__)
F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]
# share of right closures whose errors are below the bound, if their covariances are right
INLIER_SHARE = 0.999
BOUND = float(chi2.ppf(INLIER_SHARE, 6))  # squared and whitened error of a right closure
SCHEDULE_STEP = 2.0  # mu grows by so much; the paper takes 1.4 and solves each step to the end
FIRST_ITERATIONS = 6  # of Levenberg-Marquardt before the schedule
STEP_ITERATIONS = 1  # of Levenberg-Marquardt in each step of the schedule
LAST_ITERATIONS = 20  # in the solution that follows
TOLERANCE = 1e-6  # relative decrease of the error that ends it
MOST_STEPS = 100
# vertices that are solved together; beyond, one session after the other, the others held
MOST_TOGETHER = 20_000
SWEEPS = 4  # over all sessions
TURN_ITERATIONS = 5  # for a session in a sweep
BINARY = 1e-3  # a weight that is nearer to 0 or 1 counts as that
# a chain whose closures are all refused stays where it is, to the width of a continent
LOOSE = [1e3, 1e3, 1e3, 3.0, 3.0, 3.0]  # m and rad
ANCHOR_SIGMA = 1e-4  # the first vertex of a component, m and rad
UP_HUBER = 1.345  # Huber's constant for 95 % efficiency: gravity may be wrong in places


class Method(Enum):
    """How closures are told apart."""

    GNC = "gnc"
    CAUCHY = "cauchy"


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Poses ``common_T_base`` (v, 4, 4), and ``weight`` (m,) in [0, 1] of each closure.

    ``squared_error`` (m,) are the whitened errors of the closures at these poses; a right closure
    is below BOUND.
    """

    common_T_base: F64
    weight: F64
    squared_error: F64
    method: Method


def gtsam_library() -> Any:
    """The module; SemlocError where it is not installed."""
    try:
        return import_module("gtsam")
    except ImportError:
        raise SemlocError(
            "semloc optimize needs GTSAM 4.3: run pip install 'semloc_logs[optimize]'."
        ) from None


class Solver:
    """A problem with its factors; ``anchors`` are the vertices that hold the components."""

    def __init__(self, problem: Problem, anchors: NDArray[np.int64], initial: F64) -> None:
        self._gtsam = gtsam_library()
        self._problem = problem
        self._anchors = set(anchors.tolist())
        self._initial = initial
        self._fixed = self._fixed_factors()
        self._ordering: Any = None

    def solve(self, initial: F64, start: F64, seconds: float) -> Solution:
        """From ``initial`` (v, 4, 4) and the weights ``start`` (m,) of the closures.

        After ``seconds`` the schedule is given up for Cauchy weights.
        """
        deadline = time.monotonic() + seconds
        loops = self._problem.loops
        poses = self._solved(initial, start, FIRST_ITERATIONS)
        squared = squared_errors(loops, poses)
        weight = start
        largest = float(squared[start > 0].max(initial=0.0))
        mu = max(1.0 / max(2.0 * largest / BOUND - 1.0, 1e-12), 1e-12)
        if largest <= BOUND:
            mu = 1.0
        for _ in range(MOST_STEPS):
            weight = truncated_weights(squared, mu)
            if _is_binary(weight) and mu >= 1.0:
                break
            if time.monotonic() > deadline:
                LOGGER.warning(
                    "The robust solution took more than %g s: Cauchy weights are used instead."
                    " 'optimize.seconds' sets the limit.",
                    seconds,
                )
                return self.cauchy(initial, start)
            poses = self._solved(poses, weight, STEP_ITERATIONS)
            squared = squared_errors(loops, poses)
            mu *= SCHEDULE_STEP
        return Solution(poses, np.round(weight), squared, Method.GNC)

    def refined(self, initial: F64, weight: F64) -> Solution:
        """Least squares from ``initial`` (v, 4, 4) with given weights of the closures."""
        if len(initial) > MOST_TOGETHER:
            poses = self._solved_in_turn(initial, weight)
        else:
            poses = self._solved(initial, weight, LAST_ITERATIONS)
        return Solution(poses, weight, squared_errors(self._problem.loops, poses), Method.GNC)

    def cauchy(self, initial: F64, start: F64) -> Solution:
        """Weights of a Cauchy distribution, iterated; a closure above the bound is refused."""
        loops = self._problem.loops
        poses = self._solved(initial, start, LAST_ITERATIONS)
        for _ in range(LAST_ITERATIONS):
            weight = 1.0 / (1.0 + squared_errors(loops, poses) / BOUND)
            poses = self._solved(poses, weight, STEP_ITERATIONS)
        weight = (squared_errors(loops, poses) <= BOUND).astype(float)
        poses = self._solved(poses, weight, LAST_ITERATIONS)
        return Solution(poses, weight, squared_errors(loops, poses), Method.CAUCHY)

    def covariances(self, poses: F64, weight: F64) -> F64:
        """Marginal covariances (v, 6, 6) of ``poses`` (v, 4, 4), by the weights of the closures.

        Increments are in the axes of the frame, x y z rotation-x rotation-y rotation-z.
        """
        marginals = self._gtsam.Marginals(
            self._weighted(weight), self._values(poses, slice(0, len(poses)))
        )
        local = np.array([marginals.marginalCovariance(k) for k in range(len(poses))])
        # GTSAM orders a pose's error as rotation, position, in the axes of the pose
        local = np.roll(np.roll(local.reshape(-1, 6, 6), 3, axis=1), 3, axis=2)
        return turned_covariance(poses[:, :3, :3], local)

    def _weighted(self, weight: F64) -> Any:
        """All factors, the closures with these weights."""
        loops = self._problem.loops
        graph = self._gtsam.NonlinearFactorGraph(self._fixed)
        for row in np.flatnonzero(weight > 0).tolist():
            root = loops.root[row] * np.sqrt(weight[row])
            graph.add(_between(self._gtsam, loops, row, root))
        return graph

    def _values(self, poses: F64, rows: slice) -> Any:
        values = self._gtsam.Values()
        for vertex in range(rows.start, rows.stop):
            values.insert(vertex, self._gtsam.Pose3(poses[vertex]))
        return values

    def _solved(self, initial: F64, weight: F64, iterations: int) -> F64:
        """Least squares with these weights of the closures, at most so many iterations."""
        gtsam = self._gtsam
        graph = self._weighted(weight)
        if self._ordering is None:
            self._ordering = gtsam.Ordering.MetisNonlinearFactorGraph(graph)
        every = slice(0, len(initial))
        return self._optimised(graph, initial, every, iterations, self._ordering)

    def _optimised(
        self, graph: Any, poses: F64, rows: slice, iterations: int, ordering: Any = None
    ) -> F64:
        """Poses of the vertices ``rows`` by Levenberg-Marquardt from ``poses`` (v, 4, 4)."""
        gtsam = self._gtsam
        parameters = gtsam.LevenbergMarquardtParams()
        if ordering is not None:
            parameters.setOrdering(ordering)
        parameters.setMaxIterations(iterations)
        parameters.setRelativeErrorTol(TOLERANCE)
        values = self._values(poses, rows)
        solved = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
        return np.array([solved.atPose3(k).matrix() for k in range(rows.start, rows.stop)])

    def _solved_in_turn(self, initial: F64, weight: F64) -> F64:
        """The same by Gauss-Seidel sweeps over the sessions, for a start that is nearly right.

        With the other sessions held, a session is a chain, so time and memory grow with its length
        only; many sessions of the same road would fill the matrix of a common solution.
        """
        poses = initial.copy()
        chain = self._problem.chain
        bounds = np.searchsorted(chain, np.arange(chain[-1] + 2))
        fixed = [self._fixed_factors_of(k) for k in range(len(bounds) - 1)]
        for _ in range(SWEEPS):
            for k, factors in enumerate(fixed):
                graph = self._gtsam.NonlinearFactorGraph(factors)
                self._add_loops_of(k, graph, poses, weight)
                rows = slice(int(bounds[k]), int(bounds[k + 1]))
                poses[rows] = self._optimised(graph, poses, rows, TURN_ITERATIONS)
        return poses

    def _add_loops_of(self, chain: int, graph: Any, poses: F64, weight: F64) -> None:
        """Closures of a session: with itself between vertices, with others as where they put it."""
        loops = self._problem.loops
        a_is_own = self._problem.chain[loops.a] == chain
        b_is_own = self._problem.chain[loops.b] == chain
        for row in np.flatnonzero((a_is_own | b_is_own) & (weight > 0.5)).tolist():
            root = loops.root[row]
            if a_is_own[row] and b_is_own[row]:
                graph.add(_between(self._gtsam, loops, row, root))
            elif b_is_own[row]:
                placed = poses[loops.a[row]] @ loops.a_T_b[row]
                graph.add(_prior(self._gtsam, int(loops.b[row]), placed, root))
            else:
                b_T_a = inverse(loops.a_T_b[row])
                placed = poses[loops.b[row]] @ b_T_a
                graph.add(_prior(self._gtsam, int(loops.a[row]), placed, root @ _adjoint(b_T_a)))

    def _fixed_factors(self) -> Any:
        """Odometry, gravity, and what holds the frames."""
        graph = self._gtsam.NonlinearFactorGraph()
        for chain in range(int(self._problem.chain[-1]) + 1 if len(self._problem.chain) else 0):
            graph.push_back(self._fixed_factors_of(chain))
        return graph

    def _fixed_factors_of(self, chain: int) -> Any:
        gtsam = self._gtsam
        problem = self._problem
        graph = gtsam.NonlinearFactorGraph()
        first, end = np.searchsorted(problem.chain, [chain, chain + 1]).tolist()
        begun, done = np.searchsorted(problem.odometry.a, [first, end]).tolist()
        for row in range(begun, done):
            graph.add(_between(gtsam, problem.odometry, row, problem.odometry.root[row]))
        up = gtsam.Unit3(0.0, 0.0, 1.0)
        tilt = gtsam.noiseModel.Robust.Create(
            gtsam.noiseModel.mEstimator.Huber.Create(UP_HUBER),
            gtsam.noiseModel.Isotropic.Sigma(2, problem.up.sigma),
        )
        begun, done = np.searchsorted(problem.up.vertices, [first, end]).tolist()
        for row in range(begun, done):
            direction = gtsam.Unit3(*problem.up.up[row])
            vertex = int(problem.up.vertices[row])
            graph.add(gtsam.AttitudeFactorPose3(vertex, up, tilt, direction))
        if first < end:
            sigma = [ANCHOR_SIGMA] * 6 if first in self._anchors else LOOSE
            root = np.diag(1.0 / np.array(sigma))
            graph.add(_prior(gtsam, first, self._initial[first], root))
        return graph


def _between(gtsam: Any, edges: Edges, row: int, root: F64) -> Any:
    pose = gtsam.Pose3(edges.a_T_b[row])
    model = _model(gtsam, root)
    return gtsam.BetweenFactorPose3(int(edges.a[row]), int(edges.b[row]), pose, model)


def _prior(gtsam: Any, vertex: int, pose: F64, root: F64) -> Any:
    return gtsam.PriorFactorPose3(vertex, gtsam.Pose3(pose), _model(gtsam, root))


def _model(gtsam: Any, root: F64) -> Any:
    # GTSAM orders a pose's error as rotation, position
    swapped = np.roll(np.roll(root, 3, axis=0), 3, axis=1)
    return gtsam.noiseModel.Gaussian.SqrtInformation(swapped)


def _adjoint(b_T_a: F64) -> F64:
    """From errors (position, rotation) in the axes of ``a`` to ones in the axes of ``b``."""
    rotation = b_T_a[:3, :3]
    x, y, z = b_T_a[:3, 3]
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    out = np.zeros((6, 6))
    out[:3, :3] = rotation
    out[3:, 3:] = rotation
    out[:3, 3:] = cross @ rotation
    return out


def squared_errors(edges: Edges, poses: F64) -> F64:
    """Whitened squared errors (m,) of the edges at ``poses`` (v, 4, 4)."""
    error = inverse(edges.a_T_b) @ inverse(poses[edges.a]) @ poses[edges.b]
    turn = Rotation.from_matrix(error[:, :3, :3].reshape(-1, 3, 3)).as_rotvec().reshape(-1, 3)
    vector = np.concatenate([error[:, :3, 3], turn], axis=1)
    return np.asarray((np.einsum("mij,mj->mi", edges.root, vector) ** 2).sum(1))


def truncated_weights(squared: F64, mu: float) -> F64:
    """Weights of truncated least squares at the step ``mu`` of the schedule."""
    lower = mu / (mu + 1.0) * BOUND
    upper = (mu + 1.0) / mu * BOUND
    between = np.sqrt(BOUND * mu * (mu + 1.0) / np.maximum(squared, 1e-300)) - mu
    return np.where(squared <= lower, 1.0, np.where(squared >= upper, 0.0, np.clip(between, 0, 1)))


def _is_binary(weight: F64) -> bool:
    return bool(np.all((weight < BINARY) | (weight > 1.0 - BINARY)))
