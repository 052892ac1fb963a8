"""Marks over a map: lines, a drive with its direction, a scale bar, an ellipse."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.markers import MarkerStyle
from matplotlib.patches import Ellipse, Rectangle
from matplotlib.patheffects import Normal, Stroke
from matplotlib.transforms import Affine2D

from semloc_logs.arrays import F64
from semloc_logs.pictures.colours import GRID, INK, SOFT, WHITE, Colour, web_colour

DPI = 100  # of a sheet of ordinary size; lengths of pixels are at this resolution
TEXT, SMALL = 10.0, 9.0  # points
ARROW_EVERY = 130  # pixels along a drive
ARROW_TAIL = 9  # pixels over which an arrow takes its direction
GRID_EVERY = 230  # pixels between lines of the grid, at most
ENDS_APART = 30  # pixels between start and end, where both are marked
SIGMAS = 2.0  # standard deviations that an ellipse shows
LEAST_VARIANCE = 1e-12  # m^2, so that an ellipse has an extent
# pixels of the box of an ellipse: its edge, its distance from the corner, how far below its upper
# edge the ellipse and its bar are, the longer half axis, the longest bar
BOX, BOX_MARGIN, BOX_CENTRE, BAR_HEIGHT, HALF_AXIS, BOX_BAR = 132, 10, 50, 100, 38, 90


def round_length(most: float) -> float:
    """The greatest of 1, 2 and 5 times a power of ten that is not above ``most`` > 0."""
    power = 10.0 ** np.floor(np.log10(most))
    return float(max(m * power for m in (1, 2, 5) if m * power <= most))


def scale_bar(
    axes: Axes, corner: tuple[float, float], size: tuple[float, float], metres: float
) -> None:
    """A bar of a round length, at most ``size`` (width, height) pixels of ``metres`` each."""
    length = round_length(size[0] * metres)
    width = length / metres
    x, y = corner
    quarter = width / 4
    for k in range(4):
        fill = web_colour(INK if k % 2 == 0 else WHITE)
        axes.add_patch(
            Rectangle(
                (x + k * quarter, y), quarter, size[1], facecolor=fill, edgecolor=web_colour(INK)
            )
        )
    unit, shown = ("m", length) if length < 1000 else ("km", length / 1000)
    for end, text in ((x, "0"), (x + width, f"{shown:g} {unit}")):
        axes.annotate(
            text,
            (end, y + size[1]),
            (0, 3),
            textcoords="offset points",
            ha="center" if end > x else "left",
            color=web_colour(INK),
            fontsize=SMALL,
        )


def draw_grid(axes: Axes, low: tuple[float, float], metres: float) -> None:
    """Lines at round coordinates with their values along the left and the lower edge.

    ``low`` is the place (x, y) at the lower left corner, a pixel is ``metres`` wide.
    """
    pixel = _pixel(axes)
    width = axes.get_xlim()[1]
    height = axes.get_ylim()[0]
    step = round_length(GRID_EVERY * pixel * metres)
    for axis, extent in enumerate((width, height)):
        first = np.ceil(low[axis] / step) * step
        for value in np.arange(first, low[axis] + extent * metres, step):
            position = (value - low[axis]) / metres
            text = f"{value / 1000:g} km" if step >= 1000 else f"{value + 0.0:.9g} m"
            shared: dict[str, Any] = {
                "textcoords": "offset points",
                "color": web_colour(SOFT),
                "fontsize": SMALL,
                "path_effects": [Stroke(linewidth=2.5, foreground="white"), Normal()],
            }
            style: dict[str, Any] = {"color": web_colour(GRID), "linewidth": 0.6, "zorder": 0.5}
            if axis == 0:
                axes.axvline(position, **style)
                axes.annotate(text, (position, height), (3, 3), **shared)
            else:
                axes.axhline(height - position, **style)
                axes.annotate(text, (0, height - position), (3, 3), **shared)


def draw_line(axes: Axes, line: F64, colour: Colour, width: float = 2.0) -> None:
    """A line (n, 2) with a white edge."""
    axes.plot(
        line[:, 0],
        line[:, 1],
        color=web_colour(colour),
        linewidth=width,
        solid_joinstyle="round",
        path_effects=[Stroke(linewidth=2 * width, foreground="white"), Normal()],
    )


def draw_drive(axes: Axes, line: F64, colour: Colour, start: Colour) -> None:
    """The drive ``line`` (n, 2) in pixels, arrows along it, and where it starts and ends."""
    if not len(line):
        return
    draw_line(axes, line, colour)
    pixel = _pixel(axes)
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))]
    for way in np.arange(ARROW_EVERY * pixel / 2, along[-1], ARROW_EVERY * pixel):
        tail, tip = (
            np.array([np.interp(s, along, line[:, k]) for k in (0, 1)])
            for s in (max(0.0, way - ARROW_TAIL * pixel), way)
        )
        turn = float(np.arctan2(tail[1] - tip[1], tip[0] - tail[0]))  # y points down
        axes.plot(
            *tip,
            marker=MarkerStyle(">", transform=Affine2D().rotate(turn)),
            color=web_colour(colour),
            markeredgecolor="white",
            markersize=9,
        )
    if np.linalg.norm(line[-1] - line[0]) > ENDS_APART * pixel:
        _end_of_drive(axes, line[-1], colour, "end")
    _end_of_drive(axes, line[0], start, "start")


def _end_of_drive(axes: Axes, place: F64, colour: Colour, text: str) -> None:
    """A dot and its name."""
    axes.plot(*place, "o", color=web_colour(colour), markeredgecolor="white", markersize=10)
    axes.annotate(
        text,
        (place[0], place[1]),
        (9, 0),
        textcoords="offset points",
        va="center",
        color=web_colour(colour),
        fontsize=TEXT,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.5},
    )


def draw_ellipse(axes: Axes, covariance: F64, colour: Colour) -> None:
    """The ellipse of ``covariance`` (2, 2) of x and y, enlarged, with its scale, in a corner."""
    pixel = _pixel(axes)
    box = BOX * pixel
    x = axes.get_xlim()[1] - box - BOX_MARGIN * pixel
    y = axes.get_ylim()[0] - box - BOX_MARGIN * pixel  # y points down
    axes.add_patch(Rectangle((x, y), box, box, facecolor="white", edgecolor=web_colour(SOFT)))

    values, vectors = np.linalg.eigh(covariance)
    short, long = SIGMAS * np.sqrt(np.maximum(values, LEAST_VARIANCE))
    scale = HALF_AXIS * pixel / long  # pixels a metre
    centre = (x + box / 2, y + BOX_CENTRE * pixel)
    angle = float(np.degrees(np.arctan2(-vectors[1, 1], vectors[0, 1])))
    size = (2 * long * scale, 2 * short * scale)
    shade = web_colour(colour)
    axes.add_patch(Ellipse(centre, *size, angle=angle, facecolor=shade, alpha=0.25))
    axes.add_patch(Ellipse(centre, *size, angle=angle, fill=False, edgecolor=shade))

    length = round_length(BOX_BAR * pixel / scale)
    ends = centre[0] + np.array([-0.5, 0.5]) * length * scale
    axes.plot(ends, [y + BAR_HEIGHT * pixel] * 2, color=web_colour(INK))
    axes.annotate(
        f"{length * 100:g} cm, {SIGMAS:g} sigma",
        (centre[0], y + BAR_HEIGHT * pixel),
        (0, -4),
        textcoords="offset points",
        ha="center",
        va="top",
        color=web_colour(INK),
        fontsize=SMALL,
    )


def _pixel(axes: Axes) -> float:
    """Pixels of the sheet that ``axes`` lie on, for one of a sheet of ordinary size."""
    figure = axes.get_figure(root=True)
    return figure.dpi / DPI if figure else 1.0
