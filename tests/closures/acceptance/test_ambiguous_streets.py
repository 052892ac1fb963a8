"""Streets that a session has twice, or that three sessions contradict each other about."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from semloc_logs.closures.acceptance.decide import decide
from semloc_logs.closures.closure import Alignment
from semloc_logs.mapping.drift import UNMEASURED
from semloc_logs.mapping.session_map import SessionMap
from tests.closures.acceptance.known_alignments import (
    COPIED,
    GOOD,
    MODEL,
    SETTINGS,
    STRAIGHT,
    STREETS,
    accepted,
    in_street,
    sentence,
)


def test_streets_that_a_target_has_twice_are_not_accepted_there_nor_anywhere_else() -> None:
    once = [in_street(k, k, target="c") for k in COPIED]
    assert all(
        accepted(a) and a.decision.agreement.ambiguity == 0
        for a in decide(once, STREETS, SETTINGS, model=MODEL)
    )
    # the second place of each fits less well, so the veto alone rejects them
    twice = [
        dataclasses.replace(
            in_street(k, k + off), features=dataclasses.replace(GOOD, stiffness=fits)
        )
        for k in COPIED
        for off, fits in ((0, 12.0), (30, 4.0))
    ]
    there = [in_street(k, k, "c", "a") for k in COPIED]
    back = [in_street(k, k, "b", "c") for k in COPIED]
    outcomes = decide(once + twice + there + back, STREETS, SETTINGS, model=MODEL)
    assert all(a.decision.agreement.ambiguity > 0.9 for a in outcomes)
    assert not any(accepted(a) for a in outcomes)
    assert sum("ambiguous place" in sentence(a) for a in outcomes) == len(outcomes) - len(COPIED)


def test_two_queries_of_a_street_do_not_make_all_of_it_look_like_others() -> None:
    right = [in_street(k, k, target="c") for k in range(2, 60)]
    twice = [
        in_street(k, target_keyframe) for k in (30, 31) for target_keyframe in (k - 25, k + 15)
    ]
    outcomes = [
        a
        for a in decide(right + twice, STREETS, SETTINGS, model=MODEL)
        if a.alignment.target_session == "c"
    ]
    assert all(accepted(a) and a.decision.agreement.ambiguity < 0.05 for a in outcomes)


@pytest.mark.parametrize(("road", "alike"), [(0.0, True), (2000.0, False)])
def test_a_second_place_as_far_off_as_the_target_may_have_drifted_is_the_same(
    road: float, alike: bool
) -> None:
    """The target drove the street twice; the second time it lies 24 m on, after ``road`` metres."""
    twice = SimpleNamespace(
        map_T_base=np.tile(STRAIGHT, (2, 1, 1)),
        distance=np.r_[STREETS["b"].distance, road + STREETS["b"].distance],
        drift=UNMEASURED,
    )
    rows = [in_street(k, target_keyframe) for k in COPIED for target_keyframe in (k, 100 + k + 12)]
    outcomes = decide(rows, {**STREETS, "b": cast(SessionMap, twice)}, SETTINGS, model=MODEL)
    assert all((a.decision.agreement.ambiguity > 0.9) == alike for a in outcomes)


def test_three_sessions_that_contradict_each_other_look_like_others() -> None:
    """Of b and c, which lie on each other, a is in b where it is, and in c one block on."""
    rows = [in_street(k, k) for k in COPIED] + [in_street(k, k, "b", "c") for k in COPIED]
    consistent = decide(
        rows + [in_street(k, k, target="c") for k in COPIED], STREETS, SETTINGS, model=MODEL
    )
    assert all(accepted(a) and a.decision.agreement.ambiguity == 0 for a in consistent)
    for a in decide(
        rows + [in_street(k, k + 40, target="c") for k in COPIED], STREETS, SETTINGS, model=MODEL
    ):
        if "a" in (a.alignment.query_session, a.alignment.target_session):
            assert a.decision.agreement.ambiguity > 0.9
            assert not accepted(a)


@pytest.mark.parametrize(
    ("weakest", "copies"),
    [(0.75, False), (0.98, True)],  # chance explains one of four, but not one of fifty
)
def test_three_single_sweeps_that_contradict_each_other(weakest: float, copies: bool) -> None:
    """Of sweeps a in b and c, and b in c, the least probable one is 40 m off."""

    def sweep(query: str, target: str, target_keyframe: int, alone: float) -> Alignment:
        features = dataclasses.replace(GOOD, stiffness=float(np.log(alone / (1 - alone))))
        return dataclasses.replace(in_street(30, target_keyframe, query, target), features=features)

    a_in_b = sweep("a", "b", 30, 0.999)
    b_in_c = sweep("b", "c", 30, 0.999)
    consistent = [a_in_b, b_in_c, sweep("a", "c", 30, weakest)]
    for outcome in decide(consistent, STREETS, SETTINGS, model=MODEL):
        assert outcome.decision.agreement.ambiguity == 0
    contradicting = [a_in_b, b_in_c, sweep("a", "c", 50, weakest)]
    for outcome in decide(contradicting, STREETS, SETTINGS, model=MODEL):
        assert outcome.decision.agreement.ambiguity == (1.0 if copies else 0.0)


def test_streets_that_a_session_itself_has_twice_are_ambiguous() -> None:
    rows = [in_street(k, k) for k in COPIED] + [in_street(k, k + 40, target="a") for k in COPIED]
    for a in decide(rows, STREETS, SETTINGS, model=MODEL):
        assert a.decision.agreement.ambiguity > 0.9
        assert not accepted(a)


@pytest.mark.parametrize("second_place", [lambda k: (7 * k) % 100, lambda k: k + 9])
def test_second_places_that_do_not_agree_or_lie_in_the_same_view_are_no_copies(
    second_place: Any,
) -> None:
    rows = [in_street(k, where) for k in COPIED for where in (k, second_place(k))]
    assert all(
        a.decision.agreement.ambiguity < 0.02 for a in decide(rows, STREETS, SETTINGS, model=MODEL)
    )


def test_a_second_place_that_fits_much_worse_is_no_copy() -> None:
    worse = dataclasses.replace(GOOD, stiffness=-5.0)
    rows = [in_street(k, k) for k in COPIED] + [
        dataclasses.replace(in_street(k, k + 30), features=worse) for k in COPIED
    ]
    assert all(
        a.decision.agreement.ambiguity < 0.01 for a in decide(rows, STREETS, SETTINGS, model=MODEL)
    )
