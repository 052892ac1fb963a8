from __future__ import annotations

import dataclasses
import json
from functools import partial
from importlib.resources import files

import numpy as np
import pytest
from numpy.typing import NDArray

from semloc_logs.closures.acceptance.calibration import (
    NEIGHBOUR_EVIDENCE,
    Calibration,
    Model,
    NeighbourEvidence,
    fit_logistic,
    is_plausible,
    position_confidence,
    probability_ignoring_rivals,
    shipped,
)
from semloc_logs.closures.closure import FEATURES, Agreement, Features
from semloc_logs.closures.closure_tables import AGREEMENT_COLUMNS
from semloc_logs.tables import contracts

F64 = NDArray[np.float64]

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


def columns(*features: Features[float]) -> Features[F64]:
    return Features(*(np.array([getattr(f, name) for f in features]) for name in FEATURES))


def alone(features: Features[float], model: Calibration | None = None) -> float:
    return float((model or shipped().own_features).probability(features.vector()))


def decided_by(model: Model, **votes: float) -> float:
    names = [f.name for f in dataclasses.fields(Agreement)]
    assert set(votes) <= set(names)
    return float(model.decided(Agreement(*(np.array([votes.get(n, 0.0)]) for n in names)))[0])


def decided(**votes: float) -> float:
    return decided_by(shipped(), **votes)


def test_features_and_votes_are_named_as_in_the_files_and_in_their_order() -> None:
    content = json.loads(
        files("semloc_logs.closures.acceptance").joinpath("calibration.json").read_text()
    )
    assert tuple(content["alone"]["features"]) == FEATURES
    assert tuple(content["together"]["features"]) == NEIGHBOUR_EVIDENCE
    assert len(dataclasses.fields(NeighbourEvidence)) == len(NEIGHBOUR_EVIDENCE)
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
    assert GOOD.vector().tolist() == [0.95, 0.9, 0.02, 0.95, 0.1, 0.2, 3.0, 3.0]
    assert columns(GOOD, GOOD).vector().shape == (2, 8)


def test_values_of_the_agreement_by_hand() -> None:
    votes = Agreement(*(np.array([x, x]) for x in (0.75, 4.0, 3.0, 1.0, np.e - 1, 0.0, 0.5)))
    values = NeighbourEvidence.of(votes).vector()
    assert values.shape == (2, len(NEIGHBOUR_EVIDENCE))
    np.testing.assert_allclose(values[1], [np.log(3), np.log(4), 0.75, np.log(2), 1.0, 0.0])


def test_without_neighbours_the_alignment_alone_decides() -> None:
    assert decided(own_probability=0.4321) == 0.4321
    assert decided(own_probability=0.995, ambiguity=shipped().max_ambiguity) == 0.995


def test_in_ambiguous_places_nothing_is_more_probable_than_a_half() -> None:
    assert decided(own_probability=0.995, ambiguity=0.9) == 0.995 / 2
    assert (
        decided(
            own_probability=0.9999, neighbours=12, support=12.0, far_support=80.0, ambiguity=0.9
        )
        <= 0.5
    )


def test_without_rivals_an_alignment_is_judged_as_if_it_were_the_only_one() -> None:
    def own(features: Features[F64]) -> F64:
        return np.asarray(1.0 - features.distinct / 10)

    several = columns(*(dataclasses.replace(GOOD, distinct=d) for d in (0.2, 1.4, 1.5)))
    np.testing.assert_allclose(probability_ignoring_rivals(own, several), [1.0, 1.0, 0.0])


@pytest.mark.parametrize(
    ("change", "possible"),
    [
        ({}, True),
        ({"distinct": 1.2}, True),
        ({"distinct": 1.3}, False),
        ({"structure": 0.31, "contradiction": 0.02}, False),
        ({"structure": 0.5, "coverage": 0.25, "contradiction": 0.0}, False),
        ({"fit": 0.1}, True),
        ({"fit": 0.1, "stiffness": 0.2}, False),
    ],
)
def test_which_alignments_are_plausible(change: dict[str, float], possible: bool) -> None:
    assert is_plausible(columns(dataclasses.replace(GOOD, **change))).tolist() == [possible]


def test_neighbours_add_and_take() -> None:
    several = {"own_probability": 0.9, "neighbours": 12}
    assert (
        decided(**several, support=9.0)
        > decided(**several, support=3.0)
        > decided(**several, support=3.0, conflict=6.0)
    )
    assert decided(own_probability=0.97, neighbours=12, conflict=10.0) < 0.9


def test_less_support_than_the_least_is_never_right() -> None:
    """However well the rest fits: a handful of voxels fits anywhere."""
    model = dataclasses.replace(shipped(), min_support=3.0)
    features = columns(*(dataclasses.replace(GOOD, support=s) for s in (2.999, 3.0, 4.0)))
    np.testing.assert_array_equal(model.own(features) > 0.9, [False, True, True])
    assert model.own(features)[0] == 0.0
    assert shipped().min_support > 3.0
    too_few = dataclasses.replace(GOOD, support=shipped().min_support - 1e-4)
    assert shipped().own(too_few) == 0.0


