"""semloc optimize."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..console import console
from ..options import (
    Command,
    console_options,
    json_option,
    overwrite_option,
    path_option,
    tables_settings_options,
    work_option,
)
from ..results import show_trajectory_errors

if TYPE_CHECKING:
    from semloc_logs.settings import Resolved


@click.command(cls=Command)
@work_option
@path_option("--truth", help="Truth file as of semloc evaluate: trajectory errors are printed.")
@click.option(
    "--covariances", is_flag=True, help="Also write how uncertain the pose of each vertex is."
)
@click.option(
    "--map", "with_map", is_flag=True, help="Also merge the voxels of all sessions, with changes."
)
@overwrite_option
@json_option
@tables_settings_options
@console_options
def command(
    work: Path,
    truth: Path | None,
    covariances: bool,
    with_map: bool,
    overwrite: bool,
    as_json: bool,
    settings: Resolved,
) -> int:
    """Closures -> all sessions in one frame, by a robust pose graph.

    Sessions that closures connect get poses in the map frame of the first of them. Closures that
    contradict odometry and the other closures are refused. Writes optimized/.

    \b
    Example:  semloc optimize -w work
    """
    from semloc_logs.evaluation.trajectory_errors import trajectory_errors
    from semloc_logs.stages.optimise import merge_maps, optimise
    from semloc_logs.workspace import Workspace

    workspace = Workspace(work)
    with console.progress():
        report = optimise(workspace, settings, covariances=covariances, overwrite=overwrite)
        maps = merge_maps(workspace) if with_map else []
    errors = None if truth is None else trajectory_errors(workspace, truth)
    if as_json:
        merged = {"maps": [asdict(one) for one in maps]} if with_map else {}
        console.result_json(asdict(report) | merged | ({} if errors is None else errors.to_json()))
        return 0
    frames = "1 frame" if report.frames == 1 else f"{report.frames} frames"
    console.result(
        f"{report.sessions} sessions in {frames} by {report.closures} closures,"
        f" {report.rejected} of them refused: {workspace.optimized}"
    )
    for one in maps:
        console.result(
            f"Map in the frame of {one.frame}: {one.voxels} voxels, {one.changed} changed,"
            f" in {workspace.merged_map(one.frame)}"
        )
    if errors is not None:
        show_trajectory_errors(errors)
    return 0
