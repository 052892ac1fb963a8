"""Votes of neighbouring queries for and against an alignment."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from semloc_logs.alignment.hypotheses import ODOMETRY_DRIFT
from semloc_logs.arrays import F64
from semloc_logs.closures.acceptance.consistency import (
    MIN_VOTE,
    MOST_SLACK,
    NEAR,
    SLACK,
    TURN,
    TURN_DRIFT,
    _sums,
    count_votes,
    place_odds,
)
from semloc_logs.closures.acceptance.decide import decide
from semloc_logs.closures.acceptance.placements import (
    ARM,
    FAR,
    Placed,
    contradicts_odometry,
    pairs_of,
    place,
)
from semloc_logs.closures.closure import Agreement
from semloc_logs.numerics.transforms import inverse, yaw_transform
from semloc_logs.settings import STREET_VOXEL
from tests.closures.acceptance.known_alignments import (
    COPIED,
    MAP,
    MAPS,
    MODEL,
    ROAD,
    SETTINGS,
    STREETS,
    Outcome,
    accepted,
    alignment,
    bend,
    decided,
    in_street,
    sentence,
    session,
)


def test_neighbours_of_one_transform_agree_and_are_counted_by_hand() -> None:
    outcomes = decided([alignment(k, 0.5) for k in range(20, 31)])
    middle = outcomes[25, 25].decision.agreement
    assert (middle.neighbours, round(middle.support, 9), middle.conflict) == (10, 5.0, 0.0)
    assert outcomes[20, 20].decision.agreement.neighbours == 10  # all within 25 m of road
    far = decided([alignment(k, 0.5) for k in (10, 30, 50)])[30, 30].decision.agreement
    assert (far.neighbours, far.support, round(far.far_support, 9)) == (0, 0.0, 1.0)


def test_one_that_lies_elsewhere_opposes_and_is_opposed() -> None:
    moved = yaw_transform(0.0, (8.0, 0.0, 0.0))
    rows = [alignment(k, 0.9, moved if k == 25 else None) for k in range(20, 31)]
    outcomes = decided(rows)
    assert outcomes[25, 25].decision.agreement.conflict == pytest.approx(9.0)
    assert outcomes[25, 25].decision.agreement.support == 0.0
    assert outcomes[24, 24].decision.agreement.conflict == pytest.approx(0.9)
    assert outcomes[24, 24].decision.agreement.support == pytest.approx(0.9 * 9)
    assert outcomes[25, 25].decision.probability < outcomes[24, 24].decision.probability


@pytest.mark.parametrize(("off", "agrees"), [(0.3, True), (3.0, False)])
def test_what_odometry_may_drift_is_no_contradiction(off: float, agrees: bool) -> None:
    rows = [alignment(20, 0.9), alignment(24, 0.9, yaw_transform(0.0, (off, 0.0, 0.0)))]
    a = decided(rows)[20, 20].decision.agreement
    assert (a.support > 0) == agrees
    assert (a.conflict > 0) == (not agrees)


def test_a_turned_neighbour_does_not_agree() -> None:
    here = MAP @ ROAD[24]
    turned = here @ yaw_transform(0.4) @ inverse(here)
    assert decided([alignment(20, 0.9), alignment(24, 0.9, turned)])[
        20, 20
    ].decision.agreement.conflict == pytest.approx(0.9)


def test_neighbours_rescue_a_right_one_and_a_second_choice_that_agrees_is_promoted() -> None:
    rows = [alignment(k, 0.995) for k in range(20, 31) if k != 25] + [
        alignment(25, 0.9),
        alignment(25, 0.95, target_keyframe=50),
    ]
    first, second = (
        o for o in decide(rows, MAPS, SETTINGS, model=MODEL) if o.alignment.query_keyframe == 25
    )
    # odds of 9 and 19 and 1 for neither
    assert first.alignment.target_keyframe == 25
    assert first.decision.agreement.own_probability == pytest.approx(9 / 29)
    assert second.alignment.target_keyframe == 50
    assert second.decision.agreement.own_probability == pytest.approx(19 / 29)
    assert accepted(first)
    assert "neighbouring queries conflict" not in sentence(second)
    assert second.decision.probability < 0.01


def test_sessions_that_overlap_each_other_do_not_contradict() -> None:
    maps = {**MAPS, "c": session(yaw_transform(2.0, (500.0, 0.0, 0.0)) @ MAP @ ROAD)}
    rows = [alignment(k, 0.99) for k in range(20, 31)]
    both = rows + [dataclasses.replace(a, target_session="c") for a in rows]
    for a in decide(both, maps, SETTINGS, model=MODEL):
        assert (a.decision.agreement.neighbours, a.decision.agreement.conflict) == (10, 0.0)


@given(st.integers(0, 10_000), st.integers(1, 4))
@settings(max_examples=25)
def test_sessions_that_do_not_meet_a_pair_change_nothing_of_it(seed: int, others: int) -> None:
    """Sessions elsewhere, and improbable alignments of the pair's queries in them."""
    rng = np.random.default_rng(seed)
    rows = [alignment(k, float(rng.uniform(0.5, 0.9999))) for k in range(10, 40)]
    names = [f"other_{n}" for n in range(others)]
    maps = MAPS | {name: session(ROAD) for name in names}
    more = [
        dataclasses.replace(
            alignment(k, float(rng.uniform(1e-6, 1e-3)), target_keyframe=int(rng.integers(60))),
            target_session=name,
        )
        for name in names
        for k in range(10, 40)
    ]
    among_themselves = [
        dataclasses.replace(alignment(k, 0.999), query_session=name, target_session=names[0])
        for name in names[1:]
        for k in range(50)
    ]

    def of_pair(outcomes: Sequence[Outcome]) -> list[tuple[int, Any, bool]]:
        pair = [o for o in outcomes if o.alignment.target_session == "b"]
        return [(o.alignment.query_keyframe, o.decision, accepted(o)) for o in pair]

    queries = {"a": range(10, 40)}
    alone, together = (
        decide(some, maps, SETTINGS, queries, MODEL)
        for some in (rows, rows + more + among_themselves)
    )
    assert of_pair(together) == of_pair(alone)


