"""A figure laid out as Fig. 5 of the paper: left the scenarios by heading, right the matrix of
times; each with the share of queries within an error, and rank-recall at 1 m and 5 m.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from semloc_logs.experiments.answers import Answers
from semloc_logs.experiments.measures import THRESHOLDS_M, error_curve, rank_recall
from semloc_logs.experiments.scenarios import Scenario
from semloc_logs.experiments.summary_table import Outcome, Row
from semloc_logs.experiments.system import MOST_POSES
from semloc_logs.tables.atomic_files import replacing_file

_MOST_ERROR_M = 10.0  # of the error curves
_PANEL_IN = 2.1  # inches
_ROWS = 3  # panels of a scenario by heading above each other
_COLOURS = 10  # of matplotlib's cycle; then the next style of lines
_STYLES = ("-", "--", ":", "-.")


def draw_figure(outcome: Outcome, sensor: str, path: Path) -> None:
    """The figure of one sensor, as PNG; its columns are the scenarios that have queries."""
    scenarios = [s for s in outcome.scenarios[sensor] if s.trials]
    headings = [s for s in scenarios if ">" not in s.name]
    matrix = [s for s in scenarios if ">" in s.name]
    maps = list(dict.fromkeys(s.name.partition(">")[0] for s in matrix))
    queries = list(dict.fromkeys(s.name.partition(">")[2] for s in matrix))
    rows_of_matrix = len(maps)
    width = _PANEL_IN * (len(headings) + len(queries) + 0.5)
    height = _PANEL_IN * max(_ROWS, rows_of_matrix) + 1.2
    figure = Figure(figsize=(max(width, 5.0), height), layout="constrained")
    grid = figure.add_gridspec(
        1, 2, width_ratios=[max(1, len(headings)), max(0.01, len(queries))], wspace=0.02
    )
    shown = [row for row in outcome.rows if any(s == sensor for s, _ in row.answers)]
    if headings:
        part = figure.add_subfigure(grid[0, 0])
        _draw_headings(part.subplots(_ROWS, len(headings), squeeze=False), headings, shown, sensor)
        part.suptitle("viewpoint", fontsize=10)
    if matrix:
        part = figure.add_subfigure(grid[0, 1])
        # a small matrix has panels of the same height
        axes = part.subplots(max(_ROWS, rows_of_matrix), len(queries), squeeze=False)
        _draw_matrix(axes, maps, queries, matrix, shown, sensor)
        part.suptitle("time (row: database, column: query)", fontsize=10)
    handles = [Line2D([], [], label=row.title, **_style(k)) for k, row in enumerate(shown)]
    if handles:
        figure.legend(
            handles=handles,
            loc="outside lower center",
            ncols=max(1, min(len(handles), int(width / 1.7))),
            fontsize=7,
            frameon=False,
        )
    with replacing_file(path, ".png") as temporary:
        figure.savefig(temporary, dpi=150)


def _draw_headings(
    axes: NDArray[np.object_], scenarios: Sequence[Scenario], rows: Sequence[Row], sensor: str
) -> None:
    for column, scenario in enumerate(scenarios):
        top, first, second = axes[:, column]
        top.set_title(f"{scenario.name}° ({_counted(scenario)})", fontsize=9)
        _errors(top, rows, sensor, scenario.name)
        for panel, threshold in ((first, THRESHOLDS_M[0]), (second, THRESHOLDS_M[1])):
            _ranks(panel, rows, sensor, scenario.name, threshold)
        if column == 0:
            top.set_ylabel("localised", fontsize=8)
            first.set_ylabel(f"recall at {THRESHOLDS_M[0]:g} m", fontsize=8)
            second.set_ylabel(f"recall at {THRESHOLDS_M[1]:g} m", fontsize=8)


def _draw_matrix(
    axes: NDArray[np.object_],
    maps: Sequence[str],
    queries: Sequence[str],
    scenarios: Sequence[Scenario],
    rows: Sequence[Row],
    sensor: str,
) -> None:
    known = {scenario.name: scenario for scenario in scenarios}
    for row in axes[len(maps) :]:
        for panel in row:
            panel.set_axis_off()
    for i, database in enumerate(maps):
        for j, query in enumerate(queries):
            panel = axes[i, j]
            name = f"{database}>{query}"
            if name not in known:
                panel.set_axis_off()
                continue
            _errors(panel, rows, sensor, name)
            title = _counted(known[name])
            panel.set_title(f"{query} ({title})" if i == 0 else title, fontsize=9)
            if j == 0:
                panel.set_ylabel(f"{database}: localised", fontsize=8)
            if i < len(maps) - 1:
                panel.set_xlabel("")


def _counted(scenario: Scenario) -> str:
    count = len(scenario.queries)
    return f"{count} {'query' if count == 1 else 'queries'}"


def _errors(panel: Axes, rows: Sequence[Row], sensor: str, scenario: str) -> None:
    thresholds = np.linspace(0.0, _MOST_ERROR_M, 101)
    for number, answers in _lines(rows, sensor, scenario):
        panel.plot(thresholds, error_curve(answers.first_m, thresholds), **_style(number))
    _frame(panel, (0.0, _MOST_ERROR_M), "error (m)")


def _ranks(panel: Axes, rows: Sequence[Row], sensor: str, scenario: str, threshold: float) -> None:
    ranks = np.arange(1, MOST_POSES + 1)
    for number, answers in _lines(rows, sensor, scenario):
        panel.plot(ranks, rank_recall(answers.errors_m, threshold), **_style(number))
    panel.set_xscale("log")
    _frame(panel, (1.0, float(MOST_POSES)), "rank")
    panel.set_xticks([1, 10, 100], ["1", "10", "100"])


def _lines(rows: Sequence[Row], sensor: str, scenario: str) -> list[tuple[int, Answers]]:
    return [
        (k, row.answers[sensor, scenario])
        for k, row in enumerate(rows)
        if (sensor, scenario) in row.answers and len(row.answers[sensor, scenario])
    ]


def _style(number: int) -> dict[str, Any]:
    return {
        "color": f"C{number % _COLOURS}",
        "linestyle": _STYLES[number // _COLOURS % len(_STYLES)],
        "linewidth": 1.2,
    }


def _frame(panel: Axes, extent: tuple[float, float], label: str) -> None:
    panel.set_xlim(*extent)
    panel.set_ylim(-0.02, 1.02)
    panel.set_xlabel(label, fontsize=8)
    panel.tick_params(labelsize=7)
    panel.grid(alpha=0.3, linewidth=0.5)
