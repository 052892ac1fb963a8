"""semloc close."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..completion import session_names
from ..console import console
from ..options import (
    Command,
    EngineChoice,
    dry_run_option,
    query_options,
    stage_options,
    work_option,
)
from ..results import finish, report_json, show_closures, show_plan

if TYPE_CHECKING:
    from semloc_logs.settings import Resolved


@click.command(cls=Command)
@work_option
@click.option(
    "--query",
    "queries",
    metavar="SESSION",
    multiple=True,
    shell_complete=session_names,
    help="Search pairs with this session only; repeatable.",
)
@click.option(
    "--target",
    "targets",
    metavar="SESSION",
    multiple=True,
    shell_complete=session_names,
    help="And of these the ones with this session; repeatable.",
)
@click.option("--no-self", is_flag=True, help="Do not look for revisits within a session.")
@dry_run_option
@query_options
@stage_options
def command(
    work: Path,
    queries: tuple[str, ...],
    targets: tuple[str, ...],
    no_self: bool,
    dry_run: bool,
    overwrite: bool,
    as_json: bool,
    engine: EngineChoice,
    settings: Resolved,
) -> int:
    """Words -> loop closures.

    Of two sessions the later recorded one is localised in the earlier one, and each in itself apart
    from keyframes that are near in time. Pairs that were searched before are kept; --query and
    --target restrict the search, not the result. Writes closures.parquet.

    \b
    Example:  semloc close -w work --query tuesday --target monday --query-every 5
    """
    from semloc_logs.closures.closure_tables import read_closures
    from semloc_logs.stages.close import close
    from semloc_logs.stages.dry_run import Plan
    from semloc_logs.stages.pair_search import Selection
    from semloc_logs.workspace import Workspace

    workspace = Workspace(work)
    with console.progress(), engine.open(len(workspace.sessions())) as opened:
        selection = Selection(queries, targets, self_closures=not no_self)
        if dry_run:
            plan = Plan(workspace, settings)
            plan.close(selection, overwrite=overwrite)
            return show_plan(plan, opened.jobs, as_json=as_json)
        report = close(workspace, settings, opened, selection, overwrite=overwrite)
    if as_json:
        console.result_json(
            report_json(report, work) | {"closures": read_closures(workspace.closures)}
        )
    else:
        show_closures(workspace)
    return finish(report)
