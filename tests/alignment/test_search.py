"""Hypotheses at the same pose are merged; hypotheses with opposite headings stay separate."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from semloc_logs.alignment import search as search_module
from semloc_logs.alignment.hypotheses import Hypothesis
from semloc_logs.alignment.mask_grid import REACH
from semloc_logs.alignment.query_map import SEARCH_VOXELS
from semloc_logs.alignment.search import (
    MIN_SEARCH_SCORE,
    Candidate,
    _chosen,
    _rotated,
    _Searched,
    _suppressed,
    search_hypotheses,
)


def test_only_hypotheses_of_one_place_and_heading_are_one() -> None:
    poses = [
        (0.1, 5.0, 5.0, 0.0),
        (0.1 + np.pi, 5.0, 5.0, 0.0),
        (0.12, 5.1, 5.0, 0.0),
        (0.1 + 2 * np.pi, 5.0, 5.1, 0.0),
        (0.1, 9.0, 5.0, 0.0),
    ]
    searched = [_Searched(Hypothesis(3, pose, 1, 1.0), np.array(pose), 0.5) for pose in poses]
    kept = _suppressed(searched, 1.0, 10)
    assert [s.hypothesis.pose for s in kept] == [poses[0], poses[1], poses[4]]
    assert len(_suppressed(searched, 1.0, 2)) == 2
    submaps = [
        _Searched(Hypothesis(group, poses[0], 1, 1.0), np.array(poses[0]), 0.5) for group in (1, 2)
    ]
    assert len(_suppressed(submaps, 1.0, 10)) == 2
    assert _suppressed([], 1.0, 10) == []


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_voxels_stay_in_the_grid_whatever_the_shift(axis: int) -> None:
    shape = [4 * REACH] * 3
    shape[axis] = 4 * REACH + 3
    cells = np.full((shape[axis] + 4, 3), 2 * REACH)
    cells[:, axis] = np.arange(-2, shape[axis] + 2)
    grid = (np.zeros(shape, np.uint8), np.zeros(3), 1.0)
    base = np.full(len(cells), -1)
    kept = np.zeros(len(cells), np.uint8)
    count = _rotated(
        grid, cells + 0.5, np.arange(len(cells)).astype(np.uint8), np.zeros(4), base, kept
    )
    inside = np.arange(REACH, shape[axis] - REACH)  # of the cells along the axis
    assert count == len(inside)
    voxels = np.stack(np.unravel_index(base[:count], shape), axis=1)
    np.testing.assert_array_equal(voxels[:, axis], inside)
    np.testing.assert_array_equal(kept[:count], inside + 2)


@pytest.mark.parametrize(
    ("score", "is_consistent", "kept"),
    [
        (MIN_SEARCH_SCORE, False, 1),
        (MIN_SEARCH_SCORE - 1e-9, False, 0),
        (MIN_SEARCH_SCORE - 1e-9, True, 1),
    ],
)
def test_no_candidate_stays_where_none_can_become_good(
    score: float, is_consistent: bool, kept: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    mutual = SimpleNamespace(score=0.5, is_consistent=is_consistent)
    monkeypatch.setattr(search_module, "mutual_scores", lambda *_: mutual)
    target = cast(Any, None)
    candidates = _chosen([Candidate(3, np.eye(4), score, 1)], {3: target}, cast(Any, None), 5)
    assert len(candidates) == kept


def test_hypotheses_are_searched_twice_and_those_that_meet_become_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Poses along x, in voxels: the second is beside the first already. The first search moves the
    last one beside the one at 10, in steps of two; poses 3 voxels apart are one after the second.
    """
    v = 0.5
    search_results = {
        200: {0.0: (0.4, 0.0), 3.0: (0.45, 3.0), 10.0: (0.5, 10.0), 20.0: (0.6, 11.5)},
        SEARCH_VOXELS: {0.0: (0.7, 0.0), 3.0: (0.5, 3.0), 11.5: (0.3, 11.5)},
    }
    searches = []

    def search(
        grid: str, evidence: int, start: NDArray[np.float64], yaws: NDArray[np.float64], step: int
    ) -> tuple[float, NDArray[np.float64]]:
        searches.append((grid, evidence, start[1] / v, round(np.degrees(yaws.max()), 9), step))
        score, x = search_results[evidence][start[1] / v]
        return score, np.array([0.0, x * v, 0.0, 0.0])

    mutual = SimpleNamespace(score=0.5, is_consistent=True)
    monkeypatch.setattr(search_module, "mutual_scores", lambda *_: mutual)
    monkeypatch.setattr(search_module, "search", search)
    query = SimpleNamespace(voxel_size=v, evidence=SimpleNamespace(first=lambda most: most))
    targets = {3: SimpleNamespace(mask_grid="grid")}
    hypotheses = [
        Hypothesis(3, (0.0, x * v, 0.0, 0.0), votes, 1.0)
        for votes, x in enumerate([0.0, 1.5, 3.0, 10.0, 20.0])
    ]
    best, other = search_hypotheses(hypotheses, cast(Any, targets), cast(Any, query), 18, 5)
    # 18 headings: 0.8 and 0.3 of half of 20 degrees to either side
    first = [("grid", 200, x, 8.0, 2) for x in (0.0, 3.0, 10.0, 20.0)]
    second = [("grid", SEARCH_VOXELS, x, 3.0, 1) for x in (11.5, 3.0, 0.0)]
    assert searches == first + second
    assert (best.score, best.votes, best.target_T_query[0, 3]) == (0.7, 0, 0.0)
    assert (other.score, other.votes, other.target_T_query[0, 3]) == (0.3, 4, 11.5 * v)
