"""Parts of the ambiguity, on roads and triples that can be counted by hand."""

from __future__ import annotations

import numpy as np
import pytest

from semloc_logs.closures.acceptance import ambiguity as ambiguity_module
from semloc_logs.closures.acceptance.ambiguity import (
    _among_copies,
    _contradictions,
    _nearest,
    _weight_about,
    ambiguity,
)
from semloc_logs.closures.acceptance.placements import Placed, pairs_of
from semloc_logs.numerics.transforms import yaw_transform


def test_things_about_a_road_are_counted_to_both_ends_of_the_reach() -> None:
    places = np.array([30.0, 0.0, 10.0, 20.0, 20.0])
    road = np.array([0.0, 15.0, 20.0, 30.0, 99.0])
    assert _weight_about(places, road, 10.0).tolist() == [2, 3, 4, 3, 0]
    shares = np.array([1.0, 0.5, 0.25, 0.125, 0.0625])
    assert _weight_about(places, road, 5.0, shares).tolist() == [0.5, 0.4375, 0.1875, 1.0, 0.0]


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


Row = tuple[str, str, int, float, float, tuple[float, float]]


def along_roads(*rows: Row) -> Placed:
    """Alignments by their sessions, query, its road in metres, the target's, and x, y in that.

    In its own map a query lies on the x axis, at its road.
    """
    queries, targets, numbers, roads, target_roads, places = zip(*rows, strict=True)
    n = len(rows)
    return Placed(
        np.array(queries, object),
        np.array(targets, object),
        np.array(numbers, np.int64),
        np.array(roads),
        np.array(target_roads),
        np.array([yaw_transform(0.0, (road, 0.0, 0.0)) for road in roads]),
        np.array([yaw_transform(0.0, (x, y, 0.0)) for x, y in places]),
        np.full(n, 0.01),
        np.zeros(n),
        np.ones(n, bool),
    )


@pytest.mark.parametrize(
    ("voxel_size", "shares"),
    [
        # one of 4 and of 5 queries within 200 m of road has a second place; and no other one in
        # the target
        (0.30, [0.8, 0.8, 0.8 / 4, 0.8 / 5, 0.0, 0.0]),
        (0.05, [0.8, 0.8, 0.0, 0.0, 0.0, 0.0]),  # within 33 m there is no other query
    ],
)
def test_a_second_place_counts_for_the_queries_about_it(
    voxel_size: float, shares: list[float]
) -> None:
    """A query every 100 m, of which the first has two places; in the target all are far apart."""
    rows: list[Row] = [("a", "b", 0, 0.0, 0.0, (0.0, 0.0)), ("a", "b", 0, 0.0, 5e3, (0.0, 200.0))]
    rows += [("a", "b", k, 100.0 * k, 1e4 * k, (1e4 * k, 0.0)) for k in range(1, 5)]
    alignments = along_roads(*rows)
    roads = {"a": np.array([0.0, 100.0, 200.0, 300.0, 400.0]), "b": np.zeros(0)}
    support = np.r_[0.8, 0.85, np.full(4, 0.9)]
    lone = np.zeros(6, bool)
    results = ambiguity(alignments, pairs_of(alignments), roads, support, lone, voxel_size)
    np.testing.assert_allclose(results, shares, atol=1e-12)


def test_a_query_without_a_second_place_counts_where_it_fits_best() -> None:
    """At 1000 m of the target's road are two queries, of which one has a second place."""
    alignments = along_roads(
        ("a", "b", 0, 0.0, 0.0, (0.0, 0.0)),
        ("a", "b", 0, 0.0, 1000.0, (5.0, 0.0)),
        ("a", "b", 1, 5e3, 1000.0, (0.0, 0.0)),
        ("a", "b", 1, 5e3, 3000.0, (200.0, 0.0)),
    )
    roads = {"a": np.array([0.0, 5e3]), "b": np.zeros(0)}
    support = np.array([0.2, 0.9, 0.8, 0.8])
    results = ambiguity(alignments, pairs_of(alignments), roads, support, np.zeros(4, bool), 0.3)
    np.testing.assert_allclose(results, [0.0, 0.4, 0.8, 0.8])


