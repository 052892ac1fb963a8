"""Point-to-plane ICP with a robust kernel, and the covariance of what it finds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from semloc_logs.geometry import apply, exp_se3

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Target points (n, 3) with unit normals (n, 3) and how planar (n,) in [0, 1] their surroundings are; ``tree`` over the points."""

    points: F64
    normals: F64
    planar: F64
    tree: cKDTree


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """``target_T_query``; ``inliers`` share and ``count`` of query points within the last radius; ``rmse`` of their plane distances (m);
    ``information`` (6, 6), of (translation, rotation) as left increments about the query's centre ``centre`` in the target frame,
    in units of 1 / (plane distance noise)^2."""

    target_T_query: F64
    inliers: float
    count: int
    rmse: float
    information: F64
    centre: F64


def align(query: F64, surface: Surface, target_T_query: F64, radii: tuple[float, ...], iterations: int = 8) -> Fit:
    """Refine ``target_T_query`` for ``query`` points (n, 3) with correspondences within each of the shrinking ``radii`` (m).

    Gauss-Newton on the distances to the target's tangent planes (point distances where the surface is not planar), Cauchy weights.
    """
    T = target_T_query.copy()
    if not len(query):
        return Fit(T, 0.0, 0, float("inf"), np.zeros((6, 6)), T[:3, 3].copy())
    information = np.zeros((6, 6))
    inliers = np.zeros(len(query), bool)
    residual = np.zeros(0)
    centre = T[:3, 3]
    for radius in radii:
        for _ in range(iterations):
            moved = apply(T, query)
            centre = moved.mean(0)
            distance, index = surface.tree.query(moved, distance_upper_bound=radius, workers=1)
            inliers = np.isfinite(distance)
            if inliers.sum() < 12:
                return Fit(T, 0.0, int(inliers.sum()), float("inf"), np.zeros((6, 6)), centre)
            p, q = moved[inliers], surface.points[index[inliers]]
            normal, planar = surface.normals[index[inliers]], surface.planar[index[inliers]]
            offset = p - q
            residual = (offset * normal).sum(1)
            kernel = (0.15 * radius) ** 2
            weight = planar / (1 + residual**2 / kernel)
            arm = np.cross(p - centre, normal)
            J = np.concatenate([normal, arm], 1)
            H = (J * weight[:, None]).T @ J
            g = (J * weight[:, None]).T @ residual
            information = H
            # points that are not on planes (poles, leaves) hold what planes leave free, weakly
            loose = (1 - planar) * 0.1 / (1 + (offset**2).sum(1) / kernel)
            H = H + _point_information(p - centre, loose)
            g = g + np.r_[(offset * loose[:, None]).sum(0), (np.cross(p - centre, offset) * loose[:, None]).sum(0)]
            step = -np.linalg.solve(H + 1e-6 * np.trace(H) * np.eye(6), g)
            size = np.linalg.norm(step[3:])
            if size > 0.2:
                step *= 0.2 / size
            increment = exp_se3(step[:3], step[3:])
            about = np.eye(4)
            about[:3, 3] = centre
            back = np.eye(4)
            back[:3, 3] = -centre
            T = about @ increment @ back @ T
            if np.linalg.norm(step[:3]) < 1e-4 * radius and size < 1e-5:
                break
    rmse = float(np.sqrt(np.mean(np.minimum(residual**2, radii[-1] ** 2)))) if len(residual) else float("inf")
    return Fit(T, float(inliers.mean()), int(inliers.sum()), rmse, information, centre)


def _point_information(arm: F64, weight: F64) -> F64:
    """Sum of weight * J^T J for point distances, J = [I, -[arm]x]."""
    H = np.zeros((6, 6))
    total = weight.sum()
    H[:3, :3] = total * np.eye(3)
    a = (arm * weight[:, None]).sum(0)
    skew = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    H[:3, 3:], H[3:, :3] = -skew, skew
    outer = (arm * weight[:, None]).T @ arm
    H[3:, 3:] = np.trace(outer) * np.eye(3) - outer
    return H
