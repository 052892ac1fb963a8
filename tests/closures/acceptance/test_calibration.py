from __future__ import annotations

import dataclasses
import json
from importlib.resources import files

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semloc_logs.arrays import F64
from semloc_logs.closures.acceptance.calibration import (
    EVIDENCE,
    VOTES,
    Calibration,
    Evidence,
    Votes,
    fit_additions,
    fit_logistic,
    is_loose,
    log_odds,
    position_confidence,
    probability_of,
    shipped,
)
from semloc_logs.closures.closure import FEATURES, Agreement, Features
from semloc_logs.closures.closure_tables import AGREEMENT_COLUMNS
from semloc_logs.tables import contracts

GOOD = Features(
    structure=0.95,
    coverage=0.9,
    contradiction=0.03,
    fit=0.95,
    support=3.0,
    stiffness=2.0,
    range_sigma=0.0,
)


def columns(*features: Features[float]) -> Features[F64]:
    return Features(*(np.array([getattr(f, name) for f in features]) for name in FEATURES))


def own(features: Features[float]) -> float:
    return float(probability_of(shipped().own_log_odds(features)))


def decided(own_log_odds: float, **votes: float) -> float:
    names = [f.name for f in dataclasses.fields(Agreement)]
    assert set(votes) <= set(names)
    agreement = Agreement(*(np.array([votes.get(n, 0.0)]) for n in names))
    return float(shipped().log_odds(np.array([own_log_odds]), agreement)[0])


def test_evidence_and_votes_are_named_as_in_the_files_and_in_their_order() -> None:
    content = json.loads(
        files("semloc_logs.closures.acceptance").joinpath("calibration.json").read_text()
    )
    assert tuple(content["own"]["features"]) == EVIDENCE
    assert tuple(f.name for f in dataclasses.fields(Evidence)) == EVIDENCE
    assert tuple(content["votes"]["features"]) == VOTES
    assert len(dataclasses.fields(Votes)) == len(VOTES)
    table = [c["name"] for c in contracts.contract("rejected")["columns"]]
    assert [n for n in table if n in FEATURES] == list(FEATURES)
    assert [n for n in table if n in AGREEMENT_COLUMNS] == list(AGREEMENT_COLUMNS)
    names = tuple(f.name for f in dataclasses.fields(Agreement))
    assert tuple(AGREEMENT_COLUMNS.values()) == names


def test_rows_of_columns() -> None:
    votes = Agreement(*(np.array([10.0 * i, 10.0 * i + 1]) for i in range(7)))
    assert len(votes) == 2
    assert votes.row(1) == Agreement(1.0, 11.0, 21.0, 31.0, 41.0, 51.0, 61.0)
    some = votes.part(np.array([1]))
    assert (len(some), some.ambiguity.tolist()) == (1, [61.0])
    assert GOOD.vector().tolist() == [0.95, 0.9, 0.03, 0.95, 3.0, 2.0, 0.0]
    assert columns(GOOD, GOOD).vector().shape == (2, 7)


def test_evidence_and_votes_by_hand() -> None:
    two = Evidence.of(columns(GOOD, dataclasses.replace(GOOD, contradiction=0.0)))
    np.testing.assert_allclose(two.vector(), [[np.log(0.03), 2, 0], [np.log(1e-4), 2, 0]])
    agreement = Agreement(*(np.array([x, x]) for x in (0.75, 4.0, 3.0, 1.0, np.e - 1, 0.0, 0.5)))
    np.testing.assert_allclose(Votes.of(agreement).vector()[1], [np.log(4), np.log(2), 1.0, 0.0])


def test_without_votes_the_alignment_alone_decides() -> None:
    assert decided(-1.25) == -1.25
    assert decided(3.5, neighbours=12) == 3.5  # neighbours that say nothing take nothing


@given(
    st.floats(-20, 20),
    st.lists(st.floats(0, 50), min_size=4, max_size=4),
    st.sampled_from(["support", "far_support", "conflict", "far_conflict"]),
    st.floats(0, 20),
)
def test_agreeing_votes_never_lower_and_opposing_ones_never_raise(
    log_odds: float, votes: list[float], which: str, more: float
) -> None:
    names = ("support", "conflict", "far_support", "far_conflict")
    before = dict(zip(names, votes, strict=True))
    after = before | {which: before[which] + more}
    change = decided(log_odds, **after) - decided(log_odds, **before)
    assert change >= 0 if "support" in which else change <= 0


@given(
    st.floats(0, 1),
    st.floats(0, 4),
    st.floats(0, 3),
    st.sampled_from(["contradiction", "stiffness", "range_sigma"]),
    st.floats(0, 1),
)
def test_more_contradiction_or_sigma_never_helps_and_more_stiffness_never_harms(
    contradiction: float, stiffness: float, sigma: float, which: str, more: float
) -> None:
    before = dataclasses.replace(
        GOOD, contradiction=contradiction, stiffness=stiffness, range_sigma=sigma
    )
    after = dataclasses.replace(before, **{which: getattr(before, which) + more})
    change = float(shipped().own_log_odds(after)) - float(shipped().own_log_odds(before))
    assert change >= 0 if which == "stiffness" else change <= 0


def test_votes_of_the_shipped_model_count() -> None:
    weight = dict(zip(VOTES, shipped().votes.weights, strict=True))
    assert weight["agreeing"] > 0 > weight["opposing"]
    assert weight["far_agreeing"] >= 0 >= weight["far_opposing"]


