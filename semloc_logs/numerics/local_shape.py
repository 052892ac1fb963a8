"""Local shape of a point cloud: normals and the eigenvalue features of Demantke et al. (2011)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from semloc_logs.numerics.eigen import eigen

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """For each point (n,): unit ``normal`` (n, 3) and ``direction`` (n, 3) of least and of greatest
    extent (signs arbitrary), and ``linear``, ``planar``, ``scattered`` in [0, 1], which add up to
    one.
    """

    normal: F32
    direction: F32
    linear: F32
    planar: F32
    scattered: F32


def shape(points: NDArray[np.floating], neighbours: int = 16, radius: float = np.inf) -> Shape:
    """Shape of ``points`` (n, 3) from up to ``neighbours`` nearest points within ``radius`` metres;
    all scattered below 4 points.
    """
    n = len(points)
    if n < 4:
        up = np.tile(np.array([0, 0, 1], np.float32), (n, 1))
        zero = np.zeros(n, np.float32)
        return Shape(up, up, zero, zero, zero + 1)
    p = np.ascontiguousarray(points, np.float64)
    distance, index = cKDTree(p).query(
        p, k=min(neighbours, n), distance_upper_bound=radius, workers=1
    )
    return Shape(*shapes_of(p, np.arange(n), np.where(np.isfinite(distance), index, -1)))


@njit(cache=True, nogil=True)
def shapes_of(
    p: F64, at: NDArray[np.int64], index: NDArray[np.int64]
) -> tuple[F32, F32, F32, F32, F32]:
    """The columns of :class:`Shape` at the points ``p`` number ``at`` (n,) from the points
    ``index`` (n, k) around each, -1 where there is none.
    """
    n = len(index)
    normal = np.empty((n, 3), np.float32)
    direction = np.empty((n, 3), np.float32)
    linear = np.empty(n, np.float32)
    planar = np.empty(n, np.float32)
    scattered = np.empty(n, np.float32)
    mean = np.empty(3)
    d = np.empty(3)
    values = np.empty(3)
    a = np.empty((3, 3))
    vectors = np.empty((3, 3))
    for i in range(n):
        here = at[i]
        mean[:] = 0.0
        a[:] = 0.0
        count = 0
        for j in index[i]:
            if j >= 0:
                count += 1
                for k in range(3):
                    mean[k] += p[j, k] - p[here, k]
        mean /= max(count, 1)
        for j in index[i]:
            if j >= 0:
                for k in range(3):
                    d[k] = p[j, k] - p[here, k] - mean[k]
                for k in range(3):
                    for m in range(3):
                        a[k, m] += d[k] * d[m]
        a /= max(count, 1)
        eigen(a, values, vectors)
        s0 = np.sqrt(max(values[0], 0.0)) + 1e-9
        s1 = np.sqrt(max(values[1], 0.0)) + 1e-9
        s2 = np.sqrt(max(values[2], 0.0)) + 1e-9
        for k in range(3):
            normal[i, k] = vectors[k, 0]
            direction[i, k] = vectors[k, 2]
        few = count < 4
        linear[i] = 0.0 if few else (s2 - s1) / s2
        planar[i] = 0.0 if few else (s1 - s0) / s2
        scattered[i] = 1.0 if few else s0 / s2
    return normal, direction, linear, planar, scattered
