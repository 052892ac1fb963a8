"""semloc fuse."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from .console import console
from .options import (
    Command,
    EngineChoice,
    PoseChoice,
    logs_argument,
    reading_options,
    stage_options,
    work_option,
)
from .results import checked_name, finish, report_json, show_report

if TYPE_CHECKING:
    from semloc_logs.settings import Resolved


@click.command(cls=Command)
@logs_argument
@work_option
@click.option(
    "--session",
    metavar="NAME",
    help="Name of the session; default: the first log's file stem or folder name.",
)
@reading_options
@stage_options
def command(
    logs: tuple[Path, ...],
    work: Path,
    session: str | None,
    topics: dict[str, str],
    poses: PoseChoice,
    overwrite: bool,
    as_json: bool,
    engine: EngineChoice,
    settings: Resolved,
) -> int:
    """Logs -> the semantic map of one session: keyframes, submaps, voxels, trajectory. Several logs
    are one session, recorded back to back.

    Nothing is done again that is there for the same content, settings and version. Lengths are
    metres.

    \b
    Example:  semloc fuse monday_0.mcap monday_1.mcap -w work --session monday
    """
    from semloc_logs.stages.fuse import fuse
    from semloc_logs.stages.inputs import SessionInput, session_name
    from semloc_logs.workspace import Workspace

    name = checked_name(session or session_name(logs[0]))
    given = SessionInput(name, logs, topics, poses.by_session([name]).get(name))
    with console.progress(), engine.open(1) as opened:
        report = fuse([given], Workspace(work), settings, opened, overwrite=overwrite)
    if as_json:
        console.result_json(report_json(report, work))
    else:
        show_report("Fused", report)
        console.result(f"Map: {Workspace(work).session(name).picture}")
    return finish(report)
