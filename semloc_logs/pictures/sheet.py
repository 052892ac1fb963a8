"""A sheet: panels of pixels under a title, over a scale bar and a legend; matplotlib draws it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backend_bases import RendererBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.text import Text
from matplotlib.transforms import Affine2D, Transform

from semloc_logs.arrays import U8
from semloc_logs.errors import WorkspaceError
from semloc_logs.pictures.colours import INK, SOFT, WHITE, Colour, Legend, web_colour
from semloc_logs.pictures.fonts import written
from semloc_logs.pictures.map_marks import DPI, SMALL, TEXT, scale_bar
from semloc_logs.tables.atomic_files import replacing_file

# Lengths are pixels of a sheet of ordinary size; a large sheet is as much finer (dots per inch), so
# that letters and lines grow with it.
ORDINARY = 1400
NARROWEST = 900  # so that title and legend fit
PAD, GAP = 24, 12
TITLE = 17.0  # points
LINE_HEIGHT = 1.45  # of the letters
BAR_LENGTH, BAR_HEIGHT = 260, 7  # of the scale bar, at most
AXIS_LENGTH = 34
FOOT_HEIGHT = 58  # holds the scale bar and the axes of the map
SWATCH = 46  # of a legend entry: the patch of colour, and the room around it
SEPARATOR = "  |  "
FORMATS = ("png", "svg", "pdf")
VECTOR: Any = {"svg.hashsalt": "semloc", "pdf.fonttype": 42}  # TrueType in a PDF
POINTS = re.compile(r'(width|height)="([\d.]+)pt"')


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """RGB ``picture`` (height, width, 3) with lines of ``caption`` above it."""

    picture: U8
    caption: str = ""


@dataclass(frozen=True, slots=True)
class Lettering:
    """The text of a sheet: ``title``, ``facts`` below it, and ``legend``.

    A sheet with ``metres``, the width of a pixel of its panels, gets a scale bar and map axes.
    """

    title: str
    facts: Sequence[str] = ()
    legend: Legend = field(default_factory=list)
    metres: float | None = None


class _Pixels(Artist):
    """RGB ``picture`` (height, width, 3) as it is, from pixel (left, low) of the figure.

    ``to_canvas`` leads from these pixels to the units of a renderer. Images of matplotlib are
    resampled by floats even then, which takes 100 bytes for each pixel.
    """

    def __init__(self, picture: U8, left: int, low: int, to_canvas: Transform) -> None:
        super().__init__()
        self._picture = picture
        self._corner = (left, low)
        self._to_canvas = to_canvas
        self.set_zorder(-1)  # below the axes

    def draw(self, renderer: RendererBase) -> None:
        """Draw into ``renderer``, whose rows run upwards."""
        rows = cv2.cvtColor(self._picture, cv2.COLOR_RGB2RGBA)[::-1]
        x, y = self._to_canvas.transform(self._corner)
        renderer.draw_image(renderer.new_gc(), round(x, 3), round(y, 3), np.ascontiguousarray(rows))


class Sheet:
    """Rows of panels; ``axes[row][column]`` lie over them and count in pixels, y downwards."""

    def __init__(self, rows: Sequence[Sequence[Panel]], lettering: Lettering) -> None:
        widths = [sum(p.picture.shape[1] for p in row) for row in rows]
        heights = [max((p.picture.shape[0] for p in row), default=0) for row in rows]
        longest = max([*widths, sum(heights), 1])
        self._scale: float = max(1.0, longest / ORDINARY)
        self._figure = Figure(dpi=DPI * self._scale, facecolor=web_colour(WHITE))
        FigureCanvasAgg(self._figure)
        # of pixels of the sheet; SVG and PDF count in points
        self._to_canvas = Affine2D().scale(1 / self._dpi) + self._figure.dpi_scale_trans
        gaps = [self._px(GAP) * max(len(row) - 1, 0) for row in rows]
        body = max([w + g for w, g in zip(widths, gaps, strict=True)], default=0)
        self._width = max(body, self._px(NARROWEST)) + 2 * self._px(PAD)

        # from the bottom up, each part on the one below it
        top = self._px(PAD)
        top += self._legend(lettering.legend, top)
        foot = top
        if lettering.metres is not None:
            top += self._px(FOOT_HEIGHT)
        places = []
        for row, height in zip(reversed(rows), reversed(heights), strict=True):
            places.append(top)
            top += height + self._caption_height(row) + self._px(GAP)
        top = self._heading(lettering, top)
        self._figure.set_size_inches(self._width / self._dpi, top / self._dpi)
        if lettering.metres is not None:
            self._foot(foot, lettering.metres)
        self.axes = [
            self._panels(row, place, height)
            for row, place, height in zip(rows, reversed(places), heights, strict=True)
        ]

    @property
    def _dpi(self) -> float:
        return DPI * self._scale

    def _px(self, length: float) -> int:
        return round(length * self._scale)

    def _line(self, points: float) -> int:
        """Pixels of a line of letters of ``points``."""
        return round(points * LINE_HEIGHT * self._dpi / 72)

    @property
    def _room(self) -> int:
        """Pixels between the left and the right edge."""
        return self._width - 2 * self._px(PAD)

    # -- text

    def _write(self, text: str, x: float, y: float, points: float, colour: Colour = INK) -> Text:
        """One line of text with its lower left corner at pixel (x, y), counted from the bottom."""
        shown, families = written(text)
        return self._figure.text(
            x,
            y,
            shown,
            fontsize=points,
            fontfamily=families,
            color=web_colour(colour),
            va="bottom",
            transform=self._to_canvas,
            parse_math=False,
        )

    def _text_width(self, text: Text) -> float:
        return float(text.get_window_extent().width)

    def _fits(self, text: str, points: float, room: float) -> bool:
        probe = self._write(text, 0, 0, points)
        width = self._text_width(probe)
        probe.remove()
        return width <= room

    def _lines(
        self, text: str, points: float, room: float, glues: Sequence[str] = (SEPARATOR, " ", "")
    ) -> list[str]:
        """``text`` in lines not wider than ``room`` pixels, broken at the first of ``glues``.

        Where that is not enough, parts are broken at the next one; "" is between any letters.
        """
        if not glues or self._fits(text, points, room):
            return [text]
        glue, *rest = glues
        lines: list[str] = []
        for part in text.split(glue) if glue else text:
            longer = f"{lines[-1]}{glue}{part}" if lines else part
            if lines and self._fits(longer, points, room):
                lines[-1] = longer
            else:
                lines += self._lines(part, points, room, rest)
        return lines

    def _heading(self, lettering: Lettering, bottom: int) -> int:
        """Write the title and, below it, the facts; returns the upper edge."""
        bottom += self._px(GAP)
        facts = SEPARATOR.join(lettering.facts)
        for text, points, colour in ((facts, TEXT, SOFT), (lettering.title, TITLE, INK)):
            for line in reversed(self._lines(text, points, self._room)):
                self._write(line, self._px(PAD), bottom, points, colour)
                bottom += self._line(points)
        return bottom + self._px(PAD // 2)

    def _legend(self, entries: Legend, bottom: int) -> int:
        """Draw the legend in as many columns as fit; returns its height."""
        if not entries:
            return 0
        patches = [
            Patch(facecolor=web_colour(c), edgecolor=web_colour(SOFT), linewidth=0.5)
            for _, c in entries
        ]
        probes = [self._write(name, 0, 0, TEXT) for name, _ in entries]
        widest = max(self._text_width(probe) for probe in probes)
        legend = self._figure.legend(
            patches,
            [
                "\n".join(self._lines(p.get_text(), TEXT, self._room - self._px(SWATCH)))
                for p in probes
            ],
            loc="lower left",
            bbox_to_anchor=(self._px(PAD), bottom),
            bbox_transform=self._to_canvas,
            borderaxespad=0,
            borderpad=0,
            frameon=False,
            fontsize=TEXT,
            labelcolor=web_colour(INK),
            ncols=max(1, int(self._room // (widest + self._px(SWATCH)))),
        )
        for text, probe in zip(legend.get_texts(), probes, strict=True):
            text.set_parse_math(False)
            text.set_fontfamily(probe.get_fontfamily())
            probe.remove()
        return round(legend.get_window_extent().height) + self._px(GAP)

    def _caption_height(self, row: Sequence[Panel]) -> int:
        return max(len(p.caption.splitlines()) for p in row) * self._line(SMALL) if row else 0

    # -- panels

    def _area(self, x: int, y: int, width: int, height: int) -> Axes:
        """Bare axes over pixels of the sheet; (x, y) is the lower left corner."""
        whole_width, whole_height = self._figure.get_size_inches() * self._dpi
        axes = self._figure.add_axes(
            (x / whole_width, y / whole_height, width / whole_width, height / whole_height)
        )
        axes.set_axis_off()
        return axes

    def _panels(self, row: Sequence[Panel], bottom: int, row_height: int) -> list[Axes]:
        """Show the pictures of a row, their upper edges at the same height."""
        areas = []
        left = self._px(PAD)
        for panel in row:
            height, width = panel.picture.shape[:2]
            low = bottom + row_height - height
            self._figure.add_artist(_Pixels(panel.picture, left, low, self._to_canvas))
            axes = self._area(left, low, width, height)
            axes.set(xlim=(0, width), ylim=(height, 0), autoscale_on=False)
            for number, line in enumerate(reversed(panel.caption.splitlines())):
                y = bottom + row_height + number * self._line(SMALL)
                self._write(line, left, y, SMALL, SOFT)
            areas.append(axes)
            left += width + self._px(GAP)
        return areas

    # -- the foot

    def _foot(self, bottom: int, metres: float) -> None:
        """A scale bar, and the axes of the map, which has no north: x to the right, y up."""
        axes = self._area(0, bottom, self._width, self._px(FOOT_HEIGHT))
        axes.set(xlim=(0, self._width), ylim=(0, self._px(FOOT_HEIGHT)))
        left = self._px(PAD)
        low = self._px(GAP)
        scale_bar(axes, (left, low), (self._px(BAR_LENGTH), self._px(BAR_HEIGHT)), metres)
        corner = (self._width - left - 2 * self._px(AXIS_LENGTH), low)
        for name, dx, dy in (("x", 1, 0), ("y", 0, 1)):
            tip = (corner[0] + dx * self._px(AXIS_LENGTH), corner[1] + dy * self._px(AXIS_LENGTH))
            axes.annotate(
                "", tip, corner, arrowprops={"arrowstyle": "->", "color": web_colour(INK)}
            )
            axes.annotate(
                name,
                tip,
                (3 * dx - 3 * dy, -2 * dx - 4 * dy),
                textcoords="offset points",
                ha="left" if dx else "right",
                color=web_colour(INK),
                fontsize=SMALL,
            )

    # -- the result

    def image(self) -> U8:
        """RGB (height, width, 3)."""
        return rendered(self._figure)

    def save(self, path: Path) -> None:
        """PNG."""
        write_png(path, self.image())

    def write(self, file: BinaryIO, form: str) -> None:
        """SVG or PDF, the same bytes each time; its letters are outlines or in the file."""
        metadata: dict[str, Any] = {"Date": None} if form == "svg" else {"CreationDate": None}
        with rc_context(VECTOR):
            self._figure.savefig(file, format=form, metadata=metadata)

    @property
    def points(self) -> tuple[float, float]:
        """Width and height in points, as a page has them."""
        width, height = self._figure.get_size_inches()
        return float(width) * 72, float(height) * 72


def rendered(figure: Figure) -> U8:
    """The pixels (height, width, 3) of a figure with a canvas of Agg, RGB."""
    canvas: Any = figure.canvas  # matplotlib's types know only what all canvases have
    canvas.draw()
    return np.asarray(canvas.buffer_rgba(), np.uint8)[:, :, :3].copy()


def write_png(path: Path, image: U8) -> None:
    """RGB ``image`` (height, width, 3) as a PNG that appears complete or not at all."""
    with replacing_file(path) as temporary:
        _, data = cv2.imencode(".png", np.ascontiguousarray(image[:, :, ::-1]))
        temporary.write_bytes(data.tobytes())


def below_each_other(images: Sequence[U8]) -> U8:
    """Images in one column, white beside the narrower ones."""
    width = max(image.shape[1] for image in images)
    return np.vstack(
        [np.pad(i, ((0, 0), (0, width - i.shape[1]), (0, 0)), constant_values=255) for i in images]
    )


def write_sheets(path: Path, sheets: Sequence[Sheet]) -> None:
    """PNG, SVG or PDF by the ending of ``path``, which appears complete or not at all.

    In a PNG and an SVG the sheets are in one column, in a PDF each is a page. WorkspaceError for
    another ending.
    """
    form = path.suffix.lower().removeprefix(".")
    if form not in FORMATS:
        raise WorkspaceError(
            f"{path} does not end in {', '.join(f'.{f}' for f in FORMATS)}: give a name that does."
        )
    if form == "png":
        write_png(path, below_each_other([sheet.image() for sheet in sheets]))
        return
    with replacing_file(path) as temporary, temporary.open("wb") as file:
        if form == "svg":
            file.write(_svg_column(sheets).encode())
        else:
            from matplotlib.backends.backend_pdf import PdfPages

            metadata: dict[str, Any] = {"CreationDate": None}
            # fonts are written at the end
            with rc_context(VECTOR), PdfPages(file, metadata=metadata) as pages:
                for sheet in sheets:
                    sheet.write(pages, form)


def _svg_column(sheets: Sequence[Sheet]) -> str:
    """One SVG with the sheets below each other."""
    parts = []
    top = 0.0
    for sheet in sheets:
        buffer = BytesIO()
        sheet.write(buffer, "svg")
        drawn = buffer.getvalue().decode()
        _, _, after = drawn.partition("<svg ")
        attributes, _, content = after.partition(">")
        # the units of the column are points
        attributes = POINTS.sub(r'\1="\2"', attributes)
        parts.append(f'<svg x="0" y="{top:g}" {attributes}>{content}')
        top += sheet.points[1]
    width = max(sheet.points[0] for sheet in sheets)
    size = f'width="{width:g}pt" height="{top:g}pt" viewBox="0 0 {width:g} {top:g}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" version="1.1" {size}>'
    return "\n".join(['<?xml version="1.0" encoding="utf-8"?>', head, *parts, "</svg>\n"])
