"""Closures that agree, on two drives along one straight road, with figures worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from semloc_logs.arrays import F64
from semloc_logs.numerics.transforms import inverse, yaw_transform
from semloc_logs.pose_graph.consistent_sets import (
    GATE,
    STARTS,
    STRETCH,
    consistent_sets,
    largest_clique,
)
from semloc_logs.pose_graph.graph import Chain, Loops, PoseGraph
from semloc_logs.pose_graph.odometry_noise import LEAST_M, LEAST_RAD, REFERENCE_M
from semloc_logs.settings import Settings

OPTIMIZE = Settings().resolved().optimize
STEP = STRETCH * OPTIMIZE.vertex_spacing / 2  # metres between vertices: two in a stretch
COUNT = 8  # vertices of a session
SIGMA_M = 0.3
SIGMA_RAD = 0.01
# with what the settings add to the covariance of every closure
OWN_M = np.hypot(SIGMA_M, OPTIMIZE.closure_sigma)
OWN_RAD = np.hypot(SIGMA_RAD, np.radians(OPTIMIZE.closure_sigma_deg))


def drives(
    loops: list[tuple[int, int, F64]], sigma_rad: tuple[float, ...] = (SIGMA_RAD,)
) -> PoseGraph:
    """Sessions a and b on one road; loops of target vertex, query vertex and the query's pose, and
    the largest standard deviations of their rotations.
    """
    poses = np.array([yaw_transform(0.0, (STEP * k, 0.0, 0.0)) for k in range(COUNT)])
    chains = [
        Chain(name, np.arange(COUNT), poses, STEP * np.arange(COUNT, dtype=float)) for name in "ab"
    ]
    covariance = np.tile(np.diag([SIGMA_M**2, 0.01, 0.01, 1e-6, 1e-6, 1e-6]), (len(loops), 1, 1))
    covariance[:, 3, 3] = np.square(sigma_rad)
    return PoseGraph(
        chains,
        Loops(
            np.array([target for target, _, _ in loops]),
            np.array([query for _, query, _ in loops]),
            np.array([pose for _, _, pose in loops]),
            covariance,
            np.ones(len(loops)),
        ),
    )


def same_place(k: int, error: F64 | None = None) -> tuple[int, int, F64]:
    """Vertex k of both sessions, with an ``error`` of the pose."""
    return k, COUNT + k, np.eye(4) if error is None else error


def turned_round(loop: tuple[int, int, F64]) -> tuple[int, int, F64]:
    target, query, pose = loop
    return query, target, inverse(pose)


def test_the_closures_that_agree_are_one_set_whichever_way_they_are_given() -> None:
    wrong = yaw_transform(0.0, (20.0, 20.0, 0.0))
    loops = [same_place(k) for k in (0, 1, 2, 5)] + [same_place(6, wrong)]
    for given in (loops, [turned_round(loop) if k % 2 else loop for k, loop in enumerate(loops)]):
        (agreeing,) = consistent_sets(drives(given), OPTIMIZE)
        assert (agreeing.a, agreeing.b) == (0, 1)
        assert sorted(agreeing.members.tolist()) == [0, 1, 2, 3]
        assert agreeing.others.tolist() == [4]
        assert agreeing.support == 3.0  # vertices 0 and 1 lie in one stretch


def agree(first: tuple[int, int, F64], second: tuple[int, int, F64]) -> bool:
    (agreeing,) = consistent_sets(drives([first, second]), OPTIMIZE)
    return len(agreeing.members) == 2


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_closures_of_one_place_agree_within_the_gate(share: float) -> None:
    """Both sessions' odometry adds the noise of single poses."""
    most_m = GATE * np.sqrt(2 * OWN_M**2 + 2 * LEAST_M**2)
    most_rad = GATE * np.sqrt(2 * OWN_RAD**2 + 2 * LEAST_RAD**2)
    for error in (
        yaw_transform(0.0, (0.0, share * most_m, 0.0)),
        yaw_transform(share * most_rad, (0.0, 0.0, 0.0)),
    ):
        assert agree(same_place(2), same_place(2, error)) == (share < 1)


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_odometry_and_the_lever_widen_the_gate_of_closures_far_apart(share: float) -> None:
    """Between vertices 1 and 5: over 4 steps of road on each side, with this as the lever."""
    road = 4 * STEP
    turn = np.radians(OPTIMIZE.odometry_turn_deg)
    drift = OPTIMIZE.odometry_drift**2 * REFERENCE_M * road
    sideways = turn**2 * road / REFERENCE_M * road**2 / 3
    moved = 2 * OWN_M**2 + (road * OWN_RAD) ** 2 + 2 * (LEAST_M**2 + drift + sideways)
    error = yaw_transform(0.0, (0.0, share * GATE * np.sqrt(moved), 0.0))
    assert agree(same_place(1), same_place(5, error)) == (share < 1)


