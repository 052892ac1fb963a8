"""The search for the best pose about a hypothesis, in maps of voxels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from semloc_logs.alignment import search as search_module
from semloc_logs.alignment.hypotheses import Hypothesis, pose_matrix, same_place, yaw_between
from semloc_logs.alignment.mask_grid import FREE_BIT, look_up
from semloc_logs.alignment.query_map import Query
from semloc_logs.alignment.scores import MutualScores, Scores
from semloc_logs.alignment.search import Candidate, search, search_hypotheses
from semloc_logs.alignment.target_map import Target
from semloc_logs.numerics.transforms import apply, yaw_transform
from tests.alignment.voxel_maps import (
    Cell,
    V,
    block_map,
    evidence_of,
    mask_grid_of,
    moved,
    occupied,
    points_of,
    random_cells,
    town,
)


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.4])
def test_a_search_finds_the_transform_that_was_put_in(yaw: float) -> None:
    truth = yaw_transform(yaw, (3.3, -2.1, 0.4))
    target = Target(block_map(town()), V)
    query_cells = moved(town(), truth)
    query = Query(block_map(query_cells), points_of(query_cells), V)
    start = np.array([yaw + 0.12, 3.3 + 1.1, -2.1 - 0.9, 0.4 + 0.4])
    score, pose = search(target.mask_grid, query.evidence, start, (-0.12, 0.0, 0.12), 2)
    score, pose = search(
        target.mask_grid, query.evidence, pose, np.linspace(-0.1, 0.1, 9).tolist(), 1
    )
    assert score > 0.9
    target_T_query = pose_matrix(pose)
    assert np.linalg.norm(target_T_query[:3, 3] - truth[:3, 3]) < 2.5 * V
    assert yaw_between(target_T_query, truth) < np.radians(5)
    beside, _ = search(
        target.mask_grid, query.evidence, start + np.array([0.5, 6, 6, 2]), (0.0,), 1
    )
    assert beside < 0.7 * score

    wrong = [Hypothesis(0, (yaw + 1.2 * k, 9.0 - k, 6.0 * k, 0.0), 3, 1.0) for k in (1, 2, 3)]
    right = Hypothesis(0, (yaw + 0.15, 4.2, -3.0, 0.5), 2, 0.5)
    candidates = search_hypotheses([*wrong, right], {0: target}, query, 18, 24)
    best = candidates[0]
    assert same_place(best.target_T_query, truth, V)
    assert best.votes == 2
    assert candidates[0].score == max(c.score for c in candidates)
    assert len(candidates) <= 24
    twice = search_hypotheses([right, right], {0: target}, query, 18, 24)
    assert len(twice) == 1  # hypotheses at the same pose are merged
    away = Hypothesis(0, (yaw, 60.0, 0.0, 0.0), 3, 1.0)
    assert search_hypotheses([away], {0: target}, query, 18, 24) == []  # too bad to be fitted


def test_a_candidate_that_both_sides_hold_for_right_is_kept_though_few_voxels_overlap(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Poses at 0 to 5 m, best first by the search. At 4 m a tenth of the voxels is in observed
    space, and none of them contradicts; elsewhere a third of many does.
    """
    far = Scores(5000, 500, 450, 0)
    contradicted = Scores(5000, 4000, 2000, 1300)

    def scores(query: object, target: object, pose: np.ndarray) -> MutualScores:
        return (
            MutualScores(far, far)
            if pose[0, 3] == 4.0
            else MutualScores(contradicted, contradicted)
        )

    monkeypatch.setattr(search_module, "mutual_scores", scores)
    rows = [Candidate(0, yaw_transform(0.0, (x, 0, 0)), 0.9 - 0.1 * x, 3) for x in np.arange(6.0)]
    target = Target(block_map(town()), V)
    query = Query(block_map(town()), points_of(town()), V)
    chosen = search_module._chosen(rows, {0: target}, query, 4)
    assert [c.target_T_query[0, 3] for c in chosen] == [0.0, 1.0, 4.0, 2.0]
    assert search_module._chosen(rows[:1], {0: target}, query, 4) == rows[:1]
    assert search_module._chosen(rows, {0: target}, query, 1) == rows[:1]

    poor = [replace(c, score=0.1) for c in rows]
    chosen = search_module._chosen(poor, {0: target}, query, 4)
    assert chosen[2] == poor[4], "the search hardly saw it, but nothing contradicts it"
    assert search_module._chosen(poor[:4], {0: target}, query, 4) == []


