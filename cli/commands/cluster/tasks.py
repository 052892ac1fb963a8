"""semloc tasks."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ...console import console
from ...inputs import LogChoice, logs_options
from ...options import (
    Command,
    PoseChoice,
    console_options,
    reading_options,
    settings_options,
    work_option,
)
from .stage_tasks import STAGES, given_words, sessions_of, task_words

if TYPE_CHECKING:
    from semloc_logs.settings import Resolved


@click.command(cls=Command)
@click.argument("stage", type=click.Choice(STAGES))
@logs_options
@work_option
@click.option("--missing", is_flag=True, help="Only tasks that are not done.")
@click.option("--count", is_flag=True, help="Print only how many tasks there are.")
@reading_options
@functools.partial(settings_options, use="stages")
@console_options
def command(
    stage: str,
    logs: LogChoice,
    work: Path,
    missing: bool,
    count: bool,
    topics: dict[str, str],
    poses: PoseChoice,
    settings: Resolved,
) -> int:
    """The tasks of a STAGE as JSON lines, for a cluster: id, stage, inputs, command, done.

    fuse has a task for each session and needs all LOGs, describe one for each session, search one
    for each pair of sessions, and decide is one task. A stage needs the ones before it. The order
    is always the same, so that an array job can take the N-th task. Nothing is written.

    \b
    Example:  semloc tasks search -w work --missing
    """
    from semloc_logs.stages.tasks import Stage, list_tasks, task_ids
    from semloc_logs.workspace import Workspace

    sessions = sessions_of(stage, logs, topics, poses)
    if count and not missing:
        console.result(str(len(task_ids(Stage(stage), sessions, Workspace(work), settings))))
        return 0
    tasks = list_tasks(Stage(stage), sessions, Workspace(work), settings)
    tasks = [task for task in tasks if not (missing and task.done)]
    if count:
        console.result(str(len(tasks)))
        return 0
    given = given_words(logs, sessions, topics, settings)
    for task in tasks:
        content = {
            "id": task.id,
            "stage": stage,
            "inputs": list(task.inputs),
            "command": task_words(task.id, work, given),
            "done": task.done,
        }
        console.result(json.dumps(content, ensure_ascii=False))
    return 0
