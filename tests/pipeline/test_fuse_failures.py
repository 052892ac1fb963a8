"""Logs that fail to be fused, and interruptions: which sessions stay, which are made again."""

import logging
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from semloc_logs.engines import Serial
from semloc_logs.errors import (
    LogError,
    RemoteError,
    SemlocError,
    TemporaryError,
    TopicError,
    WorkspaceError,
)
from semloc_logs.mapping import session_fusion
from semloc_logs.mapping.session_fusion import FusedSession, FuseTask
from semloc_logs.settings import Settings
from semloc_logs.stages import fuse as fuse_stage
from semloc_logs.stages.inputs import Redo, SessionInput
from semloc_logs.stages.report import Report
from semloc_logs.tables.table import read_json
from semloc_logs.workspace import Workspace
from tests.pipeline.fusions import Fuse, log_of, quick_fusion, was_done


def test_a_log_that_fails_does_not_end_the_others(
    tools: SimpleNamespace, drives: Any, tmp_path: Path
) -> None:
    (tmp_path / "empty.bag").touch()
    (tmp_path / "no.mcap").write_bytes(b"no log")
    work = Workspace(tmp_path / "work")
    no_log = SessionInput("no", (tmp_path / "no.mcap",))
    inputs = [no_log, *tools.inputs(drives, "monday")]
    report = fuse_stage.fuse(inputs, work, tools.coarse_settings(), Serial())
    assert report.done == ["monday"]
    assert len(report.failed) == 1
    assert [s.name for s in work.sessions()] == ["monday"]
    with pytest.raises(LogError):
        fuse_stage.fuse([no_log], work, tools.coarse_settings(), Serial())


