"""The surface of a target: points in cells, to find the nearest one, and their tangent planes.

The planes are made when they are first met.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.arrays import F64, I32, I64
from semloc_logs.mapping.selection import thin
from semloc_logs.numerics.cells import by_cell
from semloc_logs.numerics.local_shape import (
    LEAST_SPREAD,
    MOMENTS,
    add_point,
    covariance,
    principal_axes,
    shapes_of,
)

NEIGHBOURS = 14  # that make a tangent plane
RINGS = 4  # of cells around a point that they are looked for in
# planes are less scattered and less linear than this
SCATTERED = 0.3
LINEAR = 0.9
# slabs of uncertain points are thinner than this share of their width, and have so many points
THICK = 0.5
LEAST_FLAT = 8


# A grid of cells: their edge (m), where it begins (3,), how many there are along each axis (3,),
# and ``start``: points ``start[c]`` to ``start[c + 1]`` lie in cell c. A plain tuple, which
# compiled functions pass on without a cost.
Cells = tuple[float, F64, I64, I32]
Point = tuple[float, float, float]
Arrays = tuple[F64, F64, F64, Cells, F64]  # of a surface, in the order of its fields


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Target ``points`` (n, 3) ordered by the ``cells`` they lie in.

    ``normals`` (n, 3) are unit vectors and ``planar`` (n,) is 1 where the surroundings are a plane,
    0 where not, -1 where they are not computed yet. ``spread`` (n, 3) is one standard deviation of
    the points along their rays, metres, of a flattened surface; (0, 3) else.
    """

    points: F64
    normals: F64
    planar: F64
    cells: Cells
    spread: F64 = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def arrays(self) -> Arrays:
        """All of it, for compiled functions."""
        return self.points, self.normals, self.planar, self.cells, self.spread

    @property
    def sigma(self) -> float:
        """Median standard deviation of the points along their rays, metres; 0 if not flattened."""
        return float(np.median(np.linalg.norm(self.spread, axis=1))) if len(self.spread) else 0.0


def thin_points(points: F64, cell: float, spread: F64) -> I64:
    """Numbers of one point a cell: the one of least ``spread`` (n, 3), of equal ones the first."""
    if not spread.any():
        return thin(points.astype(np.float32), cell)
    order = np.argsort(np.einsum("ij,ij->i", spread, spread), kind="stable")
    return order[thin(points[order].astype(np.float32), cell)]


def surface_of(points: NDArray[np.floating], cell: float) -> Surface:
    """A surface of ``points`` (n, 3); best are some points in each occupied cell of ``cell`` m."""
    p = np.ascontiguousarray(points, float)
    order, cells = _in_cells(p, cell)
    return Surface(p[order], np.zeros_like(p), np.full(len(p), -1.0), cells)


def flattened_surface(points: F64, spread: F64, kept: I64, radius: float, noise: float) -> Surface:
    """A surface through the middle of the slab in which uncertain ``points`` (n, 3) lie.

    ``spread`` (n, 3) is a standard deviation along their rays, metres. Points of a camera lie in a
    slab as thick as their ranges are uncertain, in which the nearest one is near for any alignment:
    so the points ``kept`` (m,) move onto the plane of those within ``radius`` metres, each of
    weight 1 / (noise^2 + sigma^2) (moving least squares: Alexa et al., Computing and Rendering
    Point Set Surfaces, TVCG 2003, with planes).
    """
    sigma = np.linalg.norm(spread, axis=1)
    order, cells = _in_cells(points, radius)
    moved, normals, planar = _flattened(points[order], sigma[order], cells, points[kept], noise)
    order, cells = _in_cells(moved, radius)
    return Surface(
        moved[order],
        normals[order],
        planar[order],
        cells,
        np.ascontiguousarray(spread[kept][order]),
    )


def _in_cells(points: F64, edge: float) -> tuple[I64, Cells]:
    """The order of points (n, 3) by cells of ``edge`` m, in a cell as they came; and the cells."""
    order, low, shape, start = _sorted(points, edge)
    return order, (float(edge), low, shape, start)


@njit(cache=True, nogil=True)
def _sorted(points: F64, cell: float) -> tuple[I64, F64, I64, I32]:
    """The order of points (n, 3) by their cells, and ``low``, ``shape`` and ``start`` of these."""
    low = np.full(3, np.inf)
    high = np.full(3, -np.inf)
    shape = np.ones(3, np.int64)
    for n in range(len(points)):
        for k in range(3):
            low[k] = min(low[k], points[n, k])
            high[k] = max(high[k], points[n, k])
    if not len(points):
        low[:] = high[:] = 0.0
    for k in range(3):
        shape[k] += int(np.floor((high[k] - low[k]) / cell))
    number = np.empty(len(points), np.int64)
    for n in range(len(points)):
        x = int(np.floor((points[n, 0] - low[0]) / cell))
        y = int(np.floor((points[n, 1] - low[1]) / cell))
        z = int(np.floor((points[n, 2] - low[2]) / cell))
        number[n] = (x * shape[1] + y) * shape[2] + z
    order, start = by_cell(number, shape[0] * shape[1] * shape[2])
    return order, low, shape, start


