"""Label images -> labels of points of another sensor, where the camera can see them.

A LIDAR beside a camera looks past the edges of near things at points that are hidden from the
camera, and its points are sparse: through the gaps between the points of a near thing, a plain
depth test lets the hidden points take the near thing's class. So the surfaces that the LIDAR saw
are drawn into a depth image without gaps: in columns of equal azimuth, as seen from the LIDAR, each
point is joined with the next one above it that continues the same surface, and this strip is as
wide as a column. A point is hidden where a strip is much nearer.

A LIDAR also looks through the windows of cars, and gets nothing back from black paint: there is no
surface where the picture has one. A point that lies behind a near surface of the very label that it
would get, and beside it by less than a thing's size, is marked doubtful.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.arrays import F32, F64, U32
from semloc_logs.labels.projection import Projector
from semloc_logs.labels.space import UNPAINTED
from semloc_logs.logs.sensors.sweeps import in_base

COLUMN = np.radians(0.4)  # the azimuth step of spinning LIDARs is 0.1 to 0.4 degrees
MOST_GAP = np.radians(2.5)  # between rings: 2 degrees with 16 of them
_ENDS, _STEPS = -1, -2
_LEAST_GAP = np.radians(0.08)
_LOOK_AHEAD = 16  # points of a column that are tried as the continuation of a surface
_CELL = np.radians(0.16)  # of the depth image
_NEARER = 0.25  # a surface that hides a point is nearer by so much (m),
_NEARER_SHARE = 0.04  # and by this share of the distance
_THING = 0.8  # m, half the size of things with windows
# around a point, for near surfaces of which _THING is as large as that
_REACH = (np.radians(6.0), np.radians(3.0), np.radians(1.5))
_NOTHING = 1e9  # m, the depth of cells without a surface
_BEHIND_SHARE = 1.1  # of the depth of the nearer surface, and
_BEHIND = 3.0  # m, so that the side of a truck is not behind its own rear
_MOST_LABELS = 40  # of a picture that are looked at: more are noise


@dataclass(frozen=True, slots=True, eq=False)
class Viewpoint:
    """Where points were measured from.

    ``origin`` (3,) of the sensor in their frame, and ``axis`` (3,), a unit vector, about which its
    azimuth is counted.
    """

    origin: NDArray[np.floating]
    axis: NDArray[np.floating]

    def columns(self, points: F32) -> tuple[NDArray[np.int32], F32, F32]:
        """Column of equal azimuth, elevation (rad) and distance (m) of points (n, 3), each (n,)."""
        rays = points - np.asarray(self.origin, np.float32)
        side = np.cross(self.axis, (1.0, 0.0, 0.0) if abs(self.axis[0]) < 0.9 else (0.0, 1.0, 0.0))
        side /= np.linalg.norm(side)
        x, y, z = np.einsum(
            "ij,nj->in",
            np.stack([side, np.cross(self.axis, side), self.axis]).astype(np.float32),
            rays,
        )
        flat = np.hypot(x, y)
        return (
            np.floor(np.arctan2(y, x) / COLUMN).astype(np.int32),
            np.arctan2(z, flat),
            np.hypot(flat, z),
        )


def nearest_depth(
    points: F32, camera: F32, pixels: F64, viewpoint: Viewpoint, projector: Projector
) -> tuple[F32, float]:
    """Depth of the nearest surface in each cell of the picture, and the edge of a cell in pixels.

    Depth in m along the optical axis, infinite without a surface. ``camera`` and ``pixels``
    are the places of all ``points`` (n, 3) of a cloud in the camera's frame and in its picture.
    """
    cell = max(1.0, float(round(projector.focal * _CELL)))
    shape = int(np.ceil(projector.height / cell)), int(np.ceil(projector.width / cell))
    depth = np.full(shape, np.inf, np.float32)
    shown = np.flatnonzero(np.isfinite(pixels[:, 0]))
    column, elevation, distance = viewpoint.columns(points[shown])
    order = np.lexsort((elevation, column))
    shown = shown[order]
    distance = distance[order]
    z = camera[shown, 2].astype(float)
    # off the axis a picture is stretched by the square of the ray's length over its depth
    stretch = np.linalg.norm(camera[shown], axis=1) / z
    half = np.maximum(projector.focal / cell * (COLUMN / 2) * distance / z * stretch, 0.5)
    cells = (pixels[shown] + 0.5) / cell
    _draw(depth, _Rings(cells, z, distance, column[order], elevation[order], half))
    return depth, cell


class _Rings(NamedTuple):
    """Points in columns of equal azimuth, upwards, for compiled functions.

    ``cell`` (n, 2) of the depth image, with fractions; depth ``z`` (n,); ``distance``, ``column``
    and ``elevation`` (n,) as by :meth:`Viewpoint.columns`; ``half`` (n,) the width of a column in
    cells, halved.
    """

    cell: F64
    z: F64
    distance: F32
    column: NDArray[np.int32]
    elevation: F32
    half: F64


@njit(cache=True, nogil=True)
def _draw(depth: F32, rings: _Rings) -> None:
    """Draw the points and the strips between them into ``depth`` (rows, columns)."""
    cell, z, _, _, _, half = rings
    for i in range(len(z)):
        _line(depth, 1, int(np.floor(cell[i, 1])), cell[i, 0], half[i], z[i])
        above = _continues(rings, i, 1)
        below = _continues(rings, i, -1)
        if above >= 0:
            _strip(depth, (cell[i], cell[above]), (z[i], z[above]), (half[i], half[above]))
        # a surface that ends before something far may reach as far as just before the next ring
        if above == _ENDS and below >= 0:
            beyond = 2 * cell[i] - cell[below]
            _strip(depth, (cell[i], beyond), (z[i], z[i]), (half[i], half[i]))
        if below == _ENDS and above >= 0:
            beyond = 2 * cell[i] - cell[above]
            _strip(depth, (cell[i], beyond), (z[i], z[i]), (half[i], half[i]))


@njit(cache=True, nogil=True)
def _continues(rings: _Rings, i: int, step: int) -> int:
    """The next point of another ring, upwards or downwards, on the same surface as point ``i``.

    _ENDS where the next ring measured something much farther or nothing, _STEPS where it measured
    something else.
    """
    _, _, distance, column, elevation, _ = rings
    ends = _ENDS
    for k in range(1, _LOOK_AHEAD + 1):
        j = i + step * k
        if j < 0 or j >= len(column) or column[j] != column[i]:
            break
        gap = abs(elevation[j] - elevation[i])
        if gap > MOST_GAP:
            break
        if gap < _LEAST_GAP:
            continue
        # a surface that is seen at less than 20 degrees falls apart into its points
        if abs(distance[j] - distance[i]) < 0.1 + 2.75 * gap * min(distance[i], distance[j]):
            return j
        if distance[j] < 1.1 * distance[i] + 2.0:
            ends = _STEPS
    return ends


@njit(cache=True, nogil=True)
def _strip(
    depth: F32, cells: tuple[F64, F64], z: tuple[float, float], half: tuple[float, float]
) -> None:
    """Join two points by a strip; ``cells``, ``z`` and ``half`` of both as in :class:`_Rings`.

    In each row of cells (in each column where the line is flat) it has the farthest depth of the
    line there, which is linear in 1 / z.
    """
    a, b = cells
    main = 1 if abs(b[1] - a[1]) >= abs(b[0] - a[0]) else 0
    first = int(np.floor(min(a[main], b[main])))
    last = int(np.floor(max(a[main], b[main])))
    if last == first:
        return
    for line in range(max(first, 0), min(last, depth.shape[1 - main] - 1) + 1):
        middle = min(max((line + 0.5 - a[main]) / (b[main] - a[main]), 0.0), 1.0)
        farthest = 0.0
        for edge in (float(line), line + 1.0):
            t = min(max((edge - a[main]) / (b[main] - a[main]), 0.0), 1.0)
            farthest = max(farthest, 1.0 / ((1 - t) / z[0] + t / z[1]))
        centre = a[1 - main] + middle * (b[1 - main] - a[1 - main])
        _line(depth, main, line, centre, half[0] + middle * (half[1] - half[0]), farthest)


@njit(cache=True, nogil=True)
def _line(
    depth: NDArray[np.floating], main: int, line: int, centre: float, half: float, z: float
) -> None:
    """Cells of one row (``main`` 1) or column (0) around ``centre`` are no farther than ``z``."""
    if line < 0 or line >= depth.shape[1 - main]:
        return
    first = int(np.floor(centre - half))
    last = int(np.floor(centre + half))
    for across in range(max(first, 0), min(last, depth.shape[main] - 1) + 1):
        row, column = (line, across) if main == 1 else (across, line)
        if z < depth[row, column]:
            depth[row, column] = z


class PaintedPoints(NamedTuple):
    """Labels (m,) or UNPAINTED, and what else is known about each point.

    ``is_doubtful`` (m,): the label may belong to something nearer; ``is_inside`` (m,): the point is
    in the picture at all, visible or hidden.
    """

    label: U32
    is_doubtful: NDArray[np.bool_]
    is_inside: NDArray[np.bool_]


def paint(
    points: F32,
    wanted: NDArray[np.integer],
    viewpoint: Viewpoint,
    labels: U32,
    camera_T_base: F64,
    projector: Projector,
) -> PaintedPoints:
    """Labels of ``points[wanted]`` (m,) in the base frame from the picture ``labels`` (h, w).

    ``points`` (n, 3) are all points that the sensor at ``viewpoint`` measured: they hide each
    other. UNPAINTED where the picture does not show the point: outside of it, or hidden.
    """
    out = np.full(len(wanted), UNPAINTED, np.uint32)
    camera = in_base(camera_T_base, points)
    pixels, front = projector.pixels(camera)
    pixels[~(front & projector.near(pixels, 0.1))] = np.nan
    depth, cell = nearest_depth(points, camera, pixels, viewpoint, projector)
    camera = camera[wanted]
    pixels = pixels[wanted]
    inside = projector.inside(pixels)
    column, row = np.floor((pixels[inside] + 0.5) / cell).astype(int).T
    z = camera[inside, 2]
    visible = depth[row, column] * (1 + _NEARER_SHARE) + _NEARER >= z
    seen = np.flatnonzero(inside)[visible]
    u, v = np.rint(pixels[seen]).astype(int).T
    out[seen] = labels[np.clip(v, 0, projector.height - 1), np.clip(u, 0, projector.width - 1)]
    known = seen[out[seen] != UNPAINTED]
    column, row = np.floor((pixels[known] + 0.5) / cell).astype(int).T
    labelled = _Labelled(out[known], row, column, camera[known, 2])
    doubtful = _behind_its_own(labelled, depth, cell, labels, projector.focal)
    is_doubtful = np.zeros(len(wanted), bool)
    is_doubtful[known[doubtful]] = True
    return PaintedPoints(out, is_doubtful, inside)


class _Labelled(NamedTuple):
    """Points with the labels ``own`` (n,) at cells (``row``, ``column``) and depth ``z`` (n,)."""

    own: U32
    row: NDArray[np.intp]
    column: NDArray[np.intp]
    z: F32


def _behind_its_own(
    points: _Labelled, depth: F32, cell: float, labels: U32, focal: float
) -> NDArray[np.bool_]:
    """Which ``points`` (n,) have a much nearer surface of the same label beside them.

    ``depth`` has cells of ``cell`` pixels of the picture ``labels`` (h, w) with focal length
    ``focal``.
    """
    own, row, column, z = points
    out = np.zeros(len(own), bool)
    rows, columns = depth.shape
    half = int(cell) // 2
    coarse = labels[half :: int(cell), half :: int(cell)]
    missing = [(0, max(0, n - m)) for n, m in zip(depth.shape, coarse.shape, strict=True)]
    coarse = np.pad(coarse, missing, "edge")[:rows, :columns]
    values, counts = np.unique(own, return_counts=True)
    for label in values[np.argsort(-counts, kind="stable")][:_MOST_LABELS]:
        members = np.flatnonzero(own == label)
        surface = np.where(coarse == label, depth, np.float32(np.inf))
        for reach in _REACH:
            close = np.where(surface < _THING / np.tan(reach), surface, np.float32(_NOTHING))
            size = 2 * int(focal * reach / cell) + 1
            around = cv2.erode(
                close,
                np.ones((size, size), np.uint8),
                borderType=cv2.BORDER_CONSTANT,
                borderValue=_NOTHING,
            )
            nearest = np.asarray(around)[row[members], column[members]]
            out[members] |= nearest * _BEHIND_SHARE + _BEHIND < z[members]
    return out


def without_borders(labels: U32, width: int) -> U32:
    """The picture (h, w) of labels, UNPAINTED within ``width`` pixels of where two labels meet."""
    if width <= 0:
        return labels
    border: NDArray[np.uint8] = np.zeros(labels.shape, np.uint8)
    for a, b, changed in (
        (border[:, 1:], border[:, :-1], labels[:, 1:] != labels[:, :-1]),
        (border[1:], border[:-1], labels[1:] != labels[:-1]),
    ):
        a |= changed.astype(np.uint8)
        b |= changed.astype(np.uint8)
    if width > 1:
        border = np.asarray(
            cv2.dilate(border, np.ones((2 * width - 1, 2 * width - 1), np.uint8)), np.uint8
        )
    return np.where(border > 0, np.uint32(UNPAINTED), labels)
