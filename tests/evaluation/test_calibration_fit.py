"""The models of the acceptance, fitted on made alignments."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import pytest

from semloc_logs.closures.acceptance.calibration import EVIDENCE, VOTES, Calibration
from semloc_logs.closures.acceptance.placements import Placed
from semloc_logs.closures.closure import Features
from semloc_logs.evaluation.acceptance_report import closures_at, reliability
from semloc_logs.evaluation.calibration_fit import calibration_json, fit, fit_signed
from semloc_logs.evaluation.judged_alignments import Judged
from semloc_logs.numerics.transforms import yaw_transform
from tests.evaluation.conftest import uncertain

Make = Callable[..., Judged]


def test_neighbours_find_more_at_the_same_reliability_and_probabilities_mean_what_they_say(
    judged: Make,
) -> None:
    data = judged()
    fitted = fit(data)
    alone, together = (closures_at(data, p, (0.99,))[0] for p in (fitted.alone, fitted.probability))
    assert together.recall > alone.recall + 0.1
    assert together.false <= 0.03 * together.accepted
    for row in reliability(fitted.probability, data.right, (0.0, 0.2, 0.8, 1.0)):
        assert abs(row["mean"] - row["right"]) < max(0.06, 2.5 / np.sqrt(row["alignments"]))
    content = calibration_json(data, fitted)
    assert (content["towns"], content["alignments"], content["right"]) == (
        3,
        1500,
        int(data.right.sum()),
    )
    for name, names in (("own", EVIDENCE), ("votes", VOTES)):
        written = Calibration.from_json(content[name], names)
        np.testing.assert_allclose(
            written.weights, getattr(fitted.model, name).weights, atol=0.5e-4
        )


def test_copied_blocks_teach_when_to_abstain_and_cost_nothing_elsewhere(judged: Make) -> None:
    data = judged()
    n = 400
    # of each query the true place and one a block on, that fits as well
    copy = np.arange(n) % 2 == 1
    query = np.arange(n) % (n // 2) // 2
    own = np.array([yaw_transform(0.0, (2.0 * k, 0.0, 0.0)) for k in query])
    target_T_query = own @ np.where(
        copy[:, None, None], yaw_transform(0.0, (85.0, 0.0, 0.0)), np.eye(4)
    )
    road = np.array(2.0 * query, float)
    a, b = (np.full(n, name, object) for name in ("a", "b"))
    placed = Placed(
        a,
        b,
        query,
        road,
        road + 85.0 * copy,
        own,
        target_T_query,
        np.full(n, 0.02),
        np.zeros(n),
        np.ones(n, bool),
    )
    features = np.tile([0.9, 0.8, 0.03, 0.5, 3.0, 2.0, 0.0], (n, 1))
    features[:, 2] *= np.exp(np.random.default_rng(1).normal(0, 0.05, n))
    town = np.where(np.arange(n) < n // 2, "repeating-0", "repeating-1").astype(object)
    poses = {
        f.name: np.concatenate([getattr(data.placed, f.name), getattr(placed, f.name)])
        for f in fields(Placed)
    }
    error = np.where(copy, 85.0, 0.02)[:, None] * np.eye(6)[0]
    both = Judged(
        np.concatenate([data.town, town]),
        Features(*np.concatenate([data.features.vector(), features]).T),
        Placed(**poses),
        uncertain(len(data) + n),
        np.concatenate([data.right, ~copy]),
        np.concatenate([data.error, error]),
        0.3,
    )
    fitted = fit(both)
    assert 0 < fitted.model.max_ambiguity <= 0.02
    accepted = fitted.probability >= 0.99
    assert not accepted[len(data) :].any()
    without = fit(data)
    assert without.model.max_ambiguity == 0.02  # the most that is allowed
    assert accepted.sum() > 0.9 * (without.probability >= 0.99).sum()


def test_what_is_said_of_a_town_does_not_depend_on_its_truth(judged: Make) -> None:
    data = judged()
    lied = data.right.copy()
    lied[data.town == "t1"] ^= True
    before = fit(data)
    after = fit(replace(data, right=lied))
    is_of_town = data.town == "t1"
    # tempering looks at all towns; the models of the other towns order the alignments of a town,
    # apart from the most certain ones, which are equally certain
    certain = [f.alone[is_of_town] > f.alone[is_of_town].max() - 1e-6 for f in (before, after)]
    below = ~(certain[0] | certain[1])
    order = [np.argsort(f.alone[is_of_town][below]).tolist() for f in (before, after)]
    assert below.sum() > 100
    assert order[0] == order[1]


def test_weights_of_the_wrong_sign_are_left_out() -> None:
    rng = np.random.default_rng(3)
    x = rng.normal(size=(4000, 3))
    right = rng.random(4000) < 1 / (1 + np.exp(-(1.5 * x[:, 0] - 1.0 * x[:, 1] + 0.3)))
    assert fit_signed(x, right, (1, -1, 0)).weights == pytest.approx((1.5, -1.0, 0.0), abs=0.15)
    assert fit_signed(x, right, (1, 1, 0)).weights[1:] == (0.0, 0.0)
