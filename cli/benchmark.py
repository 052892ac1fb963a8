"""semloc benchmark."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .console import console
from .options import Command, console_options, json_option, settings_options

if TYPE_CHECKING:
    from semloc_logs.settings import Settings


@click.command(cls=Command)
@click.argument("name", metavar="NAME")
@click.argument("logs", metavar="[LOG]...", nargs=-1, type=click.Path(path_type=Path))
@click.option("--truth", type=click.Path(path_type=Path), help="Truth file of the logs, for words.")
@json_option
@settings_options
@console_options
def command(name: str, logs: tuple[Path, ...], truth: Path | None, as_json: bool, settings: Settings) -> int:
    """Figures of speed and quality, measured here and now, beside what else does the same.

    NAME is reading, fusion, encoder, search or annotate (on simulated data), pipeline (seconds, memory and profile of a run on the
    LOGs), or words (recall of word matches between two LOGs whose truth is known, trained weights beside random ones). Close other
    programs first: times are wall-clock.

    \b
    Example:  semloc benchmark reading --json
              semloc benchmark pipeline monday.mcap tuesday.bag
              semloc benchmark words monday.mcap tuesday.bag --truth truth.json
    """
    rows: list[tuple[float, int, str]] = []
    figures: dict[str, dict[str, Any]]
    if name == "words" and (len(logs) != 2 or truth is None):
        raise click.UsageError("words needs two logs and --truth FILE.")
    if name == "pipeline" and not logs:
        raise click.UsageError("pipeline needs at least one log.")
    with console.progress():
        if name == "pipeline":
            from semloc_logs.profiling import profile_pipeline

            figures, rows = profile_pipeline(logs, settings)
        elif name == "words" and truth is not None:
            from semloc_logs.profiling import word_recalls

            figures = word_recalls(logs, truth, settings)
        else:
            from semloc_logs.evaluation.benchmarks import run_benchmark

            figures = run_benchmark(name, settings)
    if as_json:
        console.result_json(figures)
        return 0
    peers = list(dict.fromkeys(p for row in figures.values() for p in row if p not in ("ours", "unit")))
    drawn = [(figure, *(_number(row.get(column)) for column in ("ours", *peers)), str(row["unit"])) for figure, row in figures.items()]
    console.table(name, ("figure", "ours#", *(f"{p}#" for p in peers), "unit"), drawn)
    if rows:
        console.table(
            "where the time goes", ("s#", "calls#", "function"), [(f"{own:.2f}", str(calls), where) for own, calls, where in rows]
        )
    return 0


def _number(value: float | str | None) -> str | None:
    return f"{value:.4g}" if isinstance(value, int | float) else value
