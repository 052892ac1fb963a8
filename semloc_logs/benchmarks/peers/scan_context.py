"""Scan Context (Kim and Kim, IROS 2018): a place as heights over rings and sectors about the
sensor, compared over all turns.

Rings and sectors are the paper's; the radius is that to which the clouds here reach. Written for
comparison.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.arrays import F64

RINGS, SECTORS, RADIUS = 20, 60, 50.0  # m
LIFT = 2.0  # m that heights over the ground are raised by, so that they are positive


@njit(cache=True, nogil=True)
def scan_context(points: NDArray[np.float32]) -> F64:
    """(rings, sectors) of ``points`` (n, 3), metres, level, on the ground: the largest height in
    each cell (equations 1 to 4).
    """
    out = np.zeros((RINGS, SECTORS))
    for i in range(len(points)):
        x = points[i, 0]
        y = points[i, 1]
        ring = int(np.sqrt(x * x + y * y) * RINGS / RADIUS)
        if ring < RINGS:
            sector = int((np.arctan2(y, x) + np.pi) * SECTORS / (2 * np.pi)) % SECTORS
            out[ring, sector] = max(out[ring, sector], points[i, 2] + LIFT)
    return out


@njit(cache=True, nogil=True)
def context_distance(query: F64, database: F64) -> tuple[float, float]:
    """The least mean cosine distance of sectors over all turns (equations 6 and 7), and that turn:
    yaw (rad) of database_T_query.
    """
    best, turn = 2.0, 0
    norm_q = np.sqrt((query**2).sum(0))
    norm_d = np.sqrt((database**2).sum(0))
    dots = query.T @ database
    for shift in range(SECTORS):
        total, count = 0.0, 0
        for s in range(SECTORS):
            d = (s + shift) % SECTORS
            if norm_q[s] > 0 and norm_d[d] > 0:
                total += 1.0 - dots[s, d] / (norm_q[s] * norm_d[d])
                count += 1
        if count and total / count < best:
            best = total / count
            turn = shift
    return best, turn * 2 * np.pi / SECTORS


def nearest_contexts(query: F64, database: list[F64], most: int) -> list[tuple[int, float]]:
    """The ``most`` contexts of the database nearest to the query's, nearest first: their numbers
    and yaws (rad) of database_T_query.
    """
    distances = [context_distance(query, context) for context in database]
    order = np.argsort([distance for distance, _ in distances], kind="stable")[:most]
    return [(int(k), distances[k][1]) for k in order]
