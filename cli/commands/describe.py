"""semloc describe."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..completion import session_names
from ..console import console
from ..options import Command, EngineChoice, dry_run_option, stage_options, work_option
from ..results import finish, report_json, show_plan, show_report

if TYPE_CHECKING:
    from semloc_logs.settings import Resolved


@click.command(cls=Command)
@click.argument("sessions", metavar="[SESSION...]", nargs=-1, shell_complete=session_names)
@work_option
@dry_run_option
@stage_options
def command(
    sessions: tuple[str, ...],
    work: Path,
    dry_run: bool,
    overwrite: bool,
    as_json: bool,
    engine: EngineChoice,
    settings: Resolved,
) -> int:
    """Maps -> semantic words: every occupied subvolume of the sessions' submaps (all sessions by
    default) becomes a word and a 64-bit code.

    \b
    Example:  semloc describe -w work monday tuesday
    """
    from semloc_logs.stages.describe import describe
    from semloc_logs.stages.dry_run import Plan
    from semloc_logs.workspace import Workspace

    workspace = Workspace(work)
    with console.progress(), engine.open(len(sessions) or len(workspace.sessions())) as opened:
        if dry_run:
            plan = Plan(workspace, settings)
            plan.describe(sessions, overwrite=overwrite)
            return show_plan(plan, opened.jobs, as_json=as_json)
        report = describe(workspace, sessions, settings, opened, overwrite=overwrite)
    if as_json:
        console.result_json(report_json(report, work))
    else:
        show_report("Described", report)
    return finish(report)
