"""The reliability diagram of a calibration: how often alignments are right at each probability."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from semloc_logs.pictures.colours import GRID, INK, QUERY, SOFT, TARGET, Colour, web_colour
from semloc_logs.pictures.map_marks import DPI, SMALL, TEXT
from semloc_logs.pictures.sheet import rendered, write_png

SIZE = 9.0  # inches
LINES = (SOFT, QUERY, TARGET)
LIMITS = (0.0005, 0.9995)
TICKS = (0.001, 0.01, 0.1, 0.5, 0.9, 0.99, 0.999)
ADDED = 2  # to right and to wrong alignments of a bin (Agresti and Coull, 1998)

Bin = Mapping[str, float]


def draw_reliability(path: Path, curves: Mapping[str, Sequence[Bin]]) -> None:
    """PNG with one line for each of the ``curves``, of bins ``mean``, ``right``, ``alignments``.

    The axes are log-odds. The vertical strokes are one standard deviation of a binomial share
    (Agresti and Coull, 1998).
    """
    figure = Figure(figsize=(SIZE, SIZE), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set(xscale="logit", yscale="logit", xlim=LIMITS, ylim=LIMITS, aspect="equal")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_ticks(TICKS, [f"{tick:g}" for tick in TICKS])
        axis.set_ticks([], minor=True)
    axes.grid(color=web_colour(GRID))
    axes.set_axisbelow(True)
    axes.set_xlabel("probability", fontsize=TEXT)
    axes.set_ylabel("share that is right; numbers: alignments", fontsize=TEXT)
    axes.plot(LIMITS, LIMITS, color=web_colour(INK), linewidth=1)
    for (name, bins), colour in zip(curves.items(), LINES, strict=False):
        _draw_curve(axes, name, bins, colour)
    axes.legend(loc="upper left", frameon=False, fontsize=TEXT)
    write_png(path, rendered(figure))


def _draw_curve(axes: Axes, name: str, bins: Sequence[Bin], colour: Colour) -> None:
    """A line through the bins, with the uncertainty and the number of alignments of each."""
    shade = web_colour(colour)
    probability = np.array([b["mean"] for b in bins])
    share = np.array([b["right"] for b in bins])
    count = np.array([b["alignments"] for b in bins])
    x, y = np.clip([probability, share], *LIMITS)
    axes.plot(x, y, "o-", markersize=6, color=shade, label=name, clip_on=False)

    smoothed = (share * count + ADDED) / (count + 2 * ADDED)
    spread = np.sqrt(smoothed * (1 - smoothed) / (count + 2 * ADDED))
    ends = np.clip([smoothed - spread, smoothed + spread], *LIMITS)
    axes.vlines(x, *ends, color=shade, linewidth=1)
    for place, n in zip(zip(x, y, strict=True), count, strict=True):
        axes.annotate(
            f"{n:.0f}", place, (6, -10), textcoords="offset points", color=shade, fontsize=SMALL
        )
