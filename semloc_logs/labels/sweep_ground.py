"""The ground below a sweep: a height for each cell of a level grid, grown outwards from the sensor.

Echoes that come by way of a window or a puddle lie metres below the street, and parked cars, hedges
and fronts of houses hide it. The ground, however, is continuous: from cell to cell it rises or
falls by little. So it starts with the height of most cells below the sensor and is followed
outwards: points far below the height that the neighbours predict are echoes, points far above it
are objects.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.arrays import F64, I32, I64
from semloc_logs.numerics.cells import by_cell

CELL = 1.0  # of the grid, at street scale (m)
# points farther than this from the sensor, in x, y or z, are left out, at street scale (m)
REACH = 120.0
SEED_RANGE = 15.0  # of cells that give the height of the ground below the sensor (m)
# m from one cell to the next, and by how much each unseen cell between widens it
STEP, WIDENING, MOST_GAP = 0.25, 0.12, 4.0
LAYER = 0.12  # points this near to the lowest of a cell are ground (m)
ROUNDS = 16  # of relaxation, two for each way through the grid


@dataclass(frozen=True, slots=True, eq=False)
class GroundSurface:
    """Heights ``z`` (nx, ny) at the centres of cells of ``cell`` metres.

    The grid's corner is at ``low`` (2,); ``gap`` (nx, ny) is the way to the nearest cell where the
    ground was seen, in cells, 0 where it was seen itself.
    """

    low: F64
    cell: float
    z: F64
    gap: F64

    def centres(self) -> F64:
        """Centres (nx, ny, 2) of the cells."""
        x, y = (self.low[k] + (np.arange(self.z.shape[k]) + 0.5) * self.cell for k in range(2))
        return np.stack(np.meshgrid(x, y, indexing="ij"), -1)

    def height_at(self, xy: NDArray[np.floating]) -> F64:
        """Height (n,) of the ground at ``xy`` (n, 2), bilinear between cells.

        Outside of the grid the height of its border.
        """
        positions = np.ascontiguousarray(xy, np.float64)
        return np.asarray(_bilinear(self.z, (positions - self.low) / self.cell - 0.5))


def ground_surface(
    points: NDArray[np.floating], origin: NDArray[np.floating], scale: float = 1.0
) -> GroundSurface:
    """The ground below level ``points`` (n, 3), z up, seen from ``origin`` (3,).

    ``scale`` is the voxel size over 0.30 m. Points beyond 120 m (at 0.30 m voxels) of the origin in
    any axis do not count.
    """
    cell = CELL * scale
    o = np.asarray(origin, np.float64)
    p = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
    p = p[(np.abs(p - o) <= REACH * scale).all(1)]
    if not len(p):
        return GroundSurface(
            o[:2] - cell, cell, np.full((2, 2), o[2] - 1.7 * scale), np.full((2, 2), np.inf)
        )
    low = p[:, :2].min(0) - cell
    nx, ny = (np.floor((p[:, :2].max(0) - low) / cell) + 2).astype(int).tolist()
    column = ((p[:, :2] - low) / cell).astype(np.int64)
    order, start = by_cell(column[:, 0] * ny + column[:, 1], nx * ny)
    cells = _Cells(p[:, 2].copy(), order, start, nx, ny)
    lowest = _lowest(cells)
    i, j = np.divmod(np.arange(nx * ny), ny)
    away = np.hypot(low[0] + (i + 0.5) * cell - o[0], low[1] + (j + 0.5) * cell - o[1])
    seed = _seed(lowest, away, float(o[2]), scale)
    if seed is None:
        seed = float(np.percentile(p[:, 2], 2))
    z, gap = _grow(cells, np.argsort(away, kind="stable"), seed, scale)
    smooth = _relax(z, gap, nx, ny, scale)
    return GroundSurface(low, cell, smooth.reshape(nx, ny), gap.reshape(nx, ny))


class _Cells(NamedTuple):
    """Points of height ``z`` (n,) by cells of a grid (nx, ny), for compiled functions.

    Cell a = i * ny + j holds the points ``order[start[a]:start[a + 1]]``.
    """

    z: F64
    order: I64
    start: I32
    nx: int
    ny: int


def _seed(lowest: F64, away: F64, origin_z: float, scale: float) -> float | None:
    """The most frequent lowest height of the cells around the sensor and below it, if any."""
    candidates = lowest[
        (away < SEED_RANGE * scale)
        & (lowest < origin_z - 0.3 * scale)
        & (lowest > origin_z - 5 * scale)
    ]
    if not len(candidates):
        return None
    bins = np.round(candidates / (0.1 * scale)).astype(np.int64)
    bins -= bins.min()
    count = (
        np.convolve(np.bincount(bins), [1, 2, 1], "same") if bins.max() > 1 else np.bincount(bins)
    )
    return float(np.median(candidates[np.abs(bins - int(np.argmax(count))) <= 1]))


@njit(cache=True, nogil=True)
def _lowest(cells: _Cells) -> F64:
    """Lowest height of each cell, infinite without points."""
    z, order, start, _, _ = cells
    out = np.full(len(start) - 1, np.inf)
    for a in range(len(out)):
        for k in range(start[a], start[a + 1]):
            out[a] = min(out[a], z[order[k]])
    return out


@njit(cache=True, nogil=True)
def _predicted(z: F64, gap: F64, a: int, nx: int, ny: int) -> tuple[float, float]:
    """The height of cell ``a`` by the visited cells within two cells, and the way to a seen one.

    The way is in cells, -1 where none of them was visited.
    """
    i = a // ny
    j = a % ny
    weight, height, nearest = 0.0, 0.0, -1.0
    for u in range(max(i - 2, 0), min(i + 3, nx)):
        for v in range(max(j - 2, 0), min(j + 3, ny)):
            b = u * ny + v
            if gap[b] >= 0:
                d = np.sqrt((u - i) ** 2 + (v - j) ** 2)
                w = 1.0 / (d * (1.0 + gap[b])) ** 2
                weight += w
                height += w * z[b]
                if nearest < 0 or gap[b] + d < nearest:
                    nearest = gap[b] + d
    return height / weight if weight > 0 else 0.0, nearest


@njit(cache=True, nogil=True)
def _grow(cells: _Cells, sequence: I64, seed: float, scale: float) -> tuple[F64, F64]:
    """Height and gap of all cells, visited in ``sequence``; the first ones lie at ``seed``."""
    height, order, start, nx, ny = cells
    z = np.empty(nx * ny)
    gap = np.full(nx * ny, -1.0)
    for a in sequence:
        predicted, away = _predicted(z, gap, a, nx, ny)
        if away < 0:
            predicted, away = seed, 1.0
        tolerance = scale * (STEP + WIDENING * min(away, MOST_GAP))
        lowest = np.inf
        for k in range(start[a], start[a + 1]):
            h = height[order[k]]
            if h > predicted - tolerance and h < lowest:
                lowest = h
        z[a], gap[a] = predicted, away
        if lowest < predicted + tolerance:
            total, count = 0.0, 0
            for k in range(start[a], start[a + 1]):
                h = height[order[k]]
                if lowest <= h < lowest + LAYER * scale or h == lowest:
                    total += h
                    count += 1
            z[a], gap[a] = total / count, 0.0
    return z, gap


@njit(cache=True, nogil=True)
def _relax(z: F64, gap: F64, nx: int, ny: int, scale: float) -> F64:
    """A membrane through the seen heights: robust least squares by Gauss-Seidel steps.

    Heights above it pull on it less.
    """
    s = z.copy()
    for r in range(ROUNDS):
        for q in range(nx * ny):
            a = q if r % 2 == 0 else nx * ny - 1 - q
            i = a // ny
            j = a % ny
            total, count = 0.0, 0
            if i > 0:
                total += s[a - ny]
                count += 1
            if i < nx - 1:
                total += s[a + ny]
                count += 1
            if j > 0:
                total += s[a - 1]
                count += 1
            if j < ny - 1:
                total += s[a + 1]
                count += 1
            weight = 0.0
            if gap[a] == 0:
                off = (z[a] - s[a]) / (scale * (0.08 if z[a] > s[a] else 0.2))
                weight = 2.0 / (1.0 + off * off)
            s[a] = (weight * z[a] + 0.5 * total) / (weight + 0.5 * count)
    return s


@njit(cache=True, nogil=True)
def _bilinear(z: F64, position: F64) -> F64:
    """Values at fractional indices ``position`` (n, 2), clamped to the grid."""
    out = np.empty(len(position))
    for k in range(len(position)):
        u = min(max(position[k, 0], 0.0), z.shape[0] - 1.0)
        v = min(max(position[k, 1], 0.0), z.shape[1] - 1.0)
        i = min(int(u), z.shape[0] - 2)
        j = min(int(v), z.shape[1] - 2)
        a = u - i
        b = v - j
        out[k] = (1 - a) * ((1 - b) * z[i, j] + b * z[i, j + 1]) + a * (
            (1 - b) * z[i + 1, j] + b * z[i + 1, j + 1]
        )
    return out
