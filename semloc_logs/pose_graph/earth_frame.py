"""Frames that satellites align: a level one onto east, north and up."""

from __future__ import annotations

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.numerics.transforms import yaw_transform
from semloc_logs.pose_graph.graph import Positions

LEAST_FIXES = 3
LEAST_SPREAD = 10.0  # standard deviations of a fix: the heading is known to 6 degrees
ITERATIONS = 50
SETTLED = 1e-9


def enu_T_frame(poses: F64, fixes: Positions) -> F64 | None:
    """The transform (4, 4) by a turn about the vertical; ``poses`` (v, 4, 4) are of all vertices.

    Sums of distances are least, not of their squares, so that single fixes may be far off: weights
    are iterated. None where the fixes do not tell the heading.
    """
    if len(fixes) < LEAST_FIXES:
        return None
    placed = poses[fixes.vertices]
    here = np.einsum("nij,nj->ni", placed[:, :3, :3], fixes.antenna) + placed[:, :3, 3]
    sigma = np.hypot(fixes.sigma[:, 0], fixes.sigma[:, 1]) / np.sqrt(2.0)
    spread = np.sqrt(np.median(((here - np.median(here, axis=0))[:, :2] ** 2).sum(1)))
    if spread < LEAST_SPREAD * np.median(sigma):
        return None
    weight = 1.0 / sigma
    out = np.eye(4)
    for _ in range(ITERATIONS):
        before = out
        out = _aligned(here, fixes.position, weight, 1.0 / fixes.sigma[:, 2] ** 2)
        away = np.linalg.norm((here @ out[:3, :3].T + out[:3, 3] - fixes.position)[:, :2], axis=1)
        weight = 1.0 / (sigma * np.maximum(away, sigma))
        if np.abs(out - before).max() < SETTLED:
            break
    return out


def _aligned(here: F64, there: F64, weight: F64, height_weight: F64) -> F64:
    """Weighted least squares; heights apart."""
    share = weight / weight.sum()
    own = here[:, :2] - share @ here[:, :2]
    other = there[:, :2] - share @ there[:, :2]
    cross = (share * (own[:, 0] * other[:, 1] - own[:, 1] * other[:, 0])).sum()
    out = yaw_transform(float(np.arctan2(cross, (share * (own * other).sum(1)).sum())))
    out[:2, 3] = share @ (there - here @ out[:3, :3].T)[:, :2]
    out[2, 3] = np.average(there[:, 2] - here[:, 2], weights=height_weight)
    return out
