"""Coarse and fine fits: where they end, which place they leave, how they are measured."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from semloc_logs.alignment import refine as refine_module
from semloc_logs.alignment.icp import Fit, Step, Weighting, align
from semloc_logs.alignment.query_map import Query
from semloc_logs.alignment.refine import coarse_fit, escaped, fine_fit, measured
from semloc_logs.alignment.search import Candidate
from semloc_logs.alignment.target_map import PLANE_NOISE, UNCERTAIN_RADII, Target
from semloc_logs.arrays import F64
from semloc_logs.numerics.transforms import apply, inverse, yaw_transform
from tests.alignment.voxel_maps import V, block_map, moved, points_of, town


@pytest.mark.parametrize("degrees", [0, 90, 180, 270])
def test_an_alignment_is_measured_as_it_is(degrees: int) -> None:
    """Planes of the town under the true transform: nearly all points lie on them, and every third
    point stands for three.
    """
    truth = yaw_transform(np.radians(degrees), (3.0, -2.0, 0.5))
    target = Target(block_map(town()), V)
    points = points_of(town())
    query = Query(block_map(moved(town(), truth)), apply(inverse(truth), points), V)
    fit = measured(truth, target.surface, query)
    np.testing.assert_array_equal(fit.target_T_query, truth)
    assert fit.inliers > 0.99
    assert fit.rmse < 0.1 * V
    assert fit.count == pytest.approx(len(points[::3]), rel=0.01)
    whole = align(query.points, target.surface, truth, (Step(0.4 * V, 0, 1),))
    np.testing.assert_allclose(
        fit.information[:3, :3],
        whole.information[:3, :3],
        rtol=0.05,
        atol=0.02 * whole.information[:3, :3].max(),
    )
    beside = measured(
        yaw_transform(np.radians(degrees), (3.0, -2.0, 0.5 + 0.3)), target.surface, query
    )
    assert beside.inliers < 0.9


@pytest.mark.parametrize("degrees", [0, 90, 180, 270])
def test_a_coarse_fit_leaves_a_place_that_looks_alike(degrees: int) -> None:
    """A fit two voxels beside the truth gets away, one at the truth stays; a fine fit of a coarse
    one is at the truth to a tenth of a voxel.
    """
    truth = yaw_transform(np.radians(degrees), (3.0, -2.0, 0.5))
    target = Target(block_map(town()), V)
    query = Query(block_map(moved(town(), truth)), apply(inverse(truth), points_of(town())), V)
    candidate = Candidate(0, yaw_transform(0.02, (0.8 * V, -0.6 * V, 0.3 * V)) @ truth, 1.0, 10)
    right = coarse_fit(candidate, target, query)
    assert np.linalg.norm(right.target_T_query[:3, 3] - truth[:3, 3]) < 0.2 * V
    assert escaped(right, candidate, target, query, 20) is right

    beside = yaw_transform(0.0, (2 * V, -2 * V, 0.0)) @ truth
    wrong = measured(beside, target.surface, query)
    escaped_fit = escaped(wrong, candidate, target, query, 20)
    assert np.linalg.norm(escaped_fit.target_T_query[:3, 3] - truth[:3, 3]) < 0.2 * V
    fine = fine_fit(right.target_T_query, target.surface, query)
    assert np.linalg.norm(fine.target_T_query[:3, 3] - truth[:3, 3]) < 0.1 * V
    assert fine.count == len(query.points)  # the last step takes all of them


def fit_at(x: float) -> Fit:
    T = yaw_transform(0.0, (x, 0.0, 0.0))
    return Fit(T, 1.0, 100, 0.1, np.eye(6), np.zeros(3), np.zeros((2, 6)))


@pytest.mark.parametrize(
    ("of_target", "of_query", "uncertain"),
    [(0.2, 0.2, False), (0.3, 0.2, True), (0.2, 0.3, True)],
)
def test_a_fine_fit_looks_farther_and_is_held_where_either_side_is_uncertain(
    of_target: float, of_query: float, uncertain: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By more than a quarter of a voxel. Of 12 000 points every second one is taken, at last."""
    asked: list[object] = []

    def align(points: object, surface: object, start: object, *how: object) -> Fit:
        asked.extend([how[0], how[2]])
        return fit_at(0.0)

    monkeypatch.setattr(refine_module, "align", align)
    monkeypatch.setattr(refine_module, "ground_bias", lambda *_: np.ones((3, 6)))
    surface = SimpleNamespace(sigma=of_target * V)
    query = SimpleNamespace(
        points=np.zeros((12_000, 3)), spread=None, sigma=of_query * V, voxel_size=V
    )
    fit = fine_fit(np.eye(4), cast(Any, surface), cast(Any, query))
    if uncertain:
        steps = (Step(3.0 * V, 10, 6), Step(2.0 * V, 20, 4), Step(2.0 * V, 1, 2))
        assert asked == [steps, Weighting(PLANE_NOISE * V, 10.0)]
        assert not fit.ground_bias.any()
    else:
        steps = (Step(0.7 * V, 6, 6), Step(0.4 * V, 10, 4), Step(0.4 * V, 1, 2))
        assert asked == [steps, Weighting(PLANE_NOISE * V, 0.0)]
        assert fit.ground_bias.all()


