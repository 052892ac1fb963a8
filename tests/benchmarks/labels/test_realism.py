"""Portraits of sweeps whose figures one can count."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from semloc_logs.benchmarks.labels.realism import compare, portrait, total_variation
from semloc_logs.benchmarks.scans import Scan, town_sweeps
from semloc_logs.cli.main import program
from semloc_logs.errors import LogError
from semloc_logs.settings import Settings

FUSION = Settings().resolved().fusion


def street(half_width: float = 5.0, facade: float = 9.0) -> Scan:
    """Road from -half_width to half_width, pavement to the facades, which are 2 m high; the sensor
    1.7 m over the road.
    """
    x, y = np.meshgrid(np.arange(-20, 20, 0.1), np.arange(-facade, facade, 0.1))
    ground = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, -1.7)])
    x, z = np.meshgrid(np.arange(-20, 20, 0.1), np.arange(-1.7, 0.31, 0.1))
    walls = [
        np.column_stack([x.ravel(), np.full(x.size, side * facade), z.ravel()]) for side in (-1, 1)
    ]
    label = np.where(np.abs(ground[:, 1]) < half_width, 0, 1)
    points = np.concatenate([ground, *walls])
    return Scan(
        points.astype(np.float32),
        np.concatenate([label, np.full(2 * x.size, 2)]).astype(np.uint8),
        np.eye(4),
    )


def test_a_street_is_as_wide_as_it_is() -> None:
    seen = portrait(street(), FUSION)
    assert seen.numbers["road beside the sensor, width: m"] == pytest.approx(0.96 * 10, abs=0.15)
    assert seen.numbers["house beside the sensor, distance: m"] == pytest.approx(9.0, abs=0.01)
    assert np.isnan(seen.numbers["vegetation beside the sensor, distance: m"])
    assert seen.numbers["points a sweep"] == 400 * 180 + 2 * 400 * 21
    assert seen.histograms["classes of points within 50 m"][2] == pytest.approx(
        2 * 400 * 21 / seen.numbers["points a sweep"]
    )
    # straight to the side a facade is 9 m away; ahead there is nothing within 80 m
    assert seen.numbers["first thing in a direction, 25 %: m"] == pytest.approx(
        9 / np.sin(np.radians(67.5)), abs=0.3
    )
    facing = np.degrees(2 * np.arctan(20 / 9)) / 180
    assert 1 - seen.histograms["distance to the nearest structure of a direction"][
        -1
    ] == pytest.approx(facing, abs=0.02)
    assert seen.histograms["class of the nearest structure of a direction"][2] == 1.0


def test_voxels_are_counted() -> None:
    seen = portrait(street(), FUSION)
    # 40 m x 10 m of road in voxels of 0.3 m, more or less a row at the borders
    assert seen.numbers["voxels within 30 m: road"] == pytest.approx(40 * 10 / 0.09, rel=0.05)
    assert (
        seen.numbers["subvolumes within 20 m: share free"]
        + seen.numbers["subvolumes within 20 m: share unobserved"]
        < 1.0
    )
    assert 40 <= seen.numbers["subvolumes within 20 m: occupied voxels"] < 32**3


def test_histograms_have_sum_one() -> None:
    for histogram in portrait(street(), FUSION).histograms.values():
        assert histogram.sum() == pytest.approx(1.0)


def test_total_variation_is_the_share_to_move() -> None:
    assert total_variation(np.array([0.5, 0.5, 0.0]), np.array([0.5, 0.2, 0.3])) == pytest.approx(
        0.3
    )
    assert total_variation(np.array([1.0, 0.0]), np.array([0.0, 1.0])) == 1.0


def test_the_same_street_has_no_distance_and_a_wider_one_has() -> None:
    narrow = portrait(street(4.0, 7.0), FUSION)
    wide = portrait(street(8.0, 12.0), FUSION)
    same = compare([narrow], [narrow])
    other = compare([wide], [narrow])
    assert all(row["ours"] == 0 for name, row in same.items() if name.startswith("distance: "))
    assert float(other["distance: classes of voxels within 30 m"]["ours"]) > 0.03
    assert other["road beside the sensor, width: m"]["difference"] == pytest.approx(
        0.96 * 8, abs=0.2
    )


def test_a_sweep_without_a_road_is_refused() -> None:
    scan = street()
    with pytest.raises(LogError, match="no point of a road"):
        portrait(
            Scan(scan.points, np.full(len(scan.points), 2, np.uint8), scan.map_T_sensor), FUSION
        )


def test_simulated_sweeps_have_as_many_points_as_real_ones() -> None:
    (scan,) = town_sweeps(0, 1)
    seen = portrait(scan, FUSION)
    assert 105_000 < seen.numbers["points a sweep"] < 130_000
    assert seen.numbers["range, 99 %: m"] < 80


def test_the_command_compares_with_a_real_log(
    shared: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    log = shared("logs/kitti00_000052.mcap")
    monkeypatch.setattr(
        "semloc_logs.benchmarks.labels.realism.town_sweeps",
        lambda seed, sweeps: [street()] if seed == 0 else [],
    )
    result = CliRunner().invoke(program, ["benchmark", "realism", str(log), "--json"])
    assert result.exit_code == 0
    figures = json.loads(result.stdout)
    assert figures["points a sweep"]["real"] == 120_796
    assert {"ours", "real", "difference", "unit"} == set(figures["occupied voxels within 30 m"])
