"""What makes `describe` work again: every input, and nothing else; the words that a session needs
beside others; interruptions.
"""

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pyarrow.parquet as pq
import pytest

import semloc_logs
from semloc_logs.engines import Serial
from semloc_logs.errors import WorkspaceError
from semloc_logs.settings import Resolved
from semloc_logs.stages import describe as describe_stage
from semloc_logs.stages import fuse as fuse_stage
from semloc_logs.stages.inputs import Redo, SessionInput
from semloc_logs.stages.report import Report
from semloc_logs.tables.table import read_json, read_table, write_json
from semloc_logs.workspace import Workspace

Describe = Callable[..., Report]
SHIPPED = Path(semloc_logs.__file__).parent


@pytest.fixture
def describe(tools: SimpleNamespace, coarse: Workspace) -> Describe:
    """Describes sessions of the workspace ``coarse``, where they were described before, with
    whatever differs from then.
    """

    def again(*names: str, settings: Resolved | None = None, overwrite: bool = False) -> Report:
        settings = settings or tools.coarse_settings()
        return describe_stage.describe(coarse, names, settings, Serial(), overwrite=overwrite)

    return again


def test_nothing_is_done_twice(
    describe: Describe, coarse: Workspace, tools: SimpleNamespace
) -> None:
    before = tools.write_times(coarse.path)
    report = describe()
    assert (report.done, report.kept) == ([], ["monday", "tuesday"])
    assert tools.write_times(coarse.path) == before


def test_overwriting_does_it_again(
    describe: Describe, coarse: Workspace, tools: SimpleNamespace
) -> None:
    tables = tools.files(coarse.path)
    times = tools.write_times(coarse.path)
    assert describe("tuesday", overwrite=True).done == ["tuesday"]
    assert tools.files(coarse.path) == tables
    written = {name for name, time in tools.write_times(coarse.path).items() if time != times[name]}
    assert written == {"sessions/tuesday/words.json", "sessions/tuesday/words/submap-00000.parquet"}


def test_counts_of_several_submaps_go_to_their_sessions(
    coarse: Workspace, tools: SimpleNamespace
) -> None:
    """Monday has two submaps here, Tuesday one, of 1, 2 and 4 words."""
    path = coarse.session("monday").session_json
    content = read_json(path)
    [submap] = content["submaps"]
    write_json(path, content | {"submaps": [submap, submap | {"id": 1}]})
    coarse.settings.unlink()
    seen: list[tuple[str, int]] = []

    def count(function: Any, tasks: Any) -> Iterator[int]:
        for number, task in enumerate(tasks):
            seen.append((task.folder.name, task.submap))
            yield 2**number

    engine: Any = SimpleNamespace(jobs=1, map=count)
    settings = tools.coarse_settings()
    report = describe_stage.describe(coarse, [], settings, engine, overwrite=True)
    assert seen == [("monday", 0), ("monday", 1), ("tuesday", 0)]
    words = {f.name: read_json(f.words_json)["words"] for f in coarse.sessions()}
    assert words == {"monday": 3, "tuesday": 4}
    assert report.amount == 3
    assert coarse.settings.exists()


def test_a_session_without_submaps_has_an_empty_table(
    describe: Describe, coarse: Workspace
) -> None:
    """Readers find the columns of words all the same."""
    folder = coarse.session("monday")
    write_json(folder.session_json, read_json(folder.session_json) | {"submaps": []})
    assert describe("monday", overwrite=True).done == ["monday"]
    [table] = folder.words.glob("*.parquet")
    assert pq.read_metadata(table).num_rows == 0
    assert read_json(folder.words_json)["words"] == 0


def test_a_session_that_was_fused_otherwise_is_described(
    describe: Describe, coarse: Workspace, drives: Any, tools: SimpleNamespace
) -> None:
    other = tools.coarse_settings(labels__erode="3")
    fuse_stage.fuse(tools.inputs(drives, "monday"), coarse, other, Serial())
    report = describe()
    assert (report.done, report.kept) == (["monday"], ["tuesday"])
    assert describe().kept == ["monday", "tuesday"]


def test_a_session_that_was_fused_from_another_log_is_described(
    describe: Describe, coarse: Workspace, drives: Any, tools: SimpleNamespace
) -> None:
    other = SessionInput("monday", (drives["wednesday"].log,))
    fuse_stage.fuse([other], coarse, tools.coarse_settings(), Serial(), redo=Redo.EVERYTHING)
    assert describe().done == ["monday"]


@pytest.mark.parametrize(
    "changed",
    [
        {"descriptor__headings": "4"},
        {"descriptor__reach": "9"},
        {"descriptor__min_occupied": "60"},
        {"descriptor__query_stride": "4"},
    ],
)
def test_settings_of_the_descriptor_are_inputs(
    describe: Describe, tools: SimpleNamespace, changed: dict[str, str]
) -> None:
    settings = tools.coarse_settings(**changed)
    assert describe("monday", settings=settings).done == ["monday"]
    assert describe("monday", settings=settings).kept == ["monday"]


@pytest.mark.parametrize(
    "changed",
    [
        {"labels__erode": "3"},
        {"query__frames": "3"},
        {"closures__min_probability": "0.5"},
        {"training__seed": "7"},
    ],
)
def test_settings_of_other_stages_are_none(
    describe: Describe, tools: SimpleNamespace, changed: dict[str, str]
) -> None:
    assert describe(settings=tools.coarse_settings(**changed)).kept == ["monday", "tuesday"]


