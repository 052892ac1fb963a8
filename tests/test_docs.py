"""Documented commands, options, settings, links and pages exist, and commands are documented."""

import ast
import importlib.util
import re
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import click
import pytest
import yaml
from click.testing import CliRunner

import semloc_logs
from semloc_logs.benchmarks.named import BENCHMARKS, EXPERIMENTS
from semloc_logs.cli.main import COMMANDS, program
from semloc_logs.settings import Settings

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted(
    path
    for path in (*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), ROOT / "benchmarks/README.md")
    if "build" not in path.relative_to(ROOT).parts
)
README = (ROOT / "README.md").read_text(encoding="utf-8")
FILES = {"parquet", "png", "json", "md", "yaml", "tum", "mcap"}  # endings, not settings


def _id(path: object) -> str:
    return str(path.relative_to(ROOT)) if isinstance(path, Path) else str(path)


def _blocks(language: str) -> Iterator[tuple[Path, str]]:
    """Code blocks of a language in all pages."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for block in re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
            yield page, block


def _shell_lines() -> Iterator[tuple[Path, list[str]]]:
    """Words of every line in the shell blocks; comments are left out."""
    for page, block in _blocks("sh"):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if words:
                yield page, words


LINES = list(_shell_lines())
SHOWN = [(page, words[1:]) for page, words in LINES if words[0] == "semloc"]
INLINE = [
    (page, call)
    for page in PAGES
    for call in re.findall(r"`semloc ([a-z]+[^`\n]*)`", page.read_text(encoding="utf-8"))
]


def _command(name: str) -> click.Command:
    command: click.Command | None = program.get_command(click.Context(program), name)
    assert command is not None, f"semloc has no command {name}"
    return command


# -- commands


def test_the_pages_show_commands() -> None:
    assert len(SHOWN) > 40
    assert len(INLINE) > 20


@pytest.mark.parametrize(("page", "words"), SHOWN, ids=_id)
def test_shown_commands_parse(page: Path, words: list[str]) -> None:
    name, *arguments = words
    _command(name).make_context(name, arguments)  # raises on an unknown option or a wrong value


@pytest.mark.parametrize(("page", "call"), INLINE, ids=_id)
def test_options_of_commands_in_sentences_exist(page: Path, call: str) -> None:
    name, *rest = call.split()
    parameters = _command(name).params
    known = {option for p in parameters for option in (*p.opts, *p.secondary_opts)}
    given = {word.strip("[].").split("=")[0] for word in rest if word.strip("[").startswith("-")}
    assert given <= known | {"--help"}, f"semloc {name} has no {given - known}"


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_an_example_in_the_pages(name: str) -> None:
    assert name in {words[0] for _, words in SHOWN}


def test_benchmarks_in_the_pages_exist_and_all_are_shown() -> None:
    shown = {words[1] for _, words in SHOWN if words[0] == "benchmark"}
    inline = {call.split()[1] for _, call in INLINE if call.startswith("benchmark ")}
    assert shown | inline - {"NAME"} == {*BENCHMARKS, *EXPERIMENTS}


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


# -- scripts, targets, settings, links


def test_scripts_and_their_options_exist() -> None:
    calls = [(page, words[1:]) for page, words in LINES if words[0] == "python"]
    table = re.findall(
        r"^\| `([a-z_]+\.py[^`]*)` \|", (ROOT / "benchmarks/README.md").read_text(), re.MULTILINE
    )
    scripts = [words for _, words in calls if words[0].startswith("benchmarks/")]
    scripts += [[f"benchmarks/{row.split()[0]}", *row.split()[1:]] for row in table]
    assert len(scripts) > 8
    for script, *rest in scripts:
        source = (ROOT / script).read_text(encoding="utf-8")
        for option in (word for word in rest if word.startswith("--")):
            assert f'"{option}"' in source, f"{script} has no {option}"


def test_make_targets_exist() -> None:
    makefile = (ROOT / "Makefile").read_text()
    shown = {words[1] for _, words in LINES if words[0] == "make"}
    shown |= {
        target
        for page in PAGES
        for target in re.findall(r"`make ([a-z]+)", page.read_text(encoding="utf-8"))
    }
    assert {"demo", "test", "docs", "install"} <= shown
    assert not [t for t in shown if not re.search(rf"^{t}:", makefile, re.MULTILINE)]


def _settings() -> set[str]:
    return {
        f"{section}.{key}" for section, values in Settings() for key in type(values).model_fields
    }


@pytest.mark.parametrize("page", PAGES, ids=_id)
def test_settings_in_the_pages_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    sections = "|".join(Settings.model_fields)
    keys = re.findall(rf"(?:`|--set |\")((?:{sections})\.[a-z_]+)", text)
    keys += [
        name.lower().replace("__", ".") for name in re.findall(r"SEMLOC_([A-Z_]+__[A-Z_]+)", text)
    ]
    named = {key for key in keys if key.split(".")[1] not in FILES}
    renamed = {"closures.headings"} if page.name == "CHANGELOG.md" else set()
    assert named - renamed <= _settings()


def test_every_setting_is_explained() -> None:
    done = CliRunner().invoke(program, ["run", "--dump-config"])
    values = [line for line in done.output.splitlines() if line.startswith("  ")]
    assert len(values) > 35
    assert [line for line in values if "#" not in line and "seed" not in line] == []


def _anchors(page: Path) -> set[str]:
    """Anchors of the headings of a page, as the renderers make them."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    plain = [re.sub(r"[^\w\s-]", "", heading.lower()) for heading in headings]
    return {re.sub(r"\s", "-", heading) for heading in plain}


