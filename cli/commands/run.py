"""semloc run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..console import console
from ..inputs import LogChoice, logs_options, session_inputs
from ..options import (
    Command,
    EngineChoice,
    PoseChoice,
    dry_run_option,
    query_options,
    reading_options,
    retry_option,
    stage_options,
    work_option,
)
from ..results import SHOWN, finish, report_json, show_closures, show_plan, show_sessions

if TYPE_CHECKING:
    from semloc_logs.settings import Resolved


@click.command(cls=Command)
@logs_options
@work_option
@click.option(
    "--annotate",
    "annotation",
    type=click.Choice(["none", "copy", "in-place", "sidecar"]),
    default="none",
    show_default=True,
    help="Also write the closures as channels: to WORK/annotated (copy, sidecar) or into the logs.",
)
@retry_option
@dry_run_option
@reading_options
@query_options
@stage_options
def command(
    logs: LogChoice,
    work: Path,
    annotation: str,
    topics: dict[str, str],
    poses: PoseChoice,
    retry_failed: bool,
    dry_run: bool,
    overwrite: bool,
    as_json: bool,
    engine: EngineChoice,
    settings: Resolved,
) -> int:
    """Logs -> loop closures: fuse, describe, close and, with --annotate, annotate.

    Each LOG is a session, called NAME or after the file. A quoted shell pattern stands
    for the files it matches, '-' for lines of standard input.

    Can be interrupted and run again: finished work is kept. A damaged log is named, the others
    are done, and the exit code is 3. A path that does not exist stops the command at once.

    \b
    Example:  semloc run monday.mcap tuesday.bag -w work --annotate copy
    """
    sessions = session_inputs(logs.each(), topics, poses)
    from semloc_logs.stages.annotate import AnnotationMode
    from semloc_logs.stages.dry_run import Plan
    from semloc_logs.stages.inputs import Redo
    from semloc_logs.stages.run import run
    from semloc_logs.stages.stored_sessions import list_sessions
    from semloc_logs.workspace import Workspace

    workspace = Workspace(work)
    mode = AnnotationMode(annotation)
    redo = Redo.of(overwrite=overwrite, retry_failed=retry_failed)
    with console.progress(), engine.open(len(sessions)) as opened:
        if dry_run:
            plan = Plan(workspace, settings)
            plan.fuse(sessions, redo)
            plan.describe(overwrite=False)
            plan.close(overwrite=overwrite)
            return show_plan(plan, opened.jobs, as_json=as_json)
        report = run(sessions, workspace, settings, opened, annotation=mode, redo=redo)
    if as_json:
        console.result_json(report_json(report, work))
    else:
        show_sessions(list_sessions(workspace), SHOWN)
        show_closures(workspace)
        if annotation in ("copy", "sidecar"):
            console.result(f"Annotated logs: {workspace.annotated}")
        console.result(
            ", ".join(f"{stage} {seconds:.1f} s" for stage, seconds in report.seconds.items())
        )
    return finish(report)
