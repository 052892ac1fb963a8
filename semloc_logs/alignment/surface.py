"""The target of an alignment on points: a hash of cells to find the nearest point in, and tangent planes made when they are first met."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.labels.shape import shapes_at

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
NEIGHBOURS = 14  # that make a tangent plane
RINGS = 4  # of cells around a point that they are looked for in
SCATTERED, LINEAR = 0.3, 0.9  # planes are less than this


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Target ``points`` (n, 3) ordered by cells of ``cell`` metres from ``low`` (3,); points ``start[c]`` to ``start[c + 1]`` lie in cell
    ``c``, which the hash table ``keys`` -> ``rows`` finds. ``normals`` (n, 3) are unit vectors and ``planar`` (n,) is 1 where the
    surroundings are a plane, 0 where not, -1 where nobody has asked yet."""

    points: F64
    normals: F64
    planar: F64
    cell: float
    low: F64
    start: I64
    keys: I64
    rows: I64

    def nearest(self, points: F64, radius: float) -> I64:
        """Number (m,) of the point nearest to each of ``points`` (m, 3), -1 where none is nearer than ``radius``."""
        return np.asarray(_nearest(self.points, self.cell, self.low, self.start, self.keys, self.rows, points, radius))

    def look_at(self, index: I64) -> None:
        """Make the tangent planes of the points ``index`` that have none yet."""
        wanted = np.unique(index[self.planar[index] < 0])
        if len(wanted):
            around = _around(self.points, self.cell, self.low, self.start, self.keys, self.rows, wanted)
            s = shapes_at(self.points, wanted, around)
            self.normals[wanted] = s.normal
            self.planar[wanted] = (s.scattered < SCATTERED) & (s.linear < LINEAR)


def surface_of(points: NDArray[np.floating], cell: float) -> Surface:
    """A surface of ``points`` (n, 3), best of some points in each of the occupied cells of ``cell`` metres."""
    p = np.asarray(points, float)
    low = p.min(0) if len(p) else np.zeros(3)
    key = _keys(p, cell, low)
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.r_[True, np.diff(key[order]) != 0]) if len(p) else np.zeros(0, np.int64)
    size = 16
    while size < 2 * len(first):
        size *= 2
    keys, rows = _table(key[order][first], size)
    start = np.r_[first, len(p)].astype(np.int64)
    return Surface(np.ascontiguousarray(p[order]), np.zeros_like(p), np.full(len(p), -1.0), cell, low, start, keys, rows)


@njit(cache=True, nogil=True)
def _key(x: int, y: int, z: int) -> int:
    return (x << 42) + (y << 21) + z  # cells that share a number are only looked through in vain: distances decide


@njit(cache=True, nogil=True)
def _keys(points: F64, cell: float, low: F64) -> I64:
    out = np.empty(len(points), np.int64)
    for i in range(len(points)):
        x, y, z = (points[i, 0] - low[0]) / cell, (points[i, 1] - low[1]) / cell, (points[i, 2] - low[2]) / cell
        out[i] = _key(int(np.floor(x)), int(np.floor(y)), int(np.floor(z)))
    return out


@njit(cache=True, nogil=True)
def _slot(key: int, mask: int) -> int:
    return ((key * 0x9E3779B97F4A7C1) >> 20) & mask


@njit(cache=True, nogil=True)
def _table(cells: I64, size: int) -> tuple[I64, I64]:
    """Open addressing; rows are -1 where the table is empty."""
    keys, rows = np.zeros(size, np.int64), np.full(size, -1, np.int64)
    for row in range(len(cells)):
        h = _slot(cells[row], size - 1)
        while rows[h] >= 0:
            h = (h + 1) & (size - 1)
        keys[h], rows[h] = cells[row], row
    return keys, rows


@njit(cache=True, nogil=True)
def _find(keys: I64, rows: I64, key: int) -> int:
    """Row of a cell, -1 where it is empty."""
    h = _slot(key, len(keys) - 1)
    while rows[h] >= 0 and keys[h] != key:
        h = (h + 1) & (len(keys) - 1)
    return int(rows[h])


@njit(cache=True, nogil=True)
def _gap(offset: int, inside: float, cell: float) -> float:
    """Distance along an axis from a point at ``inside`` (0..1) of its cell to the cell ``offset`` away."""
    if offset > 0:
        return (offset - inside) * cell
    return (inside - offset - 1) * cell if offset < 0 else 0.0


