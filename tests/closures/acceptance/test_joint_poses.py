"""Poses that neighbours estimate together: by hand, and against one sum after another."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64
from semloc_logs.closures.acceptance.joint_poses import (
    COMMON,
    JointPoses,
    Uncertainty,
    joint_poses,
)
from semloc_logs.closures.acceptance.placements import Placed, pairs_of
from semloc_logs.closures.closure import Alignments
from semloc_logs.numerics.transforms import exp_se3, inverse, yaw_transform
from tests.closures.acceptance.known_alignments import MAP, MAPS, alignment

SIGMA = 0.3  # m
TURN = 0.01  # rad


def in_row(n: int, spacing: float = 2.0, offsets: F64 | None = None, **changes: Any) -> Placed:
    """Queries along x, whose alignments lie at the truth, or ``offsets`` (n, 3) metres off."""
    road = spacing * np.arange(n)
    own = np.array([yaw_transform(0.0, (x, 0.0, 0.0)) for x in road])
    measured = own.copy()
    if offsets is not None:
        measured[:, :3, 3] += offsets
    columns: dict[str, Any] = {
        "query_session": np.full(n, "a", object),
        "target_session": np.full(n, "b", object),
        "query": np.arange(n),
        "road": road,
        "target_road": road,
        "map_T_query": own,
        "target_T_query": measured,
        "sigma": np.full(n, SIGMA),
        "log_odds": np.zeros(n),
        "posed": np.ones(n, bool),
    }
    return Placed(**(columns | changes))


def uncertainty(n: int, drift: float = 0.0, turn: float = TURN) -> Uncertainty:
    """The same for all; ``drift`` of the query's odometry alone, along its x axis."""
    rates = np.zeros((2, n, 6))
    rates[0, :, 0] = drift
    covariance = np.diag([SIGMA**2] * 3 + [turn**2] * 3)
    return Uncertainty(np.tile(covariance, (n, 1, 1)), np.tile(np.eye(3), (n, 1, 1)), *rates)


def joint(placed: Placed, beside: Uncertainty, probability: F64 | None = None) -> JointPoses:
    sure = np.ones(len(placed)) if probability is None else probability
    return joint_poses(placed, pairs_of(placed), beside, sure, 0.3)


def test_two_queries_at_one_place_meet_half_way() -> None:
    """The error that both have in common remains, and half of the other one."""
    offsets = np.array([[0.0, 0.1, 0.0], [0.0, -0.1, 0.0]])
    poses = joint(in_row(2, 0.0, offsets), uncertainty(2))
    np.testing.assert_allclose(poses.increment[:, :3], -offsets, atol=1e-12)
    np.testing.assert_allclose(poses.increment[:, 3:], 0.0, atol=1e-12)
    assert COMMON == 0.5
    np.testing.assert_allclose(poses.covariance, 0.75 * uncertainty(2).covariance, atol=1e-12)
    np.testing.assert_allclose(poses.sigma, SIGMA * 0.75**0.5)


def test_a_turned_neighbour_moves_what_lies_ahead_of_it() -> None:
    """10 m ahead of a query that may be turned by 0.01 rad, it tells 0.1 m less about y and z."""
    poses = joint(in_row(2, 10.0), uncertainty(2))
    half = 0.5 * SIGMA**2
    arm = 0.5 * (10 * TURN) ** 2
    # y and yaw of the one from the other are correlated by the arm
    other = np.array([[half + arm, 10 * 0.5 * TURN**2], [10 * 0.5 * TURN**2, 0.5 * TURN**2]])
    alone = np.diag([half, 0.5 * TURN**2])
    expected = np.linalg.inv(np.linalg.inv(alone) + np.linalg.inv(other)) + alone
    np.testing.assert_allclose(poses.covariance[1][np.ix_([1, 5], [1, 5])], expected, atol=1e-12)
    assert poses.covariance[1, 0, 0] == pytest.approx(0.75 * SIGMA**2)


def test_what_odometry_drifts_is_not_known() -> None:
    """Over 10 m at 0.03 a metre, 0.3 m along x, which adds to the neighbour's own 0.21 m."""
    poses = joint(in_row(2, 10.0), uncertainty(2, drift=0.03, turn=1e-9))
    half = 0.5 * SIGMA**2
    along = 1 / (1 / half + 1 / (half + 0.3**2)) + half
    np.testing.assert_allclose(poses.covariance[0, [0, 1], [0, 1]], [along, 1.5 * half], rtol=1e-6)