@njit(cache=True, nogil=True)
def _in_cells_of(cells: Cells, p: Point) -> Point:
    """The point ``p`` in units of cells, from where the grid begins."""
    cell, low, _, _ = cells
    return (p[0] - low[0]) / cell, (p[1] - low[1]) / cell, (p[2] - low[2]) / cell


@njit(cache=True, nogil=True)
def _column(cells: Cells, x: int, y: int, low: int, high: int) -> tuple[int, int]:
    """The range of points in cells ``low`` to ``high``, both included, of column (x, y).

    It is empty beside the grid.
    """
    _, _, shape, start = cells
    low = max(low, 0)
    high = min(high, shape[2] - 1)
    if low > high or x < 0 or y < 0 or x >= shape[0] or y >= shape[1]:
        return 0, 0
    column = (x * shape[1] + y) * shape[2]
    return int(start[column + low]), int(start[column + high + 1])


@njit(cache=True, nogil=True)
def _flattened(
    around: F64, sigma: F64, cells: Cells, points: F64, noise: float
) -> tuple[F64, F64, F64]:
    """Each of ``points`` (m, 3) on the plane of those ``around`` it, its normal, whether planar.

    Points within a cell's edge make the plane.
    """
    moved = points.copy()
    normals = np.zeros((len(points), 3))
    planar = np.zeros(len(points))
    moments = np.empty(MOMENTS)
    mean = np.empty(3)
    a = np.empty((3, 3))
    extent = np.empty(3)
    axes = np.empty((3, 3))
    for n in range(len(points)):
        p = (points[n, 0], points[n, 1], points[n, 2])
        if _sum_around(around, sigma, cells, p, noise, moments) < LEAST_FLAT:
            continue
        covariance(moments, mean, a)
        principal_axes(a, extent, axes)
        longest = extent[2] + LEAST_SPREAD
        height = mean[0] * axes[0, 0] + mean[1] * axes[1, 0] + mean[2] * axes[2, 0]
        for k in range(3):
            normals[n, k] = axes[k, 0]
            moved[n, k] += height * axes[k, 0]
        is_thin = extent[0] / longest < THICK
        planar[n] = 1.0 if is_thin and (longest - extent[1]) / longest < LINEAR else 0.0
    return moved, normals, planar


@njit(cache=True, nogil=True)
def _sum_around(around: F64, sigma: F64, cells: Cells, p: Point, noise: float, moments: F64) -> int:
    """The number of points ``around`` within a cell's edge of ``p``.

    ``moments`` (10,): filled with the moments of their offsets from ``p``.
    """
    radius = cells[0]
    gx, gy, gz = _in_cells_of(cells, p)
    x = int(np.floor(gx))
    y = int(np.floor(gy))
    z = int(np.floor(gz))
    moments[:] = 0.0
    count = 0
    for dx in range(-1, 2):
        for dy in range(-1, 2):
            first, end = _column(cells, x + dx, y + dy, z - 1, z + 1)
            for i in range(first, end):
                o0 = around[i, 0] - p[0]
                o1 = around[i, 1] - p[1]
                o2 = around[i, 2] - p[2]
                if o0 * o0 + o1 * o1 + o2 * o2 > radius * radius:
                    continue
                count += 1
                add_point(moments, o0, o1, o2, 1.0 / (noise * noise + sigma[i] * sigma[i]))
    return count


@njit(cache=True, nogil=True)
def _gap(offset: int, inside: float, cell: float) -> float:
    """Distance along an axis from a point, at ``inside`` (0..1) of its cell, to another cell.

    The other cell is ``offset`` cells away.
    """
    if offset > 0:
        return (offset - inside) * cell
    return (inside - offset - 1) * cell if offset < 0 else 0.0


@njit(cache=True, nogil=True)
def look_at(surface: Arrays, index: I64) -> None:
    """Make the tangent planes of the points ``index`` (m,) that lack one; -1 stands for none."""
    points, normals, planar, cells, _ = surface
    wanted = np.empty(len(index), np.int64)
    count = 0
    for i in index:
        if i >= 0 and planar[i] < 0:
            planar[i] = 0.0  # so that it is taken once
            wanted[count] = i
            count += 1
    if count:
        wanted = wanted[:count]
        normal, _, linear, _, scattered = shapes_of(points, wanted, _around(points, cells, wanted))
        for n, i in enumerate(wanted):
            normals[i] = normal[n]
            planar[i] = 1.0 if scattered[n] < SCATTERED and linear[n] < LINEAR else 0.0


