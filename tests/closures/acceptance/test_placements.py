"""Where alignments lie: on which roads, in which pairs, and against the session's odometry."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from semloc_logs.closures.acceptance.decide import decide
from semloc_logs.closures.acceptance.placements import (
    Placed,
    contradicts_odometry,
    pairs_of,
    place,
    posed_pairs,
    query_roads,
)
from semloc_logs.closures.closure import Veto
from semloc_logs.numerics.transforms import yaw_transform
from tests.closures.acceptance.known_alignments import (
    MAPS,
    MODEL,
    ROAD,
    SETTINGS,
    STREETS,
    alignment,
    in_street,
    sentence,
    session,
)


def test_its_own_odometry_refutes_a_closure_of_a_session_with_itself() -> None:
    refuted, right = sorted(
        decide([in_street(5, 50, target="a"), in_street(5, 5)], STREETS, SETTINGS, model=MODEL),
        key=lambda o: o.alignment.target_session,
    )
    assert refuted.decision.vetoes == {Veto.CONTRADICTS_ODOMETRY}
    assert "contradicts the session's own odometry" in sentence(refuted)
    assert right.decision.probability > 0.9


@pytest.mark.parametrize(
    ("off", "way", "refuted"),  # 10 voxels = 3 m, and 5 % of the way
    [
        (2.9, 0.0, False),
        (3.1, 0.0, True),
        (7.9, 100.0, False),
        (8.1, 100.0, True),
        (7.9, -100.0, False),
    ],
)
def test_how_far_off_its_own_odometry_a_session_may_be(
    off: float, way: float, refuted: bool
) -> None:
    def placed(query: str, target: str, posed: bool = True) -> Placed:
        target_T_query = yaw_transform(0.0, (0.0, off, 0.0))[None]
        half = np.full(1, 0.5)
        return Placed(
            np.array([query], object),
            np.array([target], object),
            np.zeros(1, np.int64),
            np.array([150.0]),
            np.array([150.0 + way]),
            np.eye(4)[None],
            target_T_query,
            half,
            half,
            np.array([posed]),
        )

    assert contradicts_odometry(placed("a", "a"), 0.3).tolist() == [refuted]
    assert contradicts_odometry(placed("a", "b"), 0.3).tolist() == [False]
    assert contradicts_odometry(placed("a", "a", posed=False), 0.3).tolist() == [False]


def test_roads_of_queries_are_counted_once_whatever_answers() -> None:
    rows = [
        alignment(30, 0.5),
        alignment(20, 0.5),
        alignment(20, 0.5, target_keyframe=50),
        alignment(40, 0.5, query="b", target="a"),
    ]
    roads = query_roads(place(rows, MAPS, MODEL))
    assert {name: road.tolist() for name, road in roads.items()} == {"a": [40.0, 60.0], "b": [80.0]}


def test_alignments_of_one_pair_of_sessions_belong_together() -> None:
    rows = [
        alignment(30, 0.5),
        alignment(20, 0.5),
        alignment(40, 0.5, query="b", target="a"),
        alignment(25, 0.5),
    ]
    both = {("a", "b"): [1, 3, 0], ("b", "a"): [2]}
    placed = place(rows, MAPS, MODEL)
    assert {pair: r.tolist() for pair, r in pairs_of(placed).items()} == both
    assert {pair: r.tolist() for pair, r in posed_pairs(placed, pairs_of(placed)).items()} == both
    placed = place(rows, {"a": session(ROAD, posed=False), "b": MAPS["b"]}, MODEL)
    pairs = pairs_of(placed)
    assert {pair: r.tolist() for pair, r in pairs.items()} == both
    assert {pair: r.tolist() for pair, r in posed_pairs(placed, pairs).items()} == {("b", "a"): [2]}


def test_alignments_of_a_query_are_ordered_by_place() -> None:
    """By x, then y, then z."""
    places = [(1.0, 0.0, 0.0), (0.0, 1.0, 1.0), (0.0, 1.0, 0.0), (0.0, 0.0, 2.0)]
    rows = [alignment(0, 0.5) for _ in places]
    placed = dataclasses.replace(
        place(rows, MAPS, MODEL),
        target_T_query=np.array([yaw_transform(0.0, where) for where in places]),
    )
    assert pairs_of(placed)["a", "b"].tolist() == [3, 2, 1, 0]
