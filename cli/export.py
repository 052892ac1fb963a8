"""semloc export."""

from __future__ import annotations

from pathlib import Path

import click

from .console import console
from .options import Command, console_options, json_option, path_option, work_option


@click.command(cls=Command)
@click.argument("sessions", metavar="[SESSION...]", nargs=-1)
@work_option
@click.option(
    "--format",
    "form",
    type=click.Choice(["tum", "kitti", "g2o", "ply"]),
    required=True,
    help="Poses, a pose graph with closures, or the map.",
)
@path_option("-o", "--output", help="Folder of the files; default: WORK/export.")
@json_option
@console_options
def command(sessions: tuple[str, ...], work: Path, form: str, output: Path | None, as_json: bool) -> int:
    """Sessions for other programs: poses of the base frame (tum, kitti), a pose graph with the closures (g2o), the voxel map (ply).

    Poses and maps are in the session frame of the log's pose stream, metres.

    \b
    Example:  semloc export -w work --format g2o
    """
    from semloc_logs.exports import export
    from semloc_logs.workspace import Workspace

    paths = export(Workspace(work), sessions, form, output or work / "export")
    if as_json:
        console.result_json({"files": [str(p) for p in paths]})
    else:
        for path in paths:
            console.result(str(path))
    return 0
