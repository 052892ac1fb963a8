"""semloc evaluate."""

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
    path_option,
    query_options,
    tables_settings_options,
    work_option,
)
from ..results import SHOWN, show_sharpness, show_trajectory_errors

if TYPE_CHECKING:
    from semloc_logs.evaluation.truth import Evaluation
    from semloc_logs.settings import Resolved


@click.command(cls=Command)
@work_option
@path_option(
    "--truth",
    required=True,
    help="Truth file (JSON): SESSION_FILE -> T_common_session (4x4) or trajectory (a TUM file).",
)
@click.option("--no-self", is_flag=True, help="Leave revisits within a session out of the recall.")
@click.option(
    "--heading",
    type=click.FloatRange(0, 180),
    metavar="DEGREES",
    help="Only revisits at this angle to the query, such as 0, 90 or 180; 20 degrees less or more.",
)
@query_options
@json_option
@tables_settings_options
@console_options
def command(
    work: Path,
    truth: Path,
    no_self: bool,
    heading: float | None,
    as_json: bool,
    settings: Resolved,
) -> int:
    """Closures against the truth: a closure is correct within 1 m and 5 degrees.

    Recall is the share of the queries near a database keyframe (5 m) that have a correct closure.
    After semloc optimize also the errors of the trajectories before and after: ATE and RPE of 10 m,
    root mean squares, as evo defines them; and how sharp the common map is, which needs no truth.
    With --heading 90 a query counts where all keyframes near it were driven across, and closures
    between such views.

    \b
    Example:  semloc evaluate -w work --truth truth.json
    """
    from semloc_logs.evaluation.map_sharpness import map_sharpness
    from semloc_logs.evaluation.trajectory_errors import trajectory_errors
    from semloc_logs.evaluation.truth import evaluate_closures
    from semloc_logs.workspace import Workspace

    workspace = Workspace(work)
    result = evaluate_closures(
        workspace, truth, settings, self_closures=not no_self, heading_deg=heading
    )
    is_optimized = workspace.graph_closures.exists()
    errors = trajectory_errors(workspace, truth) if is_optimized else None
    sharpness = map_sharpness(workspace) if is_optimized else None
    if as_json:
        content = result.to_json()
        if errors is not None and sharpness is not None:
            content |= errors.to_json() | {"sharpness": asdict(sharpness)}
        console.result_json(content)
    else:
        show_evaluation(result)
        if errors is not None:
            show_trajectory_errors(errors)
        if sharpness is not None:
            show_sharpness(sharpness)
    if result.unjudged:
        console.warn(
            f"{result.unjudged} closures have an end whose true pose {truth} does not say: they"
            " are neither correct nor false."
        )
    return 0


def show_evaluation(result: Evaluation) -> None:
    """Closures beside the truth, the worst first, and the figures."""
    rows = sorted(result.rows, key=lambda r: (r.correct is not False, -(r.error_m or 0.0)))
    drawn = [
        (
            r.query_session,
            f"{r.query_stamp_ns / 1e9:.1f}",
            r.target_session,
            f"{r.target_stamp_ns / 1e9:.1f}",
            None if r.error_m is None else f"{r.error_m:.3f}",
            None if r.error_deg is None else f"{r.error_deg:.2f}",
            {True: "correct", False: "FALSE", None: "unknown"}[r.correct],
        )
        for r in rows[:SHOWN]
    ]
    if drawn:
        columns = ("query", "stamp (s)", "target", "stamp (s)", "error (m)", "error (deg)", "")
        console.table("Closures against the truth, worst first", columns, drawn)
    if len(rows) > SHOWN:
        console.result(f"... and {len(rows) - SHOWN} more.")
    if len(result.pairs) > 1:
        columns = ("sessions", "", "closures#", "false#", "possible#", "answered#", "recall#")
        drawn_pairs = [
            (
                p.sessions[0],
                "itself" if p.sessions[1] == p.sessions[0] else p.sessions[1],
                p.closures,
                p.false,
                p.possible,
                p.answered,
                None if p.recall is None else f"{p.recall:.3f}",
            )
            for p in sorted(result.pairs, key=lambda p: (-p.possible, p.sessions))
        ]
        console.table("Pairs of sessions", columns, drawn_pairs[:SHOWN])
        if len(drawn_pairs) > SHOWN:
            console.result(f"... and {len(drawn_pairs) - SHOWN} more pairs.")
    unjudged = f", {result.unjudged} unjudged" if result.unjudged else ""
    console.result(
        f"{result.closures} closures: {result.correct} correct, {result.false} false{unjudged}"
    )
    if result.median_error_m is not None:
        console.result(
            f"Median error {result.median_error_m:.3f} m, {result.median_error_deg:.2f} deg"
        )
    if result.recall is not None:
        console.result(
            f"Recall {result.recall:.3f}: {result.answered} of {result.possible} queries with a"
            " revisit within 5 m"
        )
    elif not result.possible:
        console.result(f"None of {result.queries} queries has a revisit within 5 m: no recall")
