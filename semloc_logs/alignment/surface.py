"""The target of an alignment on points: a hash of cells to find the nearest point in, and tangent planes made when they are first met."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.labels.eigen import eigen
from semloc_logs.labels.shape import shapes_of

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
NEIGHBOURS = 14  # that make a tangent plane
RINGS = 4  # of cells around a point that they are looked for in
SCATTERED, LINEAR = 0.3, 0.9  # planes are less than this
THICK, LEAST_FLAT = 0.5, 8  # of slabs of uncertain points, and how many make one
Arrays = tuple[F64, F64, F64, float, F64, I64, I64, I64, F64]  # of a surface, in the order of its fields


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Target ``points`` (n, 3) ordered by cells of ``cell`` metres from ``low`` (3,); points ``start[c]`` to ``start[c + 1]`` lie in cell
    ``c``, which the hash table ``keys`` -> ``rows`` finds. ``normals`` (n, 3) are unit vectors and ``planar`` (n,) is 1 where the
    surroundings are a plane, 0 where not, -1 where nobody has asked yet. ``spread`` (n, 3) is one standard deviation of the points
    along their rays, metres, of a flattened surface; (0, 3) else."""

    points: F64
    normals: F64
    planar: F64
    cell: float
    low: F64
    start: I64
    keys: I64
    rows: I64
    spread: F64 = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def arrays(self) -> Arrays:
        """All of it, for compiled functions."""
        return self.points, self.normals, self.planar, self.cell, self.low, self.start, self.keys, self.rows, self.spread

    @property
    def sigma(self) -> float:
        """Median standard deviation of the points along their rays, metres; 0 of a surface that is not flattened."""
        return float(np.median(np.linalg.norm(self.spread, axis=1))) if len(self.spread) else 0.0


def surface_of(points: NDArray[np.floating], cell: float) -> Surface:
    """A surface of ``points`` (n, 3), best of some points in each of the occupied cells of ``cell`` metres."""
    p = np.asarray(points, float)
    order, hashed = _hashed(p, cell)
    return Surface(np.ascontiguousarray(p[order]), np.zeros_like(p), np.full(len(p), -1.0), cell, *hashed)


def flattened_surface(points: F64, spread: F64, kept: I64, radius: float, noise: float) -> Surface:
    """A surface through the middle of what ``points`` (n, 3) with ``spread`` (n, 3), a standard deviation along their rays, saw of a wall.

    Points of a camera lie in a slab as thick as their ranges are uncertain, in which the nearest one is near whatever the alignment: so
    the points ``kept`` (m,) move onto the plane of those within ``radius`` metres, each of weight 1 / (noise^2 + sigma^2) (moving least
    squares: Alexa et al., Computing and Rendering Point Set Surfaces, TVCG 2003, with planes).
    """
    (order, hashed), sigma = _hashed(points, radius), np.linalg.norm(spread, axis=1)
    moved, normals, planar = _flattened(points[order], sigma[order], *hashed, points[kept], radius, noise)
    order, hashed = _hashed(moved, radius)
    return Surface(moved[order], normals[order], planar[order], radius, *hashed, np.ascontiguousarray(spread[kept][order]))


def _hashed(p: F64, cell: float) -> tuple[I64, tuple[F64, I64, I64, I64]]:
    """The order of points (n, 3) by cells, and what finds them: ``low``, ``start``, ``keys`` and ``rows`` of :class:`Surface`."""
    low = p.min(0) if len(p) else np.zeros(3)
    key = _keys(p, cell, low)
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.r_[True, np.diff(key[order]) != 0]) if len(p) else np.zeros(0, np.int64)
    size = 16
    while size < 2 * len(first):
        size *= 2
    keys, rows = _table(key[order][first], size)
    return order, (low, np.r_[first, len(p)].astype(np.int64), keys, rows)


@njit(cache=True, nogil=True)
def _flattened(
    around: F64, sigma: F64, low: F64, start: I64, keys: I64, rows: I64, points: F64, radius: float, noise: float
) -> tuple[F64, F64, F64]:
    """Each of ``points`` (m, 3) on the plane of those ``around`` it, in cells of ``radius``, the plane's normal, and whether it is one."""
    moved, normals, planar = points.copy(), np.zeros((len(points), 3)), np.zeros(len(points))
    mean, a, values, vectors = np.empty(3), np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    for n in range(len(points)):
        p = points[n]
        x, y, z = int(np.floor((p[0] - low[0]) / radius)), int(np.floor((p[1] - low[1]) / radius)), int(np.floor((p[2] - low[2]) / radius))
        mean[:], a[:], total, count = 0.0, 0.0, 0.0, 0
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                for dz in range(-1, 2):
                    row = _find(keys, rows, _key(x + dx, y + dy, z + dz))
                    if row < 0:
                        continue
                    for i in range(start[row], start[row + 1]):
                        o0, o1, o2 = around[i, 0] - p[0], around[i, 1] - p[1], around[i, 2] - p[2]
                        if o0 * o0 + o1 * o1 + o2 * o2 > radius * radius:
                            continue
                        w = 1.0 / (noise * noise + sigma[i] * sigma[i])
                        total, count = total + w, count + 1
                        mean[0] += w * o0
                        mean[1] += w * o1
                        mean[2] += w * o2
                        a[0, 0] += w * o0 * o0
                        a[1, 1] += w * o1 * o1
                        a[2, 2] += w * o2 * o2
                        a[0, 1] += w * o0 * o1
                        a[0, 2] += w * o0 * o2
                        a[1, 2] += w * o1 * o2
        if count < LEAST_FLAT:
            continue
        mean /= total
        a[1, 0], a[2, 0], a[2, 1] = a[0, 1], a[0, 2], a[1, 2]
        for k in range(3):
            for m in range(3):
                a[k, m] = a[k, m] / total - mean[k] * mean[m]
        eigen(a, values, vectors)
        s0, s1, s2 = np.sqrt(max(values[0], 0.0)), np.sqrt(max(values[1], 0.0)), np.sqrt(max(values[2], 0.0)) + 1e-9
        off = mean[0] * vectors[0, 0] + mean[1] * vectors[1, 0] + mean[2] * vectors[2, 0]
        for k in range(3):
            normals[n, k] = vectors[k, 0]
            moved[n, k] += off * vectors[k, 0]
        planar[n] = 1.0 if s0 / s2 < THICK and (s2 - s1) / s2 < LINEAR else 0.0
    return moved, normals, planar


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
def look_at(surface: Arrays, index: I64) -> None:
    """Make the tangent planes of the points ``index`` (m,) that have none yet; -1 is no point."""
    points, normals, planar, cell, low, start, keys, rows, _ = surface
    wanted, count = np.empty(len(index), np.int64), 0
    for i in index:
        if i >= 0 and planar[i] < 0:
            planar[i] = 0.0  # so that it is taken once
            wanted[count] = i
            count += 1
    if count:
        wanted = wanted[:count]
        normal, _, linear, _, scattered = shapes_of(points, wanted, _around(points, cell, low, start, keys, rows, wanted))
        for n, i in enumerate(wanted):
            normals[i] = normal[n]
            planar[i] = 1.0 if scattered[n] < SCATTERED and linear[n] < LINEAR else 0.0


@njit(cache=True, nogil=True)
def nearest_points(surface: Arrays, query: F64, radius: float) -> I64:
    """Number (m,) of the surface's point nearest to each of ``query`` (m, 3), -1 where none is nearer than ``radius``."""
    points, _, _, cell, low, start, keys, rows, _ = surface
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
