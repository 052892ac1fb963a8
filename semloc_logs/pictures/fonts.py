"""Fonts for names in any script: those installed that have the letters of a text."""

from __future__ import annotations

import logging
import unicodedata
from functools import cache

from matplotlib.font_manager import FontProperties, findfont, fontManager, get_font

LOGGER = logging.getLogger(__name__)
FAMILY = "DejaVu Sans"  # comes with matplotlib: Latin, Greek, Cyrillic and more
REPLACEMENT = "\N{REPLACEMENT CHARACTER}"
NOT_DRAWN = ("Cc", "Cs", "Zl", "Zp")  # Unicode categories: controls, halves of letters, line ends
PLACEHOLDERS = "Last Resort"  # a font with a picture of its script in place of each letter


@cache
def _has_letter(path: str, letter: str) -> bool:
    return get_font(path).get_char_index(ord(letter)) != 0


@cache
def _family_of(letter: str) -> str | None:
    """An installed font family with an upright face that has ``letter``; None without one."""
    if _has_letter(findfont(FontProperties(family=FAMILY)), letter):
        return FAMILY
    faces = {(f.name, f.fname) for f in fontManager.ttflist if f.style == "normal"}
    for family, path in sorted(faces):
        if family.startswith(PLACEHOLDERS):
            continue
        try:
            if _has_letter(path, letter):
                return family
        except (OSError, RuntimeError):  # a damaged font file of the machine
            continue
    LOGGER.warning(
        "No installed font has the letter %r (U+%04X): pictures show %s in its place.",
        letter,
        ord(letter),
        REPLACEMENT,
    )
    return None


def written(text: str) -> tuple[str, list[str]]:
    """``text`` as it can be drawn on one line, and the font families that its letters need.

    Control characters and letters that no font has become the replacement character.
    """
    families = [FAMILY]
    letters = []
    for letter in text:
        family = None if unicodedata.category(letter) in NOT_DRAWN else _family_of(letter)
        letters.append(letter if family else REPLACEMENT)
        if family and family not in families:
            families.append(family)
    return "".join(letters), families