@pytest.mark.parametrize(
    "changes",
    [
        {"posed": np.zeros(2, bool)},
        {"query": np.zeros(2, int)},  # two poses of one query are rivals
        {"query_session": np.array(["a", "c"], object)},
        {"target_session": np.array(["b", "c"], object)},
        {"road": np.array([0.0, 25.1])},
        {"target_T_query": np.array([np.eye(4), yaw_transform(0.0, (0.0, 1.5, 0.0))])},
        {"target_T_query": np.array([np.eye(4), yaw_transform(0.1, (2.0, 0.0, 0.0))])},
    ],
)
def test_what_is_no_neighbour_or_disagrees_changes_nothing(changes: dict[str, Any]) -> None:
    poses = joint(in_row(2, 2.0, np.array([[0, 0.1, 0], [0, 0, 0]]), **changes), uncertainty(2))
    assert (poses.increment == 0).all()
    assert (poses.covariance == uncertainty(2).covariance).all()


def test_an_improbable_neighbour_changes_nothing_and_is_changed() -> None:
    placed = in_row(2, 0.0, np.array([[0.0, 0.1, 0.0], [0.0, -0.1, 0.0]]))
    poses = joint(placed, uncertainty(2), np.array([0.9, 0.49]))
    assert poses.increment[0].tolist() == [0.0] * 6
    assert poses.increment[1, 1] == pytest.approx(0.1)


def one_by_one(placed: Placed, beside: Uncertainty, k: int) -> tuple[F64, F64]:
    """The same for alignment ``k``, all others being its neighbours, by one sum after another."""
    to_map = np.kron(np.eye(2), beside.map_R_target[k])
    information = np.zeros((6, 6))
    pull = np.zeros(6)
    for n in range(len(placed)):
        own = inverse(placed.map_T_query[n]) @ placed.map_T_query[k]
        predicted = placed.target_T_query[n] @ own
        axes = np.kron(np.eye(2), beside.map_R_target[n])
        covariance = (1 - COMMON) * axes @ beside.covariance[n] @ axes.T
        # of increments about a query's base, turned about another one
        steps = np.eye(6)
        for axis in range(3):
            turned = np.cross(np.eye(3)[axis], predicted[:3, 3] - placed.target_T_query[n, :3, 3])
            steps[:3, 3 + axis] = turned
        covariance = steps @ covariance @ steps.T
        for rotation, rates, road in (
            (predicted[:3, :3], beside.query_drift[k], placed.road),
            (beside.map_R_target[k], beside.target_drift[k], placed.target_road),
        ):
            turned_rates = np.kron(np.eye(2), rotation) @ np.diag(rates) * abs(road[k] - road[n])
            covariance = covariance + turned_rates @ turned_rates.T
        turn = predicted[:3, :3] @ placed.target_T_query[k, :3, :3].T
        away = np.r_[
            predicted[:3, 3] - placed.target_T_query[k, :3, 3],
            Rotation.from_matrix(turn).as_rotvec(),
        ]
        information += np.linalg.inv(covariance)
        pull += np.linalg.inv(covariance) @ away
    joint_covariance = np.linalg.inv(information)
    return (
        to_map.T @ joint_covariance @ pull,
        to_map.T @ joint_covariance @ to_map + COMMON * beside.covariance[k],
    )


def drawn(seed: int, n: int) -> tuple[Placed, Uncertainty]:
    """Alignments along a winding road, with errors, turned targets and covariances of any kind."""
    rng = np.random.default_rng(seed)
    own = np.array([yaw_transform(0.05 * k, (2.0 * k, 0.1 * k**2, 0.02 * k)) for k in range(n)])
    errors = [exp_se3(*0.005 * rng.normal(size=(2, 3))) for _ in range(n)]
    measured = MAP @ own @ np.array(errors)
    roots = rng.normal(0, 0.1, (n, 6, 6)) * np.array([1, 1, 1, 0.1, 0.1, 0.1])[:, None]
    beside = Uncertainty(
        roots @ np.swapaxes(roots, 1, 2) + 1e-4 * np.eye(6),
        Rotation.random(n, rng).as_matrix(),
        *rng.uniform(0, 0.01, (2, n, 6)),
    )
    placed = in_row(n, map_T_query=own, target_T_query=measured)
    return placed, beside


