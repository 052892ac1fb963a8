"""Local shape of a point cloud: normals and the eigenvalue features of Demantke et al. (2011).

One principal component analysis for all: moments of points, their covariance, and its axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from semloc_logs.arrays import F32, F64, I64
from semloc_logs.numerics.eigen import eigen

MOMENTS = 10  # the weight and the weighted sums of x, y, z, xx, xy, xz, yy, yz, zz
LEAST_POINTS = 4  # that have a shape: three always lie in a plane
LEAST_SPREAD = 1e-9  # metres, so that shares of a spread are defined for points in one place


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """The shape of the surroundings of points, an entry each.

    Unit ``normal`` (n, 3) and ``direction`` (n, 3) of least and of greatest extent, their signs
    arbitrary; ``linear``, ``planar``, ``scattered`` (n,) in [0, 1], which add up to one.
    """

    normal: F32
    direction: F32
    linear: F32
    planar: F32
    scattered: F32


def shape(points: NDArray[np.floating], neighbours: int = 16, radius: float = np.inf) -> Shape:
    """Shape of ``points`` (n, 3) from up to ``neighbours`` nearest points within ``radius`` metres.

    All are scattered below 4 points.
    """
    n = len(points)
    if n < LEAST_POINTS:
        up = np.tile(np.array([0, 0, 1], np.float32), (n, 1))
        zero = np.zeros(n, np.float32)
        return Shape(up, up, zero, zero, zero + 1)
    p = np.ascontiguousarray(points, np.float64)
    distance, index = cKDTree(p).query(
        p, k=min(neighbours, n), distance_upper_bound=radius, workers=1
    )
    return Shape(*shapes_of(p, np.arange(n), np.where(np.isfinite(distance), index, -1)))


@njit(cache=True, nogil=True)
def add_point(moments: F64, x: float, y: float, z: float, weight: float) -> None:
    """Add a point to ``moments`` (10,)."""
    wx = weight * x
    wy = weight * y
    wz = weight * z
    moments[0] += weight
    moments[1] += wx
    moments[2] += wy
    moments[3] += wz
    moments[4] += wx * x
    moments[5] += wx * y
    moments[6] += wx * z
    moments[7] += wy * y
    moments[8] += wy * z
    moments[9] += wz * z


@njit(cache=True, nogil=True)
def covariance(moments: F64, mean: F64, a: F64) -> None:
    """The ``mean`` (3,) and the covariance ``a`` (3, 3) of the points in ``moments`` (10,)."""
    weight = moments[0]
    for k in range(3):
        mean[k] = moments[1 + k] / weight
    t = 4
    for r in range(3):
        for c in range(r, 3):
            a[r, c] = a[c, r] = moments[t] / weight - mean[r] * mean[c]
            t += 1


@njit(cache=True, nogil=True)
def principal_axes(a: F64, spread: F64, axes: F64) -> None:
    """Standard deviations ``spread`` (3,), ascending, and unit ``axes`` (3, 3), in columns.

    The covariance ``a`` (3, 3) is overwritten.
    """
    eigen(a, spread, axes)
    for k in range(3):
        spread[k] = np.sqrt(max(spread[k], 0.0))


@njit(cache=True, nogil=True)
def shapes_of(p: F64, rows: I64, index: I64) -> tuple[F32, F32, F32, F32, F32]:
    """The columns of :class:`Shape` of the points ``p[rows]``.

    Each has the surrounding points ``index`` (n, k), -1 where there are fewer. The covariance is
    taken in two passes, about the mean: sums of squares lose digits with the distance from it.
    """
    n = len(index)
    normal = np.empty((n, 3), np.float32)
    direction = np.empty((n, 3), np.float32)
    linear = np.empty(n, np.float32)
    planar = np.empty(n, np.float32)
    scattered = np.empty(n, np.float32)
    mean = np.empty(3)
    spread = np.empty(3)
    a = np.empty((3, 3))
    axes = np.empty((3, 3))
    for i in range(n):
        count = _covariance_about(p, rows[i], index[i], mean, a)
        principal_axes(a, spread, axes)
        for k in range(3):
            normal[i, k] = axes[k, 0]
            direction[i, k] = axes[k, 2]
        s0 = spread[0] + LEAST_SPREAD
        s1 = spread[1] + LEAST_SPREAD
        s2 = spread[2] + LEAST_SPREAD
        few = count < LEAST_POINTS
        linear[i] = 0.0 if few else (s2 - s1) / s2
        planar[i] = 0.0 if few else (s1 - s0) / s2
        scattered[i] = 1.0 if few else s0 / s2
    return normal, direction, linear, planar, scattered


@njit(cache=True, nogil=True)
def _covariance_about(p: F64, row: int, index: I64, mean: F64, a: F64) -> int:
    """The ``mean`` (3,), off point ``row``, and the covariance ``a`` (3, 3) of ``p[index]``.

    Returns how many points these are.
    """
    mean[:] = 0.0
    a[:] = 0.0
    count = 0
    for j in index:
        if j >= 0:
            count += 1
            for k in range(3):
                mean[k] += p[j, k] - p[row, k]
    mean /= max(count, 1)
    for j in index:
        if j >= 0:
            dx = p[j, 0] - p[row, 0] - mean[0]
            dy = p[j, 1] - p[row, 1] - mean[1]
            dz = p[j, 2] - p[row, 2] - mean[2]
            a[0, 0] += dx * dx
            a[0, 1] += dx * dy
            a[0, 2] += dx * dz
            a[1, 1] += dy * dy
            a[1, 2] += dy * dz
            a[2, 2] += dz * dz
    a[1, 0] = a[0, 1]
    a[2, 0] = a[0, 2]
    a[2, 1] = a[1, 2]
    a /= max(count, 1)
    return count