@pytest.mark.parametrize("swap", [False, True])
def test_of_two_ends_of_the_lever_the_less_certain_one_counts(swap: bool) -> None:
    """40 m after 200 m are within 3.5 times 0.1 rad, and not within 3.5 times 0.01 rad."""
    loops = [same_place(1), same_place(5, yaw_transform(0.0, (0.0, 0.2 * 4 * STEP, 0.0)))]
    sigma_rad = (0.01, 0.1)
    if swap:
        loops.reverse()
        sigma_rad = (0.1, 0.01)
    (agreeing,) = consistent_sets(drives(loops, sigma_rad), OPTIMIZE)
    assert len(agreeing.members) == 2
    (agreeing,) = consistent_sets(drives(loops, (0.01, 0.01)), OPTIMIZE)
    assert len(agreeing.members) == 1


def test_each_pair_of_sessions_has_a_set_of_its_own() -> None:
    itself = (0, 2, yaw_transform(0.0, (2 * STEP, 0.0, 0.0)))
    loops = [same_place(0), itself, same_place(4)]
    sets = [
        (s.a, s.b, sorted(s.members.tolist())) for s in consistent_sets(drives(loops), OPTIMIZE)
    ]
    assert sets == [(0, 0, [1]), (0, 1, [0, 2])]


def test_the_most_central_of_a_set_come_first() -> None:
    """At one place, in shares of the gate: 0.9, 0.9, 0.5 and 0 agree; -0.3 with the last two."""
    most_m = GATE * np.sqrt(2 * OWN_M**2 + 2 * LEAST_M**2)
    loops = [
        same_place(2, yaw_transform(0.0, (0.0, share * most_m, 0.0)))
        for share in (0.9, 0.9, 0.5, 0.0, -0.3)
    ]
    (agreeing,) = consistent_sets(drives(loops), OPTIMIZE)
    assert agreeing.members.tolist() == [2, 3, 0, 1]
    assert agreeing.others.tolist() == [4]


def test_the_heaviest_set_in_which_all_agree() -> None:
    three_and_two = np.zeros((5, 5), bool)
    three_and_two[:3, :3] = True
    three_and_two[3:, 3:] = True
    assert largest_clique(three_and_two).tolist() == [0, 1, 2]
    assert largest_clique(three_and_two, np.array([0.3, 0.3, 0.3, 0.5, 0.5])).tolist() == [3, 4]
    path = np.eye(3, dtype=bool)
    path[0, 1] = path[1, 0] = path[1, 2] = path[2, 1] = True
    assert len(largest_clique(path)) == 2  # 0 and 2 do not agree
    assert largest_clique(np.zeros((0, 0), bool)).tolist() == []
    late = np.eye(STARTS + 3, dtype=bool)
    late[-2:, -2:] = True  # behind more closures that agree with none than there are starts
    assert largest_clique(late).tolist() == [STARTS + 1, STARTS + 2]
