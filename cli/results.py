"""Output that several commands share: closures as a table, and skipped input."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .console import console

if TYPE_CHECKING:
    from semloc_logs.stages.inputs import SessionInput
    from semloc_logs.stages.report import Report
    from semloc_logs.workspace import Workspace

    from .options import PoseChoice

SHOWN = 20  # rows of a table; files have them all


def session_inputs(
    logs: Iterable[Path],
    topics: Mapping[str, str] | None = None,
    poses: PoseChoice | None = None,
) -> list[SessionInput]:
    """Each log is a session; UsageError when two have the same name."""
    from semloc_logs.stages.inputs import SessionInput, session_name

    by_name: dict[str, Path] = {}
    for log in logs:
        name = checked_name(session_name(log))
        if name in by_name:
            raise click.UsageError(
                f"{by_name[name]} and {log} would both be session '{name}':"
                " rename one, or fuse them one by one with --session."
            )
        by_name[name] = log
    files = {} if poses is None else poses.by_session(by_name)
    return [
        SessionInput(name, (log,), topics or {}, files.get(name)) for name, log in by_name.items()
    ]


def checked_name(name: str) -> str:
    """A session's name; UsageError when it cannot be a folder's."""
    from semloc_logs.errors import WorkspaceError
    from semloc_logs.workspace import checked_name as checked

    try:
        return checked(name)
    except WorkspaceError as error:
        raise click.UsageError(str(error)) from None


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