def test_no_probability_is_more_than_the_calibration_has_seen() -> None:
    model = shipped()
    certain = dataclasses.replace(GOOD, contradiction=1e-4, stiffness=4.0)
    assert model.own_log_odds(certain) <= model.max_log_odds
    assert decided(50.0, support=99.0, far_support=99.0) == model.max_log_odds
    content = json.loads(
        files("semloc_logs.closures.acceptance").joinpath("calibration.json").read_text()
    )
    assert model.max_log_odds == pytest.approx(np.log(content["alignments"]))


def test_which_places_are_ambiguous() -> None:
    model = dataclasses.replace(shipped(), max_ambiguity=0.125)
    none = np.zeros(3)
    votes = Agreement(none, none, none, none, none, none, np.array([0.0, 0.125, 0.126]))
    assert model.is_ambiguous(votes).tolist() == [False, False, True]


@pytest.mark.parametrize(
    ("change", "loose"),
    [({}, False), ({"fit": 0.1}, False), ({"fit": 0.1, "stiffness": 0.2}, True)],
)
def test_which_alignments_their_points_do_not_hold(change: dict[str, float], loose: bool) -> None:
    assert is_loose(columns(dataclasses.replace(GOOD, **change))).tolist() == [loose]


def test_log_odds_and_back() -> None:
    p = np.array([0.0, 0.25, 0.5, 1.0])
    np.testing.assert_allclose(probability_of(log_odds(p)), p, atol=1e-8)
    assert log_odds(p)[1] == pytest.approx(-np.log(3))


def test_a_model_as_json_and_back() -> None:
    model = shipped().votes
    assert Calibration.from_json(model.to_json(VOTES), VOTES) == model


def test_log_odds_by_hand() -> None:
    model = Calibration((2.0, -1.0), (0.0,) * 2, (1.0,) * 2, (0.0,) * 2, 0.5)
    assert model.log_odds(np.array([0.25, 0.5])) == pytest.approx(0.5)
    assert model.log_odds(np.array([7.0, -3.0])) == pytest.approx(2.5)  # clipped to 1 and 0


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_probabilities_are_numbers_whatever_the_features(value: float) -> None:
    for name in FEATURES:
        p = own(dataclasses.replace(GOOD, **{name: value}))
        assert 0 <= p <= 1


def test_the_shipped_calibration_knows_good_from_bad() -> None:
    assert own(GOOD) > 0.99
    assert own(dataclasses.replace(GOOD, contradiction=0.25, stiffness=0.5)) < 0.01


def test_additions_are_to_log_odds_that_are_known() -> None:
    """What is known already is not fitted again, and nothing adds nothing."""
    rng = np.random.default_rng(1)
    x = rng.normal(0, 1, (4000, 2))
    right = rng.random(4000) < 1 / (1 + np.exp(-(x @ [1.0, -2.0])))
    weights = fit_additions(x[:, :1], right, 1e-9, -2.0 * x[:, 1])
    np.testing.assert_allclose(weights, [1.0], atol=0.1)
    assert abs(fit_additions(x[:, :1], right, 1e-9, np.zeros(4000))[0] - 1.0) > 0.2


def test_a_ridge_holds_weights_back_by_hand() -> None:
    """One right and one wrong, scaled to 1 and -1: 2 (1 - p) = ridge w, with p = 3/4 at w = log 3.

    Their mean is 3 and their standard deviation 2, so the weight of the values is half of w.
    """
    ridge = 0.5 / np.log(3)
    x = np.array([[5.0], [1.0]])
    right = np.array([True, False])
    w, b = fit_logistic(x, right, ridge)
    np.testing.assert_allclose([*w, b], [np.log(3) / 2, -3 * np.log(3) / 2], rtol=1e-9)
    # additions have no bias: the values 2 and -2
    np.testing.assert_allclose(
        fit_additions(x - 3.0, right, ridge, np.zeros(2)), [np.log(3) / 2], rtol=1e-9
    )


def test_logistic_regression_recovers_known_weights() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(0, 1, (20_000, 3)) * [1, 5, 0.1] + [0, 20, -1]
    weights = np.array([1.5, -0.4, 10.0])
    bias = 17.0
    right = rng.random(20_000) < 1 / (1 + np.exp(-(x @ weights + bias)))
    assert 0.2 < right.mean() < 0.8
    w, b = fit_logistic(x, right, ridge=1e-3)
    np.testing.assert_allclose(w, weights, rtol=0.08)
    assert b == pytest.approx(bias, rel=0.08)


def test_logistic_regression_of_separable_and_of_constant_features_stays_finite() -> None:
    x = np.c_[np.linspace(-1, 1, 40), np.full(40, 3.0)]
    w, b = fit_logistic(x, x[:, 0] > 0, ridge=1.0)
    p = 1 / (1 + np.exp(-(x @ w + b)))
    assert np.isfinite(w).all()
    assert ((p > 0.5) == (x[:, 0] > 0)).all()
    w, b = fit_logistic(x, np.ones(40, bool), ridge=1.0)
    assert (1 / (1 + np.exp(-(x @ w + b))) > 0.99).all()


def test_a_position_that_is_not_known_to_a_metre_is_not_a_closure() -> None:
    """Within 1 m = one of 1.2 standard deviations of 0.833 m: 68.3 %; in a room of 5 cm voxels the
    bound is a sixth.
    """
    np.testing.assert_allclose(
        position_confidence(np.array([1 / 1.2, 0.5 / 1.2, 0.0]), 0.30),
        [0.6827, 0.9545, 1.0],
        atol=1e-4,
    )
    assert position_confidence(1 / 1.2 / 6, 0.05) == pytest.approx(0.6827, abs=1e-4)
