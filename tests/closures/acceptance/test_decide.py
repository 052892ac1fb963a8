"""The reasons of rejections: which gate rejects, and its sentence."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest

from semloc_logs.closures.acceptance.calibration import shipped
from semloc_logs.closures.acceptance.decide import low_probability, weakest_evidence
from semloc_logs.closures.closure import (
    Agreement,
    Alignment,
    Decision,
    Features,
    Reason,
    Rejected,
)

GOOD = Features(
    structure=0.95,
    coverage=0.9,
    contradiction=0.02,
    fit=0.95,
    rmse=0.1,
    distinct=0.2,
    support=3.0,
    stiffness=3.0,
)
SURE = Agreement(0.999, 12.0, 12.0, 0.0, 0.0, 0.0, 0.0)


def decision(place: float, confidence: float = 1.0, share: float = 1.0) -> Decision:
    return Decision(place * confidence * share, SURE, place, confidence, share, 0.99)


def sentence(
    reason: Reason, made: Decision, features: Features[float] = GOOD, sigma: float = 0.1
) -> str:
    alignment = Alignment(
        query_session="a",
        target_session="b",
        query_keyframe=1,
        target_keyframe=2,
        query_stamp_ns=3,
        target_stamp_ns=4,
        target_T_query=np.eye(4),
        covariance=np.diag([sigma**2, 0.01**2, 0.01**2, 1e-6, 1e-6, 1e-6]),
        overlap=0.5,
        probability=0.9,
        inliers=10,
        words=5,
        features=features,
    )
    return Rejected(alignment, made, reason).sentence


@pytest.mark.parametrize(
    ("change", "reason", "text"),
    [
        (
            {"coverage": 0.1},
            Reason.UNOBSERVED,
            "only 10 % of the query's structure falls into observed space",
        ),
        (
            {"structure": 0.3},
            Reason.STRUCTURE_MISMATCH,
            "only 30 % of the query's structure lies on structure of its class",
        ),
        (
            {"distinct": 0.9},
            Reason.RIVAL_PLACE,
            "another place fits nearly as well (90 % of this score)",
        ),
        (
            {"distinct": 1.6},
            Reason.BETTER_RIVAL,
            "another place fits better (this one has at most 62 % of its score)",
        ),
        ({"fit": 0.4}, Reason.LOOSE_FIT, "only 40 % of the points lie on a surface"),
        ({}, Reason.WEAK_EVIDENCE, "the evidence together is too weak"),
    ],
)
def test_the_weakest_evidence_is_named(change: dict[str, float], reason: Reason, text: str) -> None:
    features = dataclasses.replace(GOOD, **change)
    assert weakest_evidence(features) is reason
    assert sentence(reason, decision(0.1234), features) == f"probability 0.123 below 0.99: {text}"


def test_neighbours_that_conflict() -> None:
    votes = Agreement(0.995, 12.0, 1.04, 7.96, 0.0, 0.0, 0.0)
    made = dataclasses.replace(decision(0.5), agreement=votes)
    reason = low_probability(Reason.WEAK_EVIDENCE, made)
    assert reason is Reason.NEIGHBOURS_CONFLICT
    assert sentence(reason, made) == (
        "probability 0.500 below 0.99: neighbouring queries conflict: of 12, 1.0 support this place"
        " and 8.0 match elsewhere"
    )


def test_an_ambiguous_place_is_named_where_nothing_else_rejects_it() -> None:
    votes = dataclasses.replace(SURE, ambiguity=0.9)
    made = dataclasses.replace(decision(0.4996), agreement=votes)
    reason = low_probability(Reason.WEAK_EVIDENCE, made)
    assert reason is Reason.AMBIGUOUS_PLACE
    assert sentence(reason, made) == (
        "probability 0.500 below 0.99: ambiguous place: 90 % of nearby queries match elsewhere"
    )
    # without the ambiguity the probability is still too low
    low = dataclasses.replace(made, place_probability=0.4)
    assert low_probability(Reason.WEAK_EVIDENCE, low) is Reason.NEIGHBOURS_CONFLICT
    clear = dataclasses.replace(
        made, agreement=dataclasses.replace(votes, ambiguity=shipped().max_ambiguity)
    )
    assert low_probability(Reason.WEAK_EVIDENCE, clear) is Reason.NEIGHBOURS_CONFLICT


def test_a_right_place_in_which_the_position_is_uncertain() -> None:
    made = decision(0.999, confidence=0.6827)
    reason = low_probability(Reason.WEAK_EVIDENCE, made)
    assert reason is Reason.UNCERTAIN_POSITION
    assert sentence(reason, made, sigma=0.8) == (
        "probability 0.682 below 0.99: position uncertainty 0.80 m (1 sigma) is too large"
    )
    assert (
        low_probability(Reason.WEAK_EVIDENCE, decision(0.992, confidence=0.994)) is reason
    )  # the place would do
    assert (
        low_probability(Reason.WEAK_EVIDENCE, decision(0.98, confidence=0.6827)) is not reason
    )  # it would not


def test_a_right_place_with_several_pose_modes() -> None:
    made = decision(0.999, confidence=0.9, share=0.86)
    reason = low_probability(Reason.WEAK_EVIDENCE, made)
    assert reason is Reason.POSE_MODES
    assert sentence(reason, made) == (
        "probability 0.773 below 0.99: other poses fit this place too: this one has 86 % of the"
        " odds"
    )
    assert (
        low_probability(Reason.WEAK_EVIDENCE, decision(0.999, 0.86, 0.9))
        is Reason.UNCERTAIN_POSITION
    )


def why(made: Decision, votes: Agreement[float], sigma: float = 0.1) -> str:
    """Why an alignment of good features is rejected."""
    made = dataclasses.replace(made, agreement=votes)
    return sentence(low_probability(weakest_evidence(GOOD), made), made, sigma=sigma)


def test_the_reason_is_the_first_that_holds() -> None:
    votes = Agreement(0.999, 12.0, 3.0, 2.0, 0.0, 0.0, 0.0)
    low = decision(0.5)
    assert "neighbouring" not in why(low, dataclasses.replace(votes, neighbours=0.0))
    assert "neighbouring" not in why(low, dataclasses.replace(votes, own_probability=0.98))
    assert "neighbouring" in why(low, dataclasses.replace(votes, own_probability=0.99))
    several = decision(0.594 / (0.9999 * 0.6), confidence=0.9999, share=0.6)
    assert "this one has 60 % of the odds" in why(several, votes)
    # the lesser of the two
    uncertain = decision(0.52 / (0.6 * 0.87), confidence=0.6, share=0.87)
    assert "position uncertainty 0.50 m" in why(uncertain, votes, sigma=0.5)
    ambiguous = dataclasses.replace(votes, ambiguity=0.9)
    assert "ambiguous place" in why(decision(0.495), ambiguous)
    assert "ambiguous place" not in why(decision(0.494), ambiguous)
    # the position is uncertain too, but the place comes first
    assert "ambiguous place" in why(decision(0.34 / 0.68, confidence=0.68), ambiguous, sigma=0.8)


@pytest.mark.parametrize("distinct", [0.86, 1.0, 1.01, 2.0])
def test_no_share_is_more_than_a_hundred_per_cent(distinct: float) -> None:
    features = dataclasses.replace(GOOD, distinct=distinct)
    reason = weakest_evidence(features)
    text = sentence(reason, decision(0.1), features)
    shares = [float(share) for share in re.findall(r"([\d.]+) %", text)]
    assert len(shares) == 1
    assert 50 <= shares[0] <= 100


def test_every_reason_has_a_sentence() -> None:
    sentences = [sentence(reason, decision(0.5)) for reason in Reason]
    assert len(set(sentences)) == len(Reason)
    assert not any("{" in text for text in sentences)
