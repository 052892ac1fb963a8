from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pytest

from semloc_logs.closures.acceptance.calibration import EVIDENCE, VOTES, Calibration
from semloc_logs.closures.acceptance.placements import Placed
from semloc_logs.closures.closure import Features
from semloc_logs.evaluation import calibration_fit
from semloc_logs.evaluation.calibration_fit import (
    Judged,
    calibration_json,
    fit,
    fit_signed,
    judge_town,
    read_judged,
    recall_at,
    reliability,
)
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import inverse, yaw_transform
from semloc_logs.pictures.reliability_diagram import draw_reliability
from semloc_logs.tables import contracts
from semloc_logs.tables.table import read_table, write_table
from semloc_logs.voxels.store import pose_columns
from semloc_logs.workspace import Workspace


def judged(n: int = 1500, seed: int = 0, towns: int = 3) -> Judged:
    """Queries 2 m apart along straight roads; right alignments lie at the truth, wrong ones
    anywhere; features tell a little.
    """
    rng = np.random.default_rng(seed)
    right = rng.random(n) < 0.7
    features = np.tile([0.8, 0.8, 0.1, 0.5, 3.0, 2.0, 0.0], (n, 1))
    features[:, 2] *= np.exp(np.where(right, -0.5, 0.5) + rng.normal(0, 0.4, n))
    features[:, 5] += rng.normal(0, 0.2, n)
    town = np.array([f"t{k % towns}" for k in range(n)], object)
    query = np.arange(n) // towns
    own = np.array([yaw_transform(0.0, (2.0 * k, 0.0, 0.0)) for k in query])
    at = own.copy()
    at[~right, :2, 3] += rng.uniform(20, 90, (int((~right).sum()), 2))
    road = np.array(2.0 * query, float)
    a, b = (np.full(n, name, object) for name in ("a", "b"))
    placed = Placed(
        a,
        b,
        query,
        road,
        road.copy(),
        own,
        at,
        np.full(n, 0.02),
        np.zeros(n),
        np.ones(n, bool),
    )
    return Judged(
        town, Features(*features.T), placed, right, np.where(right, 0.1, 50.0), np.zeros(n), 0.3
    )


def test_neighbours_find_more_at_the_same_reliability_and_probabilities_mean_what_they_say() -> (
    None
):
    data = judged()
    fitted = fit(data)
    alone, together = (recall_at(data, p, (0.99,))[0] for p in (fitted.alone, fitted.probability))
    assert together["recall"] > alone["recall"] + 0.1
    assert together["false"] <= 0.03 * together["accepted"]
    for row in reliability(fitted.probability, data.right, (0.0, 0.2, 0.8, 1.0)):
        assert abs(row["said"] - row["right"]) < max(0.06, 2.5 / np.sqrt(row["alignments"]))
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