@njit(cache=True, nogil=True)
def nearest_points(surface: Arrays, query: F64, radius: float) -> I64:
    """Number (m,) of the surface's point nearest to each of ``query`` (m, 3).

    It is -1 where none is nearer than ``radius``.
    """
    points, _, _, cells, _ = surface
    cell = cells[0]
    nearest = np.full(len(query), -1, np.int64)
    rings = int(np.ceil(radius / cell))
    for n in range(len(query)):
        p = (query[n, 0], query[n, 1], query[n, 2])
        gx, gy, gz = _in_cells_of(cells, p)
        x = int(np.floor(gx))
        y = int(np.floor(gy))
        z = int(np.floor(gz))
        fx = gx - x
        fy = gy - y
        margin = min(fx, 1 - fx, fy, 1 - fy)
        best = radius * radius
        number = -1
        # most lie in the point's own cell: the others are soon too far
        best, number = _nearer(points, _column(cells, x, y, z, z), p, best, number)
        for ring in range(rings + 1):
            for dx in range(-ring, ring + 1):
                ax = _gap(dx, fx, cell) ** 2
                if ax >= best:
                    continue
                step = 1 if abs(dx) == ring else max(2 * ring, 1)
                for dy in range(-ring, ring + 1, step):
                    rest = best - ax - _gap(dy, fy, cell) ** 2
                    if rest <= 0:
                        continue
                    up = np.sqrt(rest) / cell
                    column = _column(
                        cells, x + dx, y + dy, int(np.floor(gz - up)), int(np.floor(gz + up))
                    )
                    best, number = _nearer(points, column, p, best, number)
            if ((ring + margin) * cell) ** 2 >= best:
                break
        nearest[n] = number
    return nearest


@njit(cache=True, nogil=True)
def _nearer(
    points: F64,
    column: tuple[int, int],
    p: Point,
    best: float,
    number: int,
) -> tuple[float, int]:
    """Squared distance and number of the nearest point to ``p``, of those in ``column``.

    Point ``number`` at the squared distance ``best`` is the nearest so far.
    """
    for i in range(column[0], column[1]):
        d = (points[i, 0] - p[0]) ** 2 + (points[i, 1] - p[1]) ** 2 + (points[i, 2] - p[2]) ** 2
        if d < best:
            best = d
            number = i
    return best, number


@njit(cache=True, nogil=True)
def _around(points: F64, cells: Cells, wanted: I64) -> I64:
    """The nearest points (m, NEIGHBOURS) of the points ``wanted``, themselves among them.

    They are -1 where fewer points lie in RINGS cells.
    """
    cell = cells[0]
    nearest = np.full((len(wanted), NEIGHBOURS), -1, np.int64)
    distance = np.empty(NEIGHBOURS)
    for n in range(len(wanted)):
        p = (points[wanted[n], 0], points[wanted[n], 1], points[wanted[n], 2])
        gx, gy, gz = _in_cells_of(cells, p)
        x = int(np.floor(gx))
        y = int(np.floor(gy))
        z = int(np.floor(gz))
        gx = gx - x
        gy = gy - y
        gz = gz - z
        margin = min(gx, 1 - gx, gy, 1 - gy, gz, 1 - gz)
        distance[:] = np.inf
        for ring in range(RINGS + 1):
            for dx in range(-ring, ring + 1):
                for dy in range(-ring, ring + 1):
                    axy = _gap(dx, gx, cell) ** 2 + _gap(dy, gy, cell) ** 2
                    step = 1 if abs(dx) == ring or abs(dy) == ring else max(2 * ring, 1)
                    for dz in range(-ring, ring + 1, step):
                        if axy + _gap(dz, gz, cell) ** 2 < distance[-1]:
                            first, end = _column(cells, x + dx, y + dy, z + dz, z + dz)
                            _take(points, p, (first, end), distance, nearest[n])
            if ((ring + margin) * cell) ** 2 >= distance[-1]:
                break
    return nearest


@njit(cache=True, nogil=True)
def _take(points: F64, p: Point, column: tuple[int, int], distance: F64, nearest: I64) -> None:
    """Insert the points of ``column`` into the ``nearest``, ascending by squared ``distance``."""
    for i in range(column[0], column[1]):
        d = (points[i, 0] - p[0]) ** 2 + (points[i, 1] - p[1]) ** 2 + (points[i, 2] - p[2]) ** 2
        if d < distance[-1]:
            k = len(distance) - 1
            while k > 0 and distance[k - 1] > d:
                distance[k] = distance[k - 1]
                nearest[k] = nearest[k - 1]
                k -= 1
            distance[k] = d
            nearest[k] = i
