"""Scores of a pose by the structure of both sides, and the evidence they are counted with."""

from __future__ import annotations

import numpy as np
import pytest

from semloc_logs.alignment.mask_grid import ANY_BIT
from semloc_logs.alignment.query_map import Query, structure_mask
from semloc_logs.alignment.scores import (
    MutualScores,
    Scores,
    alignment_score,
    mutual_shares,
    reverse_scores,
    structure_scores,
)
from semloc_logs.alignment.surface import thin_points
from semloc_logs.alignment.target_map import Target
from semloc_logs.labels.space import UNLABELLED
from tests.alignment.voxel_maps import Cell, V, block_map, evidence_of, points_of


def test_structure_scores_by_hand() -> None:
    target = Target(block_map({(0, 0, 0): 2, (0, 0, 1): 254, (4, 0, 0): 254, (8, 0, 0): 8}), V)
    query_cells: dict[Cell, int] = {
        (0, 0, 0): 2,  # on its class
        (1, 0, 0): 2,  # beside it
        (4, 0, 0): 5,  # in free space
        (8, 0, 0): 2,  # on another class
        (12, 0, 0): 2,  # where nothing was observed
        (0, 0, 1): 2,  # in free space, but beside its class
        (0, 1, 0): 0,  # ground and cars do not count as structure
        (0, 1, 1): 13,
    }
    query = Query(block_map(query_cells), points_of(query_cells), V)
    assert structure_scores(query, target, np.eye(4)) == (6, 5, 3, 1)
    bare = Query(block_map({(0, 0, 0): 0}), np.zeros((1, 3)), V)
    assert structure_scores(bare, target, np.eye(4)) == (0, 0, 0, 0)
    assert structure_mask(np.array([0, 1, 9, 2, 5, 8, 13, 255], np.uint8)).tolist() == [
        False,
        False,
        False,
        True,
        True,
        True,
        False,
        True,
    ]


def test_reverse_scores_are_of_the_targets_structure_on_the_querys_map() -> None:
    """The query lies three voxels along the target's x: roles are exchanged, the pose inverted."""
    query = Query(block_map({(0, 0, 0): 2, (0, 0, 1): 254, (4, 0, 0): 254}), np.zeros((1, 3)), V)
    target = Target(block_map({(3, 0, 0): 2, (7, 0, 0): 5, (20, 0, 0): 8}), V)
    moved = np.eye(4)
    moved[0, 3] = 3 * V
    assert reverse_scores(query, target, moved) == (3, 2, 1, 1)
    assert reverse_scores(query, target, np.eye(4)) != (3, 2, 1, 1)


def test_shares_of_both_sides_by_hand() -> None:
    """150 voxels are added to each, half of them aligned and a fifth in free space."""
    good = Scores(2000, 850, 725, 20)  # 800 and 50 of 1000
    bad = Scores(3000, 850, 425, 370)  # 500 and 400 of 1000
    aligned, free = mutual_shares(good, bad)
    assert aligned == pytest.approx((0.5**2 * 0.8) ** (1 / 3))
    assert free == pytest.approx((0.4**2 * 0.05) ** (1 / 3))
    assert mutual_shares(bad, good) == (aligned, free)
    assert MutualScores(good, bad).score == pytest.approx(aligned - free)
    nothing = Scores(0, 0, 0, 0)
    assert mutual_shares(nothing, nothing) == pytest.approx((0.5, 0.2))


def test_scores_of_alignments_by_hand() -> None:
    """Below a coverage of a half the structure counts less in proportion; what contradicts free
    space is taken off in full.
    """
    assert float(alignment_score(0.8, 0.25, 0.1)) == pytest.approx(0.8 * 0.5 - 0.1)
    assert float(alignment_score(0.8, 0.5, 0.1)) == pytest.approx(0.7)
    assert float(alignment_score(0.8, 0.9, 0.1)) == pytest.approx(0.7)
    scores = Scores(100, 25, 20, 10)
    assert (scores.structure, scores.coverage, scores.contradiction) == (0.8, 0.25, 0.1)
    assert scores.score == pytest.approx(0.3)
    np.testing.assert_allclose(
        alignment_score(np.array([1.0, 0.5]), np.array([0.1, 1.0]), np.array([0.0, 0.25])),
        [0.2, 0.25],
    )


def test_some_of_the_evidence_is_three_quarters_structure() -> None:
    cells: dict[Cell, int] = {(x, 0, 0): 2 for x in range(40)}
    cells.update({(x, 5, 0): 0 for x in range(20)})
    e = evidence_of(cells, 40)
    some = e.first(16)
    assert (some.structure, len(some.bits)) == (12, 16)
    np.testing.assert_array_equal(some.centres[:, 1] == 0.5 * V, [True] * 12 + [False] * 4)
    every = e.first(1000)
    assert (every.structure, len(every.bits)) == (40, 60)


def test_of_a_cell_the_most_certain_point_stays() -> None:
    points = np.array(
        [[0.1, 0.1, 0.1], [0.2, 0.1, 0.1], [0.3, 0.1, 0.1], [1.1, 0.1, 0.1], [1.2, 0.1, 0.1]]
    )
    assert sorted(thin_points(points, 0.5, np.zeros((5, 3))).tolist()) == [0, 3]
    spread = np.array(
        [[0.3, 0.0, 0.0], [0.0, 0.1, 0.1], [0.0, 0.0, 0.2], [0.2, 0.0, 0.0], [0.0, 0.2, 0.0]]
    )
    assert sorted(thin_points(points, 0.5, spread).tolist()) == [1, 3]


def test_evidence_of_unlabelled_voxels_asks_for_anything_occupied() -> None:
    query = Query(block_map({(0, 0, 0): UNLABELLED, (3, 0, 0): 2}), np.zeros((1, 3)), V)
    bits = dict(
        zip(map(tuple, query.evidence.centres.tolist()), query.evidence.bits.tolist(), strict=True)
    )
    assert bits == {(0.25, 0.25, 0.25): ANY_BIT, (1.75, 0.25, 0.25): 2}
