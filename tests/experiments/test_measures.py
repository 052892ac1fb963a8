"""Measures, on answers that can be counted by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import binomtest

from semloc_logs.experiments.measures import (
    abstaining,
    admission,
    difference,
    difference_of_ratios,
    error_curve,
    localised,
    median_within,
    precision_recall,
    rank_recall,
    ratio,
    resampled,
    wilson,
)

NEVER = np.inf


@pytest.mark.parametrize(("successes", "n"), [(0, 10), (3, 10), (10, 10), (57, 100)])
def test_wilsons_bounds_are_scipys(successes: int, n: int) -> None:
    expected = binomtest(successes, n).proportion_ci(0.95, "wilson")
    bounds = wilson(successes, n)
    assert (bounds.low, bounds.high) == pytest.approx((expected.low, expected.high), abs=1e-9)


def test_nothing_is_known_without_samples() -> None:
    bounds = wilson(0, 0)
    assert math.isnan(bounds.value)
    assert (bounds.low, bounds.high, bounds.n) == (0.0, 1.0, 0)


def test_a_query_counts_from_the_rank_of_its_first_near_pose_on() -> None:
    errors = np.array([[0.5, 9.0, 9.0], [7.0, 0.9, 9.0], [7.0, 3.0, 0.2], [NEVER] * 3])
    assert rank_recall(errors, 1.0).tolist() == [0.25, 0.5, 0.75]
    assert rank_recall(errors, 5.0).tolist() == [0.25, 0.75, 0.75]
    assert localised(errors, 1.0).tolist() == [True, False, False, False]
    assert localised(errors, 1.0, 2).tolist() == [True, True, False, False]


def test_the_error_curve_is_the_share_of_first_poses_within_an_error() -> None:
    first = np.array([0.5, 2.0, 2.0, NEVER])
    assert error_curve(first, np.array([0.0, 0.5, 1.0, 2.0, 99.0])).tolist() == [
        0.0,
        0.25,
        0.25,
        0.75,
        0.75,
    ]
    assert median_within(first, 5.0) == 2.0
    assert math.isnan(median_within(first, 0.1))


def test_a_bootstrap_draws_whole_passages() -> None:
    passage = np.array([7, 7, 9, 9, 9])
    weights = resampled(passage, samples=50)
    assert weights.shape == (50, 5)
    assert (weights[:, 0] == weights[:, 1]).all()
    assert (weights[:, 2] == weights[:, 4]).all()
    assert (weights[:, 0] + weights[:, 2] == 2).all()


def test_queries_of_one_passage_tell_no_more_than_one_query() -> None:
    passage = np.repeat(np.arange(20), 20)
    of_passage = np.arange(20) < 10
    together = ratio(np.repeat(of_passage, 20), passage)
    alone = ratio(np.arange(400) < 200, np.arange(400))
    assert together.value == alone.value == 0.5
    assert together.high - together.low > 3 * (alone.high - alone.low)
    assert (together.n, alone.n) == (20, 400)
    # 20 fair coins: the standard deviation of their mean is 0.112
    assert together.high - together.low == pytest.approx(2 * 1.96 * 0.112, rel=0.15)


def test_where_all_queries_are_alike_the_passages_are_the_samples() -> None:
    share = ratio(np.ones(40, bool), np.repeat(np.arange(10), 4))
    assert share == wilson(10, 10)


def test_a_difference_on_the_same_queries_is_surer_than_on_others() -> None:
    rng = np.random.default_rng(0)
    passage = np.arange(200)
    other = rng.random(200) < 0.5
    one = other | (np.arange(200) % 10 == 0)
    paired = difference(one, other, passage)
    unpaired = difference_of_ratios(ratio(one, passage), ratio(other, passage))
    assert paired.value == pytest.approx(unpaired.value)
    assert paired.low > 0 > unpaired.low


def test_precision_and_recall_of_four_decisions() -> None:
    score = np.array([0.9, 0.8, 0.7, 0.6, -np.inf])
    right = np.array([True, True, False, True, True])
    curve = precision_recall(score, right, positives=4)
    assert curve.precision.tolist() == [1.0, 1.0, 2 / 3, 0.75]
    assert curve.recall.tolist() == [0.25, 0.5, 0.5, 0.75]
    assert curve.average_precision == pytest.approx(0.25 + 0.25 + 0.25 * 0.75)
    assert curve.best_f1 == pytest.approx(0.75)
    assert curve.recall_at_full_precision == 0.5
    assert curve.extended_precision == pytest.approx(0.75)


def test_decisions_of_one_score_are_accepted_together() -> None:
    curve = precision_recall(np.array([1.0, 1.0]), np.array([True, False]), positives=1)
    assert curve.precision.tolist() == [0.5]
    assert precision_recall(np.zeros(0), np.zeros(0, bool), 0).best_f1 == 0.0


def test_the_threshold_admits_the_allowed_share_of_wrong_ones() -> None:
    score = np.array([5.0, 4.0, 3.0, 2.0, 1.0])
    right = np.array([True, True, False, True, False])
    assert admission(score, right, allowed=0.0) == 4.0
    assert admission(score, right, allowed=0.25) == 2.0
    assert admission(score, ~np.ones(5, bool), allowed=0.25) == math.inf


def test_abstaining_is_judged_by_the_threshold_of_the_other_half() -> None:
    # wrong answers score below right ones, in both halves
    passage = np.arange(40)
    right = np.arange(40) % 4 < 2
    score = np.where(right, 2.0, 1.0)
    figures = abstaining(score, right, passage, allowed=0.0)
    assert figures.false_discovery.value == 0.0
    assert figures.coverage.value == 0.5
    # a half in which wrong ones score highest admits nothing to the other half
    odd = passage % 2 == 1
    score = np.where(odd & ~right, 3.0, score)
    figures = abstaining(score, right, passage, allowed=0.0)
    assert figures.coverage.value == pytest.approx(0.5)
    assert figures.false_discovery.value == pytest.approx(0.5)
