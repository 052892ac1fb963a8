from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semloc_logs.alignment.hypotheses import (
    Hypothesis,
    keep_best_submaps,
    non_maximum_suppression,
    pool,
)


def slow_pool(
    group: list[int], yaw: list[float], t: np.ndarray, weight: list[float], cell: float
) -> list[tuple[float, int, float, tuple[float, ...]]]:
    """Votes of every cell of both grids by dictionaries: (weight, group, yaw, mean translation)."""
    out = []
    for offset in (0.0, 0.5):
        votes = defaultdict(list)
        for i in range(len(group)):
            votes[(group[i], yaw[i], *np.floor(t[i] / cell + offset).tolist())].append(i)
        for (g, y, *_), members in votes.items():
            total = sum(weight[i] for i in members)
            mean = sum(weight[i] * t[i] for i in members) / total
            out.append((total, g, y, tuple(mean.tolist())))
    return sorted(out, key=lambda h: -h[0])


@given(st.integers(0, 10_000))
@settings(max_examples=30)
def test_votes_are_those_of_a_dictionary(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 60
    group = rng.integers(0, 3, n)
    yaw = rng.choice([0.0, 0.5, 1.0], n)
    t = rng.uniform(-3, 3, (n, 3)) * [1, 1, 0.3]
    weight = rng.uniform(0.1, 1.0, n)
    hypotheses = pool(group, yaw, t, weight, 1.2, 500)
    expected = slow_pool(group.tolist(), yaw.tolist(), t, weight.tolist(), 1.2)
    by_weight = {round(w, 9): (g, y, m) for w, g, y, m in expected}
    for h in hypotheses:
        g, y, mean = by_weight[round(h.weight, 9)]
        assert (h.group, h.pose[0]) == (g, y)
        np.testing.assert_allclose(h.pose[1:], mean, atol=1e-9)
        members = (group == g) & (yaw == y) & (np.abs(t - mean).max(1) < 1.2)
        assert 1 <= h.votes <= members.sum()
    weights = [h.weight for h in hypotheses]
    assert weights == sorted(weights, reverse=True)
    assert weights[0] == pytest.approx(expected[0][0])
    for w, g, y, mean in expected:  # every cell is there, itself or as its twin of the other grid
        assert any(
            h.group == g
            and h.pose[0] == y
            and np.abs(np.array(h.pose[1:]) - mean).max() < 0.3
            and h.weight >= w - 1e-9
            for h in hypotheses
        )


def test_the_heaviest_are_kept() -> None:
    group = np.zeros(11, np.int64)
    t = np.array([[0.5, 0.5, 0.5]] * 5 + [[9.5, 0.5, 0.5]] * 4 + [[20.5, 0.5, 0.5]] * 2)
    hypotheses = pool(group, np.zeros(11), t, np.ones(11), 2.0, 2)
    assert [(h.votes, h.weight, h.pose) for h in hypotheses] == [
        (5, 5.0, (0.0, 0.5, 0.5, 0.5)),
        (4, 4.0, (0.0, 9.5, 0.5, 0.5)),
    ]


def test_the_best_of_both_grids_are_as_many_as_asked_for() -> None:
    """Three matches are whole in one grid and three others in the grid that is moved."""
    x = [0.5, 1.5, 1.6, 9.9, 10.1, 10.2]
    t = np.column_stack([x, np.full(6, 0.5), np.full(6, 0.5)])
    weight = np.array([10.0, 10.0, 10.0, 11.0, 11.0, 11.0])
    [best] = pool(np.zeros(6, np.int64), np.zeros(6), t, weight, 2.0, 1)
    assert (best.votes, best.weight) == (3, 33.0)
    np.testing.assert_allclose(best.pose, (0.0, 30.2 / 3, 0.5, 0.5))


def test_weights_count_more_than_votes() -> None:
    t = np.array([[0.5, 0.5, 0.5]] * 3 + [[9.5, 0.5, 0.5]] * 2)
    weight = np.array([1.0, 1.0, 1.0, 2.0, 2.0])
    [best] = pool(np.zeros(5, np.int64), np.zeros(5), t, weight, 2.0, 1)
    assert (best.votes, best.weight) == (2, 4.0)


def test_of_equally_heavy_cells_the_first_are_kept() -> None:
    """Every third of 2000 cells is twice as heavy."""
    number = np.random.default_rng(0).permutation(2000)
    t = np.column_stack([number * 2.0 + 0.5, np.full(2000, 0.5), np.full(2000, 0.5)])
    weight = np.where(number % 3 == 1, 2.0, 1.0)
    hypotheses = pool(np.zeros(2000, np.int64), np.zeros(2000), t, weight, 2.0, 3)
    assert [h.pose[1] for h in hypotheses] == [2.5, 8.5, 14.5]


def test_a_pose_at_a_cell_border_is_counted_whole() -> None:
    t = np.array([[1.99, 0.5, 0.5], [2.01, 0.5, 0.5], [1.98, 0.5, 0.5], [2.02, 0.5, 0.5]])
    hypotheses = pool(np.zeros(4, np.int64), np.zeros(4), t, np.ones(4), 2.0, 10)
    assert hypotheses[0].votes == 4
    np.testing.assert_allclose(hypotheses[0].pose, (0, 2.0, 0.5, 0.5))


def test_matches_of_other_submaps_and_headings_do_not_add_up() -> None:
    t = np.full((3, 3), 0.3)
    hypotheses = pool(np.array([0, 1, 1]), np.array([0.0, 0.0, 0.5]), t, np.ones(3), 1.0, 10)
    assert sorted((h.group, h.pose[0], h.votes) for h in hypotheses) == [
        (0, 0.0, 1),
        (1, 0.0, 1),
        (1, 0.5, 1),
    ]
    assert pool(np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 3)), np.zeros(0), 1.0, 5) == []


