"""Robust least squares over the graph by GTSAM: graduated non-convexity, or Cauchy weights.

Yang, Antonante, Tzoumas, Carlone: Graduated Non-Convexity for Robust Spatial Perception, RA-L 2020,
with truncated least squares (their equations 14 and 15). Each step of the schedule solves the
weighted problem from the poses of the step before, so a time limit can end it between two steps.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from importlib import import_module
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from semloc_logs.arrays import F64, I64
from semloc_logs.errors import SemlocError
from semloc_logs.numerics.transforms import inverse
from semloc_logs.pose_graph.conjugate_gradients import Layout, Limits, minimised
from semloc_logs.pose_graph.graph import turned_covariance
from semloc_logs.pose_graph.normal_equations import (
    FIX_CAUCHY,
    UP_HUBER,
    Holds,
    NormalEquations,
    PosePriors,
    fix_errors,
)
from semloc_logs.pose_graph.problem import Edges, Problem

LOGGER = logging.getLogger(__name__)
# share of right closures whose errors are below the bound, if their covariances are right
INLIER_SHARE = 0.999
BOUND = float(chi2.ppf(INLIER_SHARE, 6))  # squared and whitened error of a right closure
SCHEDULE_STEP = 2.0  # mu grows by so much; the paper takes 1.4 and solves each step to the end
FIRST_ITERATIONS = 6  # of Levenberg-Marquardt before the schedule
STEP_ITERATIONS = 1  # of Levenberg-Marquardt in each step of the schedule
LAST_ITERATIONS = 20  # in the solution that follows
TOLERANCE = 1e-6  # relative decrease of the error that ends it
MOST_STEPS = 100
# vertices times squared sessions up to which GTSAM solves directly, and conjugate gradients beyond:
# sessions of the same roads fill its matrix, as each is connected with all others
MOST_FILL = 2e7
NODES_APART = 20.0  # vertex spacings between the nodes of a motion that all sessions share
RESIDUAL = 1e-2  # of each step; the steps that follow take away what it leaves
ITERATED_TOLERANCE = 1e-5  # relative decrease of the error that ends it
FIX_STEP = 4.0  # the weights of satellite fixes narrow down by so much
BINARY = 1e-3  # a weight that is nearer to 0 or 1 counts as that
# a chain whose closures are all refused stays where it is, to the width of a continent
LOOSE = [1e3, 1e3, 1e3, 3.0, 3.0, 3.0]  # m and rad
ANCHOR_SIGMA = 1e-4  # the first vertex of a component, m and rad


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
    """A problem with its factors; ``component`` (v,) numbers the frame of each vertex."""

    def __init__(self, problem: Problem, component: I64, initial: F64) -> None:
        self._gtsam = gtsam_library()
        self._problem = problem
        self._component = component
        frames, anchors = np.unique(component, return_index=True)
        is_held = np.isin(frames, component[problem.fixes.vertices])
        self._anchors = set(anchors[~is_held].tolist())
        self._fix_scale = FIX_CAUCHY
        self._initial = initial
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
        """Least squares from ``initial`` (v, 4, 4) with given weights of the closures.

        Fixes may be far off at first, as the poses drift: their weights narrow down.
        """
        poses = initial
        for scale in self._fix_scales(initial):
            self._fix_scale = scale
            poses = self._solved(poses, weight, STEP_ITERATIONS)
        self._fix_scale = FIX_CAUCHY
        poses = self._solved(poses, weight, LAST_ITERATIONS)
        return Solution(poses, weight, squared_errors(self._problem.loops, poses), Method.GNC)

    def _fix_scales(self, poses: F64) -> list[float]:
        """Constants of the weights of fixes, the largest one first."""
        if not len(self._problem.fixes):
            return []
        away = np.linalg.norm(fix_errors(self._problem.fixes, poses), axis=1)
        steps = np.ceil(np.log(max(np.median(away) / FIX_CAUCHY, 1.0)) / np.log(FIX_STEP))
        return [FIX_CAUCHY * FIX_STEP**k for k in range(int(steps), 0, -1)]

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
        marginals = self._gtsam.Marginals(self._weighted(weight), self._values(poses))
        local = np.array([marginals.marginalCovariance(k) for k in range(len(poses))])
        # GTSAM orders a pose's error as rotation, position, in the axes of the pose
        local = np.roll(np.roll(local.reshape(-1, 6, 6), 3, axis=1), 3, axis=2)
        return turned_covariance(poses[:, :3, :3], local)

    def _weighted(self, weight: F64) -> Any:
        """All factors, the closures with these weights."""
        loops = self._problem.loops
        graph = self._gtsam.NonlinearFactorGraph(self._fixed)
        for factor in self._fix_factors():
            graph.add(factor)
        for row in np.flatnonzero(weight > 0).tolist():
            root = loops.root[row] * np.sqrt(weight[row])
            graph.add(_between(self._gtsam, loops, row, root))
        return graph

    def _values(self, poses: F64) -> Any:
        values = self._gtsam.Values()
        for vertex, pose in enumerate(poses):
            values.insert(vertex, self._gtsam.Pose3(pose))
        return values

    def _solved(self, initial: F64, weight: F64, iterations: int) -> F64:
        """Least squares with these weights of the closures, at most so many iterations."""
        if self._is_large:
            self._equations.fix_scale = self._fix_scale
            limits = Limits(iterations, ITERATED_TOLERANCE, RESIDUAL)
            weights = np.concatenate([np.ones(len(self._problem.odometry)), weight])
            return minimised(self._equations, initial, weights, self._layout, limits)
        gtsam = self._gtsam
        graph = self._weighted(weight)
        if self._ordering is None:
            self._ordering = gtsam.Ordering.MetisNonlinearFactorGraph(graph)
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setOrdering(self._ordering)
        parameters.setMaxIterations(iterations)
        parameters.setRelativeErrorTol(TOLERANCE)
        values = self._values(initial)
        solved = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
        return np.array([solved.atPose3(k).matrix() for k in range(len(initial))])

    @property
    def _is_large(self) -> bool:
        chain = self._problem.chain
        sessions = int(chain.max(initial=-1)) + 1
        return len(chain) * sessions**2 > MOST_FILL

    @cached_property
    def _layout(self) -> Layout:
        problem = self._problem
        return Layout(problem.chain, self._component, NODES_APART * problem.spacing)

    @cached_property
    def _equations(self) -> NormalEquations:
        problem = self._problem
        edges = problem.odometry.joined(problem.loops)
        holds = Holds(problem.up, self._priors, problem.fixes)
        return NormalEquations(len(problem.kept), edges, holds)

    @cached_property
    def _priors(self) -> PosePriors:
        """What holds the frames: the first vertex of each chain."""
        chain = self._problem.chain
        first = np.flatnonzero(np.diff(chain, prepend=-1))
        sigma = [[ANCHOR_SIGMA] * 6 if k in self._anchors else LOOSE for k in first.tolist()]
        root = np.eye(6) / np.array(sigma)[:, None, :]
        return PosePriors(first, self._initial[first], root)

    def _fix_factors(self) -> Iterator[Any]:
        gtsam = self._gtsam
        fixes = self._problem.fixes
        cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(self._fix_scale)
        for vertex, antenna, position, sigma in zip(
            fixes.vertices.tolist(), fixes.antenna, fixes.position, fixes.sigma, strict=True
        ):
            model = gtsam.noiseModel.Robust.Create(cauchy, gtsam.noiseModel.Diagonal.Sigmas(sigma))
            yield gtsam.GPSFactorArm(vertex, position, antenna, model)

    @cached_property
    def _fixed(self) -> Any:
        """Factors of odometry, gravity, and what holds the frames."""
        gtsam = self._gtsam
        problem = self._problem
        graph = gtsam.NonlinearFactorGraph()
        for row in range(len(problem.odometry)):
            graph.add(_between(gtsam, problem.odometry, row, problem.odometry.root[row]))
        up = gtsam.Unit3(0.0, 0.0, 1.0)
        tilt = gtsam.noiseModel.Robust.Create(
            gtsam.noiseModel.mEstimator.Huber.Create(UP_HUBER),
            gtsam.noiseModel.Isotropic.Sigma(2, problem.up.sigma),
        )
        for vertex, own_up in zip(problem.up.vertices.tolist(), problem.up.up, strict=True):
            graph.add(gtsam.AttitudeFactorPose3(vertex, up, tilt, gtsam.Unit3(*own_up)))
        priors = self._priors
        for vertex, pose, root in zip(
            priors.vertices.tolist(), priors.poses, priors.root, strict=True
        ):
            graph.add(_prior(gtsam, vertex, pose, root))
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
