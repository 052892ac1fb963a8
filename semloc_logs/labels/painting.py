"""Label images -> labels of points that another sensor measured from elsewhere, where the camera can see them.

A LIDAR beside a camera looks past the edges of near things at what is hidden from the camera, and its points are sparse: through the
gaps between the points of a near thing, a plain depth test lets the hidden points take the near thing's class. So the surfaces that the
LIDAR saw are drawn into a depth image without gaps: in columns of equal azimuth, as seen from the LIDAR, each point is joined with the
next one above it that continues the same surface, and this strip is as wide as a column. A point is hidden where a strip is much nearer.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.frames import F32, F64
from semloc_logs.labels.projection import Projector
from semloc_logs.labels.space import UNPAINTED

COLUMN = np.radians(0.4)  # the azimuth step of spinning LIDARs is 0.1 to 0.4 degrees
MOST_GAP = np.radians(2.5)  # between rings: 2 degrees with 16 of them
_LOOK_AHEAD = 12  # points of a column that are tried as the continuation of a surface
_CELL = np.radians(0.16)  # of the depth image
_NEARER = 0.25  # what hides a point is nearer by so much (m),
_NEARER_SHARE = 0.04  # and by this share of the distance

U32 = NDArray[np.uint32]


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """All points of a cloud as one sensor saw them: ``points`` (n, 3) in the base frame, in order of column, then of elevation.

    ``distance`` (n,) from the sensor in metres, ``column`` (n,) and ``elevation`` (n,) in radians about the sensor's axis.
    """

    points: F32
    distance: F32
    column: NDArray[np.int32]
    elevation: F32


def scan(points: F32, origin: NDArray[np.floating], axis: NDArray[np.floating]) -> Scan:
    """``points`` (n, 3) as seen from ``origin`` (3,), by azimuth and elevation about the unit vector ``axis`` (3,)."""
    rays = points - np.asarray(origin, np.float32)
    side = np.cross(axis, (1.0, 0.0, 0.0) if abs(axis[0]) < 0.9 else (0.0, 1.0, 0.0))
    side /= np.linalg.norm(side)
    frame = np.stack([side, np.cross(axis, side), axis]).astype(np.float32)
    x, y, z = np.einsum("ij,nj->in", frame, rays)
    flat = np.hypot(x, y)
    elevation = np.arctan2(z, flat)
    column = np.floor(np.arctan2(y, x) / COLUMN).astype(np.int32)
    order = np.lexsort((elevation, column))
    return Scan(points[order], np.hypot(flat, z)[order], column[order], elevation[order])


def nearest_depth(seen: Scan, camera_T_base: F64, projector: Projector) -> tuple[F32, float]:
    """Depth (m along the optical axis) of the nearest surface in each cell of the picture, infinite where there is none, and the edge
    of a cell in pixels."""
    cell = max(1.0, float(round(projector.focal * _CELL)))
    shape = int(np.ceil(projector.height / cell)), int(np.ceil(projector.width / cell))
    depth = np.full(shape, np.inf, np.float32)
    camera = seen.points @ camera_T_base[:3, :3].T.astype(np.float32) + camera_T_base[:3, 3].astype(np.float32)
    pixels, front = projector.pixels(camera)
    margin = 0.1 * max(projector.width, projector.height)
    size = np.array([projector.width, projector.height])
    near = front & ((pixels > -margin) & (pixels < size + margin)).all(1)
    cells = (pixels[near] + 0.5) / cell
    half = projector.focal / cell * (COLUMN / 2) * seen.distance[near] / camera[near, 2]
    _draw(depth, cells, camera[near, 2].astype(float), seen.distance[near], seen.column[near], seen.elevation[near], half)
    return depth, cell


@njit(cache=True, nogil=True)
def _draw(depth, cells, z, distance, column, elevation, half):  # type: ignore[no-untyped-def]
    n = len(z)
    for i in range(n):
        _row(depth, int(np.floor(cells[i, 1])), cells[i, 0], half[i], z[i])
        for j in range(i + 1, min(i + 1 + _LOOK_AHEAD, n)):
            gap = elevation[j] - elevation[i]
            if column[j] != column[i] or gap > MOST_GAP:
                break
            # a surface that is seen at less than 20 degrees falls apart into its points
            if abs(distance[j] - distance[i]) > 0.1 + 2.75 * gap * min(distance[i], distance[j]):
                continue
            _strip(depth, cells[i], cells[j], z[i], z[j], half[i], half[j])
            break


@njit(cache=True, nogil=True)
def _strip(depth, a, b, z_a, z_b, half_a, half_b):  # type: ignore[no-untyped-def]
    """Joins two points: in each row of cells the farthest depth that the line has there, which is linear in 1 / z."""
    first, last = int(np.floor(min(a[1], b[1]))), int(np.floor(max(a[1], b[1])))
    if last == first:
        return
    for row in range(max(first, 0), min(last, depth.shape[0] - 1) + 1):
        middle = min(max((row + 0.5 - a[1]) / (b[1] - a[1]), 0.0), 1.0)
        farthest = 0.0
        for edge in (float(row), row + 1.0):
            t = min(max((edge - a[1]) / (b[1] - a[1]), 0.0), 1.0)
            farthest = max(farthest, 1.0 / ((1 - t) / z_a + t / z_b))
        _row(depth, row, a[0] + middle * (b[0] - a[0]), half_a + middle * (half_b - half_a), farthest)


@njit(cache=True, nogil=True)
def _row(depth, row, centre, half, z):  # type: ignore[no-untyped-def]
    if row < 0 or row >= depth.shape[0]:
        return
    first, last = int(np.floor(centre - half)), int(np.floor(centre + half))
    for column in range(max(first, 0), min(last, depth.shape[1] - 1) + 1):
        if z < depth[row, column]:
            depth[row, column] = z


def paint(points: F32, seen: Scan, labels: U32, camera_T_base: F64, projector: Projector) -> tuple[U32, NDArray[np.bool_]]:
    """Labels (n,) of ``points`` (n, 3) in the base frame from the picture ``labels`` (h, w), and which points are in the picture at all.

    UNPAINTED where the picture does not show the point: outside of it, or hidden by the surfaces of ``seen``, the whole cloud.
    """
    out = np.full(len(points), UNPAINTED, np.uint32)
    camera = points @ camera_T_base[:3, :3].T.astype(np.float32) + camera_T_base[:3, 3].astype(np.float32)
    pixels, front = projector.pixels(camera)
    inside = front & projector.inside(pixels)
    if not inside.any():
        return out, inside
    depth, cell = nearest_depth(seen, camera_T_base, projector)
    column, row = np.floor((pixels[inside] + 0.5) / cell).astype(int).T
    z = camera[inside, 2]
    visible = depth[row, column] * (1 + _NEARER_SHARE) + _NEARER >= z
    at = np.flatnonzero(inside)[visible]
    u, v = np.rint(pixels[at]).astype(int).T
    out[at] = labels[np.clip(v, 0, projector.height - 1), np.clip(u, 0, projector.width - 1)]
    return out, inside


def without_borders(labels: U32, width: int) -> U32:
    """The picture (h, w) of labels with UNPAINTED within ``width`` pixels of where two labels meet."""
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
        border = np.asarray(cv2.dilate(border, np.ones((2 * width - 1, 2 * width - 1), np.uint8)), np.uint8)
    return np.where(border > 0, np.uint32(UNPAINTED), labels)