def test_copied_blocks_teach_when_to_abstain_and_cost_nothing_elsewhere() -> None:
    data = judged()
    n = 400
    # of each query the true place and one a block on, that fits as well
    copy = np.arange(n) % 2 == 1
    query = np.arange(n) % (n // 2) // 2
    own = np.array([yaw_transform(0.0, (2.0 * k, 0.0, 0.0)) for k in query])
    at = own @ np.where(copy[:, None, None], yaw_transform(0.0, (85.0, 0.0, 0.0)), np.eye(4))
    road = np.array(2.0 * query, float)
    a, b = (np.full(n, name, object) for name in ("a", "b"))
    placed = Placed(
        a,
        b,
        query,
        road,
        road + 85.0 * copy,
        own,
        at,
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
    both = Judged(
        np.concatenate([data.town, town]),
        Features(*np.concatenate([data.features.vector(), features]).T),
        Placed(**poses),
        np.concatenate([data.right, ~copy]),
        np.concatenate([data.error_m, np.where(copy, 85.0, 0.1)]),
        np.zeros(len(data) + n),
        0.3,
    )
    fitted = fit(both)
    assert 0 < fitted.model.max_ambiguity <= 0.5
    accepted = fitted.probability >= 0.99
    assert not accepted[len(data) :].any()
    without = fit(data)
    assert without.model.max_ambiguity == 1.0
    assert accepted.sum() > 0.9 * (without.probability >= 0.99).sum()


def test_what_is_said_of_a_town_does_not_depend_on_its_truth() -> None:
    data = judged()
    lied = data.right.copy()
    lied[data.town == "t1"] ^= True
    before = fit(data)
    after = fit(replace(data, right=lied))
    mine = data.town == "t1"
    # tempering looks at all towns; the models of the other towns order the alignments of a town,
    # apart from the most certain ones, which are equally certain
    certain = [f.alone[mine] > f.alone[mine].max() - 1e-6 for f in (before, after)]
    below = ~(certain[0] | certain[1])
    order = [np.argsort(f.alone[mine][below]).tolist() for f in (before, after)]
    assert below.sum() > 100
    assert order[0] == order[1]


def test_weights_of_the_wrong_sign_are_left_out() -> None:
    rng = np.random.default_rng(3)
    x = rng.normal(size=(4000, 3))
    right = rng.random(4000) < 1 / (1 + np.exp(-(1.5 * x[:, 0] - 1.0 * x[:, 1] + 0.3)))
    assert fit_signed(x, right, (1, -1, 0)).weights == pytest.approx((1.5, -1.0, 0.0), abs=0.15)
    assert fit_signed(x, right, (1, 1, 0)).weights[1:] == (0.0, 0.0)


def test_reliability_and_recall_by_hand() -> None:
    p = np.array([0.05, 0.15, 0.95, 0.97])
    right = np.array([False, True, True, True])
    assert reliability(p, right, (0.0, 0.5, 1.0)) == [
        {"from": 0.0, "to": 0.5, "alignments": 2, "said": pytest.approx(0.1), "right": 0.5},
        {"from": 0.5, "to": 1.0, "alignments": 2, "said": pytest.approx(0.96), "right": 1.0},
    ]
    data = judged(4, towns=1)
    placed = replace(data.placed, query=np.array([0, 0, 1, 2]))
    row = recall_at(
        replace(data, placed=placed, right=right), np.array([0.9, 0.2, 0.95, 0.1]), (0.5,)
    )[0]
    assert row == {
        "threshold": 0.5,
        "accepted": 2,
        "false": 1,
        "possible": 3,
        "recall": pytest.approx(1 / 3),
    }


def test_a_town_is_judged_into_a_table_and_read_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    road = np.array([yaw_transform(0.1, (2.0 * k, 1.0, 0.5)) for k in range(5)])
    map_ = cast(
        SessionMap,
        SimpleNamespace(
            map_T_base=road,
            distance=2.0 * np.arange(5),
            stamps_ns=np.arange(5) * 10**9,
            folder=None,
        ),
    )
    errors = [np.eye(4), yaw_transform(0.0, (2.0, 0, 0)), yaw_transform(0.0, (9.0, 0, 0))]
    found = np.array([inverse(road[2]) @ road[1] @ e for e in errors])
    text: dict[str, Any] = {
        "query_session": ["a"] * 3,
        "target_session": ["b"] * 3,
        "reason": [""] * 3,
    }
    numbers = {
        c["name"]: np.full(3, 0.5)
        for c in contracts.contract("rejected")["columns"]
        if c["type"] == "float64"
    }
    stamps = {"query_stamp_ns": [10**9] * 3, "target_stamp_ns": [2 * 10**9] * 3}
    columns = (
        numbers
        | text
        | stamps
        | {n: [1] * 3 for n in ("inliers", "words", "neighbours")}
        | pose_columns(found)
    )
    work = Workspace(tmp_path)
    write_table(work.rejected, contracts.table("rejected", columns), {"voxel_size": 0.3})
    for name in "ab":
        (tmp_path / f"{name}.tum").write_text(
            "".join(f"{k} {2.0 * k} 1 0.5 0 0 {np.sin(0.05)} {np.cos(0.05)}\n" for k in range(5))
        )
    (tmp_path / "truth.json").write_text(
        '{"a": {"trajectory": "a.tum"}, "b": {"trajectory": "b.tum"}}'
    )
    monkeypatch.setattr(
        Workspace, "sessions", lambda _: [SimpleNamespace(name="a"), SimpleNamespace(name="b")]
    )
    monkeypatch.setattr(calibration_fit, "SessionMap", lambda _: map_)
    judge_town(work, tmp_path / "truth.json", "here", tmp_path / "judged.parquet")
    assert read_table(tmp_path / "judged.parquet")["error_m"].to_pylist() == pytest.approx(
        [0, 2, 9], abs=1e-6
    )
    back = read_judged([tmp_path / "judged.parquet"] * 2)
    assert back.right.tolist() == [True, False, False] * 2
    assert back.clear.tolist() == [True, False, True] * 2
    np.testing.assert_allclose(back.placed.target_T_query[0], road[1], atol=1e-9)
    np.testing.assert_allclose(back.placed.map_T_query[0], road[1], atol=1e-12)
    assert (back.placed.road[0], back.placed.target_road[0], back.town[0]) == (2.0, 4.0, "here")


def test_the_picture_is_a_picture(tmp_path: Path) -> None:
    bins = reliability(np.linspace(0, 1, 50), np.linspace(0, 1, 50) > 0.4)
    draw_reliability(tmp_path / "r.png", {"alone": bins, "with neighbours": bins})
    image = np.asarray(cv2.imread(str(tmp_path / "r.png")))
    assert image.shape[0] > 500
    assert (image == np.array([20, 120, 214])).all(axis=-1).any()  # the second line, BGR
