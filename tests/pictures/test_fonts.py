"""Names in any script: the letters come from whichever installed font has them."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

import pytest
from fontTools.fontBuilder import FontBuilder
from fontTools.pens.ttGlyphPen import TTGlyphPen
from matplotlib.font_manager import fontManager

from semloc_logs.pictures import fonts
from semloc_logs.pictures.fonts import FAMILY, REPLACEMENT, written

LETTER = "\U000f1234"  # of private use: no font of the machine has it


def font_with(letter: str, family: str, path: Path) -> None:
    """A font whose only letter is a square."""
    pen = TTGlyphPen(None)
    pen.moveTo((0, 0))
    for corner in ((0, 700), (700, 700), (700, 0)):
        pen.lineTo(corner)
    pen.closePath()
    square = pen.glyph()
    builder = FontBuilder(1000)
    builder.setupGlyphOrder([".notdef", "square"])
    builder.setupCharacterMap({ord(letter): "square"})
    builder.setupGlyf({".notdef": square, "square": square})
    builder.setupHorizontalMetrics({".notdef": (800, 0), "square": (800, 0)})
    builder.setupHorizontalHeader(ascent=800, descent=-200)
    builder.setupNameTable({"familyName": family, "styleName": "Regular"})
    builder.setupOS2()
    builder.setupPost()
    builder.save(path)


@pytest.fixture
def installed(tmp_path: Path) -> Iterator[str]:
    """The family of a font that has LETTER, for the length of a test."""
    path = tmp_path / "squares.ttf"
    font_with(LETTER, "Squares", path)
    before = list(fontManager.ttflist)
    fonts._family_of.cache_clear()
    fontManager.addfont(path)
    yield "Squares"
    fontManager.ttflist[:] = before
    fonts._family_of.cache_clear()


@pytest.mark.parametrize("name", ["monday_2", "Straße 5", "Поездка", "διαδρομή", "$x$_1"])
def test_common_scripts_need_one_font(name: str) -> None:
    assert written(name) == (name, [FAMILY])


def test_a_rare_letter_comes_from_the_font_that_has_it(installed: str) -> None:
    assert written(f"a{LETTER}b{LETTER}") == (f"a{LETTER}b{LETTER}", [FAMILY, installed])


def test_a_letter_of_no_font_is_replaced_and_noted_once(caplog: pytest.LogCaptureFixture) -> None:
    fonts._family_of.cache_clear()
    with caplog.at_level(logging.WARNING):
        assert written(f"a{LETTER}") == (f"a{REPLACEMENT}", [FAMILY])
        assert written(LETTER)[0] == REPLACEMENT
    assert [r.levelname for r in caplog.records] == ["WARNING"]
    assert "U+F1234" in caplog.text


def test_control_characters_are_replaced() -> None:
    assert written("a\nb\x1b") == (f"a{REPLACEMENT}b{REPLACEMENT}", [FAMILY])
