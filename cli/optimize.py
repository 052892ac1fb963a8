"""semloc optimize."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from .console import console
from .options import (
    Command,
    console_options,
    json_option,
    path_option,
    tables_settings_options,
    work_option,
)

if TYPE_CHECKING:
    from semloc_logs.settings import Resolved


@click.command(cls=Command)
@work_option
@path_option("--truth", help="Truth file as of semloc evaluate: trajectory errors are printed.")
@json_option
@tables_settings_options
@console_options
def command(work: Path, truth: Path | None, as_json: bool, settings: Resolved) -> int:
    """Closures -> all sessions in one frame, by a robust pose graph.

    Sessions that closures connect get poses in the map frame of the first of them. Closures that
    contradict odometry and the other closures are refused. Writes optimized/.

    \b
    Example:  semloc optimize -w work
    """
    from semloc_logs.evaluation.trajectory_errors import trajectory_errors
    from semloc_logs.stages.optimise import optimise
    from semloc_logs.workspace import Workspace

    workspace = Workspace(work)
    report = optimise(workspace, settings)
    errors = None if truth is None else trajectory_errors(workspace, truth)
    if as_json:
        console.result_json(asdict(report) | ({} if errors is None else errors.to_json()))
        return 0
    frames = "1 frame" if report.components == 1 else f"{report.components} frames"
    console.result(
        f"{report.sessions} sessions in {frames} by {report.closures} closures,"
        f" {report.rejected} of them refused: {workspace.optimized}"
    )
    if errors is not None:
        console.result(f"ATE {errors.ate_before_m:.3f} m before, {errors.ate_after_m:.3f} m after")
    return 0
