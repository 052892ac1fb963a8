"""A log whose odometry starts again: `fuse` tells it, `close` gives the session no closures, and
`inspect --check` tells it of the log alone.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from click.testing import CliRunner

from semloc_logs.cli.main import program
from semloc_logs.closures.closure_tables import read_closures
from semloc_logs.closures.session_pairs import Pair
from semloc_logs.engines import Serial
from semloc_logs.numerics.transforms import inverse
from semloc_logs.simulation.drives.drive import simulate_drive
from semloc_logs.simulation.output.drive_log import write_session
from semloc_logs.simulation.sensors.sensor import Sensor
from semloc_logs.stages.close import close
from semloc_logs.stages.describe import describe
from semloc_logs.stages.fuse import fuse
from semloc_logs.stages.inputs import SessionInput
from semloc_logs.stages.pair_search import PairSearch
from semloc_logs.tables.table import read_json, write_json
from semloc_logs.workspace import Workspace


@pytest.fixture(scope="module")
def reset_log(
    tmp_path_factory: pytest.TempPathFactory, drives: dict[str, Any], tools: SimpleNamespace
) -> Path:
    """Tuesday's drive again, by an odometry that starts at the identity halfway."""
    driven = drives["tuesday"].trajectory
    poses = driven.odom_T_base.copy()
    half = len(poses) // 2
    poses[half:] = inverse(poses[half]) @ poses[half:]
    driven = replace(driven, odom_T_base=poses)
    log = tmp_path_factory.mktemp("reset") / "reset.mcap"
    shots = simulate_drive(tools.crossing(), driven, Sensor("hdl32", columns=300), seed=1)
    write_session(log, driven, shots)
    return log


def test_a_session_whose_odometry_was_reset_gets_no_closures(
    reset_log: Path, coarse: Workspace, tools: SimpleNamespace
) -> None:
    settings = tools.coarse_settings()
    before = read_closures(coarse.closures)
    report = fuse([SessionInput("reset", (reset_log,))], coarse, settings, Serial())
    [sentence] = [s for s in report.skipped if "/odometry" in s]
    assert "the poses start again at the identity" in sentence
    content = read_json(coarse.session("reset").session_json)
    assert content["fit"]["fits"] is False
    assert sentence in content["problems"]

    describe(coarse, ["reset"], settings, Serial())
    report = close(coarse, settings, Serial())
    [sentence] = report.skipped
    assert sentence.startswith("Session reset gets no closures: its poses do not fit")
    closures = read_closures(coarse.closures)
    assert len(closures) == len(before)
    sessions = {row[end] for row in closures for end in ("query_session", "target_session")}
    assert "reset" not in sessions
    again = close(coarse, settings, Serial())
    assert (again.kept, again.skipped) == (["closures"], [sentence])

    all_the_same = tools.coarse_settings(closures__misfits="true")
    assert close(coarse, all_the_same, Serial()).skipped == []


def test_pairs_whose_mountings_contradict_each_other_are_not_searched(
    coarse: Workspace, tools: SimpleNamespace
) -> None:
    settings = tools.coarse_settings()
    before = read_closures(coarse.closures)
    path = coarse.session("tuesday").session_json
    content = read_json(path)
    [stream] = content["fit"]["streams"]
    [frame] = stream["frames"]
    stream["hidden"] = ["lever_x_m"]
    content["base_T_sensors"][frame][0][3] += 4.0
    write_json(path, content)

    search = PairSearch.of(coarse, settings, overwrite=True)
    with_others = {p for p in search.chosen if "tuesday" in (p.query, p.target)}
    assert with_others == {Pair("tuesday", "tuesday")}

    [sentence] = close(coarse, settings, Serial(), overwrite=True).skipped
    assert "get no closures with each other" in sentence
    closures = read_closures(coarse.closures)
    assert len(closures) < len(before)
    assert all(
        row["query_session"] == row["target_session"]
        for row in closures
        if "tuesday" in (row["query_session"], row["target_session"])
    )


def test_sessions_that_fit_are_recorded_as_such(labelled: Workspace) -> None:
    for name in ("monday", "tuesday", "wednesday"):
        fit = read_json(labelled.session(name).session_json)["fit"]
        assert fit["fits"] is True
        assert fit["track"] is None
        assert [stream["findings"] for stream in fit["streams"]] == [[]]


def test_inspect_checks_a_log_alone(reset_log: Path, drives: dict[str, Any]) -> None:
    run = CliRunner().invoke(
        program, ["inspect", str(reset_log), "--check", "--json"], prog_name="semloc"
    )
    [content] = json.loads(run.stdout)
    assert run.exit_code == 3
    assert content["verdict"].startswith("not to be trusted: /odometry: the poses start again")
    assert content["suggested"] == ""
    assert any("start again at the identity" in sentence for sentence in content["skipped"])
    assert content["fit"]["fits"] is False

    run = CliRunner().invoke(
        program, ["inspect", str(drives["monday"].log), "--check", "--json"], prog_name="semloc"
    )
    [content] = json.loads(run.stdout)
    assert run.exit_code == 0
    assert content["fit"]["fits"] is True
    assert content["verdict"].startswith("ready")