def test_without_other_alignments_all_votes_are_zero() -> None:
    placed = place([alignment(20, 0.5)], MAPS, MODEL)
    pairs = pairs_of(placed)
    own = place_odds(placed, pairs, placed.log_odds, 0.3).share
    votes = count_votes(placed, pairs, own, 0.3)
    assert dataclasses.astuple(votes.row(0)) == (0.5, 0, 0.0, 0.0, 0.0, 0.0, 0.0)


def test_without_odometry_nobody_is_a_neighbour() -> None:
    maps = {"a": session(ROAD, posed=False), "b": MAPS["b"]}
    for a in decide([alignment(k, 0.992) for k in range(20, 24)], maps, SETTINGS, model=MODEL):
        assert a.decision.agreement == Agreement(0.992, 0, 0, 0, 0, 0, 0)
        assert accepted(a)


@pytest.mark.parametrize("seed", [1, 2])
def test_the_order_of_the_alignments_does_not_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = [
        alignment(k, float(rng.uniform(0.01, 1)), target_keyframe=int(rng.integers(60)))
        for k in range(40)
        for _ in range(2)
    ]
    rows += [
        dataclasses.replace(in_street(k, target_keyframe), query_session="c")
        for k in COPIED
        for target_keyframe in (k, k + 30)
    ]
    shuffled = [rows[k] for k in rng.permutation(len(rows))]

    def keys(outcomes: Sequence[Outcome]) -> list[Any]:
        return [
            (
                o.alignment.query_keyframe,
                o.alignment.target_keyframe,
                o.decision,
                accepted(o) or sentence(o),
            )
            for o in outcomes
        ]

    maps = {**STREETS, **MAPS, "b": STREETS["b"]}
    assert keys(decide(rows, maps, SETTINGS, model=MODEL)) == keys(
        decide(shuffled, maps, SETTINGS, model=MODEL)
    )


@pytest.mark.parametrize(("alone", "expected"), [(0.9901, True), (0.9899, False), (np.nan, False)])
def test_what_is_as_probable_as_the_settings_require_is_accepted(
    alone: float, expected: bool
) -> None:
    assert accepted(decided([alignment(25, alone)])[25, 25]) is expected


def test_of_none() -> None:
    assert list(decide([], MAPS, SETTINGS, model=MODEL)) == []
    nothing = place([], {}, MODEL)
    assert len(count_votes(nothing, pairs_of(nothing), np.zeros(0), 0.3)) == 0
    assert not contradicts_odometry(nothing, 0.3).any()


