"""Output that several commands share: closures as a table, and skipped input."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from .console import console

if TYPE_CHECKING:
    from semloc_logs.stages.report import Report
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


def show_closures(work: Workspace) -> None:
    """The closures of a workspace as a table, and where they lie."""
    import numpy as np

    from semloc_logs.closures.closure_tables import read_closures

    rows = read_closures(work.closures)
    drawn = []
    for r in rows[:SHOWN]:
        yaw = np.degrees(2 * np.arctan2(r["q_z"], r["q_w"]))
        drawn.append(
            (
                r["query_session"],
                f"{r['query_stamp_ns'] / 1e9:.1f}",
                r["target_session"],
                f"{r['target_stamp_ns'] / 1e9:.1f}",
                f"{np.linalg.norm([r['t_x'], r['t_y'], r['t_z']]):.2f}",
                f"{(yaw + 180) % 360 - 180:.0f}",
                f"{r['overlap']:.2f}",
                f"{r['probability']:.4f}",
            )
        )
    if rows:
        columns = (
            "query",
            "stamp (s)",
            "target",
            "stamp (s)",
            "apart (m)",
            "yaw (deg)",
            "overlap#",
            "probability#",
        )
        console.table("", columns, drawn)
    if len(rows) > SHOWN:
        console.result(f"... and {len(rows) - SHOWN} more.")
    console.result(
        f"{len(rows)} loop closures in {work.closures}; the best rejected hypotheses in"
        f" {work.rejected}"
    )
    if not rows:
        console.note(f"To see the best rejected hypothesis: semloc show -w {work.path} -o view.png")
    if work.picture.exists():
        console.result(f"Picture: {work.picture}")