@pytest.mark.parametrize(
    ("voxels", "score", "leaves"),
    [(1.1, 0.6, True), (0.9, 0.6, False), (1.1, 0.5, False)],
)
def test_a_coarse_fit_is_left_for_a_start_a_voxel_away_that_scores_higher(
    voxels: float, score: float, leaves: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of 0.5. Of 18 headings, 0.6 of half of 20 degrees to either side are tried."""
    turns = []

    def search(
        grid: object, evidence: object, pose: F64, yaws: F64, step: int
    ) -> tuple[float, F64]:
        turns.append(np.degrees(yaws))
        return 1.0, pose + np.array([0.0, voxels * V, 0.0, 0.0])

    monkeypatch.setattr(refine_module, "search", search)
    monkeypatch.setattr(
        refine_module, "coarse_fit", lambda candidate, *_: fit_at(candidate.target_T_query[0, 3])
    )
    monkeypatch.setattr(
        refine_module,
        "structure_scores",
        lambda query, target, T: SimpleNamespace(score=score if T[0, 3] > 2.0 else 0.5),
    )
    query = cast(Any, SimpleNamespace(voxel_size=V, evidence=None))
    fit = fit_at(2.0)
    candidate = Candidate(0, np.eye(4), 1.0, 10)
    escaped_fit = escaped(fit, candidate, cast(Any, SimpleNamespace(mask_grid=None)), query, 18)
    np.testing.assert_allclose(turns, [[-6.0, -3.0, 0.0, 3.0, 6.0]], atol=1e-12)
    assert escaped_fit.target_T_query[0, 3] == pytest.approx(2.0 + voxels * V if leaves else 2.0)
    assert (escaped_fit is fit) != leaves


def test_an_alignment_of_uncertain_points_is_measured_by_their_radius() -> None:
    """Every third point, out to two voxels, stands for three: also where ranges may all be off."""
    target = Target(block_map(town()), V)
    points = points_of(town())
    spread = 0.8 * V * points / np.linalg.norm(points, axis=1, keepdims=True)
    query = Query(block_map(town()), points, V, spread)
    beside = yaw_transform(0.0, (0.0, 0.0, 1.5 * V))
    fit = measured(beside, target.surface, query)
    step = Step(UNCERTAIN_RADII[1] * V, 0, 1)
    whole = align(points, target.surface, beside, (step,), spread, Weighting(PLANE_NOISE * V))
    assert fit.inliers == pytest.approx(whole.inliers, abs=0.02)
    assert np.abs(whole.range_bias).max() > 0
    np.testing.assert_allclose(
        fit.range_bias, whole.range_bias, atol=0.1 * np.abs(whole.range_bias).max()
    )
