"""The reasons of rejections: which veto or factor rejects, and its sentence."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from semloc_logs.closures.acceptance import decide
from semloc_logs.closures.acceptance.calibration import (
    Calibration,
    Model,
    probability_of,
    shipped,
)
from semloc_logs.closures.acceptance.decide import weakest, why_rejected
from semloc_logs.closures.closure import (
    Agreement,
    Alignment,
    Decision,
    Features,
    Reason,
    Rejected,
    Veto,
)

GOOD = Features(
    structure=0.95,
    coverage=0.9,
    contradiction=0.02,
    fit=0.95,
    support=3.0,
    stiffness=3.0,
    range_sigma=0.0,
)
SURE = Agreement(0.999, 12.0, 12.0, 0.0, 0.0, 0.0, 0.0)
# 10 less for each e-fold of contradiction, 1 more for the stiffness, 4 less for a voxel of sigma
MODEL = Model(
    Calibration((-10.0, 1.0, -4.0), (-9.0,) * 3, (9.0,) * 3, (np.log(0.02), 3.0, 0.0), -30.0),
    shipped().votes,
    20.0,
    0.125,
)


def decision(
    place: float, confidence: float = 1.0, share: float = 1.0, vetoes: frozenset[Veto] = frozenset()
) -> Decision:
    return Decision(vetoes, place, share, confidence, SURE, 0.99)


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
        inliers=10,
        words=5,
        features=features,
    )
    return Rejected(alignment, made, reason).sentence


def why(made: Decision, votes: Agreement[float] = SURE, features: Features[float] = GOOD) -> Reason:
    return why_rejected(dataclasses.replace(made, agreement=votes), features, MODEL)


@pytest.mark.parametrize(
    ("change", "reason", "text"),
    [
        (
            {"contradiction": 0.2},
            Reason.FREE_SPACE,
            "20 % of the structure of both sides lies in free space",
        ),
        (
            {"stiffness": 0.1, "fit": 0.4},
            Reason.LOOSE_FIT,
            "only 40 % of the points lie on a surface",
        ),
        (
            {"range_sigma": 1.5},
            Reason.UNCERTAIN_RANGES,
            "the ranges are too uncertain (1.5 voxels)",
        ),
    ],
)
def test_the_weakest_evidence_is_named(change: dict[str, float], reason: Reason, text: str) -> None:
    features = dataclasses.replace(GOOD, **change)
    assert weakest(features, MODEL) is reason
    assert sentence(reason, decision(0.1234), features) == f"probability 0.123 below 0.99: {text}"


def test_of_two_kinds_of_weak_evidence_the_one_that_takes_more_is_named() -> None:
    # 10 log 2 = 6.9, against 4 x 1.7 = 6.8 and 4 x 1.8 = 7.2
    for sigma, reason in ((1.7, Reason.FREE_SPACE), (1.8, Reason.UNCERTAIN_RANGES)):
        features = dataclasses.replace(GOOD, contradiction=0.04, range_sigma=sigma)
        assert weakest(features, MODEL) is reason


@pytest.mark.parametrize(
    ("veto", "reason"),
    [
        (Veto.CONTRADICTS_ODOMETRY, Reason.CONTRADICTS_ODOMETRY),
        (Veto.AMBIGUOUS_PLACE, Reason.AMBIGUOUS_PLACE),
        (Veto.LOOSE_FIT, Reason.LOOSE_FIT),
    ],
)
def test_a_veto_rejects_whatever_the_probability(veto: Veto, reason: Reason) -> None:
    made = decision(0.9999, vetoes=frozenset({veto}))
    assert made.probability == 0.9999
    assert why(made) is reason
    assert "probability" not in sentence(reason, made)


def test_an_ambiguous_place_says_how_much() -> None:
    votes = dataclasses.replace(SURE, ambiguity=0.9)
    made = dataclasses.replace(
        decision(0.9999, vetoes=frozenset({Veto.AMBIGUOUS_PLACE})), agreement=votes
    )
    assert sentence(Reason.AMBIGUOUS_PLACE, made) == (
        "ambiguous place: 90 % of nearby queries match elsewhere"
    )


def test_neighbours_that_conflict() -> None:
    votes = Agreement(0.995, 12.0, 1.04, 7.96, 0.0, 0.0, 0.0)
    made = dataclasses.replace(decision(0.5), agreement=votes)
    assert why(made, votes) is Reason.NEIGHBOURS_CONFLICT
    assert sentence(Reason.NEIGHBOURS_CONFLICT, made) == (
        "probability 0.500 below 0.99: neighbouring queries conflict: of 12, 1.0 support this place"
        " and 8.0 match elsewhere"
    )
    # by itself it would not have been accepted either
    assert why(made, dataclasses.replace(votes, own_probability=0.98)) is Reason.RIVAL_PLACE


def test_rivals_are_named_where_they_alone_reject() -> None:
    votes = dataclasses.replace(SURE, own_probability=0.5)
    made = dataclasses.replace(decision(0.5), agreement=votes)
    assert why(made, votes) is Reason.RIVAL_PLACE
    assert sentence(Reason.RIVAL_PLACE, made) == (
        "probability 0.500 below 0.99: other places fit too: by itself this one has a probability"
        " of 0.50"
    )
    weak = dataclasses.replace(GOOD, contradiction=0.2)  # log-odds of 16 - 30 + 3: no rival needed
    assert why(made, votes, weak) is Reason.FREE_SPACE


def test_a_right_place_in_which_the_position_is_uncertain() -> None:
    made = decision(0.999, confidence=0.6827)
    assert why(made) is Reason.UNCERTAIN_POSITION
    assert sentence(Reason.UNCERTAIN_POSITION, made, sigma=0.8) == (
        "probability 0.682 below 0.99: position uncertainty 0.80 m (1 sigma) is too large"
    )
    assert why(decision(0.992, confidence=0.994)) is Reason.UNCERTAIN_POSITION  # the place would do
    assert why(decision(0.98, confidence=0.6827)) is not Reason.UNCERTAIN_POSITION  # it would not


def test_a_right_place_with_several_pose_modes() -> None:
    made = decision(0.999, confidence=0.9, share=0.86)
    assert why(made) is Reason.POSE_MODES
    assert sentence(Reason.POSE_MODES, made) == (
        "probability 0.773 below 0.99: other poses fit this place too: this one has 86 % of the"
        " odds"
    )
    assert why(decision(0.999, 0.86, 0.9)) is Reason.UNCERTAIN_POSITION


def test_as_much_as_is_required_is_enough() -> None:
    """Of the probability and of each of its factors: they do not reject."""
    loose = decision(0.99, vetoes=frozenset({Veto.LOOSE_FIT}))
    assert loose.probability == loose.min_probability
    assert why(loose) is Reason.LOOSE_FIT
    assert why(decision(0.99, confidence=0.9)) is Reason.UNCERTAIN_POSITION
    assert why(decision(0.99, confidence=0.9, share=0.9)) is Reason.UNCERTAIN_POSITION
    votes = dataclasses.replace(SURE, own_probability=0.99)
    assert why(decision(0.5), votes) is Reason.NEIGHBOURS_CONFLICT
    weak = dataclasses.replace(GOOD, contradiction=0.03)
    by_itself = float(probability_of(MODEL.own_log_odds(weak)))
    rivals = dataclasses.replace(decision(0.5), min_probability=by_itself)
    votes = dataclasses.replace(SURE, own_probability=0.5)
    assert why(rivals, votes, weak) is Reason.RIVAL_PLACE


def test_every_reason_has_a_sentence() -> None:
    sentences = [sentence(reason, decision(0.5)) for reason in Reason]
    assert len(set(sentences)) == len(Reason)
    assert not any("{" in text for text in sentences)


def test_what_has_just_the_required_probability_passes() -> None:
    at_bound = dataclasses.replace(
        decision(0.9999, vetoes=frozenset({Veto.LOOSE_FIT})), min_probability=0.9999
    )
    assert why(at_bound) is Reason.LOOSE_FIT
    place = dataclasses.replace(decision(0.99, confidence=0.5), min_probability=0.99)
    assert why(place) is Reason.UNCERTAIN_POSITION
    neighbours = dataclasses.replace(SURE, own_probability=0.99)
    assert why(decision(0.5), neighbours) is Reason.NEIGHBOURS_CONFLICT


def test_each_query_has_one_first_alignment_in_each_target() -> None:
    class Rows:
        pair = np.array([2, 0, 0, 2])
        query_keyframe = np.array([0, 1, 1, 0])

        def __len__(self) -> int:
            return 4

    first = decide._is_first(cast(Any, Rows()), np.array([3, 2, 0, 1]))
    np.testing.assert_array_equal(first, [False, False, True, True])


def test_alignments_are_ordered_by_query_then_probability_then_structure() -> None:
    rows = SimpleNamespace(
        pairs=[("b", "a"), ("a", "b")],
        pair=np.array([0, 0, 1, 0]),
        query_stamp_ns=np.array([10, 10, 50, 10]),
        target_stamp_ns=np.ones(4, int),
        features=SimpleNamespace(structure=np.array([0.3, 0.6, 0.1, 0.9])),
    )
    order = decide._order(cast(Any, rows), np.array([0.5, 0.5, 0.2, 0.4]))
    np.testing.assert_array_equal(order, [2, 1, 0, 3])
