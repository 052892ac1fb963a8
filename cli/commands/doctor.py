"""semloc doctor."""

from __future__ import annotations

from pathlib import Path

import click

from ..console import console
from ..options import Command, console_options, json_option, work_option


@click.command(cls=Command)
@work_option
@json_option
@console_options
def command(work: Path, as_json: bool) -> int:
    """Check every file of a workspace: that it can be read, has its columns and rows, and is of the
    maps, settings and version that it should be of. Exit code 3 when something is wrong; each fault
    comes with what to run. Nothing is changed.

    \b
    Example:  semloc doctor -w work
    """
    from semloc_logs.stages.doctor import examine
    from semloc_logs.workspace import Workspace

    result = examine(Workspace(work))
    if as_json:
        findings = [
            {"path": str(f.path), "fault": f.fault, "remedy": f.remedy} for f in result.findings
        ]
        console.result_json({"files": result.files, "rows": result.rows, "findings": findings})
    else:
        console.result(f"{result.files} tables with {result.rows} rows were read")
        for finding in result.findings:
            console.result(f"{finding.path}: {finding.fault}\n  {finding.remedy}")
        if not result.findings:
            console.result("Nothing is wrong")
    return 3 if result.findings else 0
