"""Where things are on a sheet: panels by their pixels, letters inside the sheet, the scale bar."""

from __future__ import annotations

import warnings
from hashlib import sha256
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from semloc_logs.errors import WorkspaceError
from semloc_logs.pictures.colours import INK, QUERY, Legend
from semloc_logs.pictures.map_marks import draw_drive, draw_grid, draw_line, round_length
from semloc_logs.pictures.sheet import (
    Lettering,
    Panel,
    Sheet,
    below_each_other,
    write_png,
    write_sheets,
)

RED, BLUE = (200, 10, 10), (10, 10, 200)


def plain(width: int, height: int, colour: tuple[int, int, int]) -> NDArray[np.uint8]:
    return np.full((height, width, 3), colour, np.uint8)


def box_of(image: NDArray[np.uint8], colour: tuple[int, int, int]) -> tuple[int, int, int, int]:
    """Left, top, width and height of the pixels of exactly this colour, which fill it."""
    rows, columns = np.nonzero((image == colour).all(2))
    left, top = int(columns.min()), int(rows.min())
    width, height = int(columns.max()) + 1 - left, int(rows.max()) + 1 - top
    assert len(rows) == width * height
    return left, top, width, height


def test_panels_keep_their_pixels_and_their_order() -> None:
    rows = [[Panel(plain(300, 200, RED), "left"), Panel(plain(100, 150, BLUE))]]
    image = Sheet(rows, Lettering("title")).image()
    left, top, *size = box_of(image, RED)
    assert size == [300, 200]
    assert box_of(image, BLUE) == (left + 300 + 12, top, 100, 150)


def test_rows_stand_one_below_the_other() -> None:
    rows = [[Panel(plain(50, 60, RED))], [Panel(plain(70, 40, BLUE))]]
    image = Sheet(rows, Lettering("title")).image()
    left, top, *size = box_of(image, RED)
    assert size == [50, 60]
    assert box_of(image, BLUE) == (left, top + 60 + 12, 70, 40)


def test_the_picture_of_a_panel_is_not_resampled() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (213, 317, 3)).astype(np.uint8)
    pixels[:1] = pixels[-1:] = RED
    pixels[:, :1] = pixels[:, -1:] = RED
    image = Sheet([[Panel(pixels)]], Lettering("title", ["a fact"], [("x", BLUE)], 0.1)).image()
    rows, columns = np.nonzero((image == RED).all(2))
    top, left = rows.min(), columns.min()
    np.testing.assert_array_equal(image[top : top + 213, left : left + 317], pixels)


def test_axes_of_a_panel_count_its_pixels_downwards() -> None:
    sheet = Sheet([[Panel(plain(400, 300, RED))]], Lettering("title"))
    draw_line(sheet.axes[0][0], np.array([[100.0, 50.0], [200.0, 50.0]]), BLUE, width=3)
    image = sheet.image()
    # the white edge of the line lies on the red panel, whose corner the other test found
    rows, columns = np.nonzero((image == BLUE).all(2))
    top, left = np.argwhere((image == RED).all(2)).min(0)
    assert rows.mean() - top == pytest.approx(50, abs=1)
    assert columns.min() - left == pytest.approx(100, abs=3)
    assert columns.max() - left == pytest.approx(200, abs=3)


@pytest.mark.parametrize("size", [(10, 10), (700, 20), (3000, 2000)])
def test_title_facts_and_legend_stay_inside(size: tuple[int, int]) -> None:
    facts = [f"fact number {n} of a sheet" for n in range(30)]
    legend: Legend = [(f"class number {n}", QUERY) for n in range(25)]
    image = Sheet([[Panel(plain(*size, RED))]], Lettering("name " * 60, facts, legend, 0.3)).image()
    border = np.concatenate(
        [image[:4].reshape(-1, 3), image[-4:].reshape(-1, 3), image[:, 0], image[:, -1]]
    )
    assert (border == 255).all()
    assert box_of(image, RED)[2:] == size


