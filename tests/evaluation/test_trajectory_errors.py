"""Trajectory errors: figures that can be checked by hand, and the same as evo computes."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64
from semloc_logs.evaluation.trajectory_errors import (
    aligned_distances,
    relative_errors,
    rigid_alignment,
    rms,
)
from semloc_logs.numerics.transforms import exp_se3, transform, translation_quaternion


def _line(n: int, step_m: float) -> F64:
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, 0, 3] = step_m * np.arange(n)
    return poses


def _wandering(seed: int, n: int = 60) -> tuple[F64, F64]:
    """A truth that wanders in space, and an estimate that drifts from it in another frame."""
    rng = np.random.default_rng(seed)
    truth = [np.eye(4)]
    estimate = [exp_se3(rng.normal(0, 50, 3), rng.normal(0, 1, 3))]
    for _ in range(n - 1):
        step = exp_se3(np.array([1.0, 0.0, 0.0]), rng.normal(0, 0.1, 3))
        truth.append(truth[-1] @ step)
        noise = exp_se3(rng.normal(0, 0.05, 3), rng.normal(0, 0.02, 3))
        estimate.append(estimate[-1] @ step @ noise)
    return np.array(truth), np.array(estimate)


def test_an_estimate_that_is_too_long_by_a_tenth_is_off_most_at_its_ends() -> None:
    # centred, 0 .. 10 m against 0 .. 11 m is off by 0.1 of the distance from the middle
    off = aligned_distances(_line(11, 1.0), _line(11, 1.1))
    np.testing.assert_allclose(off, 0.1 * np.abs(np.arange(11) - 5.0), atol=1e-12)
    assert rms(off) == pytest.approx(0.1 * np.sqrt(10.0))  # mean of 0, 1, 1, 4, 4, .. 25, 25 is 10


def test_relative_errors_are_of_the_road_that_is_given() -> None:
    metres, degrees = relative_errors(_line(21, 1.0), _line(21, 1.1), 5.5)
    # five steps are 5.5 m of the estimate and 5 m of the truth
    np.testing.assert_allclose(metres, [0.5, 0.5, 0.5, 0.5], atol=1e-12)
    np.testing.assert_allclose(degrees, np.zeros(4), atol=1e-6)


def test_without_values_there_is_no_mean() -> None:
    assert rms(np.zeros(0)) is None
    metres, _ = relative_errors(_line(3, 1.0), _line(3, 1.0), 50.0)
    assert len(metres) == 0


@settings(max_examples=30)
@given(st.integers(0, 10_000))
def test_the_alignment_gives_a_known_transform_back(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(0, 20, (30, 3))
    wanted = transform(rng.normal(0, 100, 3), Rotation.random(rng=rng).as_quat())
    moved = points @ wanted[:3, :3].T + wanted[:3, 3]
    np.testing.assert_allclose(rigid_alignment(moved, points), wanted, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_evo_has_the_same_figures(seed: int) -> None:
    evo = pytest.importorskip("evo.core.metrics")
    trajectories = pytest.importorskip("evo.core.trajectory")
    truth, estimate = _wandering(seed)
    stamps = np.arange(len(truth), dtype=float)

    def evo_trajectory(poses: F64) -> Any:
        t, q = translation_quaternion(poses)
        return trajectories.PoseTrajectory3D(t, np.roll(q, 1, axis=1), stamps)

    reference = evo_trajectory(truth)
    aligned = evo_trajectory(estimate)
    aligned.align(reference, correct_scale=False)
    ape = evo.APE(evo.PoseRelation.translation_part)
    ape.process_data((reference, aligned))
    ours = aligned_distances(truth, estimate)
    np.testing.assert_allclose(ours, ape.error, atol=1e-9)
    assert rms(ours) == pytest.approx(ape.get_statistic(evo.StatisticsType.rmse))

    metres, degrees = relative_errors(truth, estimate, 7.0)
    pairs = (
        (metres, evo.PoseRelation.translation_part),
        (degrees, evo.PoseRelation.rotation_angle_deg),
    )
    for errors, relation in pairs:
        rpe = evo.RPE(relation, delta=7.0, delta_unit=evo.Unit.meters)
        rpe.process_data((reference, aligned))
        np.testing.assert_allclose(errors, rpe.error, atol=1e-6)
