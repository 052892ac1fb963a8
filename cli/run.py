"""semloc run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from .console import console
from .options import (
    Command,
    EngineChoice,
    console_options,
    engine_options,
    json_option,
    label_options,
    logs_argument,
    overwrite_option,
    pose_options,
    query_options,
    settings_options,
    topic_option,
    trajectories,
    work_option,
)
from .results import finish, report_json, session_logs, show_closures

if TYPE_CHECKING:
    from semloc_logs.settings import Settings


@click.command(cls=Command)
@logs_argument
@work_option
@click.option(
    "--annotate",
    "annotation",
    type=click.Choice(["none", "copy", "in-place", "sidecar"]),
    default="none",
    show_default=True,
    help="Also write the closures as channels: to WORK/annotated (copy, sidecar) or into the logs.",
)
@topic_option
@pose_options
@label_options
@query_options
@overwrite_option
@json_option
@engine_options
@settings_options
@console_options
def command(
    logs: tuple[Path, ...],
    work: Path,
    annotation: str,
    topics: dict[str, str],
    pose_files: tuple[str, ...],
    pose_times: tuple[str, ...],
    pose_frame: str,
    overwrite: bool,
    as_json: bool,
    engine: EngineChoice,
    settings: Settings,
) -> int:
    """Logs -> loop closures, all of it: fuse, describe, close and, if asked for, annotate. Each LOG is a session.

    Can be interrupted and run again: finished work is kept. A log that cannot be read is named, the others are done, and the exit
    code is 3.

    \b
    Example:  semloc run monday.mcap tuesday.bag -w work --annotate copy
    """
    sessions = session_logs(logs)
    poses = trajectories(sessions, pose_files, pose_times, pose_frame)
    from semloc_logs.stages import run
    from semloc_logs.workspace import Workspace

    workspace = Workspace(work)
    with console.progress(), engine.open(len(sessions)) as opened:
        report = run(sessions, workspace, settings, topics, opened, console.note, annotation, overwrite, poses)
    if as_json:
        console.result_json(report_json(report, work))
    else:
        show_closures(workspace)
        if annotation in ("copy", "sidecar"):
            console.result(f"Annotated logs: {workspace.annotated}")
        console.result(", ".join(f"{stage} {seconds:.1f} s" for stage, seconds in report.seconds.items()))
    return finish(report)