def steep(weights: dict[str, float], bias: float) -> Calibration:
    """A model of some of the values of agreement."""
    n = len(NEIGHBOUR_EVIDENCE)
    return Calibration(
        tuple(weights.get(name, 0.0) for name in NEIGHBOUR_EVIDENCE), (-9.0,) * n, (9.0,) * n, bias
    )


def test_which_model_decides() -> None:
    """Near neighbours only: the model of near ones; far ones too, whether they agree or not: the
    other. No neighbours: the alignment.
    """
    model = dataclasses.replace(
        shipped(), near=steep({}, -1.0), together=steep({}, 1.0), max_ambiguity=0.5
    )
    by = partial(decided_by, model)
    near = 1 / (1 + np.exp(1.0))
    together = 1 / (1 + np.exp(-1.0))
    assert by(own_probability=0.7, neighbours=3) == pytest.approx(near)
    assert by(own_probability=0.7, neighbours=3, far_support=0.1) == pytest.approx(together)
    assert by(own_probability=0.7, neighbours=3, far_conflict=0.1) == pytest.approx(together)
    assert by(own_probability=0.7, far_support=5.0) == 0.7
    # an impossible alignment stays impossible
    assert by(own_probability=0.0, neighbours=3, far_support=5.0) == 0.0
    assert by(own_probability=0.7, neighbours=3, ambiguity=0.5) == pytest.approx(near)
    assert by(own_probability=0.7, neighbours=3, ambiguity=0.51) == pytest.approx(near / 2)


def test_logistic_regression_counts_rows_and_takes_offsets() -> None:
    """A row that counts three times is three rows; log-odds that are known already are not fitted
    again.
    """
    rng = np.random.default_rng(1)
    x = rng.normal(0, 1, (400, 2))
    right = rng.random(400) < 1 / (1 + np.exp(-(x @ [1.0, -2.0] + 0.5)))
    twice = np.r_[np.arange(400), np.arange(100)]
    counts = np.r_[np.full(100, 2.0), np.ones(300)]
    z = (x - x[twice].mean(0)) / x[twice].std(0)  # scaled alike, so that the ridge is one
    (w, b), (expected, bias) = (
        fit_logistic(z, right, 1e-9, counts),
        fit_logistic(z[twice], right[twice], 1e-9),
    )
    np.testing.assert_allclose([*w, b], [*expected, bias], rtol=1e-5)
    w, b = fit_logistic(x[:, :1], right, 1e-9, offset=-2.0 * x[:, 1])
    np.testing.assert_allclose([w[0], b], [1.0, 0.5], atol=0.3)
    assert abs(fit_logistic(x[:, :1], right, 1e-9)[0][0] - w[0]) > 0.1


def test_a_model_as_json_and_back() -> None:
    model = shipped().together
    assert Calibration.from_json(model.to_json(NEIGHBOUR_EVIDENCE), NEIGHBOUR_EVIDENCE) == model


def test_probability_by_hand() -> None:
    model = Calibration((2.0, 0, 0, 0, 0, -1.0, 0, 0), (0.0,) * 8, (1.0,) * 8, 0.5)
    one = dataclasses.replace(GOOD, structure=0.25, distinct=0.5)
    assert alone(one, model) == pytest.approx(1 / (1 + np.exp(-0.5)))
    clipped = dataclasses.replace(one, structure=7.0, distinct=-3.0)
    assert alone(clipped, model) == pytest.approx(1 / (1 + np.exp(-2.5)))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_probabilities_are_numbers_whatever_the_features(value: float) -> None:
    for name in FEATURES:
        p = alone(dataclasses.replace(GOOD, **{name: value}))
        assert 0 <= p <= 1


def test_the_shipped_calibration_knows_good_from_bad() -> None:
    bad = Features(
        structure=0.2,
        coverage=0.3,
        contradiction=0.5,
        fit=0.2,
        rmse=0.9,
        distinct=0.98,
        support=1.0,
        stiffness=0.5,
    )
    assert alone(GOOD) > 0.95
    assert alone(bad) < 0.01
    for name, worse in (("structure", 0.5), ("contradiction", 0.4), ("distinct", 1.1)):
        assert alone(dataclasses.replace(GOOD, **{name: worse})) <= alone(GOOD)


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
    w, b = fit_logistic(x, x[:, 0] > 0)
    p = 1 / (1 + np.exp(-(x @ w + b)))
    assert np.isfinite(w).all()
    assert ((p > 0.5) == (x[:, 0] > 0)).all()
    w, b = fit_logistic(x, np.ones(40, bool))
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
