"""Fast Point Feature Histograms (Rusu et al., ICRA 2009): 33 dimensions that do not depend on the
heading.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from semloc_logs.arrays import F32, F64, I64
from semloc_logs.experiments.systems.shapes.near_points import Cells, cells_of, neighbours

BINS = 11  # of each of the three angles
SIZE = 3 * BINS
SUM = 100.0  # of the bins of each angle


def feature_histograms(points: F64, normals: F64, keypoints: I64, radius: float) -> F32:
    """FPFH (k, 33) of the ``keypoints``, rows of ``points`` (n, 3) with unit ``normals`` (n, 3).

    Neighbours lie within ``radius`` metres. The bins of each angle sum to 100, or to 0 where a
    keypoint has no neighbour.
    """
    if not len(points) or not len(keypoints):
        return np.zeros((len(keypoints), SIZE), np.float32)
    cells = cells_of(points, radius)
    simple = _simple_histograms(points, normals, cells, radius)
    return _weighted_sums(points, simple, cells, np.asarray(keypoints, np.int64), radius)


@njit(cache=True, nogil=True)
def _bin(share: float) -> int:
    return min(max(int(share * BINS), 0), BINS - 1)


@njit(cache=True, nogil=True)
def _add_pair(p: F64, n: F64, q: F64, m: F64, out: F64) -> None:
    """Count the angles between ``p`` with normal ``n`` and ``q`` with normal ``m`` into ``out``."""
    dx = q[0] - p[0]
    dy = q[1] - p[1]
    dz = q[2] - p[2]
    far = np.sqrt(dx * dx + dy * dy + dz * dz)
    dx /= far
    dy /= far
    dz /= far
    along_n = n[0] * dx + n[1] * dy + n[2] * dz
    along_m = m[0] * dx + m[1] * dy + m[2] * dz
    # the source has the smaller angle between its normal and the line to the other point
    swapped = abs(along_n) < abs(along_m)
    u = m if swapped else n
    t = n if swapped else m
    if swapped:
        dx = -dx
        dy = -dy
        dz = -dz
    phi = -along_m if swapped else along_n
    vx = dy * u[2] - dz * u[1]
    vy = dz * u[0] - dx * u[2]
    vz = dx * u[1] - dy * u[0]
    size = np.sqrt(vx * vx + vy * vy + vz * vz)
    if size < 1e-9:  # the line is the normal: the other axes are free
        return
    vx /= size
    vy /= size
    vz /= size
    wx = u[1] * vz - u[2] * vy
    wy = u[2] * vx - u[0] * vz
    wz = u[0] * vy - u[1] * vx
    alpha = vx * t[0] + vy * t[1] + vz * t[2]
    theta = np.arctan2(wx * t[0] + wy * t[1] + wz * t[2], u[0] * t[0] + u[1] * t[1] + u[2] * t[2])
    out[_bin((theta + np.pi) / (2 * np.pi))] += 1.0
    out[BINS + _bin((alpha + 1.0) / 2.0)] += 1.0
    out[2 * BINS + _bin((phi + 1.0) / 2.0)] += 1.0


@njit(cache=True, nogil=True)
def _simple_histograms(points: F64, normals: F64, cells: Cells, radius: float) -> F64:
    """Simplified histograms (n, 33) of the pairs of each point with its neighbours."""
    out = np.zeros((len(points), SIZE))
    nearby_rows = np.empty(len(points), np.int64)
    for row in range(len(points)):
        count = neighbours(points, cells, row, radius, nearby_rows)
        for other in nearby_rows[:count]:
            _add_pair(points[row], normals[row], points[other], normals[other], out[row])
        _scale(out[row])
    return out


@njit(cache=True, nogil=True)
def _scale(histogram: F64) -> None:
    for first in range(0, SIZE, BINS):
        total = histogram[first : first + BINS].sum()
        if total > 0:
            histogram[first : first + BINS] *= SUM / total


@njit(cache=True, nogil=True)
def _weighted_sums(points: F64, simple: F64, cells: Cells, keypoints: I64, radius: float) -> F32:
    """The histogram of each keypoint and the mean of its neighbours', weighted by 1 / distance."""
    out = np.zeros((len(keypoints), SIZE), np.float32)
    nearby_rows = np.empty(len(points), np.int64)
    total = np.empty(SIZE)
    for number in range(len(keypoints)):
        row = keypoints[number]
        count = neighbours(points, cells, row, radius, nearby_rows)
        total[:] = 0.0
        for other in nearby_rows[:count]:
            dx = points[other, 0] - points[row, 0]
            dy = points[other, 1] - points[row, 1]
            dz = points[other, 2] - points[row, 2]
            total += simple[other] / np.sqrt(dx * dx + dy * dy + dz * dz)
        if count:
            total = simple[row] + total / count
        _scale(total)
        out[number] = total.astype(np.float32)
    return out