@njit(cache=True, nogil=True)
def _nearest(points: F64, cell: float, low: F64, start: I64, keys: I64, rows: I64, query: F64, radius: float) -> I64:
    found = np.full(len(query), -1, np.int64)
    rings = int(np.ceil(radius / cell))
    for n in range(len(query)):
        px, py, pz = query[n, 0], query[n, 1], query[n, 2]
        gx, gy, gz = (px - low[0]) / cell, (py - low[1]) / cell, (pz - low[2]) / cell
        x, y, z = int(np.floor(gx)), int(np.floor(gy)), int(np.floor(gz))
        gx, gy, gz = gx - x, gy - y, gz - z
        margin = min(gx, 1 - gx, gy, 1 - gy, gz, 1 - gz)
        best = radius * radius
        for ring in range(rings + 1):
            for dx in range(-ring, ring + 1):
                ax = _gap(dx, gx, cell) ** 2
                if ax >= best:
                    continue
                for dy in range(-ring, ring + 1):
                    axy = ax + _gap(dy, gy, cell) ** 2
                    if axy >= best:
                        continue
                    step = 1 if abs(dx) == ring or abs(dy) == ring else max(2 * ring, 1)
                    for dz in range(-ring, ring + 1, step):
                        if axy + _gap(dz, gz, cell) ** 2 >= best:
                            continue
                        row = _find(keys, rows, _key(x + dx, y + dy, z + dz))
                        if row < 0:
                            continue
                        for i in range(start[row], start[row + 1]):
                            d = (points[i, 0] - px) ** 2 + (points[i, 1] - py) ** 2 + (points[i, 2] - pz) ** 2
                            if d < best:
                                best = d
                                found[n] = i
            if ((ring + margin) * cell) ** 2 >= best:
                break
    return found


@njit(cache=True, nogil=True)
def _around(points: F64, cell: float, low: F64, start: I64, keys: I64, rows: I64, wanted: I64) -> I64:
    """The nearest points (m, NEIGHBOURS) of the points ``wanted``, themselves among them, -1 where there are fewer in RINGS cells."""
    found = np.full((len(wanted), NEIGHBOURS), -1, np.int64)
    distance = np.empty(NEIGHBOURS)
    for n in range(len(wanted)):
        p = points[wanted[n]]
        gx, gy, gz = (p[0] - low[0]) / cell, (p[1] - low[1]) / cell, (p[2] - low[2]) / cell
        x, y, z = int(np.floor(gx)), int(np.floor(gy)), int(np.floor(gz))
        gx, gy, gz = gx - x, gy - y, gz - z
        margin = min(gx, 1 - gx, gy, 1 - gy, gz, 1 - gz)
        distance[:] = np.inf
        for ring in range(RINGS + 1):
            for dx in range(-ring, ring + 1):
                for dy in range(-ring, ring + 1):
                    axy = _gap(dx, gx, cell) ** 2 + _gap(dy, gy, cell) ** 2
                    step = 1 if abs(dx) == ring or abs(dy) == ring else max(2 * ring, 1)
                    for dz in range(-ring, ring + 1, step):
                        if axy + _gap(dz, gz, cell) ** 2 >= distance[-1]:
                            continue
                        row = _find(keys, rows, _key(x + dx, y + dy, z + dz))
                        if row >= 0:
                            _take(points, p, start[row], start[row + 1], distance, found[n])
            if ((ring + margin) * cell) ** 2 >= distance[-1]:
                break
    return found


@njit(cache=True, nogil=True)
def _take(points: F64, p: F64, first: int, end: int, distance: F64, found: I64) -> None:
    """Insert points ``first`` to ``end`` into the list of the nearest, ascending by squared ``distance``."""
    for i in range(first, end):
        d = (points[i, 0] - p[0]) ** 2 + (points[i, 1] - p[1]) ** 2 + (points[i, 2] - p[2]) ** 2
        if d < distance[-1]:
            k = len(distance) - 1
            while k > 0 and distance[k - 1] > d:
                distance[k], found[k] = distance[k - 1], found[k - 1]
                k -= 1
            distance[k], found[k] = d, i
