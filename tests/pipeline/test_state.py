"""The settings that a workspace keeps: every stage takes them, and a contradiction is refused."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from semloc_logs.engines import Serial
from semloc_logs.errors import SettingsError, WorkspaceError
from semloc_logs.settings import Settings, load
from semloc_logs.stages import describe as describe_stage
from semloc_logs.stages import fuse as fuse_stage
from semloc_logs.stages.state import keep, read_kept, settle
from semloc_logs.tables.table import read_json, write_json
from semloc_logs.workspace import Workspace

ROOM = {"fusion.voxel_size": "0.05"}


def kept(folder: Path, **given: str) -> Workspace:
    """A workspace with a session, its words, its alignments and these settings."""
    work = Workspace(folder / "work")
    write_json(work.session("a").session_json, {})
    write_json(work.session("a").words_json, {})
    work.alignments("a", "a").parent.mkdir(parents=True)
    work.alignments("a", "a").touch()
    keep(work, load(assignments=given).resolved())
    return work


def given(**settings: str) -> Settings:
    return load(assignments={key.replace("__", "."): value for key, value in settings.items()})


def test_later_commands_take_them(tmp_path: Path) -> None:
    work = kept(tmp_path, **ROOM, **{"labels.source": "geometry"})
    settled = settle(work, given(training__seed="3")).resolved()
    assert (settled.fusion.voxel_size, settled.labels.source) == (0.05, "geometry")
    assert settled.training.seed == 3
    assert set(settle(work, given(training__seed="3")).given()) == {
        "fusion.voxel_size",
        "labels.source",
        "training.seed",
    }
    assert settled.fusion.max_range == pytest.approx(50 * 0.05 / 0.30)


@pytest.mark.parametrize(
    ("key", "before", "after"),
    [
        ("fusion.voxel_size", "0.05", "0.3"),
        ("fusion.max_range", "8.333333333333334", "9.0"),
        ("labels.source", "geometry", "uniform"),
        ("descriptor.stride", "8", "4"),
        ("query.frames", "5", "1"),
        ("closures.kappa", "10.0", "5.0"),
    ],
)
def test_a_contradiction_is_refused_with_both_values(
    tmp_path: Path, key: str, before: str, after: str
) -> None:
    work = kept(tmp_path, **ROOM, **{"labels.source": "geometry"})
    contradicting = load(assignments={key: after})
    for writes, remedy in ((False, "as its tables have it"), (True, "or add --overwrite")):
        sentence = f"{key}={before}, and {key}={after} is given: leave it out, {remedy}"
        with pytest.raises(SettingsError, match=sentence):
            settle(work, contradicting, writes=writes)
    settled = settle(work, contradicting, writes=True, overwrite=True)
    section, name = key.split(".")
    assert str(getattr(getattr(settled, section), name)) == after
    assert settle(work, load(assignments={key: before})) is not None, "the same value is none"


def test_closures_bind_the_settings_of_their_search_though_alignments_are_gone(
    tmp_path: Path,
) -> None:
    work = kept(tmp_path)
    work.alignments("a", "a").unlink()
    work.closures.touch()
    with pytest.raises(SettingsError, match=r"query\.every=4"):
        settle(work, given(query__every="4"))


def test_without_sessions_other_settings_of_maps_take_the_place_of_kept_ones(
    tmp_path: Path,
) -> None:
    work = kept(tmp_path, **ROOM)
    work.session("a").session_json.unlink()
    keep(work, given(fusion__voxel_size="0.1").resolved())
    settings = read_kept(work)
    assert settings is not None
    assert settings.resolved().fusion.voxel_size == 0.1


def test_a_section_binds_once_tables_depend_on_it(tmp_path: Path) -> None:
    work = kept(tmp_path)
    other = given(descriptor__stride="4"), given(query__every="4"), given(fusion__hit="1")
    work.alignments("a", "a").unlink()
    assert settle(work, other[1]).query.every == 4
    with pytest.raises(SettingsError, match="stride"):
        settle(work, other[0])
    with pytest.raises(SettingsError, match="hit"):
        settle(work, other[2])
    work.session("a").words_json.unlink()
    assert settle(work, other[0]).descriptor.stride == 4
    settled = settle(work, other[2]).resolved()
    assert settled.fusion.hit == 1
    # of that session alone: later ones take the settings of the first
    keep(work, settled)
    assert settle(work, given()).fusion.hit == Settings().fusion.hit
    keep(work, settled, overwrite=True)
    assert settle(work, given()).fusion.hit == 1


@pytest.mark.parametrize("key", ["logs.memory", "labels.threads", "training.seed"])
def test_what_changes_no_table_is_free(tmp_path: Path, key: str) -> None:
    work = kept(tmp_path)
    value = {"logs.memory": "1000000000", "labels.threads": "2", "training.seed": "7"}[key]
    for writes in (False, True):
        settle(work, load(assignments={key: value}), writes=writes)
    content = work.settings.read_bytes()
    file = work.settings.stat().st_ino
    keep(work, load(assignments={key: value}).resolved())
    assert work.settings.read_bytes() == content
    assert work.settings.stat().st_ino == file, "it is not written again"


def test_a_stage_may_choose_the_probability_and_a_reader_may_not(tmp_path: Path) -> None:
    work = kept(tmp_path)
    lenient = given(closures__min_probability="0.5")
    settled = settle(work, lenient, writes=True)
    keep(work, settled.resolved())
    assert settle(work, Settings()).closures.min_probability == 0.5
    with pytest.raises(SettingsError, match="min_probability"):
        settle(work, given(closures__min_probability="0.9"))


def test_nothing_contradicts_before_there_is_a_session(tmp_path: Path) -> None:
    work = Workspace(tmp_path / "work")
    keep(work, load(assignments=ROOM).resolved())
    settled = settle(work, given(fusion__voxel_size="0.3"), writes=True).resolved()
    assert (settled.fusion.voxel_size, settled.fusion.max_range) == (0.3, 50.0)


def test_paths_hold_wherever_the_next_command_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    work = kept(tmp_path, **{"descriptor.weights": "w.safetensors"})
    monkeypatch.chdir("/")
    assert settle(work, Settings()).descriptor.weights == tmp_path / "w.safetensors"


def test_a_file_of_another_version_is_named(tmp_path: Path) -> None:
    work = kept(tmp_path)
    write_json(work.settings, {"given": {"fusion": {"gone": 1}}})
    with pytest.raises(WorkspaceError, match=r"workspace\.json is of another version"):
        read_kept(work)
    for content in ({}, {"given": None}, {"given": ["fusion"]}):
        write_json(work.settings, content)
        with pytest.raises(WorkspaceError, match=r"workspace\.json is of another version"):
            read_kept(work)


def test_every_stage_writes_them_down(
    coarse: Workspace, drives: Any, tools: SimpleNamespace
) -> None:
    settings = tools.coarse_settings()
    content = read_json(coarse.settings)
    assert content["settings"] == settings.tables(*content["settings"])
    assert settle(coarse, Settings()).resolved() == settings
    coarse.settings.unlink()
    describe_stage.describe(coarse, [], settings, Serial())
    assert read_json(coarse.settings) == content
    coarse.settings.unlink()
    fuse_stage.fuse(tools.inputs(drives, "monday"), coarse, settings, Serial())
    assert read_json(coarse.settings) == content


def test_sessions_of_other_settings_are_not_described(
    coarse: Workspace, tools: SimpleNamespace
) -> None:
    other = tools.coarse_settings(fusion__hit="0.9")
    with pytest.raises(WorkspaceError, match=r"monday was fused with fusion\.hit=0\.85, .*0\.9"):
        describe_stage.describe(coarse, [], other, Serial())
