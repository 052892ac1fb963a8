"""Protocols of the literature, on frames that can be counted by hand."""

from __future__ import annotations

import numpy as np
import pytest

from semloc_logs.experiments.protocols import (
    Retrieval,
    loop_decisions,
    loop_figures,
    nearest_frames,
    pair_figures,
    registration_figures,
)

NOTHING = -np.inf


def road(*x: float) -> np.ndarray:
    return np.array([[value, 0.0, 0.0] for value in x])


def test_the_frame_of_a_pose_is_the_nearest_view() -> None:
    positions = np.array([[[9.0, 1, 0], [31.0, 0, 0], [np.nan] * 3]])
    assert nearest_frames(positions, road(0.0, 10.0, 20.0)).tolist() == [[1, 2, -1]]


def test_a_loop_is_right_within_four_metres() -> None:
    answers = Retrieval(
        queries=road(0.0, 13.9, 50.0, 20.0),
        database=road(0.0, 10.0, 20.0),
        frame=np.array([[0], [1], [2], [-1]]),
        score=np.array([[0.9], [0.8], [0.7], [NOTHING]]),
    )
    decisions = loop_decisions(answers)
    # 13.9 m is 3.9 m from the view at 10 m; nothing lies within 4 m of 50 m; 20 m got no answer
    assert decisions.right.tolist() == [True, True, False, False]
    assert decisions.has_loop.tolist() == [True, True, False, True]
    figures = loop_figures([answers])
    assert figures.loops == 3
    assert figures.average_precision == pytest.approx(2 / 3)
    assert figures.recall_at_full_precision == pytest.approx(2 / 3)
    assert figures.best_f1 == pytest.approx(0.8)
    # two trials with databases of their own are pooled
    assert loop_figures([answers, answers]).loops == 6


def test_pairs_within_three_metres_beside_pairs_beyond_twenty() -> None:
    answers = Retrieval(
        queries=road(0.0, 100.0),
        database=road(1.0, 10.0, 50.0, 102.0),
        frame=np.array([[0, 2], [2, 3]]),
        score=np.array([[0.9, 0.4], [0.8, 0.7]]),
    )
    figures = pair_figures([answers])
    # positive: 0 m and 1 m; 100 m and 102 m. negative: 0 m with 50 and 102 m; 100 m with 1, 10, 50
    assert (figures.positives, figures.negatives) == (2, 5)
    # by score: 0.9 right, 0.8 wrong, 0.7 right, 0.4 wrong
    assert figures.best_f1 == pytest.approx(0.8)
    assert figures.extended_precision == pytest.approx((1.0 + 0.5) / 2)


def test_a_registration_succeeds_within_two_metres_and_five_degrees() -> None:
    error_m = np.array([0.5, 1.5, 2.5, 0.1, np.inf])
    error_deg = np.array([1.0, 3.0, 1.0, 6.0, np.inf])
    figures = registration_figures(error_m, error_deg, np.arange(5))
    assert figures.success.value == pytest.approx(0.4)
    assert (figures.translation_m, figures.rotation_deg) == (1.0, 2.0)
