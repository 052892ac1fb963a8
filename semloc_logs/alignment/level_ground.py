"""The error of a fit where level ground is lifted as a whole, by snow, leaves or grass."""

from __future__ import annotations

import numpy as np

from semloc_logs.alignment.icp import KERNEL
from semloc_logs.alignment.surface import Surface, look_at, nearest_points
from semloc_logs.arrays import F64
from semloc_logs.numerics.transforms import apply

STRIDE = 3  # of the points that are looked at, which stand for all
LEVEL = 0.9  # of the normal's height on level ground
LEAST_POINTS = 30


def ground_bias(
    points: F64, surface: Surface, target_T_query: F64, centre: F64, reach: float, radius: float
) -> F64:
    """Right sides (3, 6) of a fit's equations if its level ground is off as a whole.

    Points (n, 3) of the query within ``reach`` metres of level ground lie above or below it by so
    much in the mean. Each row is that much: all of it lifted, and tilted along x and along y. The
    fit used those within ``radius``; its equations are about ``centre`` (3,).
    """
    moved = apply(target_T_query, points[::STRIDE])
    index = nearest_points(surface.arrays, moved, reach)
    look_at(surface.arrays, index)
    met = index >= 0
    index = index[met]
    normal = surface.normals[index]
    is_level = (np.abs(normal[:, 2]) > LEVEL) & (surface.planar[index] > 0)
    if int(is_level.sum()) < LEAST_POINTS:
        return np.zeros((3, 6))

    upward = normal[is_level] * np.sign(normal[is_level, 2:])
    on_ground = moved[met][is_level]
    residual = on_ground - surface.points[index[is_level]]
    height = np.einsum("ij,ij->i", residual, upward)
    arm = on_ground - centre
    weight = STRIDE * surface.planar[index[is_level]] / (1 + (height / (KERNEL * radius)) ** 2)
    weight *= np.linalg.norm(residual, axis=1) < radius

    around = arm - arm.mean(0)
    width = max(float(np.sqrt(np.mean(around[:, :2] ** 2))), radius)
    shapes = np.stack([np.ones(len(arm)), around[:, 0] / width, around[:, 1] / width])
    jacobian = np.concatenate([upward, np.cross(arm, upward)], axis=1)
    return np.asarray(float(np.mean(height)) * (shapes * weight) @ jacobian)
