"""Large graphs: derivatives against differences, and the same poses as by a direct solution."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from semloc_logs.numerics.transforms import exp_se3
from semloc_logs.pose_graph import solver
from semloc_logs.pose_graph.graph import Positions
from semloc_logs.pose_graph.normal_equations import Holds, NormalEquations, PosePriors, moved
from semloc_logs.pose_graph.problem import Directions, Edges
from semloc_logs.settings import load
from semloc_logs.stages.optimise import optimise
from semloc_logs.tables.table import read_table
from semloc_logs.voxels.store import poses_of

SETTINGS = load().resolved()


def _random_equations(rng: np.random.Generator) -> tuple[NormalEquations, np.ndarray]:
    """Three poses that two edges, a prior, two directions and a fix hold, none fulfilled."""

    def pose(scale: float) -> np.ndarray:
        return exp_se3(rng.normal(0, scale, 3), rng.normal(0, 0.5, 3))

    def root() -> np.ndarray:
        return np.eye(6) + 0.2 * rng.normal(size=(6, 6))

    edges = Edges(
        np.array([0, 2]),
        np.array([1, 0]),
        np.array([pose(2.0), pose(2.0)]),
        np.array([root(), root()]),
    )
    up = Directions(np.array([0, 2]), np.array([[0.0, 0.1, 0.99], [0.2, 0.0, 0.98]]), 2.0)
    priors = PosePriors(np.array([1]), np.array([pose(1.0)]), np.array([root()]))
    sigma = np.array([[1.0, 2.0, 3.0]])
    fixes = Positions(np.array([2]), rng.normal(size=(1, 3)), rng.normal(size=(1, 3)), sigma)
    return NormalEquations(3, edges, Holds(up, priors, fixes)), np.array(
        [pose(1.0) for _ in range(3)]
    )


def test_the_gradient_is_the_slope_of_the_cost() -> None:
    equations, poses = _random_equations(np.random.default_rng(3))
    weight = np.array([0.7, 1.0])
    gradient = equations.linearised(poses, weight).gradient
    step = 1e-6
    for axis in range(18):
        along = np.zeros(18)
        along[axis] = step
        ahead = equations.cost(moved(poses, along), weight)
        behind = equations.cost(moved(poses, -along), weight)
        assert gradient[axis] == pytest.approx((ahead - behind) / (2 * step), rel=1e-4, abs=1e-5)


def test_the_hessian_is_symmetric_and_leads_to_the_minimum() -> None:
    equations, poses = _random_equations(np.random.default_rng(4))
    weight = np.ones(2)
    for _ in range(30):
        system = equations.linearised(poses, weight)
        dense = system.hessian.toarray()
        np.testing.assert_allclose(dense, dense.T, atol=1e-12)
        poses = moved(poses, np.linalg.solve(dense + 1e-9 * np.eye(18), -system.gradient))
    assert np.abs(equations.linearised(poses, weight).gradient).max() < 1e-5


def test_conjugate_gradients_give_the_poses_of_a_direct_solution(
    drives: Any, square_of: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("gtsam")
    drives.add("a", square_of(2), 0.004, 1.005)
    drives.add("b", square_of(2), -0.004, 0.995)
    drives.add("c", square_of(1), 0.002, 1.0)
    wrong = exp_se3(np.array([30.0, 0.0, 0.0]), np.zeros(3))
    right = [("b", k, "a", k, None) for k in range(0, 801, 20)]
    right += [("c", k, "b", k, None) for k in range(0, 401, 20)]
    drives.close([*right, ("b", 100, "a", 200, wrong)])
    direct = optimise(drives.work, SETTINGS)
    names = ("a", "b", "c")
    by_gtsam = [poses_of(read_table(drives.work.optimized_trajectory(n))) for n in names]

    monkeypatch.setattr(solver, "MOST_FILL", 0)
    iterated = optimise(drives.work, SETTINGS, overwrite=True)
    assert (iterated.rejected, iterated.frames) == (direct.rejected, direct.frames) == (1, 1)
    for name, expected in zip(names, by_gtsam, strict=True):
        poses = poses_of(read_table(drives.work.optimized_trajectory(name)))
        # odometry is off by metres, closures by 0.1 m
        assert np.abs(poses[:, :3, 3] - expected[:, :3, 3]).max() < 0.03
        turn = np.swapaxes(poses[:, :3, :3], 1, 2) @ expected[:, :3, :3]
        assert np.degrees(Rotation.from_matrix(turn).magnitude()).max() < 0.1
