"""Parts of the ambiguity, on roads and triples that can be counted by hand."""

from __future__ import annotations

import numpy as np
import pytest

from semloc_logs.closures.acceptance import ambiguity as ambiguity_module
from semloc_logs.closures.acceptance.ambiguity import (
    _about,
    _contradictions,
    _nearest,
    ambiguity,
)
from semloc_logs.closures.acceptance.placements import Placed


def test_things_about_a_road_are_counted_to_both_ends_of_the_reach() -> None:
    places = np.array([30.0, 0.0, 10.0, 20.0, 20.0])
    road = np.array([0.0, 15.0, 20.0, 30.0, 99.0])
    assert _about(places, road, 10.0).tolist() == [2, 3, 4, 3, 0]
    shares = np.array([1.0, 0.5, 0.25, 0.125, 0.0625])
    assert _about(places, road, 5.0, shares).tolist() == [0.5, 0.4375, 0.1875, 1.0, 0.0]


def test_the_nearest_of_ascending_values_and_the_first_of_two() -> None:
    values = np.array([0.0, 10.0, 20.0])
    assert _nearest(values, np.array([-5.0, 4.0, 5.0, 6.0, 15.0, 99.0])).tolist() == [
        0,
        0,
        0,
        1,
        1,
        2,
    ]


def placed(sessions: list[str], targets: list[str], log_odds: float) -> Placed:
    """Alignments at the same place of different sessions; all queries are at 50 m of road."""
    n = len(sessions)
    return Placed(
        np.array(sessions, object),
        np.array(targets, object),
        np.zeros(n, np.int64),
        np.full(n, 50.0),
        np.full(n, 50.0),
        np.tile(np.eye(4), (n, 1, 1)),
        np.tile(np.eye(4), (n, 1, 1)),
        np.full(n, 0.01),
        np.full(n, log_odds),
        np.ones(n, bool),
    )


@pytest.mark.parametrize(
    ("lone", "expected"),
    [
        ([False, False, False], [1, 1, 0]),  # the road of session a, where a queries or is queried
        ([True, False, False], [0, 0, 0]),  # one contradiction of a lone query may be chance
        ([False, True, False], [0, 0, 0]),
        ([False, False, True], [0, 0, 0]),
    ],
)
def test_a_contradiction_with_a_lone_query_is_not_counted_along_the_road(
    lone: list[bool], expected: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    triple = np.array([[0, 1, 2]])
    monkeypatch.setattr(ambiguity_module, "_contradictions", lambda *_: triple)
    rows = placed(["a", "a", "b"], ["b", "c", "c"], 0.0)
    roads = {name: np.array([50.0]) for name in "abc"}
    counts = ambiguity(rows, {}, roads, np.zeros(3), np.array(lone), 0.3)
    assert counts.tolist() == expected


@pytest.mark.parametrize(
    ("voxel_size", "metres_off", "road_between", "contradicts"),
    [
        (0.3, 19.9, 0.0, False),  # 20 m at street voxels
        (0.3, 20.1, 0.0, True),
        (0.05, 3.3, 0.0, False),  # a sixth of it at a sixth of the voxel
        (0.05, 3.4, 0.0, True),
        (0.05, 99.0, 33.0, True),  # odometry ties a sixth of 200 m together
        (0.05, 99.0, 34.0, False),
    ],
)
def test_three_alignments_contradict_each_other_by_metres_at_the_scale_of_the_voxels(
    voxel_size: float, metres_off: float, road_between: float, contradicts: bool
) -> None:
    """a in b and b in c put a at the origin of c, a in c puts it elsewhere."""
    rows = placed(["a", "a", "b"], ["b", "c", "c"], 0.0)
    rows.target_T_query[1, 0, 3] = metres_off
    rows.road[1] += road_between
    pairs = {("a", "b"): np.array([0]), ("a", "c"): np.array([1]), ("b", "c"): np.array([2])}
    triples = _contradictions(rows, pairs, np.ones(3), voxel_size)
    assert triples.tolist() == ([[0, 1, 2]] if contradicts else [])
