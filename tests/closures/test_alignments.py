"""Alignments as columns: what they are made of comes back, from tables too."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semloc_logs.closures.alignment_tables import (
    alignment_table,
    by_target,
    joined,
    read_alignments,
    write_part,
)
from semloc_logs.closures.closure import Alignment, Alignments, Features
from semloc_logs.tables.table import write_table


def alignment(seed: int, query: str = "b", target: str = "a") -> Alignment:
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, 3] = rng.uniform(-5, 5, 3)
    root = rng.standard_normal((6, 6))
    return Alignment(
        query_session=query,
        target_session=target,
        query_keyframe=int(rng.integers(100)),
        target_keyframe=int(rng.integers(100)),
        query_stamp_ns=int(rng.integers(2**60)),
        target_stamp_ns=int(rng.integers(2**60)),
        target_T_query=pose,
        covariance=root @ root.T,
        overlap=float(rng.random()),
        inliers=int(rng.integers(1000)),
        words=int(rng.integers(1000)),
        features=Features(*rng.random(7).tolist()),
    )


def content(a: Alignment) -> list[Any]:
    """All values of an alignment, comparable."""
    names = [n for n in Alignment.__slots__ if n not in ("target_T_query", "covariance")]
    arrays = [a.target_T_query.tolist(), a.covariance.tolist()]
    return [[getattr(a, n) for n in names if n != "features"], arrays, a.features.vector().tolist()]


def test_the_columns_of_several_pairs_give_the_alignments_back() -> None:
    pairs = (("b", "a"), ("c", "b"), ("b", "a"))
    rows = [alignment(k, query, target) for k, (query, target) in enumerate(pairs)]
    others = [alignment(9, "c", "a")]
    held = Alignments.joined([Alignments.of(rows), Alignments.of([]), Alignments.of(others)])
    assert held.given is None
    assert [content(a) for a in held] == [content(a) for a in (*rows, *others)]
    assert [content(a) for a in held[1:3]] == [content(a) for a in rows[1:3]]
    assert content(held[-1]) == content(others[0])
    with pytest.raises(IndexError):
        held[4]
    names = [list(of_end) for of_end in held.sessions()]
    assert names == [list("bcbc"), list("abaa")]
    assert held.sigma() == pytest.approx([a.sigma for a in (*rows, *others)])
    assert {pair: rows_of_pair.tolist() for pair, rows_of_pair in held.by_pair()} == {
        ("b", "a"): [0, 2],
        ("c", "b"): [1],
        ("c", "a"): [3],
    }


def test_no_alignments_have_columns_too() -> None:
    held = Alignments.joined([])
    assert list(held) == []
    assert list(held.by_pair()) == []
    assert held.sigma().tolist() == []


def test_tables_keep_alignments(tmp_path: Path) -> None:
    rows = [alignment(k) for k in range(3)]
    write_table(tmp_path / "table.parquet", alignment_table(rows), {})
    held = read_alignments(tmp_path / "table.parquet", "b", "a")
    expected = [content(a)[0] + content(a)[2] for a in rows]
    assert [content(a)[0] + content(a)[2] for a in held] == expected
    assert held.covariance == pytest.approx(np.array([a.covariance for a in rows]))
    assert held.target_T_query == pytest.approx(np.array([a.target_T_query for a in rows]))


def test_parts_become_one_table_for_each_target(tmp_path: Path) -> None:
    first = [alignment(0, target="a"), alignment(1, target="b"), alignment(2, target="a")]
    second = [alignment(3, target="a")]
    targets = {"a": "1", "b": "2", "c": "3"}
    write_part(tmp_path / "1.parquet", [1], targets, first)
    write_part(tmp_path / "2.parquet", [2], targets, second)
    parts = [by_target(tmp_path / name) for name in ("1.parquet", "2.parquet")]
    for target in "abc":
        expected = [a.query_keyframe for a in (*first, *second) if a.target_session == target]
        table = joined(part[target] for part in parts if target in part)
        assert table["query_keyframe"].to_pylist() == expected
        assert "target_session" not in table.column_names