def test_a_map_of_other_voxels_is_refused(describe: Describe, tools: SimpleNamespace) -> None:
    with pytest.raises(WorkspaceError, match=r"fusion\.voxel_size=0\.5"):
        describe(settings=tools.coarse_settings(fusion__voxel_size="0.4"))


def test_the_version_is_an_input(describe: Describe, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(semloc_logs, "__version__", "999.0")
    assert describe().done == ["monday", "tuesday"]


@pytest.mark.parametrize(
    ("key", "shipped"),
    [
        ("weights", "subvolumes/weights/semantic.safetensors"),
        ("vocabulary", "words/vocabularies/semantic.safetensors"),
    ],
)
def test_files_of_weights_and_vocabulary_are_inputs(
    describe: Describe, tools: SimpleNamespace, tmp_path: Path, key: str, shipped: str
) -> None:
    file = Path(shutil.copyfile(SHIPPED / shipped, tmp_path / "mine.safetensors"))
    settings = tools.coarse_settings(**{f"descriptor__{key}": str(file)})
    assert describe("monday", settings=settings).done == ["monday"]
    os.utime(file, (1, 1))
    assert describe("monday", settings=settings).kept == ["monday"]
    content = bytearray(file.read_bytes())
    content[-1] ^= 0x80  # the sign of the last number
    file.write_bytes(content)
    assert describe("monday", settings=settings).done == ["monday"]
    assert describe("monday", settings=settings).kept == ["monday"]


@pytest.mark.parametrize(("both", "warned"), [(False, True), (True, False)])
def test_weights_without_their_words_are_warned_of(
    describe: Describe,
    tools: SimpleNamespace,
    caplog: pytest.LogCaptureFixture,
    *,
    both: bool,
    warned: bool,
) -> None:
    given = {"descriptor__weights": str(SHIPPED / "subvolumes/weights/semantic.safetensors")}
    if both:
        words = SHIPPED / "words/vocabularies/semantic.safetensors"
        given["descriptor__vocabulary"] = str(words)
    describe("monday", settings=tools.coarse_settings(**given))
    assert ("learn words of these" in caplog.text) is warned


# -- which words


def variants(work: Workspace, name: str) -> list[str]:
    """The variants of words in the tables of a session; words.json has to list the same."""
    names = sorted(
        set(read_table(work.session(name).words / "submap-00000.parquet")["variant"].to_pylist())
    )
    assert read_json(work.session(name).words_json)["variants"] == names
    return names


def test_a_session_with_classes_beside_one_without_gets_both_kinds_of_words(
    describe: Describe, coarse: Workspace, drives: Any, tools: SimpleNamespace
) -> None:
    assert variants(coarse, "monday") == ["semantic"]
    uniform = tools.coarse_settings(labels__source="uniform")
    fuse_stage.fuse(tools.inputs(drives, "wednesday"), coarse, uniform, Serial())
    assert describe("monday").done == ["monday"], "it is to be compared with all others"
    assert describe().done == ["tuesday", "wednesday"]
    assert variants(coarse, "monday") == variants(coarse, "tuesday") == ["geometric", "semantic"]
    assert variants(coarse, "wednesday") == ["geometric"]
    assert describe().kept == ["monday", "tuesday", "wednesday"]
    shutil.rmtree(coarse.session("wednesday").path)
    assert describe().kept == ["monday", "tuesday"], "more words than are needed do no harm"


def test_the_kind_of_words_may_be_chosen(
    describe: Describe, coarse: Workspace, tools: SimpleNamespace
) -> None:
    assert describe(
        "monday", settings=tools.coarse_settings(descriptor__variant="geometric")
    ).done == ["monday"]
    assert variants(coarse, "monday") == ["geometric"]
    assert variants(coarse, "tuesday") == ["semantic"]


# -- interruptions


@pytest.mark.parametrize("step", [0, 1, 2])
def test_an_interrupted_session_is_done_again(
    step: int,
    describe: Describe,
    coarse: Workspace,
    tools: SimpleNamespace,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Interrupted at the table, at its folder's place, or at words.json, under other settings."""
    folder = coarse.session("monday")
    other = tools.coarse_settings(descriptor__reach="6")
    first = tools.files(folder.path)
    assert tools.renames(monkeypatch, lambda: describe("monday", settings=other)) >= 3
    second = tools.files(folder.path)
    assert first["words/submap-00000.parquet"] != second["words/submap-00000.parquet"]
    tools.renames(monkeypatch, lambda: describe("monday", settings=other, overwrite=True), step)
    describe("monday", settings=other)
    assert tools.files(folder.path) == second
    # settings are written down before
    tools.renames(monkeypatch, lambda: describe("monday"), step + 1)
    assert describe("monday").done == ["monday"]
    assert tools.files(folder.path) == first
    tools.renames(monkeypatch, lambda: describe("monday", settings=other), step + 1)
    describe("monday")
    assert tools.files(folder.path) == first, (
        "the old words.json must not speak for half of the new words"
    )


def test_words_of_other_settings_are_not_vouched_for(
    describe: Describe, tools: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed when new words have their place and words.json is still to be written; then the old
    settings are given again.
    """

    def killed(path: Path, content: dict[str, Any]) -> None:
        raise KeyboardInterrupt

    other = tools.coarse_settings(descriptor__variant="geometric")
    with monkeypatch.context() as patch:
        patch.setattr(describe_stage, "write_json", killed)
        with pytest.raises(KeyboardInterrupt):
            describe("monday", settings=other)
    assert describe("monday").done == ["monday"]
