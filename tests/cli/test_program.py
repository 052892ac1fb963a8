"""Exit codes, streams and start-up of the program, whatever the command."""

import io
import json
import logging
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner, Result
from rich.console import Console as Screen

from semloc_logs.cli import main as main_module
from semloc_logs.cli.console import Bars, Pace, console, duration, rate, sentence
from semloc_logs.cli.main import COMMANDS, program
from semloc_logs.cli.options import Command, EngineChoice, console_options
from semloc_logs.errors import (
    LogError,
    RemoteError,
    RoleError,
    SettingsError,
    TopicError,
    WorkspaceError,
)
from semloc_logs.progress import Progress

HEAVY = (
    "torch",
    "numba",
    "pyarrow",
    "scipy",
    "cv2",
    "pydantic",
    "numpy",
    "rich",
    "rosbags",
    "mcap",
)


def semloc(*args: str, **options: Any) -> Result:
    return CliRunner().invoke(program, list(args), prog_name="semloc", **options)


@pytest.fixture
def failing(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A program whose command 'run' raises what the test says."""

    def make(problem: BaseException | int) -> None:
        def answer() -> int:
            console.note("working")
            console.result("answer")
            if isinstance(problem, BaseException):
                raise problem
            return problem

        decorate: Any = click.command("run", cls=Command)
        command = decorate(console_options(answer))
        monkeypatch.setattr(main_module.Program, "get_command", lambda *_: command)

    return make


@pytest.mark.parametrize(
    "args", [["--help"], ["run", "--help"], ["--version"], ["benchmark", "--help"], ["nothing"]]
)
def test_start_up_imports_nothing_heavy(args: list[str]) -> None:
    code = (
        f"import sys; sys.argv = ['semloc', *{args!r}]\nfrom semloc_logs.cli.main import"
        " main\ntry: main()\nexcept SystemExit: pass\n"
    )
    code += f"print('HEAVY', *[m for m in {HEAVY!r} if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=30
    )
    assert done.stdout.splitlines()[-1] == "HEAVY"


def test_help_answers_at_once() -> None:
    command = [
        sys.executable,
        "-P",
        "-c",
        "from semloc_logs.cli.main import program; program.main(['--help'])",
    ]
    taken = []
    for _ in range(3):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(command, check=True, timeout=30, stdout=subprocess.DEVNULL)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        taken.append(after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime)
    assert min(taken) < 0.3  # seconds of processor time; about 0.1 on an idle machine


def test_help_lists_every_command() -> None:
    done = semloc("--help")
    assert done.exit_code == 0
    for name, (_, says) in COMMANDS.items():
        assert name in done.output
        assert says.split(",")[0] in done.output


@pytest.mark.parametrize(
    ("problem", "code", "says"),
    [
        (
            LogError("a.mcap is empty; record it again."),
            1,
            "Error: a.mcap is empty; record it again.",
        ),
        (RoleError("There is no LIDAR."), 1, "Error: There is no LIDAR."),
        (WorkspaceError("work has no session."), 1, "Error: work has no session."),
        (SettingsError("Unknown setting 'x'."), 2, "Error: Unknown setting 'x'."),
        (TopicError("--topic lidar=/x: the log has no topic '/x'."), 2, "Error: --topic lidar=/x"),
        (RemoteError("https://h/x cannot be read."), 1, "Error: https://h/x cannot be read."),
        (click.UsageError("Give one."), 2, "Error: Give one."),
        (
            PermissionError(13, "Permission denied", "/data/x"),
            1,
            "Error: /data/x cannot be read or written (Permission denied)",
        ),
        (OSError(28, "No space left on device"), 1, "No space left on device"),
        (MemoryError(), 1, "Error: There is not enough memory"),
        (ZeroDivisionError("division by zero"), 1, "Error: Unexpected ZeroDivisionError at "),
        (KeyboardInterrupt(), 130, "Interrupted"),
        (main_module.Terminated(), 143, "Terminated"),
    ],
)
def test_every_error_is_one_sentence_and_a_code(
    failing: Any, problem: BaseException, code: int, says: str
) -> None:
    failing(problem)
    done = semloc("run")
    assert done.exit_code == code
    assert done.stdout == "answer\n"
    assert says in done.stderr
    assert "Traceback" not in done.stderr
    errors = [line for line in done.stderr.splitlines() if line.startswith("Error")]
    assert len(errors) == 1


def test_the_traceback_of_an_unexpected_error_is_shown_with_v(failing: Any) -> None:
    failing(ZeroDivisionError("division by zero"))
    done = semloc("run", "-v")
    assert done.exit_code == 1
    assert "Traceback (most recent call last)" in done.stderr
    failing(LogError("An expected one."))
    assert "Traceback" not in semloc("run", "-v").stderr


@pytest.mark.parametrize("code", [0, 3])
def test_the_codes_of_commands_are_the_programs(failing: Any, code: int) -> None:
    failing(code)
    assert semloc("run").exit_code == code


def test_results_and_notes_go_to_different_streams(failing: Any) -> None:
    failing(0)
    done = semloc("run")
    assert (done.stdout, done.stderr) == ("answer\n", "working\n")
    assert semloc("run", "-q").stderr == ""


def test_notes_as_json_lines(failing: Any) -> None:
    failing(LogError("It is gone."))
    done = semloc("run", "--log-format", "json")
    lines = [json.loads(line) for line in done.stderr.splitlines()]
    assert [(line["level"], line["message"]) for line in lines] == [
        ("info", "working"),
        ("error", "It is gone."),
    ]


def test_usage_errors_as_json_lines() -> None:
    done = semloc("run", "-w", "w", "--log-format", "json")
    assert done.exit_code == 2
    assert "LOG" in json.loads(done.stderr)["message"]


@pytest.mark.parametrize(
    "args",
    [
        ["nothing"],
        ["run"],
        ["run", "--no-such-option"],
        ["evaluate", "-w", "x"],
        ["run", "a.mcap", "-w", "w", "--jobs", "0"],
    ],
)
def test_wrong_usage_is_2(args: list[str]) -> None:
    done = semloc(*args)
    assert done.exit_code == 2
    assert "Error: " in done.stderr
    assert done.stdout == ""


def test_progress_lines_are_few_without_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    console.reset()
    for k in range(1, 101):
        console.show_progress(Progress("close", "tuesday", k, 100, "queries"))
    console.note("done")
    lines = capsys.readouterr().err.splitlines()
    assert lines[-2:] == ["close tuesday: 100 of 100 queries", "done"]
    assert len(lines) < 10


def test_progress_tells_the_share_the_rate_and_the_time_left() -> None:
    pace = Pace(40, now=100.0)  # a run that goes on has done some before
    pace.move(50, 200, now=105.0)
    event = Progress("close", "tuesday", 50, 200, "queries")
    assert (
        sentence(event, pace) == "close tuesday: 50 of 200 queries (25 %), 2 queries/s, 75 s left"
    )
    assert sentence(Progress("close", "tuesday", 200, 200, "queries"), pace) == (
        "close tuesday: 200 of 200 queries"
    )
    assert [rate(0.0083), rate(0.5), rate(123.4, "queries")] == [
        "0.5/min",
        "0.5/s",
        "123 queries/s",
    ]
    assert [duration(s) for s in (44, 720, 12600)] == ["44 s", "12 min", "3.5 h"]


@pytest.mark.parametrize("width", [80, 120])
def test_bars_fit_a_terminal(width: int) -> None:
    screen = Screen(file=io.StringIO(), width=width)
    bars = Bars(screen)
    for name in ("monday", "a_session_with_a_name_of_forty_characters"):
        pace = Pace(0, now=0.0)
        pace.move(1234, 5678, now=10.0)
        bars.show(Progress("fuse", name, 1234, 5678, "keyframes"), pace)
    screen.print(bars._bar.get_renderable())
    lines = screen.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert len(lines) == 2
    assert all(len(line) <= width for line in lines)
    for figure in ("fuse monday ", " 22 % ", "1234 of 5678 keyframes", "123/s", "36 s left"):
        assert figure in lines[0]


def test_progress_has_the_same_fields_in_json(capsys: pytest.CaptureFixture[str]) -> None:
    console.reset()
    console.log_format = "json"
    console.show_progress(Progress("fuse", "monday", 7, None, "frames"))
    console.verbosity = 1  # every event
    console.show_progress(Progress("fuse", "monday", 8, None, "frames"))
    (line,) = capsys.readouterr().err.splitlines()
    content = json.loads(line)
    del content["time"]
    assert content == {
        "level": "info",
        "message": content["message"],
        "stage": "fuse",
        "session": "monday",
        "done": 8,
        "total": None,
        "unit": "frames",
        "share": None,
        "rate": content["rate"],
        "left_s": None,
    }
    assert content["message"].startswith("fuse monday: 8 frames, ")
    assert content["rate"] > 0
    console.reset()


def test_what_the_package_logs_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    console.reset()
    with console.progress():
        logging.getLogger("semloc_logs.stages.fuse").info("%s: %d keyframes", "monday", 60)
        logging.getLogger("semloc_logs.stages.fuse").warning("a.mcap is cut off")
    logging.getLogger("semloc_logs.stages.fuse").info("later")
    assert capsys.readouterr().err.splitlines() == [
        "monday: 60 keyframes",
        "Warning: a.mcap is cut off",
    ]


def test_numbers_that_are_none_are_null_in_json(capsys: pytest.CaptureFixture[str]) -> None:
    console.result_json({"a": float("nan"), "b": [float("inf"), 1.5], "c": Path("x")})
    assert json.loads(capsys.readouterr().out) == {"a": None, "b": [None, 1.5], "c": "x"}


@pytest.mark.parametrize(
    ("name", "jobs", "tasks", "cores", "kind"),
    [
        (None, None, 1, 8, "Serial"),
        (None, None, 2, 8, "Processes"),
        (None, None, 2, 1, "Serial"),
        (None, 3, 1, 8, "Processes"),
        (None, 1, 5, 8, "Serial"),
        ("serial", 4, 5, 8, "Serial"),
        ("processes", None, 1, 1, "Processes"),
    ],
)
def test_default_engine(
    monkeypatch: pytest.MonkeyPatch,
    name: str | None,
    jobs: int | None,
    tasks: int,
    cores: int,
    kind: str,
) -> None:
    monkeypatch.setattr("semloc_logs.engines.processes.cores", lambda: cores)
    monkeypatch.setattr("semloc_logs.engines.worker_memory.machine_memory", lambda: 1 << 40)
    with EngineChoice(name, jobs).open(tasks) as engine:
        assert type(engine).__name__ == kind
        assert engine.jobs == (1 if kind == "Serial" else jobs or cores)


# -- interruption, with real processes and signals

SLOW = """
import os, tempfile, time

def nap(folder):
    with tempfile.TemporaryDirectory(dir=folder):
        os.write(1, b"asleep\\n")
        time.sleep(1000)
"""
NAPPING = """
import click, slow, sys
from semloc_logs.cli.main import Program, program
from semloc_logs.cli.options import EngineChoice

@click.command()
def nap():
    with EngineChoice(sys.argv[2], 2).open(2) as engine:
        list(engine.map(slow.nap, [sys.argv[1]] * 2))

Program.get_command = lambda *_: nap
if __name__ == "__main__":
    program.main(["nap"])
"""


@contextmanager
def _sleeping(folder: Path, engine: str, tasks: int) -> Iterator[subprocess.Popen[str]]:
    """A program of which so many tasks sleep, each in a temporary folder inside ``folder``/busy.

    Its workers have its stdout, too: that ends when the last of them has. Nothing here waits for a
    time.
    """
    (folder / "slow.py").write_text(SLOW)
    (folder / "napping.py").write_text(NAPPING)
    (folder / "busy").mkdir()
    command = [sys.executable, str(folder / "napping.py"), str(folder / "busy"), engine]
    pipe = subprocess.PIPE
    with subprocess.Popen(
        command, stdout=pipe, stderr=pipe, text=True, start_new_session=True
    ) as started:
        try:
            assert started.stdout is not None
            for _ in range(tasks):
                assert started.stdout.readline() == "asleep\n", started.communicate()
            assert len(list((folder / "busy").iterdir())) == tasks
            yield started
        finally:
            with suppress(ProcessLookupError):  # as it should be
                os.killpg(started.pid, signal.SIGKILL)


@pytest.mark.timeout(240)  # new processes import much
@pytest.mark.parametrize(("engine", "tasks"), [("serial", 1), ("processes", 2)])
@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_an_interrupted_program_cleans_up(
    tmp_path: Path, engine: str, tasks: int, number: signal.Signals, code: int
) -> None:
    with _sleeping(tmp_path, engine, tasks) as started:
        os.killpg(started.pid, number)  # as a terminal does it: workers get it too
        _, errors = started.communicate()  # until the program and its workers are gone
        assert started.returncode == code, errors
        assert "Traceback" not in errors
        assert list((tmp_path / "busy").iterdir()) == []


DEAF = """
import hashlib, os, threading
import click
from semloc_logs.cli.main import Program, program

@click.command()
def nap():
    threading.Timer(1.0, os.write, (1, b"asleep\\n")).start()
    hashlib.pbkdf2_hmac("sha256", b"x", b"y", 2 * 10**9)  # minutes, without a look at signals

Program.get_command = lambda *_: nap
program.main(["nap"])
"""


@pytest.mark.timeout(240)
def test_a_program_in_a_long_call_of_a_library_leaves_too() -> None:
    pipe = subprocess.PIPE
    command = [sys.executable, "-c", DEAF]
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as started:
        try:
            assert started.stdout is not None
            assert started.stdout.readline() == "asleep\n", started.communicate()
            started.terminate()
            _, told = started.communicate()
        finally:
            started.kill()
    assert started.returncode == 143
    assert told.startswith("Error: Terminated; finished work is kept")


@pytest.mark.timeout(240)
def test_workers_leave_with_a_killed_parent(tmp_path: Path) -> None:
    with _sleeping(tmp_path, "processes", 2) as started:
        started.kill()
        started.communicate()
        assert list((tmp_path / "busy").iterdir()) == []


@pytest.mark.parametrize(
    "arguments",
    [
        ("simulate", "-o"),
        ("demo", "-o"),
        ("train", "--variant", "semantic", "-o"),
    ],
    ids=lambda arguments: arguments[0],
)
def test_without_the_ray_caster_a_command_names_the_extra_and_writes_nothing(
    arguments: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "embreex", None)
    done = semloc(*arguments, str(tmp_path / "out"))
    assert done.exit_code == 1
    assert (
        f"semloc {arguments[0]} needs the extra 'sim': pip install 'semloc_logs[sim]'"
        in " ".join(done.stderr.split())
    )
    assert not (tmp_path / "out").exists()


def test_the_simulation_is_imported_without_the_ray_caster() -> None:
    code = (
        "import sys; sys.modules['embreex'] = None\n"
        "import semloc_logs.simulation.demo, semloc_logs.training.training_scenes\n"
        "from semloc_logs.simulation.town.hall import build_hall\n"
        "print(len(build_hall(1).triangles) > 100)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "True\n"


@pytest.mark.parametrize(("typed", "meant"), [("fues", "fuse"), ("anotate", "annotate")])
def test_a_command_that_is_spelled_wrong_is_suggested(typed: str, meant: str) -> None:
    done = semloc(typed, "a.mcap")
    assert done.exit_code == 2
    assert f"No such command '{typed}'. Did you mean '{meant}'?" in done.stderr
    assert "Did you mean" not in semloc("xyzzy").stderr