@pytest.mark.parametrize(
    ("voxel_size", "off", "to_z", "contradicts"),
    [
        # 20 m, and of 40 + 60 + 20 m of way 1 % by odometry and 1.5 % by an error of heading
        (0.30, 22.9, 60.0, False),
        (0.30, 23.1, 60.0, True),
        # at most 200 m of road lie between the queries
        (0.30, 99.0, 199.0, True),
        (0.30, 99.0, 201.0, False),
        (0.05, 23.1, 60.0, False),  # 33 m at voxels of 5 cm
    ],
)
def test_when_alignments_of_three_sessions_contradict(
    voxel_size: float, off: float, to_z: float, contradicts: bool
) -> None:
    """A query of a in g and one 40 m on in h, which is ``off``, and ``to_z`` m on one of g in h."""
    alignments = along_roads(
        ("a", "g", 0, 50.0, 50.0, (50.0, 0.0)),
        ("a", "h", 1, 90.0, 90.0, (90.0, off)),
        ("g", "h", 0, 50.0 + to_z, 50.0 + to_z, (50.0 + to_z, 0.0)),
    )
    results = _contradictions(alignments, pairs_of(alignments), np.full(3, 0.7), voxel_size)
    assert results.tolist() == [[0, 1, 2]] * contradicts


def test_a_contradiction_counts_about_the_first_of_its_queries() -> None:
    """Of a, 50 m lie within 200 m of 2 queries and 150 m of 3; 300 m are too far from 50 m."""
    alignments = along_roads(
        ("a", "g", 0, 50.0, 50.0, (50.0, 0.0)),
        ("a", "h", 1, 150.0, 150.0, (150.0, 99.0)),
        ("a", "k", 2, 300.0, 300.0, (300.0, 0.0)),
        ("g", "h", 0, 50.0, 50.0, (50.0, 0.0)),
    )
    roads = {"a": np.array([50.0, 150.0, 300.0]), "g": np.array([50.0])}
    support = np.full(4, 0.9)
    results = ambiguity(alignments, pairs_of(alignments), roads, support, np.zeros(4, bool), 0.3)
    np.testing.assert_allclose(results, [1 / 2, 1 / 3, 0.0, 0.0])


@pytest.mark.parametrize(
    ("right", "wrong", "triples"),
    [
        (0.9, 0.8, []),  # of the alignments of a query the best one counts
        (0.8, 0.9, [[1, 2, 3]]),
        (0.5, 0.69, []),  # less than 0.7 may be doubted
    ],
)
def test_only_the_best_alignment_beyond_doubt_contradicts(
    right: float, wrong: float, triples: list[list[int]]
) -> None:
    alignments = along_roads(
        ("a", "g", 0, 50.0, 50.0, (50.0, 0.0)),
        ("a", "g", 0, 50.0, 50.0, (50.0, 300.0)),
        ("a", "h", 0, 50.0, 50.0, (50.0, 0.0)),
        ("g", "h", 0, 50.0, 50.0, (50.0, 0.0)),
    )
    support = np.array([right, wrong, 0.99, 0.99])
    results = _contradictions(alignments, pairs_of(alignments), support, 0.3)
    assert results.tolist() == triples


@pytest.mark.parametrize(("weakest", "copies"), [(0.96, False), (0.98, True)])
def test_alignments_with_a_session_among_copies_at_either_end(weakest: float, copies: bool) -> None:
    """Chance explains a wrong alignment of 4 % and not one of 2 %: less than 3 % tell of copies."""
    rows = placed(["a", "a", "b", "a", "d", "d"], ["b", "c", "c", "d", "b", "e"], 0.0)
    known = np.array([0.99, weakest, 0.999, 0.5, 0.5, 0.5])
    results = _among_copies(rows, known, np.array([[0, 1, 2]]))
    assert results.tolist() == [copies, copies, copies, copies, copies, False]
