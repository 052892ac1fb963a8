"""`--dry-run` names what a command would do, and writes nothing."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from click.testing import CliRunner, Result

from semloc_logs.cli.main import program
from semloc_logs.engines import Serial
from semloc_logs.errors import WorkspaceError
from semloc_logs.logs.containers.open import open_log
from semloc_logs.stages.dry_run import Plan, PlannedStage, measured_rates
from semloc_logs.stages.inputs import Redo, SessionInput
from semloc_logs.stages.run import run
from semloc_logs.workspace import Workspace


def planned(plan: Plan) -> dict[str, tuple[list[str], int]]:
    return {stage.stage: (list(stage.todo), stage.total) for stage in plan.stages}


def semloc(*args: object) -> Result:
    return CliRunner().invoke(program, [str(a) for a in args], prog_name="semloc")


def test_all_of_a_run_is_planned(tools: SimpleNamespace, drives: Any, tmp_path: Path) -> None:
    work = Workspace(tmp_path / "work")
    plan = Plan(work, tools.coarse_settings())
    plan.fuse(tools.inputs(drives, "tuesday", "monday"))
    plan.describe(overwrite=False)
    plan.close(overwrite=False)
    pairs = ["monday in monday", "tuesday in monday", "tuesday in tuesday"]
    assert planned(plan) == {
        "fuse": (["tuesday", "monday"], 2),
        "describe": (["tuesday", "monday"], 2),
        "close": (pairs, 3),
    }
    assert all(stage.amount > 0 and stage.seconds > 0 for stage in plan.stages)
    assert not work.path.exists()


def test_one_more_log_is_searched_in_the_others(
    tools: SimpleNamespace, drives: Any, coarse: Workspace
) -> None:
    settings = tools.coarse_settings()
    sessions = tools.inputs(drives, *drives)
    before = tools.write_times(coarse.path)
    plan = Plan(coarse, settings)
    plan.fuse(sessions)
    plan.describe(overwrite=False)
    plan.close(overwrite=False)
    assert tools.write_times(coarse.path) == before
    pairs = [f"wednesday in {name}" for name in ("monday", "tuesday", "wednesday")]
    assert planned(plan) == {
        "fuse": (["wednesday"], 3),
        "describe": (["wednesday"], 3),
        "close": (pairs, 6),
    }
    report = run(sessions, coarse, settings, Serial())
    assert [work for work in report.done if work != "close closures"] == [
        "fuse wednesday",
        "describe wednesday",
    ]
    assert set(measured_rates(coarse)) == {"fuse", "describe", "close"}

    again = Plan(coarse, settings)
    again.fuse(sessions)
    again.describe(overwrite=False)
    again.close(overwrite=False)
    assert planned(again) == {"fuse": ([], 3), "describe": ([], 3), "close": ([], 6)}


def stages_of(plan: Plan) -> dict[str, PlannedStage]:
    return {stage.stage: stage for stage in plan.stages}


def seconds_of(log: Path) -> float:
    with closing(open_log(log)) as opened:
        assert opened.start_ns is not None
        assert opened.end_ns is not None
        return (opened.end_ns - opened.start_ns) / 1e9


def test_amounts_and_seconds_by_hand(tools: SimpleNamespace, drives: Any, tmp_path: Path) -> None:
    """One session of two logs, at 8 m/s: submaps of 4 m that repeat a half, a query every 8 m."""
    seconds = seconds_of(drives["tuesday"].log) + seconds_of(drives["wednesday"].log)
    settings = tools.coarse_settings(fusion__submap_length="4", fusion__submap_overlap="0.5")
    sessions = [SessionInput("both", (drives["tuesday"].log, drives["wednesday"].log))]

    def plan_in(work: Workspace) -> dict[str, PlannedStage]:
        plan = Plan(work, settings)
        plan.fuse(sessions)
        plan.describe(overwrite=False)
        plan.close(overwrite=False)
        return stages_of(plan)

    usual = plan_in(Workspace(tmp_path / "new"))
    assert usual["fuse"].amount == round(seconds) >= 4
    assert usual["fuse"].seconds == pytest.approx(0.5 * seconds)
    assert usual["describe"].amount == 1 + int(8 * seconds / 2)
    assert usual["describe"].seconds == 3.0 * usual["describe"].amount
    assert usual["close"].seconds == pytest.approx(0.1 * (1 + seconds))

    measured = Workspace(tmp_path / "measured")
    measured.path.mkdir()
    measured.summary.write_text(json.dumps({"rates": {"fuse": 2.0, "other": 1.0}}))
    rated = plan_in(measured)
    assert rated["fuse"].seconds == pytest.approx(2.0 * seconds)
    assert rated["close"].seconds == usual["close"].seconds


def test_a_log_that_cannot_be_opened_makes_no_session(
    tools: SimpleNamespace, drives: Any, tmp_path: Path
) -> None:
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(b"not a log")
    plan = Plan(Workspace(tmp_path / "work"), tools.coarse_settings())
    sessions = [SessionInput("broken", (broken,)), *tools.inputs(drives, "monday")]
    plan.fuse(sessions)
    plan.describe(overwrite=False)
    plan.close(overwrite=False)
    assert planned(plan) == {
        "fuse": (["broken", "monday"], 2),
        "describe": (["monday"], 1),
        "close": (["monday in monday"], 1),
    }


def test_all_is_planned_again_with_overwrite(
    tools: SimpleNamespace, drives: Any, coarse: Workspace
) -> None:
    """A session that is fused again is described once, not as it is and as it will be."""
    settings = tools.coarse_settings()
    pairs = ["monday in monday", "tuesday in monday", "tuesday in tuesday"]
    alone = Plan(coarse, settings)
    alone.close(overwrite=True)
    assert planned(alone) == {"close": (pairs, 3)}

    plan = Plan(coarse, settings)
    plan.fuse(tools.inputs(drives, "tuesday"), Redo.EVERYTHING)
    plan.describe(overwrite=True)
    plan.close(overwrite=True)
    assert planned(plan) == {
        "fuse": (["tuesday"], 1),
        "describe": (["monday", "tuesday"], 2),
        "close": (pairs, 3),
    }


def test_the_later_recorded_session_is_the_query_whatever_its_name(
    tools: SimpleNamespace, drives: Any, coarse: Workspace
) -> None:
    plan = Plan(coarse, tools.coarse_settings())
    sessions = [SessionInput("a", (drives["wednesday"].log,))]
    plan.fuse(sessions)
    plan.close(overwrite=False)
    pairs = ["a in monday", "a in tuesday", "a in a"]
    assert planned(plan)["close"] == (pairs, 6)


def test_sessions_without_words_are_named(tools: SimpleNamespace, coarse: Workspace) -> None:
    """Where `describe` is not planned before, as in the command itself."""
    coarse.session("monday").words_json.unlink()
    plan = Plan(coarse, tools.coarse_settings())
    with pytest.raises(WorkspaceError, match="monday"):
        plan.close(overwrite=True)
    plan.describe(overwrite=False)
    plan.close(overwrite=True)
    assert planned(plan)["close"][1] == 3


@pytest.mark.parametrize("command", ["run", "fuse", "describe", "close"])
def test_commands_with_dry_run_write_nothing(
    command: str, tools: SimpleNamespace, drives: Any, coarse: Workspace
) -> None:
    logs = [f"wednesday={drives['wednesday'].log}"] if command in ("run", "fuse") else []
    before = tools.write_times(coarse.path)
    done = semloc(command, *logs, "-w", coarse.path, "--dry-run")
    assert done.exit_code == 0, done.stderr
    assert "nothing was written" in done.stdout
    assert ("wednesday" in done.stdout) == bool(logs)
    told = json.loads(semloc(command, *logs, "-w", coarse.path, "--dry-run", "--json").stdout)
    assert [stage["stage"] for stage in told["stages"]] == {
        "run": ["fuse", "describe", "close"]
    }.get(command, [command])
    assert told["seconds"] >= 0
    assert tools.write_times(coarse.path) == before
