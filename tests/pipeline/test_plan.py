"""`--dry-run` names what a command would do, and writes nothing."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from click.testing import CliRunner, Result

from semloc_logs.cli.main import program
from semloc_logs.engines import Serial
from semloc_logs.stages.dry_run import Plan, measured_rates
from semloc_logs.stages.run import run
from semloc_logs.workspace import Workspace


def planned(plan: Plan) -> dict[str, tuple[list[str], int]]:
    return {stage.stage: (list(stage.todo), stage.total) for stage in plan.stages}


def semloc(*args: object) -> Result:
    return CliRunner().invoke(program, [str(a) for a in args], prog_name="semloc")


def test_all_of_a_run_is_planned(tools: SimpleNamespace, drives: Any, tmp_path: Path) -> None:
    work = Workspace(tmp_path / "work")
    plan = Plan(work, tools.coarse_settings())
    plan.fuse(tools.inputs(drives, "tuesday", "monday"), overwrite=False, retry_failed=False)
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
    plan.fuse(sessions, overwrite=False, retry_failed=False)
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
    again.fuse(sessions, overwrite=False, retry_failed=False)
    again.describe(overwrite=False)
    again.close(overwrite=False)
    assert planned(again) == {"fuse": ([], 3), "describe": ([], 3), "close": ([], 6)}


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
