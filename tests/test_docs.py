"""What is documented exists, and what exists is documented."""

import re
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from semloc_logs.cli.main import COMMANDS, program

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = [
    text
    for language, text in re.findall(r"```(\w*)\n(.*?)```", README, re.DOTALL)
    if language == "sh"
]
SHOWN = re.findall(r"^semloc ([a-z]+)(.*)$", "\n".join(BLOCKS), re.MULTILINE)


def _command(name: str) -> click.Command:
    found: click.Command | None = program.get_command(click.Context(program), name)
    assert found is not None
    return found


def test_readme_shows_commands() -> None:
    assert {"inspect", "run", "demo", "annotate"} <= {name for name, _ in SHOWN}


@pytest.mark.parametrize(("name", "rest"), SHOWN)
def test_commands_and_options_of_the_readme_exist(name: str, rest: str) -> None:
    assert name in COMMANDS
    known = {
        option
        for parameter in _command(name).params
        for option in (*parameter.opts, *parameter.secondary_opts)
    }
    given = {word.split("=")[0] for word in rest.split("#")[0].split() if word.startswith("-")}
    assert given <= known | {"--help"}, f"semloc {name} has no {given - known}"


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_is_in_the_readme(name: str) -> None:
    assert f"semloc {name}" in README


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_teaches(name: str) -> None:
    done = CliRunner().invoke(program, [name, "--help"], prog_name="semloc")
    assert done.exit_code == 0
    assert f"Example:  semloc {name} " in done.output
    assert "-v, --verbose" in done.output
    assert len((_command(name).help or "").split()) > 15


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_is_explained_and_lengths_have_units(name: str) -> None:
    for parameter in _command(name).params:
        if isinstance(parameter, click.Option):
            assert parameter.help, f"semloc {name} {parameter.opts[0]} has no help"
        if parameter.metavar == "M" and isinstance(parameter, click.Option):
            assert "(m)" in (parameter.help or "")


def test_every_setting_is_explained() -> None:
    done = CliRunner().invoke(program, ["run", "--dump-config"])
    values = [line for line in done.output.splitlines() if line.startswith("  ")]
    assert len(values) > 35
    assert [line for line in values if "#" not in line and "seed" not in line] == []


def test_folders_of_the_readme_exist() -> None:
    table = re.findall(r"^\| `([a-z_/.]+)` \|", README.split("## Folders")[1], re.MULTILINE)
    assert len(table) > 8
    assert not [path for path in table if not (ROOT / path).exists()]
