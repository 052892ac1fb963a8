from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from semloc_logs.closures.closure import (
    FEATURES,
    Agreement,
    Alignment,
    Closure,
    Decision,
    Features,
    Reason,
    Rejected,
)
from semloc_logs.closures.closure_tables import (
    AGREEMENT_COLUMNS,
    read_closures,
    unique_closures,
    write_closures,
    write_rejected,
)
from semloc_logs.numerics.transforms import yaw_transform
from semloc_logs.tables import contracts
from semloc_logs.tables.table import read_metadata, read_table

SECOND = 10**9
# three sessions along the same road, a keyframe every metre
ROAD = dict.fromkeys("abc", np.arange(100.0))


def alignment(query: str, i: int, target: str, j: int) -> Alignment:
    rng = np.random.default_rng(i)
    half = rng.standard_normal((6, 6))
    features = Features(0.9, 0.9, 0.0, 0.9, 3.0, 3.0, 0.0)
    return Alignment(
        query_session=query,
        target_session=target,
        query_keyframe=i,
        target_keyframe=j,
        query_stamp_ns=i * SECOND,
        target_stamp_ns=j * SECOND,
        target_T_query=yaw_transform(0.1 * i, (0.5, 0.25, -0.1)),
        covariance=half @ half.T,
        overlap=0.75,
        inliers=1000 + i,
        words=i,
        features=features,
    )


def decision(probability: float) -> Decision:
    agreement = Agreement(0.9, 7.0, 5.0, 1.0, 2.0, 0.5, 0.25)
    return Decision(frozenset(), probability, 1.0, 1.0, agreement, 0.99)


def closure(query: str, i: int, target: str, j: int, probability: float = 0.995) -> Closure:
    return Closure(alignment(query, i, target, j), decision(probability))


def keys(rows: list[Closure]) -> list[tuple[str, int, str, int]]:
    alignments = [c.alignment for c in rows]
    return [
        (a.query_session, a.query_keyframe, a.target_session, a.target_keyframe) for a in alignments
    ]


@pytest.mark.parametrize("swap", [False, True])
def test_of_a_closure_found_from_both_ends_the_more_probable_stays(swap: bool) -> None:
    one = closure("a", 10, "b", 40, 0.995)
    other = closure("b", 41, "a", 11, 0.999)
    rows = [other, one] if swap else [one, other]
    assert keys(unique_closures(rows, ROAD, 2.0)) == [("b", 41, "a", 11)]


@pytest.mark.parametrize(
    "rows",
    [
        [("a", 10, "b", 40), ("b", 40, "a", 13)],  # one end too far away
        [("a", 10, "b", 40), ("b", 43, "a", 10)],  # the other
        [("a", 10, "b", 40), ("a", 11, "b", 41)],  # two queries of one session are two closures
        [("a", 10, "b", 40), ("b", 40, "c", 10)],  # other sessions
        [("a", 10, "a", 60), ("a", 12, "a", 62)],
        # a drive with itself: both ends lie at one place, but the way between differs
        [("a", 60, "a", 10), ("a", 60, "a", 12)],
    ],
)
def test_what_is_not_a_twin_stays(rows: list[tuple[str, int, str, int]]) -> None:
    assert sorted(keys(unique_closures([closure(*r) for r in rows], ROAD, 2.0))) == sorted(rows)


def test_a_session_that_closes_with_itself() -> None:
    rows = [
        closure("a", 10, "a", 60, 0.993),
        closure("a", 60, "a", 10, 0.996),
        closure("a", 90, "a", 10),
    ]
    assert keys(unique_closures(rows, ROAD, 2.0)) == [("a", 60, "a", 10), ("a", 90, "a", 10)]


def test_closures_are_sorted_by_session_and_time_whatever_the_order() -> None:
    rows = [
        closure("b", 5, "a", 50),
        closure("a", 30, "b", 80),
        closure("a", 7, "c", 20),
        closure("a", 7, "b", 90),
    ]
    expected = [("a", 7, "b", 90), ("a", 7, "c", 20), ("a", 30, "b", 80), ("b", 5, "a", 50)]
    for order in ([0, 1, 2, 3], [3, 2, 1, 0], [1, 3, 0, 2]):
        assert keys(unique_closures([rows[i] for i in order], ROAD, 2.0)) == expected
    assert unique_closures([], ROAD, 2.0) == []


def test_many_closures_of_one_pair_of_sessions_take_no_quadratic_time() -> None:
    n = 3000
    road = np.linspace(0.0, 5.0 * n, n, endpoint=False)
    rows = [closure("a", i, "b", i, 0.995) for i in range(n)] + [
        closure("b", i, "a", i, 0.994) for i in range(n)
    ]
    kept = unique_closures(rows, {"a": road, "b": road}, 2.0)
    assert len(kept) == n
    assert {c.alignment.query_session for c in kept} == {"a"}


