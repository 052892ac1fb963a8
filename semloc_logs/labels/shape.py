"""Local shape of a point cloud: normals and the eigenvalue features of Demantke et al. (2011)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

F32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """For each point (n,): unit ``normal`` (n, 3) and ``direction`` (n, 3) of least and of greatest extent (signs arbitrary), and
    ``linear``, ``planar``, ``scattered`` in [0, 1], which add up to one."""

    normal: F32
    direction: F32
    linear: F32
    planar: F32
    scattered: F32


def shape(points: NDArray[np.floating], neighbours: int = 16, radius: float = np.inf) -> Shape:
    """Shape of ``points`` (n, 3) from up to ``neighbours`` nearest points within ``radius`` metres; all scattered below 4 points."""
    n = len(points)
    if n < 4:
        up = np.tile(np.array([0, 0, 1], np.float32), (n, 1))
        zero = np.zeros(n, np.float32)
        return Shape(up, up, zero, zero, zero + 1)
    p = np.asarray(points, np.float64)
    distance, index = cKDTree(p).query(p, k=min(neighbours, n), distance_upper_bound=radius, workers=1)
    inside = np.isfinite(distance)
    index[~inside] = 0
    local = (p[index] - p[:, None]) * inside[..., None]
    count = inside.sum(1)
    centred = (local - (local.sum(1) / count[:, None])[:, None]) * inside[..., None]
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred, optimize=True) / count[:, None, None])
    s = np.sqrt(np.maximum(values, 0)) + 1e-9
    scattered = np.where(count < 4, 1.0, s[:, 0] / s[:, 2])
    linear = np.where(count < 4, 0.0, (s[:, 2] - s[:, 1]) / s[:, 2])
    planar = np.where(count < 4, 0.0, (s[:, 1] - s[:, 0]) / s[:, 2])
    as32 = [np.asarray(a, np.float32) for a in (vectors[:, :, 0], vectors[:, :, 2], linear, planar, scattered)]
    return Shape(*as32)
