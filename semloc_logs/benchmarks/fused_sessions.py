"""Logs fused into a workspace for a benchmark, one session a log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from semloc_logs.engines import Engine, make_engine
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.settings import Resolved
from semloc_logs.stages.fuse import fuse
from semloc_logs.stages.inputs import SessionInput, session_name
from semloc_logs.workspace import Workspace


def fuse_sessions(
    sessions: Mapping[str, Sequence[Path]],
    work: Workspace,
    settings: Resolved,
    engine: Engine | None = None,
) -> None:
    """Fuse the logs of each session, without notes; in this process without ``engine``."""
    inputs = [SessionInput(name, tuple(logs)) for name, logs in sessions.items()]
    fuse(inputs, work, settings, engine or make_engine("serial"))


def fused_maps(logs: Sequence[Path], folder: Path, settings: Resolved) -> list[SessionMap]:
    """The maps of ``logs``, one session each, fused in ``folder``."""
    work = Workspace(folder)
    sessions = {session_name(log): [log] for log in logs}
    fuse_sessions(sessions, work, settings)
    return [SessionMap(work.session(name)) for name in sessions]
