"""What `semloc tasks` and `semloc task` share: the stages, and the words of a task's command."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ...inputs import STANDARD_INPUT, LogChoice, session_inputs

if TYPE_CHECKING:
    from semloc_logs.settings import Resolved
    from semloc_logs.stages.inputs import SessionInput

    from ...options import PoseChoice

STAGES = ("fuse", "describe", "search", "decide")
FUSE = STAGES[0]


def sessions_of(
    stage: str, logs: LogChoice, topics: Mapping[str, str], poses: PoseChoice
) -> list[SessionInput]:
    """The sessions to fuse; UsageError where another stage gets logs, or they cannot be read again
    by the tasks.
    """
    if stage != FUSE:
        if logs.logs or logs.manifest is not None:
            raise click.UsageError(f"{stage} reads the workspace: only {FUSE} takes LOGs.")
        return []
    if STANDARD_INPUT in (*logs.logs, str(logs.manifest)):
        raise click.UsageError("Tasks cannot read standard input again: use a --manifest FILE.")
    return session_inputs(logs.each(), topics, poses)


def task_words(task: str, work: Path, given: list[str]) -> list[str]:
    """The command of a task, word by word; paths are absolute."""
    return ["semloc", "task", task, "-w", str(work.absolute()), *given]


def given_words(
    logs: LogChoice,
    sessions: list[SessionInput],
    topics: Mapping[str, str],
    settings: Resolved,
) -> list[str]:
    """Logs, topics, poses and settings, as every task of the stage needs them."""
    words: list[str] = []
    listed = len(list(logs.listed()))
    # several logs of one session are in the manifest
    for session in sessions[: len(sessions) - listed]:
        words.append(f"{session.name}={_absolute(session.logs[0])}")
        if session.poses is not None:
            words += ["--poses", f"{session.name}={session.poses.path.absolute()}"]
            if session.poses.times is not None:
                words += ["--pose-times", f"{session.name}={session.poses.times.absolute()}"]
            if session.poses.frame:
                words += ["--pose-frame", session.poses.frame]
    if logs.manifest is not None:
        words += ["--manifest", str(logs.manifest.absolute())]
    for role, topic in topics.items():
        words += ["--topic", f"{role}={topic}"]
    reading = settings.logs.model_dump(mode="json", exclude_defaults=True)
    for section, values in {"logs": reading, **settings.differences()}.items():
        for name, value in values.items():
            words += ["--set", f"{section}.{name}={json.dumps(value, ensure_ascii=False)}"]
    return words


def _absolute(log: Path) -> str:
    """A local path is absolute; an address stays as it is."""
    return str(log) if ":/" in str(log) else str(log.absolute())
