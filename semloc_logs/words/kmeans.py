"""k-means that does not depend on threads, BLAS or block size (Lloyd 1982).

Points and centroids are multiples of 2^-11 and no longer than 1 (:func:`grid`), so their products
are multiples of 2^-22 whose partial sums stay below 1 (Cauchy-Schwarz): float32 holds them exactly
in whatever order a matrix product adds, and float64 holds the exact sums of any number of points
that fits into memory.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.arrays import F32

STEP = 2.0**-11
BLOCK = 16384  # points compared at once: 16 MB of similarities to 256 centroids


def grid(a: NDArray[np.floating]) -> F32:
    """``a`` rounded to multiples of 2^-11."""
    return (np.round(np.asarray(a, np.float32) * 2048) / 2048).astype(np.float32)


def nearest_centroids(points: F32, centroids: F32) -> tuple[NDArray[np.int64], F32]:
    """Row of the nearest of ``centroids`` (k, d) for each of ``points`` (n, d), and its distance.

    The first of equals; squared distances (n,). Both are multiples of 2^-11.
    """
    half = (centroids**2).sum(1) / 2
    nearest = np.zeros(len(points), np.int64)
    distance = np.zeros(len(points), np.float32)
    for i in range(0, len(points), BLOCK):
        block = points[i : i + BLOCK]
        score = half - block @ centroids.T
        nearest[i : i + BLOCK] = best = score.argmin(1)
        distance[i : i + BLOCK] = (block**2).sum(1) + 2 * score[np.arange(len(block)), best]
    return nearest, distance


@njit(cache=True, nogil=True)
def _sums(
    points: F32, nearest: NDArray[np.int64], k: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Sums (k, d) and counts (k,) of the points of each centroid."""
    sums = np.zeros((k, points.shape[1]))
    count = np.zeros(k, np.int64)
    for i in range(len(points)):
        count[nearest[i]] += 1
        for d in range(points.shape[1]):
            sums[nearest[i], d] += points[i, d]
    return sums, count


def kmeans(points: NDArray[np.floating], k: int, rng: np.random.Generator, rounds: int) -> F32:
    """Centroids (k, d) of ``points`` (n, d), n >= k, no longer than 1, by Lloyd's algorithm.

    It starts from distinct random points. A centroid without points takes the point farthest from
    its own. Points and centroids are rounded to multiples of 2^-11.
    """
    points = grid(points)
    centroids = points[np.sort(rng.choice(len(points), k, replace=False))].copy()
    for _ in range(rounds):
        nearest, distance = nearest_centroids(points, centroids)
        sums, count = _sums(points, nearest, k)
        full = count > 0
        moved = centroids.copy()
        moved[full] = grid(sums[full] / count[full, None])
        moved[~full] = points[np.argsort(-distance, kind="stable")[: int((~full).sum())]]
        if np.array_equal(moved, centroids):
            break
        centroids = moved
    return centroids