def test_a_name_is_no_formula() -> None:
    names = ["drive $x_1$", "drive a"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        one, other = (
            Sheet([[Panel(plain(9, 9, RED))]], Lettering(n, [n], [(n, BLUE)])).image()
            for n in names
        )
    assert (one[: one.shape[0] // 3] < 128).sum() > (other[: other.shape[0] // 3] < 128).sum()


@pytest.mark.parametrize(
    ("most", "length"),
    [(1.0, 1), (1.99, 1), (2.0, 2), (4.9, 2), (75, 50), (0.03, 0.02), (1e4, 1e4)],
)
def test_round_lengths(most: float, length: float) -> None:
    assert round_length(most) == pytest.approx(length)


@pytest.mark.parametrize(("metres", "pixels"), [(0.1, 200), (1.0, 200), (0.25, 200), (0.05, 200)])
def test_the_scale_bar_is_as_long_as_it_reads(metres: float, pixels: int) -> None:
    """At most 260 pixels: 20 m, 200 m, 50 m, 10 m."""
    image = Sheet([[Panel(plain(1000, 50, RED))]], Lettering("title", metres=metres)).image()
    dark = (np.abs(image.astype(int) - INK).max(2) < 40)[-70:]
    longest = max(
        len(run) for row in dark for run in "".join("x" if d else " " for d in row).split()
    )
    assert longest == pytest.approx(pixels, abs=3)


def test_a_drive_of_no_or_one_point() -> None:
    for line in (np.zeros((0, 2)), np.array([[5.0, 5.0]]), np.array([[5.0, 5.0]] * 3)):
        sheet = Sheet([[Panel(plain(200, 200, RED))]], Lettering("title"))
        draw_drive(sheet.axes[0][0], line, BLUE, QUERY)
        assert bool((sheet.image() == QUERY).all(2).any()) == bool(len(line))


def test_images_below_each_other_and_written(tmp_path: Path) -> None:
    whole = below_each_other([plain(3, 2, RED), plain(5, 1, BLUE)])
    assert whole.shape == (3, 5, 3)
    assert (whole[:2, 3:] == 255).all()
    write_png(tmp_path / "image.png", whole)
    read = cv2.imread(str(tmp_path / "image.png"))
    assert read is not None
    np.testing.assert_array_equal(read[:, :, ::-1], whole)


def two_sheets() -> list[Sheet]:
    return [Sheet([[Panel(plain(200, 100, colour))]], Lettering("title")) for colour in (RED, BLUE)]


@pytest.mark.parametrize(
    ("ending", "start"), [("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")]
)
def test_the_ending_tells_the_format(tmp_path: Path, ending: str, start: bytes) -> None:
    paths = [tmp_path / f"{name}.{ending}" for name in "ab"]
    for path in paths:
        write_sheets(path, two_sheets())
    contents = [path.read_bytes() for path in paths]
    assert contents[0].startswith(start)
    assert sha256(contents[0]).digest() == sha256(contents[1]).digest()
    assert sorted(tmp_path.iterdir()) == paths


def test_an_svg_has_its_sheets_below_each_other(tmp_path: Path) -> None:
    write_sheets(tmp_path / "a.svg", two_sheets())
    root = ElementTree.parse(tmp_path / "a.svg").getroot()
    inner = root.findall("{http://www.w3.org/2000/svg}svg")
    heights = [float(i.attrib["height"]) for i in inner]
    assert [float(i.attrib["viewBox"].split()[3]) for i in inner] == pytest.approx(heights)
    assert [float(i.attrib["y"]) for i in inner] == pytest.approx([0, heights[0]], abs=0.01)
    whole = float(root.attrib["height"].removesuffix("pt"))
    assert whole == pytest.approx(sum(heights), abs=0.01)


def test_another_ending_is_refused(tmp_path: Path) -> None:
    with pytest.raises(WorkspaceError, match=r"does not end in \.png, \.svg, \.pdf"):
        write_sheets(tmp_path / "a.jpg", two_sheets())
    assert not list(tmp_path.iterdir())


def test_a_grid_lies_at_round_coordinates() -> None:
    sheet = Sheet([[Panel(plain(460, 400, (255, 255, 255)))]], Lettering("title", metres=0.1))
    axes = sheet.axes[0][0]
    draw_grid(axes, (-3.0, 98.0), 0.1)  # 46 m x 40 m
    texts = [t.get_text() for t in axes.texts]
    assert texts == ["0 m", "20 m", "40 m", "100 m", "120 m"]
    verticals = [np.asarray(line.get_xdata())[0] for line in axes.lines[:3]]
    assert verticals == pytest.approx([30, 230, 430])
    # y counts pixels downwards
    horizontals = [np.asarray(line.get_ydata())[0] for line in axes.lines[3:]]
    assert horizontals == pytest.approx([380, 180])
