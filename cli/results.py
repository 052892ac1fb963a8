"""Output that several commands share: closures as a table, and skipped input."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .console import console, duration

if TYPE_CHECKING:
    from semloc_logs.evaluation.map_sharpness import Sharpness
    from semloc_logs.evaluation.trajectory_errors import TrajectoryErrors
    from semloc_logs.stages.dry_run import Plan
    from semloc_logs.stages.report import Report
    from semloc_logs.stages.stored_sessions import SessionSummary
    from semloc_logs.workspace import Workspace

SHOWN = 20  # rows of a table; files have them all


def finish(*reports: Report) -> int:
    """Print the sentences about skipped and failed input; the exit code."""
    sentences = list(dict.fromkeys(s for r in reports for s in (*r.skipped, *r.failed)))
    for sentence in sentences:
        console.warn(sentence)
    return 3 if sentences else 0


def report_json(report: Report, work: Path) -> dict[str, Any]:
    """A stage's report as --json prints it."""
    keys = ("done", "kept", "skipped", "failed")
    return {
        "work": str(work),
        **{k: getattr(report, k) for k in keys},
        "seconds": report.seconds,
        "closures": report.closures,
    }


def show_report(verb: str, report: Report) -> None:
    """What was done, for people."""
    if report.done:
        console.result(f"{verb}: {', '.join(report.done)}")
    if report.kept:
        console.result(f"Done before: {', '.join(report.kept)} (--overwrite does it again)")


def show_sessions(sessions: Sequence[SessionSummary], shown: int | None = None) -> None:
    """Sessions of a workspace as a table, or the first of them."""
    rows = [
        (
            s.name,
            time.strftime("%Y-%m-%d %H:%M", time.gmtime(s.start_ns / 1e9)),
            f"{s.duration_s:.0f}",
            f"{s.road_m:.0f}",
            s.label_source,
            s.searched,
            s.closures,
        )
        for s in sessions
    ]
    columns = ("session", "recorded", "time (s)", "road (m)", "labels", "pairs#", "closures#")
    console.table("", columns, rows[:shown])
    if shown is not None and len(rows) > shown:
        console.result(f"... and {len(rows) - shown} more sessions.")


def show_plan(plan: Plan, workers: int, *, as_json: bool) -> int:
    """What a command would do."""
    if as_json:
        stages = [asdict(stage) for stage in plan.stages]
        seconds = sum(stage.seconds for stage in plan.stages) / workers
        failed = plan.known_failures
        console.result_json(
            {"stages": stages, "workers": workers, "seconds": seconds, "failed": failed}
        )
        return 0
    ends = {"close": "pairs of sessions"}
    rows = [
        (
            stage.stage,
            f"{len(stage.todo)} of {stage.total} {ends.get(stage.stage, 'sessions')}",
            f"{stage.amount:.0f} {stage.unit}" if stage.todo else None,
            f"about {duration(stage.seconds / workers)}" if stage.todo else None,
        )
        for stage in plan.stages
    ]
    console.table("", ("stage", "to do", "work", "time"), rows)
    for stage in plan.stages:
        if stage.todo:
            more = len(stage.todo) - SHOWN
            listed = ", ".join(stage.todo[:SHOWN]) + (f" and {more} more" if more > 0 else "")
            console.result(f"{stage.stage}: {listed}")
    for sentence in plan.known_failures:
        console.warn(sentence)
    seconds = sum(stage.seconds for stage in plan.stages) / workers
    plural = "" if workers == 1 else "s"
    console.result(f"About {duration(seconds)} with {workers} worker{plural}; nothing was written.")
    return 0


def show_closures(work: Workspace) -> None:
    """The closures of a workspace by pairs of sessions, and where they lie."""
    from semloc_logs.closures.closure_tables import read_closures

    rows = read_closures(work.closures)
    pairs: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        pairs.setdefault((row["query_session"], row["target_session"]), []).append(row)
    drawn = [
        (
            query,
            "itself" if target == query else target,
            len(closures),
            _seconds(closures, "query"),
            f"{min(row['overlap'] for row in closures):.2f}",
            f"{min(row['probability'] for row in closures):.4f}",
        )
        for (query, target), closures in sorted(pairs.items(), key=lambda p: (-len(p[1]), p[0]))
    ]
    if drawn:
        columns = ("query", "in", "closures#", "over (s)", "overlap from#", "probability from#")
        console.table("", columns, drawn[:SHOWN])
    if len(drawn) > SHOWN:
        console.result(f"... and {len(drawn) - SHOWN} more pairs of sessions.")
    alone = sorted({f.name for f in work.sessions()} - {name for pair in pairs for name in pair})
    if rows and alone:
        listed = ", ".join(alone[:SHOWN]) + (" and others" if len(alone) > SHOWN else "")
        console.result(f"Without closures: {listed}")
    console.result(
        f"{len(rows)} loop closures in {work.closures}; the best rejected hypotheses in"
        f" {work.rejected}"
    )
    if not rows:
        from semloc_logs.stages.hints import voxel_size_hint

        if hint := voxel_size_hint(work):
            console.note(hint)
        console.note(f"To see the best rejected hypothesis: semloc show -w {work.path} -o view.png")
    if work.picture.exists():
        console.result(f"Picture: {work.picture}")


def _seconds(rows: list[dict[str, Any]], end: str) -> str:
    """The time from the first to the last closure."""
    stamps_ns = [row[f"{end}_stamp_ns"] for row in rows]
    return f"{(max(stamps_ns) - min(stamps_ns)) / 1e9:.0f}"


def show_trajectory_errors(errors: TrajectoryErrors) -> None:
    """Errors of each session before and after, and of all together."""
    rows = [
        (
            row.session,
            row.frame,
            *(
                "-" if value is None else f"{value:.3f}"
                for value in (row.ate_before_m, row.ate_after_m, row.rpe_before_m, row.rpe_after_m)
            ),
        )
        for row in errors.trajectories
    ]
    columns = ("session", "frame", "ATE before (m)", "after (m)", "RPE before (m)", "after (m)")
    console.table("Trajectories against the truth, each aligned alone", columns, rows)
    if errors.ate_after_m is not None:
        before = "-" if errors.ate_before_m is None else f"{errors.ate_before_m:.3f} m"
        console.result(f"ATE {before} before, {errors.ate_after_m:.3f} m after")


def show_sharpness(sharpness: Sharpness) -> None:
    """The planes of the common map before and after, where sessions meet."""
    figures = [
        f"{100 * planes:.0f} % of the cells are planes, {thickness:.3f} m thick, {when}"
        for planes, thickness, when in (
            (sharpness.planes_before, sharpness.thickness_before_m, "before"),
            (sharpness.planes_after, sharpness.thickness_after_m, "after"),
        )
        if planes is not None and thickness is not None
    ]
    if figures:
        console.result(f"Map in {sharpness.places} places: {'; '.join(figures)}")