def slow_sums(group: Placed, probabilities: Sequence[F64], voxel_size: float) -> list[F64]:
    """For each of the ``probabilities`` (n,) the sums over other queries' alignments, agreeing
    ones and others, near it and far from it (4, n).

    Of each query the most probable alignment of either kind counts, and as opposing only if it is
    more probable than an agreeing one.
    """
    scale = voxel_size / STREET_VOXEL
    voting = np.max(probabilities, axis=0) >= MIN_VOTE
    voters = group.part(voting)
    votes = [np.where(p >= MIN_VOTE, p, 0.0)[voting] for p in probabilities]
    out = [np.zeros((4, len(group))) for _ in probabilities]
    for k in range(len(group)):
        along = np.abs(voters.road - group.road[k])
        there = np.flatnonzero((along <= FAR * scale) & (voters.query != group.query[k]))
        if not len(there):
            continue
        others_there = voters.part(there)
        along = along[there]
        agrees = slow_agrees(group.part(np.array([k])), others_there, along, voxel_size)
        _, first, number = np.unique(others_there.query, return_index=True, return_inverse=True)
        is_near = along[first] <= NEAR * scale
        for sums, p in zip(out, votes, strict=True):
            support = np.zeros(len(first))
            conflict = np.zeros(len(first))
            np.maximum.at(support, number, np.where(agrees, p[there], 0.0))
            np.maximum.at(conflict, number, np.where(agrees, 0.0, p[there]))
            conflict[conflict <= support] = 0.0
            sums[:, k] = [
                support[is_near].sum(),
                conflict[is_near].sum(),
                support[~is_near].sum(),
                conflict[~is_near].sum(),
            ]
    return out


def slow_agrees(one: Placed, others: Placed, along: F64, voxel_size: float) -> NDArray[np.bool_]:
    """Whether ``one`` and the odometry predict ``others`` (m), which lie ``along`` metres of road
    away.
    """
    predicted = one.target_T_query[0] @ inverse(one.map_T_query[0]) @ others.map_T_query
    off = np.linalg.norm(predicted[:, :3, 3] - others.target_T_query[:, :3, 3], axis=1)
    trace = np.einsum("nij,nij->n", predicted[:, :3, :3], others.target_T_query[:, :3, :3])
    turn = np.arccos(np.clip((trace - 1) / 2, -1, 1))
    sigma = np.hypot(one.sigma[0], others.sigma)
    allowed = np.minimum(SLACK * voxel_size + 2 * sigma, MOST_SLACK * voxel_size)
    drift = ODOMETRY_DRIFT * (along + np.abs(others.target_road - one.target_road[0])) + ARM * along
    return np.asarray(
        (off <= allowed + drift) & (turn <= TURN + TURN_DRIFT * along * STREET_VOXEL / voxel_size)
    )


@given(st.integers(0, 10_000), st.sampled_from([0.3, 0.05]))
@settings(max_examples=40)
def test_voters_are_counted_as_one_by_one(seed: int, voxel_size: float) -> None:
    """Alignments of a bent road, right, moved, turned or in other places, as many as three of a
    query, against the slow count.
    """
    rng = np.random.default_rng(seed)
    scale = voxel_size / 0.3
    road = bend(60)
    road[:, :3, 3] *= scale
    query = np.sort(rng.integers(0, 60, 50))
    error = np.array(
        [
            yaw_transform(
                rng.normal(0, 0.05), rng.normal(0, rng.choice([0.1, 1.0, 10.0]) * scale, 3)
            )
            for _ in query
        ]
    )
    placed = Placed(
        np.full(50, "a", object),
        np.full(50, "b", object),
        query,
        np.asarray(2.0 * scale * query, float),
        2.0 * scale * query + rng.normal(0, 3 * scale, 50),
        road[query],
        error @ MAP @ road[query],
        rng.uniform(0.01, 0.5, 50) * scale,
        rng.normal(-2, 3, 50),
        np.ones(50, bool),
    )
    own = place_odds(placed, pairs_of(placed), placed.log_odds, voxel_size).share
    probabilities = own, placed.probability_ignoring_rivals
    for sums, expected in zip(
        _sums(placed, probabilities, voxel_size),
        slow_sums(placed, probabilities, voxel_size),
        strict=True,
    ):
        np.testing.assert_allclose(sums, expected, atol=1e-12)
