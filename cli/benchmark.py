"""semloc benchmark."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from .console import console
from .options import Command, console_options, json_option, settings_options

if TYPE_CHECKING:
    from semloc_logs.settings import Settings


@click.command(cls=Command)
@click.argument("name", metavar="NAME")
@json_option
@settings_options
@console_options
def command(name: str, as_json: bool, settings: Settings) -> int:
    """Figures of speed, measured here and now on simulated data, beside what else does the same.

    NAME is reading, fusion, encoder, search or annotate. Close other programs first: the figures are wall-clock time.

    \b
    Example:  semloc benchmark reading --json
    """
    from semloc_logs.evaluation.benchmarks import run_benchmark

    with console.progress():
        figures = run_benchmark(name, settings)
    if as_json:
        console.result_json(figures)
        return 0
    peers = list(dict.fromkeys(p for row in figures.values() for p in row if p not in ("ours", "unit")))
    drawn = [(figure, *(_number(row.get(column)) for column in ("ours", *peers)), row["unit"]) for figure, row in figures.items()]
    console.table(name, ("figure", "ours#", *(f"{p}#" for p in peers), "unit"), drawn)
    return 0


def _number(value: float | str | None) -> str | None:
    return f"{value:.4g}" if isinstance(value, int | float) else value
