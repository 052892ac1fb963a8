"""semloc fuse."""

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
    reading_options,
    retry_option,
    stage_options,
    work_option,
)
from ..results import finish, report_json, show_plan, show_report

if TYPE_CHECKING:
    from semloc_logs.settings import Resolved


@click.command(cls=Command)
@logs_options
@work_option
@click.option(
    "--session",
    metavar="NAME",
    help="Name of the session; default: the first log's file stem or folder name.",
)
@retry_option
@dry_run_option
@reading_options
@stage_options
def command(
    logs: LogChoice,
    work: Path,
    session: str | None,
    topics: dict[str, str],
    poses: PoseChoice,
    retry_failed: bool,
    dry_run: bool,
    overwrite: bool,
    as_json: bool,
    engine: EngineChoice,
    settings: Resolved,
) -> int:
    """Logs -> the semantic map of one session: keyframes, submaps, voxels, trajectory. Several logs
    are one session, recorded back to back; the sessions of a --manifest are sessions of their own.

    Nothing is done again that is there for the same content, settings and version. Another log
    under the name of a known session is refused without --overwrite. Lengths are metres.

    A map of points (PCD, PLY, LAS, LAZ) is a session, too: seen from a tour over its ground, or
    from the trajectory of --poses.

    \b
    Example:  semloc fuse monday_0.mcap monday_1.mcap -w work --session monday
    """
    sessions = session_inputs(logs.joined(session), topics, poses)
    from semloc_logs.stages.dry_run import Plan
    from semloc_logs.stages.fuse import fuse
    from semloc_logs.stages.inputs import Redo
    from semloc_logs.workspace import Workspace

    workspace = Workspace(work)
    redo = Redo.of(overwrite=overwrite, retry_failed=retry_failed)
    with console.progress(), engine.open(len(sessions)) as opened:
        if dry_run:
            plan = Plan(workspace, settings)
            plan.fuse(sessions, redo)
            return show_plan(plan, opened.jobs, as_json=as_json)
        report = fuse(sessions, workspace, settings, opened, redo=redo)
    if as_json:
        console.result_json(report_json(report, work))
    else:
        show_report("Fused", report)
        for given in sessions:
            console.result(f"Map: {workspace.session(given.name).picture}")
    return finish(report)
