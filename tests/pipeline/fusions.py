"""Fusion of logs without reading them, for tests of `fuse`."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from semloc_logs.engines import Serial
from semloc_logs.errors import LogError, TopicError
from semloc_logs.logs.problems import Problem
from semloc_logs.mapping.session_fusion import FusedSession, FuseTask
from semloc_logs.settings import Settings
from semloc_logs.stages import fuse as fuse_stage
from semloc_logs.stages.inputs import SessionInput
from semloc_logs.stages.report import Report
from semloc_logs.tables.table import write_json
from semloc_logs.workspace import Workspace

Fuse = Callable[..., Report]


def was_done(report: Report) -> bool:
    assert (report.done, report.kept) in ((["monday"], []), ([], ["monday"]))
    return bool(report.done == ["monday"])


def log_of(folder: Path, name: str) -> SessionInput:
    log = folder / f"{name}.mcap"
    log.write_bytes(name.encode())
    return SessionInput(name, (log,))


def quick_fusion(
    monkeypatch: pytest.MonkeyPatch, problems: tuple[Problem, ...] = ()
) -> Callable[..., Report]:
    """Fuses sessions without reading them: one whose name begins with "bad" fails, with "topic"
    lacks a topic.
    """

    def quick(task: FuseTask, **options: Any) -> FusedSession:
        name = task.folder.name
        if name.startswith("bad"):
            raise LogError(f"{name} cannot be read.")
        if name.startswith("topic"):
            raise TopicError(f"{name} lacks a topic.")
        counts = {"keyframes": 0, "voxels": 0, "label_source": "log"}
        recorded = {"fingerprint": task.fingerprint, "skipped": ["no fix"], **counts}
        write_json(task.folder.session_json, recorded)
        return FusedSession({"logs": [], **counts}, problems)

    monkeypatch.setattr(fuse_stage, "fuse_session", quick)

    def fuse(work: Workspace, *names: str, **options: Any) -> Report:
        sessions = [log_of(work.path.parent, name) for name in names]
        return fuse_stage.fuse(sessions, work, Settings().resolved(), Serial(), **options)

    return fuse