def test_what_lies_in_free_space_is_subtracted_from_a_search_score() -> None:
    """Of four voxels of a wall two lie on one, one in free space and one where nothing was
    observed: a quarter of the structure's share, which is three quarters; of two voxels of ground
    one lies on ground and one in free space.
    """
    target: dict[Cell, int] = {
        (0, 0, 0): 2,
        (12, 0, 0): 2,
        (20, 0, 0): 254,
        (40, 0, 0): 0,
        (60, 0, 0): 254,
    }
    grid = mask_grid_of(block_map(target))
    cells: dict[Cell, int] = {
        (0, 0, 0): 2,
        (12, 0, 0): 2,
        (20, 0, 0): 2,
        (30, 0, 0): 2,
        (40, 0, 0): 0,
        (60, 0, 0): 0,
    }
    value, pose = search(grid, evidence_of(cells, 4), np.zeros(4), (0.0,), 1)
    # one cell aside: free cells are left, walls are not
    assert value == pytest.approx(0.75 * (2 - 0) / 4 + 0.25 * 1 / 2, abs=1e-5)
    assert abs(pose[1:]).max() == V
    free = {(20 + x, y, z): 254 for x in range(-3, 4) for y in range(-3, 4) for z in range(-3, 4)}
    free |= {(60 + x, y, z): 254 for x in range(-3, 4) for y in range(-3, 4) for z in range(-3, 4)}
    value, pose = search(
        mask_grid_of(block_map(target | free)),
        evidence_of(cells, 4),
        np.zeros(4),
        (0.0,),
        1,
    )
    assert value == pytest.approx(0.75 * (2 - 1) / 4 + 0.25 * (1 - 1) / 2, abs=1e-5)
    assert not pose.any()


@given(st.integers(0, 10_000), st.sampled_from([1, 2]))
@settings(max_examples=8)
def test_a_search_finds_the_best_of_all_its_poses(seed: int, step: int) -> None:
    """Every turn and shift that is tried, one by one, by look-ups of turned and moved voxels."""
    rng = np.random.default_rng(seed)
    grid = mask_grid_of(block_map(random_cells(seed, 500)))
    e = evidence_of({c: s for c, s in random_cells(seed + 1, 30, -6, 7).items() if occupied(s)}, 8)
    start = np.r_[rng.uniform(-3, 3), rng.uniform(-0.5, 0.5, 3)]
    yaws = (-0.2, 0.0, 0.3)

    def value(pose: NDArray[np.float64]) -> float:
        mask = look_up(grid, apply(pose_matrix(pose), e.centres))
        hit = ((mask & e.bits) != 0).astype(int) - (mask == FREE_BIT)
        return float(0.75 * hit[:8].mean() + 0.25 * hit[8:].mean())

    sides = [step * V * np.arange(-n, n + 1) for n in (2, 2, 1)]
    poses = [
        start + np.array([yaw, x, y, z])
        for yaw in yaws
        for x in sides[0]
        for y in sides[1]
        for z in sides[2]
    ]
    best, pose = search(grid, e, start, yaws, step)
    # of equals the nearest: 1e-6 a cell
    assert best == pytest.approx(max(map(value, poses)), abs=2e-5)
    assert value(pose) == pytest.approx(best, abs=2e-5)
    assert np.abs(np.array(poses) - pose).max(1).min() < 1e-9


def test_of_equally_good_poses_the_one_nearest_the_start_is_taken() -> None:
    """A wall along x holds nothing along it: the search stays where it began, and takes the least
    turn.
    """
    grid = mask_grid_of(block_map({(x, 0, z): 2 for x in range(-40, 40) for z in range(10)}))
    cells: dict[Cell, int] = {(x, 0, z): 2 for x in range(-3, 4) for z in range(3, 6)}
    start = np.array([0.0, 0.3, 0.1, 0.2])
    _, pose = search(grid, evidence_of(cells, len(cells)), start, (0.02, -0.01, 0.0, 0.01), 2)
    np.testing.assert_array_equal(pose, start)


def test_the_same_place() -> None:
    a = yaw_transform(1.0, (2.0, 3.0, 0.0))
    assert same_place(a, yaw_transform(1.0 + np.radians(4), (2.0 + 3 * V, 3.0, 0.0)), V)
    assert not same_place(a, yaw_transform(1.0, (2.0 + 3.5 * V, 3.0, 0.0)), V)
    assert not same_place(a, yaw_transform(1.0 - np.radians(6), (2.0, 3.0, 0.0)), V)
    # 100 m of road between them: 1 m and 2 degrees more
    driven = yaw_transform(1.0 + np.radians(6), (2.0 + 3.5 * V, 3.0, 0.0))
    assert not same_place(a, driven, V)
    assert same_place(a, driven, V, 100.0)
    assert not same_place(a, yaw_transform(1.0, (2.0 + 3.5 * V + 1.0, 3.0, 0.0)), V, 100.0)
    assert yaw_between(yaw_transform(3.1), yaw_transform(-3.1)) == pytest.approx(2 * np.pi - 6.2)
