"""semloc task."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from semloc_logs.errors import SemlocError, SettingsError, TemporaryError

from ...console import console
from ...inputs import LogChoice, logs_options
from ...options import (
    Command,
    PoseChoice,
    console_options,
    json_option,
    reading_options,
    retry_option,
    settings_options,
    work_option,
)
from ...results import report_json
from .stage_tasks import STAGES, sessions_of

if TYPE_CHECKING:
    from semloc_logs.settings import Resolved

FAILED = 1
AGAIN = 75  # EX_TEMPFAIL of sysexits.h


@click.command(cls=Command)
@click.argument("task", metavar="ID|STAGE")
@logs_options
@work_option
@click.option(
    "--index",
    type=click.IntRange(0),
    metavar="I",
    help="Do the task with this number of the STAGE, from 0 on; for array jobs.",
)
@click.option(
    "--of",
    "step",
    type=click.IntRange(1),
    metavar="N",
    help="The array has N jobs: do the tasks I, I + N, I + 2 N and so on.",
)
@retry_option
@reading_options
@json_option
@functools.partial(settings_options, use="stages")
@console_options
def command(
    task: str,
    logs: LogChoice,
    work: Path,
    index: int | None,
    step: int | None,
    topics: dict[str, str],
    poses: PoseChoice,
    retry_failed: bool,
    as_json: bool,
    settings: Resolved,
) -> int:
    """One task that 'semloc tasks' lists: an ID such as fuse/monday or search/tuesday/monday, or
    with --index a STAGE. Tasks of a stage can be done at once, on machines that see the same
    workspace. A done task ends at once.

    Exit codes: 0 done, also where some input was skipped, which stderr names; 1 failed, and would
    fail again; 2 wrong usage; 75 worth another try (the workspace is in use, the disk is full,
    there is too little memory); 143 terminated.

    \b
    Example:  semloc task search -w work --index 3 --of 20
    """
    stage = task.split("/")[0]
    if (index is None) != (task not in STAGES) and task != "decide":
        raise click.UsageError(
            "Give an ID such as fuse/monday, or a STAGE and --index; 'semloc tasks STAGE' lists"
            " the IDs."
        )
    if step is not None and (index is None or index >= step):
        raise click.UsageError("--of N needs an --index below N.")
    from semloc_logs.engines import Serial
    from semloc_logs.stages.inputs import Redo
    from semloc_logs.stages.tasks import Stage, do_task, task_ids
    from semloc_logs.workspace import Workspace

    workspace = Workspace(work)
    sessions = sessions_of(stage, logs, topics, poses)
    tasks = [task]
    if index is not None and task in STAGES:
        listed = task_ids(Stage(task), sessions, workspace, settings)
        tasks = listed[index::step] if step else listed[index : index + 1]
        if not step and not tasks:
            raise click.UsageError(f"{task} has {len(listed)} tasks; --index counts from 0.")
    redo = Redo.of(retry_failed=retry_failed)
    reports: list[dict[str, Any]] = []
    codes = {0}
    with console.progress():
        for one in tasks:
            try:
                report = do_task(one, sessions, workspace, settings, Serial(), redo=redo)
            except (SemlocError, OSError, MemoryError) as problem:
                if isinstance(problem, SettingsError):
                    raise
                codes.add(_code(problem))
                console.error(f"{one}: {_sentence(problem)}")
                continue
            for sentence in dict.fromkeys((*report.skipped, *report.failed)):
                console.warn(sentence)
            reports.append({"id": one, **report_json(report, work)})
            if not as_json:
                console.result(f"{one}: {'done' if report.done else 'done before'}")
    if as_json:
        console.result_json(reports)
    return max(codes)


def _code(problem: BaseException) -> int:
    is_worth_another_try = isinstance(problem, TemporaryError | OSError | MemoryError)
    return AGAIN if is_worth_another_try else FAILED


def _sentence(problem: BaseException) -> str:
    if isinstance(problem, OSError):
        where = problem.filename or "A file"
        return f"{where} cannot be read or written ({problem.strerror or problem})."
    return str(problem) or "There is not enough memory."
