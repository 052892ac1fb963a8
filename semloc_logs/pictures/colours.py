"""The colours of all pictures, RGB: of lines and letters, and of classes with their names."""

from __future__ import annotations

from functools import cache

import numpy as np

from semloc_logs.arrays import U8
from semloc_logs.labels.space import GROUND, UNLABELLED, cityscapes

Colour = tuple[int, int, int]
Legend = list[tuple[str, Colour]]

INK = (35, 35, 40)
SOFT = (95, 95, 105)
GRID = (225, 225, 225)
WHITE = (255, 255, 255)

# of a single map
DRIVE = (214, 39, 40)
START = (20, 120, 50)

# of two maps, one laid on the other
QUERY = (214, 120, 20)
TARGET = (20, 90, 200)
PALE = (205, 205, 210)  # to which a map fades under another one
CLOSURE = (214, 39, 40)

# of the drives and maps of several sessions, told apart also without red and green
SESSIONS: tuple[Colour, ...] = (
    (0, 114, 178),
    (204, 110, 0),
    (0, 140, 105),
    (163, 65, 138),
    (122, 106, 0),
    (70, 150, 200),
    (110, 60, 200),
    (120, 70, 40),
)

# of a query's voxels, by the map that they are laid on
ALIGNED = (34, 139, 84)
IN_FREE_SPACE = (214, 39, 40)
UNOBSERVED = (240, 170, 60)

UNKNOWN_CLASS = (176, 176, 176)
# the ground is lighter than in Cityscapes, and what geometry tells is told apart
GROUND_COLOURS = ((196, 196, 200), (222, 214, 204), (206, 220, 194))
BUILDING_COLOUR = (104, 92, 92)
POLE_COLOUR = (148, 84, 176)
UNLABELLED_COLOUR = (150, 166, 190)
# what labels from geometry can tell, by the class ids of Cityscapes
GEOMETRY_NAMES = {0: "ground", 2: "wall-like", 5: "pole-like", 8: "vegetation-like"}


@cache
def class_colours() -> U8:
    """RGB (256, 3) of class ids: the colours of Cityscapes, with the ground in light greys.

    Read-only, as all callers share it.
    """
    table = np.full((256, 3), UNKNOWN_CLASS, np.uint8)
    table[: len(cityscapes().colours)] = cityscapes().colours
    table[list(GROUND)] = GROUND_COLOURS
    table[2] = BUILDING_COLOUR
    table[5] = POLE_COLOUR
    table[UNLABELLED] = UNLABELLED_COLOUR
    table.flags.writeable = False
    return table


def class_name(label: int, label_source: str) -> str:
    """The name of a class id in a legend, for labels from ``label_source``."""
    if label_source == "geometry" and label in GEOMETRY_NAMES:
        return GEOMETRY_NAMES[label]
    names = cityscapes().names
    return names[label] if label < len(names) else "class unknown"


def class_legend(labels: U8, label_source: str = "") -> Legend:
    """Names and colours of the classes among ``labels`` (any shape), the most frequent first."""
    counts = np.bincount(labels.ravel(), minlength=256)
    present = sorted(np.flatnonzero(counts).tolist(), key=lambda label: (-counts[label], label))
    colours = class_colours()
    return [(class_name(c, label_source), rgb(colours[c])) for c in present]


def rgb(colour: U8) -> Colour:
    """A row (3,) of a table of colours."""
    red, green, blue = colour.tolist()
    return red, green, blue


def web_colour(colour: Colour) -> str:
    """The colour as matplotlib takes it: ``#rrggbb``."""
    return "#{:02x}{:02x}{:02x}".format(*colour)
