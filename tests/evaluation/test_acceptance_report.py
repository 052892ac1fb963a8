"""The report of the acceptance, by hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from semloc_logs.evaluation.acceptance_report import (
    closures_at,
    most_of,
    reliability,
    report_of,
    share_bounds,
)
from semloc_logs.evaluation.judged_alignments import Judged
from semloc_logs.pictures.reliability_diagram import draw_reliability

Make = Callable[..., Judged]


def test_reliability_by_hand() -> None:
    p = np.array([0.05, 0.15, 0.95, 0.97])
    right = np.array([False, True, True, True])
    assert reliability(p, right, (0.0, 0.5, 1.0)) == [
        {"from": 0.0, "to": 0.5, "alignments": 2, "mean": pytest.approx(0.1), "right": 0.5},
        {"from": 0.5, "to": 1.0, "alignments": 2, "mean": pytest.approx(0.96), "right": 1.0},
    ]


def test_of_each_query_the_most_probable_alignment_is_a_closure(judged: Make) -> None:
    data = judged(4, towns=1)
    placed = replace(data.placed, query=np.array([0, 0, 1, 2]))
    right = np.array([False, True, True, True])
    row = closures_at(
        replace(data, placed=placed, right=right), np.array([0.9, 0.2, 0.95, 0.1]), (0.5,)
    )[0]
    assert (row.accepted, row.false, row.possible) == (2, 1, 3)
    assert (row.towns, row.false_towns) == (1, 1)
    assert row.recall == pytest.approx(1 / 3)


def test_bounds_of_shares_as_in_the_tables() -> None:
    """The rule of three, more exactly, and a value of Clopper and Pearson's table."""
    assert most_of(0, 1000) == pytest.approx(1 - 0.05 ** (1 / 1000))
    assert most_of(0, 0) == 1.0
    assert share_bounds(0, 10) == pytest.approx((0.0, 0.3085), abs=1e-4)
    assert share_bounds(5, 10) == pytest.approx((0.1871, 0.8129), abs=1e-4)
    assert share_bounds(10, 10)[1] == 1.0


def sessions(data: Judged, queries: list[str], target: str) -> Judged:
    placed = replace(
        data.placed,
        query_session=np.array(queries, object),
        target_session=np.full(len(queries), target, object),
    )
    return replace(data, placed=placed)


def test_towns_are_told_apart_by_kind_and_sensors(judged: Make) -> None:
    drives = sessions(judged(40, towns=1), ["hdl32_0", "stereo_0"] * 20, "hdl32_1")
    p = np.where(drives.right, 0.995, 0.5)
    report = report_of(drives, p)
    assert [(g.kind, g.sensors) for g in report.groups] == [
        ("drives, ordinary towns", "all"),
        ("drives, ordinary towns", "hdl32, hdl32"),
        ("drives, ordinary towns", "hdl32, stereo"),
    ]
    assert (report.towns, report.queries) == (1, 40)
    everything = report.groups[0]
    assert everything.errors is not None
    right = int(drives.right.sum())
    assert everything.errors.closures == right
    # of the fixture: one standard deviation along each axis, both within their ellipses
    assert everything.errors.median_m == pytest.approx(0.02 * 3**0.5)
    assert everything.errors.nees_position == pytest.approx(3.0)
    assert everything.errors.nees_pose == pytest.approx(6.0)
    assert (everything.errors.within_position, everything.errors.within_pose) == (1.0, 1.0)
    assert [row.accepted for row in everything.at] == [right, right, 0]


def test_sessions_of_one_query_each_are_single_sweeps_and_copies_are_named(judged: Make) -> None:
    data = judged(6, towns=1)
    names = [f"vlp16_0_{k:02d}" for k in range(6)]
    copies = replace(data, town=np.full(6, "repeating-x", object))
    report = report_of(sessions(copies, names, "vlp16_1_00"), np.zeros(6))
    assert [(g.kind, g.sensors) for g in report.groups] == [
        ("single sweeps, copied blocks", "vlp16, vlp16")
    ]
    assert report.groups[0].errors is None
    assert report.reliability == []


def test_the_tables_have_a_row_for_each_group(judged: Make) -> None:
    data = sessions(judged(40, towns=1), ["hdl32_0", "stereo_0"] * 20, "hdl32_1")
    report = report_of(data, np.where(data.right, 0.995, 0.5))
    lines = report.markdown().splitlines()
    possible = int(data.right.sum())
    closures = next(line for line in lines if line.startswith("| drives, ordinary towns | all |"))
    assert f"| {possible} | 1.00 (" in closures
    assert f"| 0 of {possible} |" in closures
    assert sum(line.startswith("| drives") for line in lines) == 6
    # every table has as many cells in each row as in its head
    for table in report.markdown().split("\n\n")[1:]:
        assert len({line.count("|") for line in table.strip().splitlines()}) == 1
    assert report.to_json()["groups"][0]["at"][0]["recall"] == 1.0


def test_the_picture_is_a_picture(tmp_path: Path) -> None:
    bins = reliability(np.linspace(0, 1, 50), np.linspace(0, 1, 50) > 0.4)
    draw_reliability(tmp_path / "r.png", {"alone": bins, "with neighbours": bins})
    image = np.asarray(cv2.imread(str(tmp_path / "r.png")))
    assert image.shape[0] > 500
    assert (image == np.array([20, 120, 214])).all(axis=-1).any()  # the second line, BGR
