"""Hypotheses of the paper on made answers."""

from __future__ import annotations

import numpy as np
import pytest

from semloc_logs.experiments.answers import Answers
from semloc_logs.experiments.orderings import (
    FAMILIES,
    FPFH,
    SIFT,
    Finding,
    Verdict,
    findings,
)
from semloc_logs.experiments.system import MOST_POSES

QUERIES = 60
PAPER, OURS = FAMILIES
SEMANTIC, GEOMETRIC, ACCUMULATED = PAPER.semantic, PAPER.geometric, PAPER.accumulated


def answers(share: float, rank: int = 1) -> Answers:
    """The first ``share`` of the queries, of 60 passages, have a right pose at a rank."""
    errors = np.full((QUERIES, MOST_POSES), np.inf)
    errors[: round(share * QUERIES), rank - 1] = 0.5
    return Answers(
        queries=[f"q{k:03d}" for k in range(QUERIES)],
        errors_m=errors,
        errors_deg=errors,
        score=np.where(np.isfinite(errors), 1.0, -np.inf),
        positions=np.full((QUERIES, MOST_POSES, 3), np.nan),
        truth=np.zeros((QUERIES, 3)),
        trial=["000"] * QUERIES,
        passage=np.arange(QUERIES),
        cpu_s=np.zeros(QUERIES),
    )


def finding(known: dict[tuple[str, str, str], Answers], text: str, scenario: str) -> Finding:
    (only,) = [
        f
        for f in findings(known, [SIFT, FPFH])
        if f.hypothesis == text and f.scenario == scenario and f.method in (PAPER.title, "SIFT")
    ]
    return only


@pytest.mark.parametrize(
    ("semantic", "geometric", "verdict"),
    [
        (0.8, 0.4, Verdict.HOLDS),
        (0.4, 0.8, Verdict.FAILS),
        (0.5, 0.5, Verdict.UNDECIDED),
    ],
)
def test_an_order_holds_where_its_bounds_exclude_the_other_one(
    semantic: float, geometric: float, verdict: Verdict
) -> None:
    known = {
        (SEMANTIC, "lidar", "90"): answers(semantic),
        (GEOMETRIC, "lidar", "90"): answers(geometric),
    }
    order = finding(known, "semantic above geometric", "90")
    assert order.verdict == verdict
    assert order.figure is not None
    assert order.figure.value == pytest.approx(semantic - geometric)
    assert finding(known, "geometric above FPFH", "90").verdict == Verdict.UNKNOWN


def test_acc_is_compared_with_the_single_frame_on_the_same_queries() -> None:
    known = {
        (SEMANTIC, "stereo", "180"): answers(0.5),
        (ACCUMULATED, "stereo", "180"): answers(0.9),
    }
    assert finding(known, "acc. above single", "180").verdict == Verdict.HOLDS
    assert finding(known, "acc. above single", "0").verdict == Verdict.UNKNOWN


def test_180_is_easier_than_90() -> None:
    known = {
        (SEMANTIC, "lidar", "90"): answers(0.3),
        (SEMANTIC, "lidar", "180"): answers(0.9),
    }
    assert finding(known, "180 easier than 90", "180, 90").verdict == Verdict.HOLDS


@pytest.mark.parametrize(
    ("share", "verdict"),
    [(0.0, Verdict.UNDECIDED), (0.5, Verdict.FAILS)],
)
def test_few_passages_do_not_show_that_sift_is_near_zero(share: float, verdict: Verdict) -> None:
    known = {(SIFT, "lidar", "90"): answers(share)}
    assert finding(known, "SIFT localises less than 5%", "90").verdict == verdict


def test_sift_beats_ours_at_high_ranks_only() -> None:
    known = {
        (SIFT, "lidar", "0"): answers(0.95, rank=40),
        (SEMANTIC, "lidar", "0"): answers(0.6),
    }
    text = f"SIFT above it within the first {MOST_POSES} poses"
    assert finding(known, text, "0").verdict == Verdict.HOLDS


def test_ours_falls_least_from_one_time_to_another() -> None:
    known = {}
    for system, same, other in ((SEMANTIC, 0.9, 0.85), (SIFT, 0.95, 0.1), (FPFH, 0.6, 0.2)):
        known[system, "lidar", "summer>summer"] = answers(same)
        known[system, "lidar", "summer>snow"] = answers(other)
    text = "from one time to another it falls least"
    order = finding(known, text, "cross-time")
    assert order.verdict == Verdict.HOLDS
    assert order.figure is not None
    # FPFH falls by 0.4, ours by 0.05
    assert order.figure.value == pytest.approx(0.35)


def test_our_pipeline_is_tested_in_its_own_right() -> None:
    known = {
        (OURS.semantic, "lidar", "90"): answers(0.5),
        (OURS.accumulated, "lidar", "90"): answers(0.9),
    }
    verdicts = {
        f.method: f.verdict
        for f in findings(known, [])
        if f.hypothesis == "acc. above single" and f.scenario == "90"
    }
    assert verdicts == {PAPER.title: Verdict.UNKNOWN, OURS.title: Verdict.HOLDS}
