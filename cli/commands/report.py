"""semloc report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..console import console
from ..options import (
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
@path_option("-o", "--output", help="HTML file.  [default: WORK/report.html]")
@click.option("--slim", is_flag=True, help="Without pictures: a small file.")
@json_option
@tables_settings_options
@console_options
def command(work: Path, output: Path | None, slim: bool, as_json: bool, settings: Resolved) -> int:
    """One page that opens anywhere: all drives and closures on a map with zoom and filters, a
    table of sessions by sessions, the evidence of each closure, the reason where a place has none,
    sessions with their warnings, timings and settings.

    The page is one file without any connection to a network. semloc run writes it, too.

    \b
    Example:  semloc report -w work -o report.html
    """
    from semloc_logs.stages.report_page import write_report
    from semloc_logs.workspace import Workspace

    path = write_report(Workspace(work), settings, output, slim=slim)
    if as_json:
        console.result_json({"output": str(path), "bytes": path.stat().st_size})
    else:
        console.result(f"Report: {path} ({path.stat().st_size / 1e6:.1f} MB)")
    return 0
