"""Shape of the surroundings of voxels: their points, their columns, the objects they belong to.

Points are summed up in voxels first, so that a neighbourhood is a sum over a few voxels and not
over its points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from semloc_logs.arrays import F64, I64, Bools
from semloc_logs.numerics.cells import cell_starts
from semloc_logs.numerics.eigen import eigen
from semloc_logs.numerics.local_shape import MOMENTS, add_point, covariance, principal_axes

# of surroundings without normals: as if they pointed everywhere
NO_TILT = 1 / 3
NO_ORDER = 1 / 3
MOST_GAP = 3  # empty voxels within one column
LEAST = 5  # points that a normal is taken from: three always lie in a plane
CROWN = 16  # voxels; how far above it something may spread over a trunk


@dataclass(frozen=True, slots=True, eq=False)
class Voxels:
    """Occupied voxels (m, 3) from a corner at zero, in columns and from low to high.

    ``of_point`` (n,) is the voxel of each point; column a = i * ny + j holds voxels start[a] ..
    start[a + 1].
    """

    ijk: I64
    of_point: I64
    shape: tuple[int, int]
    start: I64


@dataclass(frozen=True, slots=True, eq=False)
class VoxelShapes:
    """One entry for each occupied voxel (m,); lengths in metres.

    ``rough``: standard deviation of the points of 3^3 voxels along their normal. ``tilt`` and
    ``wide_tilt``: mean squared vertical part of the normals of 5^3 and 9^3 voxels (0: upright
    surfaces only, 1: level ones only); ``disorder`` and ``wide_disorder``: smallest eigenvalue of
    these normals' second moments (0: planes that share a line, 1/3: no order at all). ``thick`` and
    ``long``: standard deviation of the points of the 3 x 3 columns within four voxels, horizontally
    where it is greatest, and vertically. ``up``, ``down``: how far these columns go on without a
    gap of a metre. ``beside``: number of voxels at 2 and 3 voxels from them, two up and two down.
    ``crown``: number of voxels beside and 3 to 16 voxels above.
    """

    rough: F64
    tilt: F64
    disorder: F64
    wide_tilt: F64
    wide_disorder: F64
    thick: F64
    long: F64
    up: F64
    down: F64
    beside: I64
    crown: I64


def voxelise(points: F64, size: float) -> Voxels:
    """Voxels of ``size`` metres that ``points`` (n, 3), n > 0, occupy.

    Memory goes with the area that they cover.
    """
    ijk = np.floor(points / size).astype(np.int64)
    ijk -= ijk.min(0)
    nx, ny, nz = (ijk.max(0) + 1).tolist()
    key, of_point = np.unique((ijk[:, 0] * ny + ijk[:, 1]) * nz + ijk[:, 2], return_inverse=True)
    column = key // nz
    ijk = np.stack([column // ny, column % ny, key % nz], 1)
    return Voxels(ijk, of_point.reshape(-1), (nx, ny), cell_starts(column, nx * ny))


def voxel_shapes(points: F64, voxels: Voxels, size: float) -> VoxelShapes:
    """Shapes of the surroundings of ``voxels`` of ``size`` metres, made from ``points`` (n, 3)."""
    nx, ny = voxels.shape
    moments = _moments(points - points.mean(0), voxels.of_point, len(voxels.ijk))
    rough, normal = _normals(voxels.ijk, moments, voxels.start, nx, ny)
    values, counts = _surroundings(voxels.ijk, moments, normal, voxels.start, nx, ny)
    up, down = _columns(voxels.ijk, voxels.start, nx, ny)
    tilt, disorder, wide_tilt, wide_disorder, thick, long = values.T
    metres_up = size * up.astype(np.float64)
    metres_down = size * down.astype(np.float64)
    return VoxelShapes(
        rough,
        tilt,
        disorder,
        wide_tilt,
        wide_disorder,
        thick,
        long,
        metres_up,
        metres_down,
        counts[:, 0],
        counts[:, 1],
    )


@njit(cache=True, nogil=True)
def _moments(p: F64, of_point: I64, m: int) -> F64:
    """Moments (m, 10) of the points of each voxel."""
    out = np.zeros((m, MOMENTS))
    for i in range(len(p)):
        add_point(out[of_point[i]], p[i, 0], p[i, 1], p[i, 2], 1.0)
    return out


@njit(cache=True, nogil=True)
def _normals(ijk: I64, moments: F64, start: I64, nx: int, ny: int) -> tuple[F64, F64]:
    """Least standard deviation (m,) of the points of 3^3 voxels, and its direction (m, 3).

    The direction is zero where the points are too few.
    """
    m = len(ijk)
    rough = np.empty(m)
    normal = np.zeros((m, 3))
    total = np.empty(MOMENTS)
    mean = np.empty(3)
    spread = np.empty(3)
    a = np.empty((3, 3))
    axes = np.empty((3, 3))
    for k in range(m):
        i, j, z = ijk[k]
        total[:] = 0.0
        for u in range(max(i - 1, 0), min(i + 2, nx)):
            for q in range(start[u * ny + max(j - 1, 0)], start[u * ny + min(j + 1, ny - 1) + 1]):
                if abs(ijk[q, 2] - z) <= 1:
                    for t in range(MOMENTS):
                        total[t] += moments[q, t]
        covariance(total, mean, a)
        principal_axes(a, spread, axes)
        rough[k] = spread[0]
        if total[0] >= LEAST:
            for t in range(3):
                normal[k, t] = axes[t, 0]
    return rough, normal


@njit(cache=True, nogil=True)
def _surroundings(
    ijk: I64, moments: F64, normal: F64, start: I64, nx: int, ny: int
) -> tuple[F64, I64]:
    """Values (m, 6) and counts (m, 2) of the surroundings of each voxel.

    Tilt, disorder, wide tilt, wide disorder, thickness, length; voxels beside and in the crown.
    """
    m = len(ijk)
    out = np.empty((m, 6))
    counts = np.zeros((m, 2), np.int64)
    outer = np.empty((m, 7))
    inner = np.empty(7)
    wide = np.empty(7)
    tall = np.empty(MOMENTS)
    mean = np.empty(3)
    for k in range(m):
        x, y, z = normal[k]
        outer[k] = np.array((x * x, x * y, x * z, y * y, y * z, z * z, x * x + y * y + z * z))
    a = np.empty((3, 3))
    values = np.empty(3)
    vectors = np.empty((3, 3))
    for k in range(m):
        i, j, z = ijk[k]
        inner[:], wide[:], tall[:] = 0.0, 0.0, 0.0
        for u in range(max(i - 4, 0), min(i + 5, nx)):
            for q in range(start[u * ny + max(j - 4, 0)], start[u * ny + min(j + 4, ny - 1) + 1]):
                dz = ijk[q, 2] - z
                if dz < -4 or dz > CROWN:
                    continue
                d = max(abs(u - i), abs(ijk[q, 1] - j))
                if dz <= 4:
                    for t in range(7):
                        wide[t] += outer[q, t]
                    if d <= 1:
                        for t in range(MOMENTS):
                            tall[t] += moments[q, t]
                if d <= 2 and abs(dz) <= 2:
                    for t in range(7):
                        inner[t] += outer[q, t]
                if 2 <= d <= 3 and abs(dz) <= 2:
                    counts[k, 0] += 1
                if d >= 2 and dz >= 3:
                    counts[k, 1] += 1
        out[k, 0], out[k, 1] = _order(inner, a, values, vectors)
        out[k, 2], out[k, 3] = _order(wide, a, values, vectors)
        covariance(tall, mean, a)
        out[k, 4], out[k, 5] = _thickness(a)
    return out, counts


@njit(cache=True, nogil=True)
def _order(total: F64, a: F64, values: F64, vectors: F64) -> tuple[float, float]:
    """Tilt and disorder of summed normals, as in :class:`VoxelShapes`."""
    if total[6] < 1e-9:
        return NO_TILT, NO_ORDER
    t = 0
    for r in range(3):
        for c in range(r, 3):
            a[r, c] = a[c, r] = total[t] / total[6]
            t += 1
    tilt = a[2, 2]
    eigen(a, values, vectors)
    return tilt, max(values[0], 0.0)


@njit(cache=True, nogil=True)
def _thickness(a: F64) -> tuple[float, float]:
    """Standard deviations of a covariance: horizontally along the longer axis, and vertically."""
    longer = 0.5 * (a[0, 0] + a[1, 1]) + np.sqrt(
        0.25 * (a[0, 0] - a[1, 1]) ** 2 + a[0, 1] * a[0, 1]
    )
    return np.sqrt(max(longer, 0.0)), np.sqrt(max(a[2, 2], 0.0))


@njit(cache=True, nogil=True)
def _columns(ijk: I64, start: I64, nx: int, ny: int) -> tuple[I64, I64]:
    """Voxels that the 3 x 3 columns around each voxel go on up and down."""
    m = len(ijk)
    up = np.zeros(m, np.int64)
    down = np.zeros(m, np.int64)
    height = ijk[:, 2].max() + 1
    taken = np.zeros(height, np.bool_)
    before = -1
    for k in range(m):
        i, j, z = ijk[k]
        if i * ny + j != before:  # voxels of a column follow each other
            before = i * ny + j
            taken[:] = False
            for u in range(max(i - 1, 0), min(i + 2, nx)):
                for q in range(
                    start[u * ny + max(j - 1, 0)], start[u * ny + min(j + 1, ny - 1) + 1]
                ):
                    taken[ijk[q, 2]] = True
        for direction in (1, -1):
            t = z + direction
            reached = 0
            gap = 0
            while 0 <= t < height and gap <= MOST_GAP:
                if taken[t]:
                    reached = abs(t - z)
                    gap = 0
                else:
                    gap += 1
                t += direction
            if direction == 1:
                up[k] = reached
            else:
                down[k] = reached
    return up, down


def objects(voxels: Voxels, member: Bools, height: F64, size: float) -> tuple[F64, F64, F64]:
    """Length, width and top (m,) of the object of each ``member`` voxel (m,), seen from above.

    Zeros for the other voxels. Objects are columns of members that touch, also by their corners.
    Length and width are the sides of a rectangle with the same second moments; the top is the
    greatest ``height`` (m,). Metres.
    """
    number, count = _label(voxels.ijk, voxels.start, *voxels.shape, member)
    xy = voxels.ijk[:, :2].astype(np.float64)
    n = np.maximum(np.bincount(number, minlength=count), 1)
    mean = [np.bincount(number, xy[:, k], count) / n for k in range(2)]
    dx = xy[:, 0] - mean[0][number]
    dy = xy[:, 1] - mean[1][number]
    xx, xy_, yy = (np.bincount(number, v, count) / n for v in (dx * dx, dx * dy, dy * dy))
    root = np.sqrt(0.25 * (xx - yy) ** 2 + xy_**2)
    axes = [size * np.sqrt(12 * np.maximum(0.5 * (xx + yy) + s * root, 0.0) + 1.0) for s in (1, -1)]
    top = np.zeros(count)
    np.maximum.at(top, number, height)
    length, width, top = (np.where(member, a[number], 0.0) for a in (*axes, top))
    return length, width, top


@njit(cache=True, nogil=True)
def _label(ijk: I64, start: I64, nx: int, ny: int, member: Bools) -> tuple[I64, int]:
    """The number (m,) of the object of each voxel, 0 for no member, and the next free number."""
    m = len(ijk)
    number = np.zeros(m, np.int64)
    stack = np.empty(m, np.int64)
    count = 1
    for first in range(m):
        if not member[first] or number[first]:
            continue
        number[first], stack[0], size = count, first, 1
        while size:
            size -= 1
            i = ijk[stack[size], 0]
            j = ijk[stack[size], 1]
            for u in range(max(i - 1, 0), min(i + 2, nx)):
                for q in range(
                    start[u * ny + max(j - 1, 0)], start[u * ny + min(j + 1, ny - 1) + 1]
                ):
                    if member[q] and not number[q]:
                        number[q], stack[size] = count, q
                        size += 1
        count += 1
    return number, count
