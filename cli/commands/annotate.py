"""semloc annotate."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..completion import session_names
from ..console import console
from ..options import (
    Command,
    LogPath,
    console_options,
    json_option,
    overwrite_option,
    tables_settings_options,
    work_option,
)

if TYPE_CHECKING:
    from semloc_logs.settings import Resolved


@click.command(cls=Command)
@click.argument("log", metavar="LOG", type=LogPath())
@work_option
@click.option(
    "-o",
    "--output",
    type=LogPath(),
    help="Write a copy of the log with the results to this MCAP file; a copy of a .bag log may be a"
    " .bag, too.",
)
@click.option(
    "--in-place",
    is_flag=True,
    help="Write the results into the log itself (MCAP only); crash-safe.",
)
@click.option("--sidecar", type=LogPath(), help="Write an MCAP file with the results only.")
@click.option(
    "--session",
    metavar="NAME",
    shell_complete=session_names,
    help="Session of the log; default: its file stem or folder name.",
)
@click.option(
    "--frame",
    type=click.Choice(["target", "common"]),
    default="target",
    show_default=True,
    help="/semloc/pose is in the frames of target sessions, or in the common frame of semloc"
    " optimize.",
)
@overwrite_option
@json_option
@tables_settings_options
@console_options
def command(
    log: Path,
    work: Path,
    output: Path | None,
    in_place: bool,
    sidecar: Path | None,
    session: str | None,
    frame: str,
    overwrite: bool,
    as_json: bool,
    settings: Resolved,
) -> int:
    """Closures -> channels of the log, in its own encoding: /semloc/loop_closures, /semloc/pose,
    /semloc/markers, a map, and transforms that place their frames.

    Give exactly one of -o, --in-place and --sidecar. The recorded messages stay as they are; a
    second run replaces the earlier results.

    \b
    Example:  semloc annotate monday.mcap -w work -o monday.semloc.mcap
    """
    modes = {"copy": output is not None, "in-place": in_place, "sidecar": sidecar is not None}
    chosen = [mode for mode, is_given in modes.items() if is_given]
    if len(chosen) != 1:
        raise click.UsageError(
            "Give exactly one of -o OUT.mcap, --in-place and --sidecar OUT.mcap."
        )
    from semloc_logs.stages.annotate import Annotation, AnnotationMode, annotate
    from semloc_logs.workspace import Workspace

    annotation = Annotation(
        AnnotationMode(chosen[0]), output or sidecar, overwrite, frame == "common"
    )
    made = annotate(log, Workspace(work), settings, annotation, session=session)
    if as_json:
        console.result_json({k: getattr(made, k) for k in made.__dataclass_fields__})
    else:
        replaced = ", earlier results replaced" if made.replaced else ""
        console.result(
            f"{made.path}: {made.closures} closures in {made.messages} messages,"
            f" {made.bytes_written} bytes{replaced}"
        )
    return 0