def test_a_log_that_failed_is_read_again_when_it_or_the_settings_change_or_on_demand(
    tools: SimpleNamespace, drives: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = tmp_path / "no.mcap"
    log.write_bytes(b"no log")
    work = Workspace(tmp_path / "work")
    read: list[str] = []
    fuse_session = session_fusion.fuse_session

    def counted(task: FuseTask, **options: Any) -> FusedSession:
        read.append(task.folder.name)
        return fuse_session(task, **options)

    monkeypatch.setattr(fuse_stage, "fuse_session", counted)

    def fuse_again(**options: Any) -> tuple[Report, int]:
        read.clear()
        settings = options.pop("settings", tools.coarse_settings())
        inputs = [SessionInput("no", (log,)), *tools.inputs(drives, "monday")]
        return fuse_stage.fuse(inputs, work, settings, Serial(), **options), read.count("no")

    first, reads = fuse_again()
    assert (first.done, len(first.failed), reads) == (["monday"], 1, 1)
    content = read_json(work.failure("no"))
    assert content["reason"] == first.failed[0]
    assert content["logs"] == [str(log)]
    second, reads = fuse_again()
    assert (second.kept, reads) == (["monday"], 0)
    assert second.failed == [f"{first.failed[0]} It failed before: --retry-failed reads it again."]
    assert fuse_again(redo=Redo.FAILED)[1] == 1
    log.write_bytes(b"still no log")
    assert fuse_again()[1] == 1
    assert fuse_again()[1] == 0
    assert fuse_again(settings=tools.coarse_settings(labels__source="uniform"))[1] == 1
    shutil.copyfile(drives["tuesday"].log, log)
    fused, _ = fuse_again()
    assert fused.done == ["no", "monday"]
    assert work.failures() == []


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_an_interrupted_session_is_done_again(
    share: float,
    fuse: Fuse,
    coarse: Workspace,
    tools: SimpleNamespace,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Interrupted after a share of its files, under other settings: the present session stays
    whole, with its words, until the new one is.
    """
    folder = coarse.session("monday")
    other = tools.coarse_settings(fusion__hit="0.9", fusion__keyframe_resolution="0.3")
    first = tools.files(folder.path)
    steps = tools.renames(monkeypatch, lambda: fuse(settings=other))
    second = tools.files(folder.path)
    assert steps > 5
    assert first.keys() - second.keys() == {n for n in first if n.startswith("words")}
    tools.renames(monkeypatch, fuse, round(share * (steps - 1)))
    assert tools.files(folder.path) == second
    assert [p.name for p in folder.path.parent.iterdir() if p.name.startswith(".")] == []
    assert was_done(fuse()), "the interrupted stage"
    assert tools.files(folder.path) == {n: d for n, d in first.items() if not n.startswith("words")}


def test_a_killed_replacement_is_put_back(
    fuse: Fuse, coarse: Workspace, tools: SimpleNamespace
) -> None:
    """Killed between the two renames: the session is away under another name."""
    before = tools.files(coarse.path)
    folder = coarse.session("monday").path
    folder.rename(folder.with_name(".monday.0badcafe.old.tmp"))
    half = folder.with_name(".monday.0badcafe.tmp")
    half.mkdir()
    (half / "session.json").write_text("{}")
    assert [s.name for s in coarse.sessions()] == ["tuesday"]
    assert not was_done(fuse())
    assert tools.files(coarse.path) == before


@pytest.mark.parametrize(
    ("error", "raised"),
    [(TemporaryError, TemporaryError), (TopicError, TopicError), (RemoteError, LogError)],
)
def test_a_fault_that_is_not_the_logs_is_not_remembered(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    error: type[SemlocError],
    raised: type[SemlocError],
) -> None:
    """A server that is away, a topic that was named wrongly: the next run reads the log again."""

    def fails(task: FuseTask, **options: Any) -> FusedSession:
        raise error("It did not work.")

    monkeypatch.setattr(fuse_stage, "fuse_session", fails)
    work = Workspace(tmp_path / "work")
    settings = Settings().resolved()
    with pytest.raises(raised, match="It did not work") as caught:
        fuse_stage.fuse([log_of(tmp_path, "a")], work, settings, Serial())
    assert type(caught.value) is raised
    both = [log_of(tmp_path, name) for name in ("a", "b")]
    with pytest.raises(raised):
        fuse_stage.fuse(both, work, settings, Serial())
    assert work.failures() == []


def test_a_worker_with_a_disk_of_its_own_is_named(tmp_path: Path) -> None:
    elsewhere: Any = SimpleNamespace(
        jobs=1, map=lambda function, tasks: [FusedSession({}, ()) for _ in tasks]
    )
    work = Workspace(tmp_path / "work")
    with pytest.raises(WorkspaceError, match="on a disk of its own"):
        fuse_stage.fuse([log_of(tmp_path, "a")], work, Settings().resolved(), elsewhere)


def test_only_logs_of_the_named_sessions_are_repaired_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    repaired: list[Path] = []
    monkeypatch.setattr(fuse_stage, "recover", repaired.append)
    fuse = quick_fusion(monkeypatch)
    report = fuse(Workspace(tmp_path / "work"), "a", "b", "c", names=["a", "c"])
    assert report.done == ["a", "c"]
    assert repaired == [tmp_path / "a.mcap", tmp_path / "c.mcap"]


def test_one_failure_is_raised_and_several_are_logged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    fuse = quick_fusion(monkeypatch)
    work = Workspace(tmp_path / "work")
    with pytest.raises(LogError, match="bad 1 cannot be read"):
        fuse(work, "bad 1")
    assert "bad 1 cannot be read" not in caplog.text
    with pytest.raises(LogError, match=r"It failed before.*bad 2 cannot be read"):
        fuse(work, "bad 1", "bad 2")
    assert "bad 2 cannot be read" not in caplog.text  # the only one that was read
    with pytest.raises(LogError, match="bad 3 cannot be read"):
        fuse(work, "bad 3", "bad 4")
    assert "bad 3: bad 3 cannot be read." in caplog.text
    # with a log that failed before it is more than a missing topic
    with pytest.raises(LogError) as caught:
        fuse(work, "bad 1", "topic")
    assert not isinstance(caught.value, TopicError)


def test_overwriting_includes_what_failed() -> None:
    options = [(True, True), (True, False), (False, True), (False, False)]
    chosen = [Redo.of(overwrite=o, retry_failed=r) for o, r in options]
    assert chosen == [Redo.EVERYTHING, Redo.EVERYTHING, Redo.FAILED, Redo.NOTHING]
