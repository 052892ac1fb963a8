"""Whole logs: fusing beside its necessary parts, and memory."""

from pathlib import Path

import numpy as np
import pytest

from semloc_logs.benchmarks.speed.fusion_memory import peak_memory
from semloc_logs.benchmarks.speed.profiles import SPANS, profile_fuse
from semloc_logs.errors import SemlocError
from semloc_logs.logs.session.session import SessionOptions, open_session
from semloc_logs.settings import Settings
from semloc_logs.simulation.output.long_drive import Lap


@pytest.fixture(scope="module")
def lap() -> Lap:
    return Lap(columns=60, length_m=40.0)


@pytest.mark.parametrize("onwards", [True, False])
def test_laps_join_and_go_on_or_come_back(lap: Lap, onwards: bool, tmp_path: Path) -> None:
    log = tmp_path / "drive.mcap"
    assert lap.write(log, 3, onwards=onwards) == 3 * 20
    session = open_session([log], SessionOptions(min_range=0.5))
    try:
        clouds = list(session.clouds())
        _, poses = session.trajectory()
    finally:
        session.close()
    assert len(clouds) == 3 * 20
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert steps.max() < 0.5
    away = np.linalg.norm(poses[:, :2, 3] - poses[0, :2, 3], axis=1)
    assert away.max() == pytest.approx(120.0 if onwards else 40.0, abs=1.5)
    assert poses[-1, 2, 2] > 0.99  # still upright
    # the second lap's first sweep is the first lap's first or, on the way back, its last
    assert len(clouds[20].points) == len(clouds[0 if onwards else 19].points)


def test_fusing_is_split_into_parts(lap: Lap, tmp_path: Path) -> None:
    log = tmp_path / "drive.mcap"
    lap.write(log, 1, onwards=True)
    figures, rows = profile_fuse([log], Settings().resolved(), rounds=1)
    value = {k: float(v["ours"]) for k, v in figures.items()}
    assert value["clouds"] == value["keyframes"] == 20
    assert value["ratio"] == pytest.approx(
        value["whole"] / (value["reading"] + value["integrating"])
    )
    assert value["whole"] > value["reading"] > 0
    parts = {k: v for k, v in value.items() if k.startswith("part: ")}
    assert parts.keys() == {"part: rest", *(f"part: {span.name}" for span in SPANS)}
    # a function that is no longer called takes no time
    assert {part for part, seconds in parts.items() if seconds <= 0} <= {"part: picture"}
    assert parts["part: rest"] < 0.5 * sum(parts.values())
    assert len(rows) == 12


def test_peak_memory_is_that_of_the_other_process() -> None:
    assert 10 < peak_memory(["--version"]) < 300


def test_peak_memory_of_what_fails(tmp_path: Path) -> None:
    with pytest.raises(SemlocError, match=r"no\.mcap"):
        peak_memory(["fuse", str(tmp_path / "no.mcap"), "-w", str(tmp_path / "w")])
