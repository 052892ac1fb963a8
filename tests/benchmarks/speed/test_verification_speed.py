"""Verification beside the paper's own (3.5), written out slowly, on the drawn place of the
benchmark.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semloc_logs.alignment.hypotheses import pose_matrix, same_place, yaw_between
from semloc_logs.alignment.refine import coarse_fit, escaped, fine_fit
from semloc_logs.alignment.scores import structure_scores
from semloc_logs.alignment.search import search_hypotheses
from semloc_logs.alignment.surface import surface_of
from semloc_logs.alignment.target_map import FINE_RADII
from semloc_logs.alignment.tau import tau
from semloc_logs.arrays import F64
from semloc_logs.benchmarks.speed.verification_speed import TRUTH, Scene, scene
from semloc_logs.numerics.transforms import inverse
from semloc_logs.settings import Settings
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE

KAPPA = 3.0


@pytest.fixture(scope="module")
def made() -> Scene:
    return scene(Settings().resolved(), 20.0, 12)


def slow_tau(s: Scene, T: F64, every: int) -> float:
    """The paper's ratio on every so manyth voxel: the closest observed one of all decides."""
    v = s.target.voxel_size
    low, high = s.target.blocks.bounds()
    state = s.target.blocks.dense(low, tuple((high - low).tolist()))
    observed = np.argwhere(state != UNOBSERVED_STATE)
    states = state[tuple(observed.T)]
    centres = (observed + low + 0.5) * v
    ijk, label = s.query.blocks.occupied()
    aligned = 0
    for p, c in zip((ijk[::every] + 0.5) * v, label[::every], strict=True):
        squared = ((centres - (T[:3, :3] @ p + T[:3, 3])) ** 2).sum(1)
        n = int(squared.argmin())
        aligned += int(
            squared[n] < KAPPA**2
            and states[n] not in (FREE_STATE, UNOBSERVED_STATE)
            and states[n] == c
        )
    return aligned / len(label[::every])


def test_the_ratio_is_the_papers(made: Scene) -> None:
    for h in made.hypotheses[:3]:
        T = pose_matrix(np.array(h.pose))
        ratio, _ = tau(made.query.occupied, made.target.blocks, made.target.voxel_size, T, KAPPA)
        assert ratio == pytest.approx(slow_tau(made, T, 60), abs=0.08)  # of a sample


def test_the_search_ranks_first_what_the_paper_ranks_first(made: Scene) -> None:
    """The paper's ranking is by tau of the hypotheses as refined; the true one is first in both, by
    far.
    """
    v = made.target.voxel_size
    candidates = search_hypotheses(made.hypotheses, {0: made.target}, made.query, 18, 6)
    by_paper = [
        tau(made.query.occupied, made.target.blocks, v, c.target_T_query, KAPPA)[0]
        for c in candidates
    ]
    assert int(np.argmax(by_paper)) == 0
    assert same_place(candidates[0].target_T_query, pose_matrix(TRUTH), v)
    assert candidates[0].score > 1.3 * candidates[1].score


def test_a_fit_escapes_to_where_more_voxels_agree(made: Scene) -> None:
    """Started 1 m and more off, past what a coarse fit finds its way back from; the fit of the
    truth stays as it is.
    """
    v = made.target.voxel_size
    best = search_hypotheses(made.hypotheses, {0: made.target}, made.query, 18, 6)[0]
    right = replace(best, target_T_query=pose_matrix(TRUTH))
    settled = coarse_fit(right, made.target, made.query)
    assert escaped(settled, right, made.target, made.query, 18) is settled
    off = replace(best, target_T_query=pose_matrix(TRUTH + np.array([0.0, 1.1, 1.1, 0.0])))
    stuck = coarse_fit(off, made.target, made.query)
    assert not same_place(stuck.target_T_query, pose_matrix(TRUTH), v / 2)
    assert same_place(
        escaped(stuck, off, made.target, made.query, 18).target_T_query, pose_matrix(TRUTH), v / 2
    )


def test_the_transform_put_in_comes_back(made: Scene) -> None:
    truth = pose_matrix(TRUTH)
    v = made.target.voxel_size
    best = search_hypotheses(made.hypotheses, {0: made.target}, made.query, 18, 6)[0]
    coarse = coarse_fit(best, made.target, made.query)
    assert np.linalg.norm((inverse(truth) @ coarse.target_T_query)[:3, 3]) < FINE_RADII[0] * v
    fine = fine_fit(coarse.target_T_query, surface_of(made.points, 2 * v), made.query)
    assert np.linalg.norm((inverse(truth) @ fine.target_T_query)[:3, 3]) < 0.01
    assert yaw_between(fine.target_T_query, truth) < 0.001
    scores = structure_scores(made.query, made.target, fine.target_T_query)
    assert scores.structure > 0.9
    assert scores.contradiction < 0.05
