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
from semloc_logs.evaluation.decision_parts import parts_markdown, without_parts
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


def test_of_every_part_of_the_acceptance_there_is_a_row_without_it(judged: Make) -> None:
    """In these towns the contradiction and the neighbours alone tell."""
    data = judged()
    rows = {name: closures_at(j, p, (0.99,))[0] for name, j, p in without_parts(data)}
    assert list(rows)[:4] == ["nothing", *(f"`{name}`" for name in EVIDENCE)]
    whole = rows["nothing"]
    assert whole == closures_at(fit(data).judged, fit(data).probability, (0.99,))[0]
    for name in ("`log_contradiction`", "votes of neighbours"):
        assert rows[name].accepted < 0.9 * whole.accepted
    assert rows["the position"] == whole
    table = parts_markdown(data).splitlines()
    assert table[0] == "| left out | drives, ordinary towns |"
    assert table[2] == f"| nothing | {whole.accepted - whole.false} of {whole.possible}, " + (
        f"{whole.false} |"
    )
    assert len(table) == 2 + len(rows)


def test_a_veto_that_is_left_out_does_not_reject(judged: Make) -> None:
    """Every second alignment is not held by its points."""
    data = judged()
    loose = np.arange(len(data)) % 2 == 1
    fit_share = np.where(loose, 0.1, 0.5)
    stiffness = np.where(loose, 0.2, 2.0)
    features = replace(data.features, fit=fit_share, stiffness=stiffness)
    p = {name: p for name, _, p in without_parts(replace(data, features=features))}
    assert p["nothing"][loose].max() == p["the veto of ambiguous places"][loose].max() == 0.0
    assert p["the veto of loose fits"][loose].max() > 0.5


def test_neighbours_and_the_position_take_from_an_uncertain_pose(judged: Make) -> None:
    """0.4 m alone, which neighbours halve."""
    data = judged()
    covariance = 400 * data.uncertain.covariance
    uncertain_poses = replace(
        data,
        uncertain=replace(data.uncertain, covariance=covariance),
        placed=replace(data.placed, sigma=np.full(len(data), 0.4)),
    )
    p = {name: p[data.right] for name, _, p in without_parts(uncertain_poses)}
    assert p["poses of neighbours"].max() < p["nothing"].max() < p["the position"].max()
