"""Registration of one cloud with another: points on the planes of cells.

The target is cut into cells, each with the mean and the normal of its points (Magnusson, The
three-dimensional normal-distributions transform, 2009); the source's points are moved on these
planes (Chen and Medioni, Object modelling by registration of multiple range images, 1992). It is
coarse beside the fit of :mod:`semloc_logs.alignment`, a few centimetres, and takes milliseconds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.arrays import F64, I64
from semloc_logs.numerics.eigen import eigen
from semloc_logs.numerics.hash_table import EMPTY, empty_table, place_of
from semloc_logs.numerics.local_shape import MOMENTS, add_point, covariance
from semloc_logs.numerics.transforms import exp_se3

LEAST_POINTS = 5  # of a cell with a plane
THIN = 0.3  # a plane is thinner than this share of its width
WIDE = 0.1  # and wider than this share of its length: a single line of a LIDAR has no plane
ITERATIONS = 12
STEP = 1e-4  # an update shorter than this (cells, radians) ends the iteration
DAMPING = 1e-4  # of the Gauss-Newton step, as a share of the trace: where the scene does not tell


@dataclass(frozen=True, slots=True, eq=False)
class PlaneCells:
    """Planes by cell of ``size`` metres: ``means`` and ``normals`` (n, 3).

    ``table`` holds the keys of cells and ``rows`` the plane at each of its places, -1 without one.
    """

    size: float
    table: I64
    rows: I64
    means: F64
    normals: F64

    @staticmethod
    def of(points: NDArray[np.floating], size: float) -> PlaneCells:
        """The planes of ``points`` (n, 3)."""
        return PlaneCells(size, *_planes(np.ascontiguousarray(points, np.float64), size))


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """``target_T_source`` (4, 4) and how well it fits.

    ``information`` (6, 6) of a left increment (translation, rotation about the target's origin) for
    distances of 1 m standard deviation; ``rms`` of the distances (m); ``share`` of the source's
    points that lie on a plane.
    """

    target_T_source: F64
    information: F64
    rms: float
    share: float


def register(target: PlaneCells, source: F64, start: F64) -> Fit:
    """Moves ``source`` (n, 3) from ``start`` (4, 4) onto the planes of the ``target``."""
    pose = start.copy()
    hessian = np.zeros((6, 6))
    gradient = np.zeros(6)
    for _ in range(ITERATIONS):
        _normal_equations(target_arrays(target), source, pose, hessian, gradient)
        damped = hessian + np.eye(6) * (DAMPING * np.trace(hessian) / 6 + 1e-9)
        step = -np.linalg.solve(damped, gradient)
        pose = exp_se3(step[:3], step[3:]) @ pose
        if np.abs(step).max() < STEP * target.size:
            break
    count, squares = _normal_equations(target_arrays(target), source, pose, hessian, gradient)
    rms = float(np.sqrt(squares / count)) if count else np.inf
    return Fit(pose, hessian.copy(), rms, count / max(len(source), 1))


def share_at(target: PlaneCells, source: F64, pose: F64) -> float:
    """The share of ``source`` (n, 3) that lies on planes of the ``target`` at ``pose`` (4, 4)."""
    count, _ = _normal_equations(target_arrays(target), source, pose, np.zeros((6, 6)), np.zeros(6))
    return count / max(len(source), 1)


def share_along(target: PlaneCells, source: F64, pose: F64, direction: F64) -> float:
    """As :func:`share_at`, of what shows a motion along a unit ``direction`` (3,) of the target.

    A point counts by the square of its plane's slope against the direction: the ground and the
    walls along a street count nothing, they lie on themselves wherever the vehicle is.
    """
    return _weight_along(target_arrays(target), source, pose, direction) / max(len(source), 1)


def target_arrays(target: PlaneCells) -> tuple[float, I64, I64, F64, F64]:
    """The fields as compiled functions take them."""
    return target.size, target.table, target.rows, target.means, target.normals


@njit(cache=True, nogil=True)
def _key(x: float, y: float, z: float, size: float) -> int:
    i = np.int64(np.floor(x / size))
    j = np.int64(np.floor(y / size))
    k = np.int64(np.floor(z / size))
    return int((i << 42) + (j << 21) + k)


@njit(cache=True, nogil=True)
def _planes(points: F64, size: float) -> tuple[I64, I64, F64, F64]:
    table = empty_table(len(points))
    rows = np.full(len(table), -1, np.int64)
    keys = np.empty(len(points), np.int64)
    moments = np.zeros((len(points), MOMENTS))
    corner = np.zeros((len(points), 3))
    count = 0
    for i in range(len(points)):
        x, y, z = points[i]
        key = _key(x, y, z, size)
        place = place_of(table, key)
        if table[place] == EMPTY:
            table[place] = key
            rows[place] = count
            keys[count] = key
            corner[count, 0] = np.floor(x / size) * size
            corner[count, 1] = np.floor(y / size) * size
            corner[count, 2] = np.floor(z / size) * size
            count += 1
        row = rows[place]
        # about the corner of the cell: sums of squares lose digits with the distance
        add_point(moments[row], x - corner[row, 0], y - corner[row, 1], z - corner[row, 2], 1.0)

    planes = 0
    means = np.zeros((count, 3))
    normals = np.zeros((count, 3))
    mean = np.zeros(3)
    a = np.zeros((3, 3))
    values = np.zeros(3)
    vectors = np.zeros((3, 3))
    for row in range(count):
        if moments[row, 0] < LEAST_POINTS:
            continue
        covariance(moments[row], mean, a)
        eigen(a, values, vectors)
        thickness = np.sqrt(max(values[0], 0.0))
        width = np.sqrt(max(values[1], 0.0))
        length = np.sqrt(max(values[2], 0.0))
        if thickness > THIN * width or width < WIDE * length or length == 0.0:
            continue
        keys[planes] = keys[row]
        for k in range(3):
            means[planes, k] = mean[k] + corner[row, k]
            normals[planes, k] = vectors[k, 0]
        planes += 1

    # a table of the planes alone is small enough for the caches: it is looked up many times
    table = empty_table(planes)
    rows = np.full(len(table), -1, np.int64)
    for row in range(planes):
        place = place_of(table, keys[row])
        table[place] = keys[row]
        rows[place] = row
    return table, rows, means[:planes].copy(), normals[:planes].copy()


@njit(cache=True, nogil=True)
def _nearest(target: tuple[float, I64, I64, F64, F64], q: F64) -> int:
    """The plane of the eight cells around the corner that is nearest to a point; -1 without one."""
    size, table, rows, means, _ = target
    x0 = np.int64(np.floor(q[0] / size - 0.5))
    y0 = np.int64(np.floor(q[1] / size - 0.5))
    z0 = np.int64(np.floor(q[2] / size - 0.5))
    best = -1
    least = size * size
    for corner in range(8):
        x = x0 + (corner & 1)
        y = y0 + ((corner >> 1) & 1)
        z = z0 + (corner >> 2)
        row = rows[place_of(table, (x << 42) + (y << 21) + z)]
        if row < 0:
            continue
        distance = (
            (q[0] - means[row, 0]) ** 2 + (q[1] - means[row, 1]) ** 2 + (q[2] - means[row, 2]) ** 2
        )
        if distance < least:
            least = distance
            best = row
    return int(best)


@njit(cache=True, nogil=True)
def _move(pose: F64, point: F64, q: F64) -> None:
    """Fill ``q`` with a point (3,) moved by a pose (4, 4)."""
    for k in range(3):
        q[k] = pose[k, 0] * point[0] + pose[k, 1] * point[1] + pose[k, 2] * point[2] + pose[k, 3]


@njit(cache=True, nogil=True)
def _weight_along(
    target: tuple[float, I64, I64, F64, F64], source: F64, pose: F64, direction: F64
) -> float:
    """Squared slopes of the planes that moved points lie on."""
    size, _, _, means, normals = target
    scale = (size / 6.0) ** 2
    weight = 0.0
    q = np.empty(3)
    for i in range(len(source)):
        _move(pose, source[i], q)
        best = _nearest(target, q)
        if best < 0:
            continue
        error = 0.0
        slope = 0.0
        for k in range(3):
            error += normals[best, k] * (q[k] - means[best, k])
            slope += normals[best, k] * direction[k]
        if error * error < scale:
            weight += slope * slope
    return weight


@njit(cache=True, nogil=True)
def _normal_equations(
    target: tuple[float, I64, I64, F64, F64], source: F64, pose: F64, hessian: F64, gradient: F64
) -> tuple[int, float]:
    """Fill ``hessian`` and ``gradient`` of the squared distances; the points on planes, and their
    sum of squares. Distances above a sixth of a cell count less and less (Geman and McClure).
    """
    size, _, _, means, normals = target
    hessian[:] = 0.0
    gradient[:] = 0.0
    scale = (size / 6.0) ** 2
    count = 0
    squares = 0.0
    q = np.empty(3)
    jacobian = np.empty(6)
    for i in range(len(source)):
        _move(pose, source[i], q)
        best = _nearest(target, q)
        if best < 0:
            continue
        n = normals[best]
        error = (
            n[0] * (q[0] - means[best, 0])
            + n[1] * (q[1] - means[best, 1])
            + n[2] * (q[2] - means[best, 2])
        )
        weight = (scale / (scale + error * error)) ** 2
        jacobian[0] = n[0]
        jacobian[1] = n[1]
        jacobian[2] = n[2]
        jacobian[3] = q[1] * n[2] - q[2] * n[1]
        jacobian[4] = q[2] * n[0] - q[0] * n[2]
        jacobian[5] = q[0] * n[1] - q[1] * n[0]
        for r in range(6):
            gradient[r] += weight * jacobian[r] * error
            for c in range(r, 6):
                hessian[r, c] += weight * jacobian[r] * jacobian[c]
        if error * error < scale:
            count += 1
            squares += error * error
    for r in range(6):
        for c in range(r):
            hessian[r, c] = hessian[c, r]
    return count, squares