@pytest.mark.parametrize("page", PAGES, ids=_id)
def test_links_resolve(page: Path) -> None:
    code = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)
    text = code.sub("", page.read_text(encoding="utf-8"))
    for link in re.findall(r"\]\(([^)]+)\)", text):
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), f"{_id(page)} links to {link}"
        assert not anchor or anchor in _anchors(target), f"{_id(page)} links to {link}"


def test_pages_of_tables_of_contents_exist() -> None:
    for page, block in _blocks(r"\{toctree\}"):
        names = [line for line in block.splitlines() if line and not line.startswith(":")]
        assert names
        for name in names:
            assert (page.parent / f"{name}.md").exists(), f"{_id(page)} lists {name}"


# -- generated pages, examples in Python, facts


def _generator() -> ModuleType:
    spec = importlib.util.spec_from_file_location("docs_generate", ROOT / "docs/generate.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


GENERATED: dict[str, str] = _generator().pages()


@pytest.mark.parametrize("name", GENERATED)
def test_generated_pages_are_up_to_date(name: str) -> None:
    written = (ROOT / "docs/reference" / name).read_text(encoding="utf-8")
    assert written == GENERATED[name], "run `make reference` and commit docs/reference"


def test_generated_pages_name_everything() -> None:
    assert not [key for key in _settings() if f"`{key}`" not in GENERATED["settings.md"]]
    for table in (ROOT / "schemas/parquet").glob("*.json"):
        assert f"## {table.stem}\n" in GENERATED["tables.md"]
    for space in (ROOT / "schemas/label_spaces").glob("*.yaml"):
        assert f"## {space.stem}\n" in GENERATED["label_spaces.md"]
    for message in (ROOT / "schemas/messages").glob("LoopClosure.*"):
        assert message.read_text().strip() in GENERATED["messages.md"]


@pytest.mark.parametrize(("page", "code"), list(_blocks("python")), ids=_id)
def test_examples_in_python_use_public_names(page: Path, code: str) -> None:
    names = {
        node.attr
        for node in ast.walk(ast.parse(code))
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.value.id == "semloc"
    }
    assert names <= set(semloc_logs.__all__)


def test_rooms_of_the_architecture_are_the_rooms() -> None:
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    table = text.split("## Rooms")[1].split("Beside")[0]
    rows = re.findall(r"^\| (`[^|]+) \|", table, re.MULTILINE)
    named = {room for row in rows for room in re.findall(r"`([a-z_]+)`", row)}
    package = ROOT / "semloc_logs"
    rooms = {path.parent.name for path in package.glob("*/__init__.py")}
    rooms |= {path.stem for path in package.glob("*.py")} - {"__init__"}
    assert named == rooms | {"schemas"}


@pytest.mark.parametrize("name", ["ARCHITECTURE.md", "CONTRIBUTING.md", "README.md"])
def test_paths_in_sentences_exist(name: str) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    folders = "semloc_logs|cli|schemas|tests|docs|benchmarks|examples"
    paths = re.findall(rf"`((?:{folders})/[\w/.]*)`", text)
    assert paths
    real = [path for path in paths if "NAME" not in path and path != "docs/build/"]
    assert not [path for path in real if not (ROOT / path).exists()]


def test_readme_is_short_and_shows_the_first_commands() -> None:
    assert len(README.splitlines()) < 120
    assert {"make demo", "make test"} <= {" ".join(words[:2]) for _, words in LINES}
    assert "make test" in README
    first = {words[0] for page, words in SHOWN if page.name == "README.md"}
    assert {"inspect", "run", "show", "annotate"} <= first


def test_citation_names_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert citation["version"] == project["version"]
    assert citation["license"] == project["license"]
    assert "authors" not in project
    assert citation["references"][0]["year"] == 2018