@pytest.mark.parametrize("n", [0, 3])
def test_closures_as_a_table(n: int, tmp_path: Path) -> None:
    rows = [closure("a", i, "b", i + 50) for i in range(n)]
    write_closures(tmp_path / "closures.parquet", rows, {"schema_version": 1})
    table = read_table(tmp_path / "closures.parquet")
    assert table.schema.equals(contracts.schema("closures"))
    assert read_metadata(tmp_path / "closures.parquet") == {"schema_version": 1}
    closures = read_closures(tmp_path / "closures.parquet")
    assert len(closures) == n
    for c, row in zip(rows, closures, strict=True):
        a = c.alignment
        assert (row["query_session"], row["target_session"], row["query_stamp_ns"]) == (
            "a",
            "b",
            a.query_stamp_ns,
        )
        assert (row["t_x"], row["t_y"], row["t_z"]) == (0.5, 0.25, -0.1)
        assert row["q_z"] == pytest.approx(np.sin(0.05 * a.query_keyframe))
        assert row["q_w"] == pytest.approx(np.cos(0.05 * a.query_keyframe))
        np.testing.assert_array_equal(np.array(row["covariance"]).reshape(6, 6), a.covariance)
        assert (row["overlap"], row["probability"], row["inliers"], row["words"]) == (
            0.75,
            0.995,
            a.inliers,
            a.words,
        )


@pytest.mark.parametrize("n", [0, 3])
def test_rejections_as_a_table(n: int, tmp_path: Path) -> None:
    rows = [
        Rejected(
            dataclasses.replace(alignment("a", 5, "b", i), covariance=np.eye(6) * (i + 1) ** 2),
            decision(0.1 * i),
            Reason.UNCERTAIN_POSITION,
        )
        for i in range(n)
    ]
    write_rejected(tmp_path / "rejected.parquet", rows, {})
    table = read_table(tmp_path / "rejected.parquet")
    assert table.schema.equals(contracts.schema("rejected"))
    # the most probable first
    assert table["reason"].to_pylist() == [
        f"probability 0.{i}00 below 0.99: position uncertainty {i + 1}.00 m (1 sigma) is too large"
        for i in reversed(range(n))
    ]
    for name in FEATURES:
        assert table[name].to_pylist() == [getattr(r.alignment.features, name) for r in rows]
    votes = dict(zip(AGREEMENT_COLUMNS, (0.9, 7, 5.0, 1.0, 2.0, 0.5, 0.25), strict=True))
    for column, value in votes.items():
        assert table[column].to_pylist() == [value] * n
    assert table["sigma"].to_pylist() == pytest.approx([i + 1 for i in reversed(range(n))])


def test_rejections_are_sorted_by_query_then_probability_then_target(tmp_path: Path) -> None:
    ordered = [
        ("a", 7, "c", 9, 0.1),  # sessions in the order of their names
        ("b", 2, "c", 8, 0.3),  # queries in the order of their times
        ("b", 2, "a", 9, 0.2),  # the most probable first
        ("b", 2, "c", 1, 0.2),  # targets in the order of their names
        ("b", 2, "c", 4, 0.2),  # and of their times
        ("b", 5, "a", 1, 0.9),
    ]
    rows = [
        Rejected(alignment(query, i, target, j), decision(p), Reason.NEIGHBOURS_CONFLICT)
        for query, i, target, j, p in ordered
    ]
    for turn in range(len(rows)):
        write_rejected(tmp_path / "rejected.parquet", rows[turn:] + rows[:turn], {})
        table = read_table(tmp_path / "rejected.parquet")
        keys = zip(
            table["query_session"].to_pylist(),
            table["query_stamp_ns"].to_pylist(),
            table["target_session"].to_pylist(),
            table["target_stamp_ns"].to_pylist(),
            strict=True,
        )
        expected = [(query, i * SECOND, target, j * SECOND) for query, i, target, j, _ in ordered]
        assert list(keys) == expected


@pytest.mark.parametrize("better", [0, 1])
def test_of_equally_probable_twins_the_one_of_more_structure_stays(better: int) -> None:
    twins = [closure("a", 10, "b", 50), closure("b", 50, "a", 10)]
    a = twins[better].alignment
    features = dataclasses.replace(a.features, structure=0.95)
    twins[better] = dataclasses.replace(
        twins[better], alignment=dataclasses.replace(a, features=features)
    )
    for given in (twins, twins[::-1]):
        assert keys(unique_closures(given, ROAD, 5.0)) == keys([twins[better]])
