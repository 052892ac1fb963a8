"""Drawings of closures and drives as values, which each encoding only writes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, auto

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.logs.annotation.scene import Colour, Drive

LINES_A_SPHERE = 5  # lines are so many times thinner than a sphere
NAME_SIZE = 2.0  # height of the name of a drive, in diameters of a sphere


class Shape(Enum):
    """What a marker draws."""

    SPHERE = auto()
    SPHERES = auto()
    LINE_STRIP = auto()
    LINE_LIST = auto()  # a line for each two points
    TEXT = auto()


@dataclass(frozen=True, slots=True, eq=False)
class Marker:
    """A drawing at ``points`` (n, 3), one point for a sphere or a text.

    ``size`` (m) is the diameter of spheres, the width of lines, the height of a text. ``kind`` is a
    name as ``semloc/places``. ``colors`` has one for each point, or none where all have ``color``.
    """

    shape: Shape
    kind: str
    points: F64
    size: float
    color: Colour = (1.0, 1.0, 1.0, 1.0)
    colors: Sequence[Colour] = ()
    text: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class MarkerGroup:
    """Markers of one thing in the frame ``frame_id``, which are replaced together.

    ``name`` is unique in a message; ``number`` is unique among the markers of one kind.
    """

    name: str
    number: int
    stamp_ns: int
    frame_id: str
    markers: Sequence[Marker]


@dataclass(frozen=True, slots=True, eq=False)
class Mark:
    """This log's end of a closure, in the frame ``frame_id``."""

    stamp_ns: int
    frame_id: str
    key: int  # number of the closure in this log
    position: F64
    other: F64 | None  # position of the other end
    size: float  # diameter of the sphere, m
    text: str
    color: Colour


def closure_markers(mark: Mark) -> MarkerGroup:
    """A sphere at this log's end of a closure, a line to the other end, and a text."""
    color = mark.color
    place = mark.position[None]
    markers = [Marker(Shape.SPHERE, "semloc/places", place, mark.size, color)]
    if mark.other is not None:
        ends = np.array([mark.position, mark.other])
        width = mark.size / LINES_A_SPHERE
        markers.append(Marker(Shape.LINE_LIST, "semloc/closures", ends, width, color))
    above = _above(mark.position, mark.size)
    markers.append(Marker(Shape.TEXT, "semloc/names", above, mark.size, color, text=mark.text))
    return MarkerGroup(f"semloc/{mark.key}", mark.key, mark.stamp_ns, mark.frame_id, markers)


def overview_markers(
    drives: Sequence[Drive], marks: Sequence[Mark], stamp_ns: int, frame_id: str, size: float
) -> list[MarkerGroup]:
    """All drives, and all closures as spheres of ``size`` m in ``frame_id`` and lines between them.

    Viewers that jump to a time show the last message of each topic only, so that messages of single
    closures do not show them all.
    """
    width = size / LINES_A_SPHERE
    groups = []
    for number, drive in enumerate(drives):
        name_size = NAME_SIZE * size
        above = _above(drive.positions[0], name_size)
        markers = [
            Marker(Shape.LINE_STRIP, "semloc/drives", drive.positions, width, drive.color),
            Marker(
                Shape.TEXT, "semloc/sessions", above, name_size, drive.color, text=drive.session
            ),
        ]
        name = f"semloc/drives/{drive.session}"
        groups.append(MarkerGroup(name, number, stamp_ns, drive.frame_id, markers))

    of_closures = []
    if marks:
        places = np.array([mark.position for mark in marks])
        colors = [mark.color for mark in marks]
        of_closures.append(Marker(Shape.SPHERES, "semloc/places", places, size, colors=colors))
    lines = [
        (end, mark.color)
        for mark in marks
        if mark.other is not None
        for end in (mark.position, mark.other)
    ]
    if lines:
        ends = np.array([end for end, _ in lines])
        colors = [color for _, color in lines]
        of_closures.append(Marker(Shape.LINE_LIST, "semloc/closures", ends, width, colors=colors))
    groups.append(MarkerGroup("semloc/closures", 0, stamp_ns, frame_id, of_closures))
    return groups


def _above(position: F64, size: float) -> F64:
    """Where a text of ``size`` m stands, or one beside a sphere of this size (1, 3)."""
    return np.asarray(position + np.array([0.0, 0.0, 1.5 * size]))[None]
