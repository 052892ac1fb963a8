"""semloc show."""

from __future__ import annotations

from pathlib import Path

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


@click.command(cls=Command)
@work_option
@click.option(
    "--query",
    metavar="SESSION",
    shell_complete=session_names,
    help="Only queries of this session.",
)
@click.option(
    "--at",
    type=float,
    metavar="SECONDS",
    help="The query nearest to this time, of its log or since its start (s).",
)
@click.option(
    "--closure",
    type=int,
    metavar="N",
    help="Closure N of closures.parquet, counted from 1.",
)
@click.option(
    "--count",
    type=click.IntRange(0, 20),
    default=2,
    show_default=True,
    help="So many of the best closures.",
)
@path_option("-o", "--output", required=True, help="PNG, SVG or PDF file, by its ending.")
@overwrite_option
@json_option
@console_options
def command(
    work: Path,
    query: str | None,
    at: float | None,
    closure: int | None,
    count: int,
    output: Path,
    overwrite: bool,
    as_json: bool,
) -> int:
    """A picture of closures: the query's voxels in the colours of their classes laid over the pale
    map, before and after the alignment, the verdict of the map on each voxel, and subvolumes whose
    words matched, as seen and as the network completes them.

    Without --at or --closure: the best closures of different pairs of sessions, and the best
    hypothesis that was rejected.

    \b
    Example:  semloc show -w work --query tuesday --at 95 -o closure.png
    """
    from semloc_logs.errors import WorkspaceError
    from semloc_logs.pictures.closure_sheet import draw_views
    from semloc_logs.pictures.closure_view import (
        Wanted,
        choose,
        closing_settings,
        closure_view,
        drawn,
    )
    from semloc_logs.pictures.sheet import FORMATS
    from semloc_logs.pictures.times import time_text
    from semloc_logs.workspace import Workspace

    if output.suffix.lower().removeprefix(".") not in FORMATS:
        raise click.BadParameter(
            f"'{output}' does not end in .png, .svg or .pdf", param_hint="--output"
        )
    if closure is not None and (query is not None or at is not None):
        raise click.UsageError("--closure names a closure by itself: leave out --query and --at.")
    if output.exists() and not overwrite:
        raise WorkspaceError(f"{output} exists already: give --overwrite or another name.")
    workspace = Workspace(work)
    chosen = choose(workspace, Wanted(query, at, closure, count))
    settings = closing_settings(workspace)
    views = [closure_view(workspace, choice, settings) for choice in chosen]
    draw_views(output, views)
    if as_json:
        console.result_json({"output": str(output), "shown": [drawn(view) for view in views]})
    else:
        for view in views:
            row = view.choice.row
            verdict = "closure" if view.choice.accepted else f"rejected ({view.choice.reason})"
            ends = (
                f"{row[f'{end}_session']} at {time_text(row[f'{end}_stamp_ns'])}"
                for end in ("query", "target")
            )
            console.result(f"{' in '.join(ends)}: {verdict}, probability {row['probability']:.4f}")
        console.result(f"Picture: {output}")
    return 0
