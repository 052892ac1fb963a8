"""Alignments that are judged already."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from semloc_logs.closures.acceptance.joint_poses import Uncertainty
from semloc_logs.closures.acceptance.placements import Placed
from semloc_logs.closures.closure import Features
from semloc_logs.evaluation.judged_alignments import Judged
from semloc_logs.numerics.transforms import yaw_transform


@pytest.fixture
def judged() -> Callable[..., Judged]:
    """A maker of judged alignments."""
    return _judged


def _judged(n: int = 1500, seed: int = 0, towns: int = 3) -> Judged:
    """Queries 2 m apart along straight roads; right alignments lie at the truth, wrong ones
    anywhere; features tell a little.
    """
    rng = np.random.default_rng(seed)
    right = rng.random(n) < 0.7
    features = np.tile([0.8, 0.8, 0.1, 0.5, 3.0, 2.0, 0.0], (n, 1))
    features[:, 2] *= np.exp(np.where(right, -0.5, 0.5) + rng.normal(0, 0.4, n))
    features[:, 5] += rng.normal(0, 0.2, n)
    town = np.array([f"t{k % towns}" for k in range(n)], object)
    query = np.arange(n) // towns
    own = np.array([yaw_transform(0.0, (2.0 * k, 0.0, 0.0)) for k in query])
    target_T_query = own.copy()
    target_T_query[~right, :2, 3] += rng.uniform(20, 90, (int((~right).sum()), 2))
    road = np.array(2.0 * query, float)
    a, b = (np.full(n, name, object) for name in ("a", "b"))
    placed = Placed(
        a,
        b,
        query,
        road,
        road.copy(),
        own,
        target_T_query,
        np.full(n, 0.02),
        np.zeros(n),
        np.ones(n, bool),
    )
    # 3 and 6 as the squares over the covariances
    error = np.where(right, 0.02, 50.0)[:, None] * np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    error[right, 3:] = 0.002
    return Judged(town, Features(*features.T), placed, uncertain(n), right, error, 0.3)


def uncertain(n: int) -> Uncertainty:
    """Standard deviations of 2 cm and 2 mrad; odometry without drift."""
    covariance = np.diag([0.02**2] * 3 + [0.002**2] * 3)
    axes = np.tile(np.eye(3), (n, 1, 1))
    return Uncertainty(np.tile(covariance, (n, 1, 1)), axes, np.zeros((n, 6)), np.zeros((n, 6)))
