"""Tasks, one by one and at once, leave the same files as `semloc run`."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from click.testing import CliRunner, Result

from semloc_logs.cli.main import program
from semloc_logs.closures.session_pairs import Pair
from semloc_logs.engines import Serial
from semloc_logs.errors import LogError, SettingsError, WorkspaceError
from semloc_logs.stages.inputs import Redo, SessionInput
from semloc_logs.stages.tasks import Stage, do_task, list_tasks, parse_task
from semloc_logs.tables.table import read_json, write_json
from semloc_logs.workspace import Workspace

TWO = ("monday", "tuesday")
SEARCHES = ["search/monday/monday", "search/tuesday/monday", "search/tuesday/tuesday"]


def semloc(*args: object) -> Result:
    return CliRunner().invoke(program, [str(a) for a in args], prog_name="semloc")


def flags(settings: dict[str, str]) -> list[str]:
    return [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]


@pytest.fixture
def given(drives: Any, tools: SimpleNamespace) -> list[str]:
    """The logs and settings of ``coarse`` as words of a command."""
    logs = [f"{name}={drives[name].log}" for name in TWO]
    return [*logs, *flags(tools.COARSE)]


def test_tasks_in_any_order_leave_the_files_of_a_run(
    tools: SimpleNamespace, drives: Any, coarse: Workspace, tmp_path: Path
) -> None:
    settings = tools.coarse_settings()
    sessions = tools.inputs(drives, *TWO)
    work = Workspace(tmp_path / "tasks")
    for stage in Stage:
        tasks = list_tasks(stage, sessions, work, settings)
        assert not any(task.done for task in tasks)
        for task in reversed(tasks):
            do_task(task.id, sessions, work, settings, Serial())
        again = list_tasks(stage, sessions, work, settings)
        assert [task.id for task in again] == [task.id for task in tasks]
        assert all(task.done for task in again)
    assert tools.files(work.path) == tools.files(coarse.path)
    assert list((work.path / ".parts").glob("*")) == []
    assert list(work.locks.rglob("target=*")) == []


def test_commands_of_tasks_run_at_once(
    given: list[str], tools: SimpleNamespace, coarse: Workspace, tmp_path: Path
) -> None:
    """As a cluster runs them: a process each, and the lines of `semloc tasks` tell which."""
    work = tmp_path / "tasks"
    for stage in Stage:
        logs = given if stage == Stage.FUSE else []
        listed = semloc("tasks", stage, *logs, "-w", work)
        assert listed.exit_code == 0, listed.stderr
        tasks = [json.loads(line) for line in listed.stdout.splitlines()]
        assert set(tasks[0]) == {"id", "stage", "inputs", "command", "done"}
        command = [sys.executable, "-c", "from semloc_logs.cli.main import main; main()"]
        runs = [
            subprocess.Popen(
                [*command, *task["command"][1:]],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
            for task in tasks
        ]
        ends = [(process.communicate(), process.returncode) for process in runs]
        assert [code for _, code in ends] == [0] * len(tasks), ends
        assert semloc("tasks", stage, *logs, "-w", work, "--missing").stdout == ""
    assert tools.files(work) == tools.files(coarse.path)


def test_array_jobs_take_tasks_by_their_number(coarse: Workspace) -> None:
    def done(*args: object) -> list[str]:
        run = semloc("task", "search", "-w", coarse.path, "--json", *args)
        assert run.exit_code == 0, run.stderr
        return [task["id"] for task in json.loads(run.stdout)]

    assert semloc("tasks", "search", "-w", coarse.path, "--count").stdout == "3\n"
    assert [done("--index", n) for n in range(3)] == [[task] for task in SEARCHES]
    assert done("--index", 0, "--of", 2) == [SEARCHES[0], SEARCHES[2]]
    assert done("--index", 4, "--of", 5) == []  # an array with more jobs than tasks
    assert semloc("task", "search", "-w", coarse.path, "--index", 3).exit_code == 2
    assert semloc("task", "search", "-w", coarse.path).exit_code == 2
    assert semloc("task", "search", "-w", coarse.path, "--index", 3, "--of", 3).exit_code == 2


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("serach/a/b", r"Did you mean 'search'\?"),
        ("search/a", "write search/QUERY/TARGET"),
        ("fuse", "write fuse/SESSION"),
        ("decide/a", "write decide"),
        ("describe/", "write describe/SESSION"),
    ],
)
def test_what_is_not_a_task_is_wrong_usage(text: str, sentence: str) -> None:
    with pytest.raises(SettingsError, match=sentence):
        parse_task(text)


def test_a_pair_has_one_direction(coarse: Workspace, tools: SimpleNamespace) -> None:
    with pytest.raises(WorkspaceError, match="search is 'search/tuesday/monday'"):
        do_task("search/monday/tuesday", [], coarse, tools.coarse_settings(), Serial())


def test_decide_waits_for_all_pairs(coarse: Workspace, tools: SimpleNamespace) -> None:
    before = tools.files(coarse.path)
    coarse.alignments("tuesday", "monday").unlink()
    with pytest.raises(WorkspaceError, match=r"1 pairs of .* not searched yet .search/tuesday"):
        do_task("decide", [], coarse, tools.coarse_settings(), Serial())
    do_task(SEARCHES[1], [], coarse, tools.coarse_settings(), Serial())
    do_task("decide", [], coarse, tools.coarse_settings(), Serial())
    assert tools.files(coarse.path) == before


def test_exit_codes_tell_what_to_try_again(coarse: Workspace, tmp_path: Path) -> None:
    """For the podFailurePolicy of a Kubernetes Job."""
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(b"not a log")
    assert semloc("task", "fuse/bad", bad, "-w", tmp_path / "w").exit_code == 1
    assert semloc("task", "fuse/none", bad, "-w", tmp_path / "w").exit_code == 2
    script = (
        "import sys, time; from pathlib import Path; from semloc_logs.stages.lock import writing;"
        "from semloc_logs.workspace import Workspace\n"
        "with writing(Workspace(Path(sys.argv[1])), ['monday']):\n"
        "    print('ready', flush=True); time.sleep(300)"
    )
    other = subprocess.Popen([sys.executable, "-c", script, coarse.path], stdout=subprocess.PIPE)
    try:
        assert other.stdout is not None
        assert other.stdout.readline() == b"ready\n"
        busy = semloc("task", SEARCHES[1], "-w", coarse.path)
    finally:
        other.kill()
        other.wait()
    assert busy.exit_code == 75
    assert "Session 'monday'" in busy.stderr


def test_parts_of_a_killed_task_are_used(
    coarse: Workspace, tools: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    from semloc_logs.stages import pair_search

    settings = tools.coarse_settings()
    monkeypatch.setattr(pair_search, "QUERIES_A_TASK", 1)
    table = coarse.alignments("tuesday", "monday")
    table.unlink()
    do_task(SEARCHES[1], [], coarse, settings, Serial())
    undisturbed = table.read_bytes()
    table.unlink()
    done: list[int] = []
    real = vars(pair_search)["search_queries"]

    def counted(task: Any) -> int:
        if len(done) == 1:
            raise KeyboardInterrupt
        done.append(1)
        return int(real(task))

    monkeypatch.setattr(pair_search, "search_queries", counted)
    with pytest.raises(KeyboardInterrupt):
        do_task(SEARCHES[1], [], coarse, settings, Serial())
    parts = coarse.search_parts("tuesday", "monday")
    assert len(list(parts.glob("*.parquet"))) == 1
    left = pair_search.PairSearch.of_pair(coarse, settings, Pair("tuesday", "monday"))._missing()
    total = sum(1 for _ in left[0].chunks)
    assert sum(1 for chunk in left[0].chunks if left[0].targets(chunk)) == total - 1 > 0

    monkeypatch.setattr(pair_search, "search_queries", real)
    do_task(SEARCHES[1], [], coarse, settings, Serial())
    assert not parts.exists()
    assert table.read_bytes() == undisturbed


def test_a_task_fuses_its_session_only(drives: Any, tools: SimpleNamespace, tmp_path: Path) -> None:
    work = Workspace(tmp_path / "work")
    sessions = tools.inputs(drives, *TWO)
    report = do_task("fuse/monday", sessions, work, tools.coarse_settings(), Serial())
    assert report.done == ["monday"]
    assert [folder.name for folder in work.sessions()] == ["monday"]
    with pytest.raises(SettingsError, match=r"None of the logs .* Did you mean 'monday'\?"):
        do_task("fuse/mondey", sessions, work, tools.coarse_settings(), Serial())


def test_a_task_reads_a_failed_log_again_when_told_so(
    tools: SimpleNamespace, tmp_path: Path
) -> None:
    work = Workspace(tmp_path / "work")
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(b"not a log")
    sessions = [SessionInput("bad", (bad,))]
    written = []
    settings = tools.coarse_settings()
    for redo in (Redo.NOTHING, Redo.NOTHING, Redo.FAILED):
        with pytest.raises(LogError, match=r"bad\.mcap is not a log"):
            do_task("fuse/bad", sessions, work, settings, Serial(), redo=redo)
        written.append(work.failure("bad").stat().st_mtime_ns)
    assert written[0] == written[1] < written[2]
    [task] = list_tasks(Stage.FUSE, sessions, work, settings)
    assert not task.done


def test_a_search_tells_whether_it_was_done(coarse: Workspace, tools: SimpleNamespace) -> None:
    coarse.alignments("tuesday", "monday").unlink()
    coarse.settings.unlink()  # a task may be the first of a workspace with these settings
    settings = tools.coarse_settings()
    first = do_task(SEARCHES[1], [], coarse, settings, Serial())
    assert (first.done, first.kept, first.skipped) == ([SEARCHES[1]], [], [])
    assert coarse.settings.exists()
    again = do_task(SEARCHES[1], [], coarse, settings, Serial())
    assert (again.done, again.kept) == ([], [SEARCHES[1]])


def test_a_session_whose_poses_do_not_fit_is_not_searched(
    coarse: Workspace, tools: SimpleNamespace
) -> None:
    path = coarse.session("monday").session_json
    content = read_json(path)
    write_json(path, content | {"fit": {"track": "its poses jump", "streams": []}})
    settings = tools.coarse_settings()
    listed = [task.id for task in list_tasks(Stage.SEARCH, [], coarse, settings)]
    assert listed == [SEARCHES[2]]
    report = do_task(SEARCHES[1], [], coarse, settings, Serial())
    [sentence] = report.skipped
    assert "Session monday gets no closures: its poses do not fit (its poses jump)" in sentence