@pytest.mark.parametrize("seed", range(3))
def test_all_at_once_is_the_same_as_one_by_one(seed: int) -> None:
    placed, beside = drawn(seed, 6)
    poses = joint(placed, beside)
    for k in range(6):
        increment, covariance = one_by_one(placed, beside, k)
        np.testing.assert_allclose(poses.increment[k], increment, atol=1e-10)
        np.testing.assert_allclose(poses.covariance[k], covariance, atol=1e-10)


@given(st.integers(0, 2**31), st.integers(2, 6))
def test_neighbours_never_make_a_pose_less_certain(seed: int, n: int) -> None:
    placed, beside = drawn(seed, n)
    poses = joint(placed, beside)
    less = beside.covariance - poses.covariance
    assert np.linalg.eigvalsh(less).min() >= -1e-12
    fewer = placed.part(np.arange(n - 1))
    before = joint(fewer, beside.part(np.arange(n - 1)))
    less = before.covariance - poses.covariance[:-1]
    assert np.linalg.eigvalsh(less).min() >= -1e-12


@given(st.integers(0, 2**31))
def test_the_frame_of_the_target_s_map_does_not_matter(seed: int) -> None:
    placed, beside = drawn(seed, 4)
    poses = joint(placed, beside)
    frame = exp_se3(np.array([30.0, -5.0, 2.0]), np.array([0.3, -0.2, 2.0]))
    elsewhere = in_row(
        4, map_T_query=placed.map_T_query, target_T_query=frame @ placed.target_T_query
    )
    turned = Uncertainty(
        beside.covariance,
        frame[:3, :3] @ beside.map_R_target,
        beside.query_drift,
        beside.target_drift,
    )
    again = joint(elsewhere, turned)
    np.testing.assert_allclose(again.increment, poses.increment, atol=1e-9)
    np.testing.assert_allclose(again.covariance, poses.covariance, atol=1e-9)


def test_many_alignments_are_taken_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    placed, beside = drawn(0, 6)
    poses = joint(placed, beside)
    monkeypatch.setattr("semloc_logs.closures.acceptance.joint_poses.ROWS_AT_ONCE", 2)
    parts = joint(placed, beside)
    np.testing.assert_allclose(parts.increment, poses.increment, atol=1e-12)
    np.testing.assert_allclose(parts.covariance, poses.covariance, atol=1e-12)


def test_errors_of_neighbours_average() -> None:
    """Of drives of 9 queries a metre apart whose errors are half their own, half in common."""
    rng = np.random.default_rng(0)
    squares = []
    for _ in range(200):
        own = rng.normal(0, SIGMA * 0.5**0.5, (9, 3))
        error = own + rng.normal(0, SIGMA * 0.5**0.5, 3)
        placed = in_row(9, 1.0, np.clip(error, -0.55, 0.55))
        poses = joint(placed, uncertainty(9, turn=1e-6))
        after = placed.target_T_query[4, :3, 3] - [4.0, 0.0, 0.0] + poses.increment[4, :3]
        squares.append(after @ np.linalg.solve(poses.covariance[4, :3, :3], after))
    assert np.mean(squares) == pytest.approx(3.0, rel=0.15)


def test_alignments_get_the_poses_in_the_axes_of_their_target() -> None:
    """The target looks along y of its map: an increment along its x is one along -y of the map."""
    rows = Alignments.of([alignment(20, 0.9), alignment(21, 0.9)])
    beside = Uncertainty.of(rows, MAPS)
    np.testing.assert_array_equal(beside.map_R_target[1], MAPS["b"].map_T_base[21, :3, :3])
    increment = np.array([[0.1, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0.2]])
    moved = JointPoses(increment, 2 * rows.covariance).of(rows)
    np.testing.assert_allclose(
        moved.target_T_query[0, :3, 3], rows.target_T_query[0, :3, 3] + [0.1, 0, 0]
    )
    np.testing.assert_allclose(
        moved.target_T_query[1, :3, :3], yaw_transform(0.2)[:3, :3] @ rows.target_T_query[1, :3, :3]
    )
    np.testing.assert_array_equal(moved[0].covariance, 2 * rows.covariance[0])
    assert moved[1].features.stiffness == rows[1].features.stiffness
