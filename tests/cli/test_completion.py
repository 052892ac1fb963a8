"""Words that the shell completes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from click.shell_completion import ShellComplete

from semloc_logs.cli.main import program
from semloc_logs.settings import Settings
from semloc_logs.tables.table import write_json
from semloc_logs.workspace import Workspace


@pytest.fixture
def work(tmp_path: Path) -> Workspace:
    work = Workspace(tmp_path / "work")
    for name in ("monday", "tuesday", "thursday"):
        write_json(work.session(name).session_json, {})
    return work


def completed(*words: str) -> list[str]:
    """What the last of the words may become."""
    shell = ShellComplete(program, {}, "semloc", "_SEMLOC_COMPLETE")
    return [item.value for item in shell.get_completions(list(words[:-1]), words[-1])]


@pytest.mark.parametrize(
    "words",
    [
        ("close", "--query"),
        ("close", "--target"),
        ("show", "--query"),
        ("export", "--format", "tum"),
        ("describe",),
        ("annotate", "x.mcap", "--session"),
        ("sessions", "show"),
    ],
)
def test_names_of_sessions(words: tuple[str, ...], work: Workspace) -> None:
    command, *rest = words
    before = [command, "-w", str(work.path), *rest]
    assert completed(*before, "t") == ["thursday", "tuesday"]
    assert completed(*before, "x") == []


def test_the_workspace_is_work_where_none_is_given(
    work: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(work.path.parent)
    assert completed("show", "--query", "m") == ["monday"]
    monkeypatch.chdir(work.path)
    assert completed("show", "--query", "m") == []


def test_a_session_is_offered_once(work: Workspace) -> None:
    assert completed("describe", "-w", str(work.path), "monday", "") == ["thursday", "tuesday"]


def test_keys_of_settings_and_their_values() -> None:
    assert completed("run", "--set", "fusion.vo") == ["fusion.voxel_size="]
    assert completed("run", "--set", "labels.source=g") == ["labels.source=geometry"]
    keys = completed("run", "--set", "")
    assert set(keys) == {
        f"{s}.{key}=" for s, values in Settings() for key in type(values).model_fields
    }


def test_formats_roles_commands_and_actions() -> None:
    assert completed("export", "--format", "la") == ["las", "laz"]
    assert completed("run", "--topic", "stereo") == ["stereo_left=", "stereo_right="]
    assert completed("de") == ["describe", "demo"]
    assert completed("sessions", "re") == ["rename", "remove"]


def test_the_program_answers_the_shell(work: Workspace) -> None:
    script = Path(sys.executable).with_name("semloc")
    environment = {
        "_SEMLOC_COMPLETE": "bash_complete",
        "COMP_WORDS": f"semloc show -w {work.path} --query mo",
        "COMP_CWORD": "5",
    }
    done = subprocess.run(
        [script], env=environment, capture_output=True, text=True, check=True, timeout=120
    )
    assert done.stdout == "plain,monday\n"
