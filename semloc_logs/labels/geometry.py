"""Classes from geometry alone: ground, wall-like, vegetation-like, pole-like by local shape and height above the ground."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semloc_logs.labels.shape import Shape
from semloc_logs.labels.space import BUILDING, POLE, ROAD, UNLABELLED, VEGETATION

CELL = 0.30 * 4  # of the ground grid, at street scale (m)


def ground_surface(points: NDArray[np.floating], scale: float = 1.0) -> NDArray[np.float64]:
    """Height (n,) of the ground below each of ``points`` (n, 3), whose z axis is up.

    The lowest points of 1.2 m cells, a cell being lowered to what its surroundings reach at a slope of 20 %; ``scale`` is the
    voxel size over 0.30 m.
    """
    cell = CELL * scale
    xy = np.floor(points[:, :2] / cell).astype(np.int64)
    low = xy.min(0)
    shape = xy.max(0) - low + 1
    if shape.prod() > 4_000_000:  # a stray far point must not cost memory: coarser cells serve as well
        return np.full(len(points), float(np.percentile(points[:, 2], 5)))
    xy -= low
    address = xy[:, 0] * shape[1] + xy[:, 1]
    order = np.lexsort((points[:, 2], address))
    sorted_address = address[order]
    start = np.flatnonzero(np.r_[True, sorted_address[1:] != sorted_address[:-1]])
    count = np.diff(np.r_[start, len(order)])
    grid = np.full(int(shape.prod()), np.inf)
    # the 2nd of few, the 5 % of many: one stray return below the street is no ground
    grid[sorted_address[start]] = points[order[start + np.minimum(count // 20 + (count > 3), count - 1)], 2]
    surface = np.pad(grid.reshape(tuple(shape)), 4, constant_values=np.inf)  # a margin, because roll wraps around
    for step in (1, 2, 4):  # grey erosion by a cone of 20 % slope, in doubling steps
        neighbours = [
            np.roll(surface, (dx, dy), (0, 1)) + 0.2 * step * cell * np.hypot(np.sign(dx), np.sign(dy))
            for dx in (-step, 0, step)
            for dy in (-step, 0, step)
        ]
        surface = np.minimum.reduce(neighbours)
    return np.asarray(surface[xy[:, 0] + 4, xy[:, 1] + 4], float)


def classify(points: NDArray[np.floating], shape: Shape, scale: float = 1.0) -> NDArray[np.uint8]:
    """Class (n,) of level ``points`` (n, 3) with their local ``shape``; 255 where the shape says nothing.

    ``scale`` is the voxel size over 0.30 m: a room is a street in miniature.
    """
    if not len(points):
        return np.zeros(0, np.uint8)
    height = points[:, 2] - ground_surface(points, scale)
    upright = np.abs(shape.normal[:, 2])
    label = np.full(len(points), UNLABELLED, np.uint8)
    label[shape.scattered > 0.25] = VEGETATION
    label[(shape.planar > 0.45) & (upright < 0.5)] = BUILDING
    label[(shape.planar > 0.45) & (upright > 0.8) & (height > 2.0 * scale)] = BUILDING  # roofs and ceilings
    label[(shape.linear > 0.6) & (np.abs(shape.direction[:, 2]) > 0.9) & (height > 0.3 * scale)] = POLE
    label[(height < 0.35 * scale) & ((upright > 0.7) | (height < 0.15 * scale))] = ROAD
    return label
