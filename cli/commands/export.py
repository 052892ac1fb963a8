"""semloc export."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import click

from ..completion import session_names
from ..console import console
from ..options import (
    Command,
    console_options,
    json_option,
    overwrite_option,
    path_option,
    work_option,
)

POINTS = ("ply", "pcd", "las", "laz", "xyz")


@click.command(cls=Command)
@click.argument("sessions", metavar="[SESSION...]", nargs=-1, shell_complete=session_names)
@work_option
@click.option(
    "--format",
    "form",
    type=click.Choice(["tum", "kitti", "g2o", "foxglove-layout", "geojson", "rrd", *POINTS]),
    required=True,
    help="Poses, a pose graph with closures, a layout or a recording of a viewer, lines on the"
    " earth, or points.",
)
@click.option(
    "--what",
    type=click.Choice(["voxels", "keyframes"]),
    help="Points: occupied voxels (default) or the keyframes' points.",
)
@click.option(
    "--frame",
    type=click.Choice(["session", "map", "common", "utm"]),
    help="Poses and points are in the session frame of the log's poses (default), points in the"
    " level map frame that starts at the first keyframe; both in the common frame of semloc"
    " optimize, points in UTM coordinates where satellite fixes place it.",
)
@click.option(
    "--bounds",
    type=float,
    nargs=4,
    metavar="XMIN YMIN XMAX YMAX",
    help="Only points within this box of that frame (m).",
)
@path_option("-o", "--output", help="Folder of the files; default: WORK/export.")
@overwrite_option
@json_option
@console_options
def command(
    sessions: tuple[str, ...],
    work: Path,
    form: str,
    what: Literal["voxels", "keyframes"] | None,
    frame: Literal["session", "map", "common", "utm"] | None,
    bounds: tuple[float, float, float, float] | None,
    output: Path | None,
    overwrite: bool,
    as_json: bool,
) -> int:
    """Sessions for other programs: poses of the base frame (tum, kitti), a pose graph with the
    closures (g2o), a layout that shows annotated logs in Foxglove (foxglove-layout), drives and
    closures on the earth (geojson), a recording for Rerun (rrd), points (ply, pcd, las, laz,
    xyz) with their classes.

    Poses and points are in the session frame of the log's pose stream, metres, unless --frame is
    given.

    \b
    Example:  semloc export -w work --format las --bounds -50 -50 50 50
    """
    is_of_points = what or bounds or (frame and (frame != "common" or form == "g2o"))
    if form not in POINTS and is_of_points:
        raise click.UsageError(
            f"--what, --frame and --bounds choose points; {form} has none. Formats with points:"
            f" {', '.join(POINTS)}."
        )
    if bounds and not (bounds[0] < bounds[2] and bounds[1] < bounds[3]):
        raise click.BadParameter(
            "the box is empty: give XMIN YMIN XMAX YMAX with XMIN < XMAX and YMIN < YMAX",
            param_hint="--bounds",
        )
    from semloc_logs.exports import Selection, export
    from semloc_logs.workspace import Workspace

    selection = Selection(what or "voxels", frame or "session", bounds)
    folder = output or work / "export"
    paths = export(Workspace(work), sessions, form, folder, selection, overwrite=overwrite)
    if as_json:
        console.result_json({"files": [str(p) for p in paths]})
    else:
        for path in paths:
            console.result(str(path))
    return 0
