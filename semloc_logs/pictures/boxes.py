"""A subvolume as boxes: isometric, seen from +x, +y and above, as in figure 3 of the paper."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64, U8
from semloc_logs.pictures.colours import PALE, class_colours
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE

EDGE = 12.0  # pixels of a voxel's edge
MARGIN = 2  # pixels around the boxes
COSINE = 0.866  # of 30 degrees, by which the level axes rise in the picture
OUTLINE = 0.8  # brightness of a face's edges over its own
_FACES = (  # corners of the faces that show, the neighbour that would hide them, brightness
    (((1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1)), (1, 0, 0), 0.62),
    (((0, 1, 0), (1, 1, 0), (1, 1, 1), (0, 1, 1)), (0, 1, 0), 0.8),
    (((0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)), (0, 0, 1), 1.0),
)


def draw_boxes(state: U8) -> U8:
    """RGB picture of the occupied voxels of ``state`` (x, y, z)."""
    filled = (state != FREE_STATE) & (state != UNOBSERVED_STATE)
    shape = state.shape
    nx, ny, nz = shape
    width = int(EDGE * (nx + ny) * COSINE) + 2 * MARGIN
    height = int(EDGE * ((nx + ny) * 0.5 + nz)) + 2 * MARGIN
    image = np.full((height, width, 3), 255, np.uint8)
    floor = np.array([[0, 0, 0], [nx, 0, 0], [nx, ny, 0], [0, ny, 0]], float)
    cv2.polylines(image, [_pixels(floor, shape)], True, PALE, 1, cv2.LINE_AA)

    table = class_colours()
    open_side = np.pad(~filled, ((0, 1), (0, 1), (0, 1)), constant_values=True)
    voxel = np.argwhere(filled)
    for i, j, k in voxel[np.argsort(voxel.sum(1), kind="stable")]:  # the farthest first
        colour = table[state[i, j, k]].astype(float)
        for corners, (dx, dy, dz), bright in _FACES:
            if open_side[i + dx, j + dy, k + dz]:
                face = _pixels(np.array(corners, float) + np.array([i, j, k]), shape)
                cv2.fillConvexPoly(image, face, tuple((colour * bright).tolist()))
                edge = tuple((colour * bright * OUTLINE).tolist())
                cv2.polylines(image, [face], True, edge, 1)
    return image


def _pixels(points: F64, shape: tuple[int, ...]) -> NDArray[np.int32]:
    """Pixels (n, 2) of points (n, 3) in voxels of a grid of ``shape``."""
    nx, _, nz = shape
    u = (points[:, 1] - points[:, 0] + nx) * COSINE
    v = (points[:, 0] + points[:, 1]) * 0.5 + nz - points[:, 2]
    return np.asarray(np.round(EDGE * np.stack([u, v], 1)) + MARGIN, np.int32)