def test_a_pose_beside_a_better_one_is_left_out() -> None:
    """Within 0.5 m along each axis and 0.05 rad, in the same submap; headings go round."""
    best = (3.13, 1.0, 2.0, 3.0)
    poses = [
        best,
        (3.13 + 0.04, 1.4, 1.6, 3.4),
        (3.13 + 0.04 - 2 * np.pi, 1.0, 2.0, 3.0),
        (3.13 + 0.06, 1.0, 2.0, 3.0),
        (3.13, 1.6, 2.0, 3.0),
        (3.13, 1.0, 1.4, 3.0),
        (3.13, 1.0, 2.0, 3.6),
        best,
    ]
    groups = np.array([4, 4, 4, 4, 4, 4, 4, 5])
    kept = non_maximum_suppression(groups, np.array(poses), 0.5, 9)
    assert kept.tolist() == [0, 3, 4, 5, 6, 7]
    assert non_maximum_suppression(groups, np.array(poses), 0.5, 2).tolist() == [0, 3]


def test_the_submaps_with_the_heaviest_hypotheses_are_looked_into() -> None:
    hypotheses = [
        Hypothesis(group, (0.0, float(k), 0.0, 0.0), 1, weight)
        for k, (group, weight) in enumerate([(7, 1.0), (2, 3.0), (7, 4.0), (5, 3.0)])
    ]
    assert [h.group for h in keep_best_submaps(hypotheses, 2)] == [7, 2, 7]
    assert [h.group for h in keep_best_submaps(hypotheses[::-1], 2)] == [7, 2, 7]
    # not those with the most of them
    many = [Hypothesis(8, (0.0, float(k), 0.0, 0.0), 1, 2.0) for k in range(3)]
    assert [h.group for h in keep_best_submaps([*many, hypotheses[1]], 1)] == [2]
    assert keep_best_submaps(hypotheses, 9) == hypotheses
    assert keep_best_submaps([], 3) == []


def test_agreement_by_hand() -> None:
    """Of 25 votes of weight 1, nine are for one cell: 9 / 5."""
    group = np.zeros(25, np.int64)
    translation = np.zeros((25, 3))
    translation[9:, 0] = 10.0 * np.arange(1, 17)
    best, *_ = pool(group, np.zeros(25), translation + 0.5, np.ones(25), 2.0, 4)
    assert (best.weight, best.everywhere) == (9.0, 25.0)
    assert best.agreement == pytest.approx(1.8)
    assert Hypothesis(0, (0.0, 0.0, 0.0, 0.0), 1, 1.0).agreement == np.inf
