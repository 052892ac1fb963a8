"""Where the time of `semloc run` goes: seconds of each stage, peak memory, and the functions that take most of it."""

from __future__ import annotations

import cProfile
import pstats
import resource
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from semloc_logs.engines import make_engine
from semloc_logs.settings import Settings
from semloc_logs.stages import run, session_name
from semloc_logs.tables import read_metadata
from semloc_logs.workspace import Workspace

Figures = dict[str, dict[str, float | str]]


def profile_pipeline(logs: Sequence[Path], settings: Settings, functions: int = 12) -> tuple[Figures, list[tuple[float, int, str]]]:
    """Run the pipeline on ``logs`` in this process in a fresh workspace.

    Returns the figures (seconds of each stage, seconds a query, peak resident memory in MB) and, for the ``functions`` that took most
    time themselves, seconds, calls and where they are. The profiler adds some percent to code that calls many small functions.
    """
    with tempfile.TemporaryDirectory(prefix="semloc-profile-") as folder:
        work = Workspace(Path(folder))
        profiler = cProfile.Profile()
        report = profiler.runcall(
            run, {session_name(log): [log] for log in logs}, work, settings, {}, make_engine("serial"), lambda _: None
        )
        queries = int(read_metadata(work.closures)["queries"])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024 if sys.platform.startswith("linux") else 1024**2)
    figures: Figures = {f"{stage}": {"ours": seconds, "unit": "s"} for stage, seconds in report.seconds.items()}
    figures["query"] = {"ours": report.seconds["close"] / max(queries, 1), "unit": "s a query"}
    figures["memory"] = {"ours": round(peak, 1), "unit": "MB peak"}
    figures["closures"] = {"ours": float(report.closures), "unit": ""}
    stats = pstats.Stats(profiler).stats  # type: ignore[attr-defined]
    rows = sorted(((own, calls, _place(where)) for where, (_, calls, own, _, _) in stats.items()), reverse=True)
    return figures, rows[:functions]


def _place(where: tuple[str, int, str]) -> str:
    path, line, name = where
    return name if line == 0 else f"{'/'.join(Path(path).parts[-2:])}:{line} {name}"
