"""Point-to-plane ICP with a robust kernel, and the information of what it finds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.alignment.surface import Arrays, Surface, look_at, nearest_points

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
LEAST_POINTS = 12  # that an alignment needs
KERNEL = 0.15  # of the robust weights, in units of the radius
LOOSE = 0.1  # weight of points that are not on planes
LONGEST_TURN = 0.2  # of one step, radians


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """``target_T_query``; ``inliers`` share and ``count`` of query points within the last radius;
    ``rmse`` of their plane distances (m); ``information`` (6, 6), of (translation, rotation) as
    left increments about the query's centre ``centre`` in the target frame, in units of 1 / (plane
    distance noise)^2; ``pull`` (2, 6): the right side of its equations if all uncertain points of
    the query, or of the target, were a standard deviation too far.
    """

    target_T_query: F64
    inliers: float
    count: int
    rmse: float
    information: F64
    centre: F64
    pull: F64


@dataclass(frozen=True, slots=True)
class Step:
    """Correspondences within ``radius`` metres, at most ``iterations`` times, with every
    ``stride``-th query point.
    """

    radius: float
    iterations: int
    stride: int = 1


def align(
    query: F64,
    surface: Surface,
    target_T_query: F64,
    steps: tuple[Step, ...],
    spread: F64 | None = None,
    noise: float = 0.05,
    hold: float = 0.0,
) -> Fit:
    """Refine ``target_T_query`` for ``query`` points (n, 3) step by step.

    Gauss-Newton on the distances to the target's tangent planes (point distances where the surface
    is not planar), Cauchy weights. A step of no iterations moves nothing: the fit is that of the
    given transform. ``spread`` (n, 3) is one standard deviation of each point along its ray, in
    metres; a point weighs as much as ``noise`` (m), that of planes, leaves it across the plane. The
    start holds the middle of the query as ``hold`` of its points on planes would; it may turn about
    it.
    """
    radii, iterations, strides = (
        np.array([getattr(step, name) for step in steps])
        for name in ("radius", "iterations", "stride")
    )
    points = np.ascontiguousarray(query, float)
    T, centre, used, count, squared, information, pull = _align(
        points,
        np.zeros((0, 3)) if spread is None else np.ascontiguousarray(spread, float),
        surface.arrays,
        np.array(target_T_query, float),
        (radii.astype(float), iterations.astype(np.int64), strides.astype(np.int64)),
        float(noise) ** 2,
        float(hold),
    )
    if count < LEAST_POINTS:
        return Fit(T, 0.0, count, float("inf"), np.zeros((6, 6)), centre, np.zeros((2, 6)))
    return Fit(T, count / used, count, float(np.sqrt(squared / count)), information, centre, pull)


@njit(cache=True, nogil=True)
def _align(
    query: F64,
    spread: F64,
    surface: Arrays,
    start: F64,
    steps: tuple[F64, I64, I64],
    noise: float,
    hold: float,
) -> tuple[F64, F64, int, int, float, F64, F64]:
    """The transform, the centre of the points, how many were used and how many met a surface, their
    squares, information and pull.
    """
    T = start
    centre = start[:3, 3].copy()
    count = 0
    used = 0
    squared = 0.0
    information = np.zeros((6, 6))
    pull = np.zeros((2, 6))
    query_centre = np.zeros(3)
    for n in range(len(query) if hold > 0 else 0):
        for k in range(3):
            query_centre[k] += query[n, k] / len(query)
    radii, iterations, strides = steps
    for step in range(len(radii)):
        radius = radii[step]
        last = step == len(radii) - 1
        some = query[:: strides[step]]
        moved = np.empty((len(some), 3))
        ray = np.zeros((len(some) if len(spread) else 0, 3))
        used = len(some)
        for _ in range(max(iterations[step], 1)):
            centre[:] = 0.0
            for n in range(used):
                for k in range(3):
                    moved[n, k] = (
                        T[k, 0] * some[n, 0] + T[k, 1] * some[n, 1] + T[k, 2] * some[n, 2] + T[k, 3]
                    )
                    centre[k] += moved[n, k] / used
            for n in range(len(ray)):
                s = spread[n * strides[step]]
                for k in range(3):
                    ray[n, k] = T[k, 0] * s[0] + T[k, 1] * s[1] + T[k, 2] * s[2]
            index = nearest_points(surface, moved, radius)
            count = int((index >= 0).sum())
            if count < LEAST_POINTS:
                return T, centre if used else T[:3, 3].copy(), used, count, 0.0, information, pull
            look_at(surface, index)
            kernel = (KERNEL * radius) ** 2
            squared, information, pull, H, g = _normal_equations(
                moved, ray, index, surface, centre, kernel, noise
            )
            if iterations[step] == 0:
                break
            for k in range(3):
                off = start[k, 3] - T[k, 3]
                for m in range(3):
                    off += (start[k, m] - T[k, m]) * query_centre[m]
                g[k] -= hold / strides[step] * off
                H[k, k] += hold / strides[step]
            move = -np.linalg.solve(H + 1e-6 * np.trace(H) * np.eye(6), g)
            angle = np.sqrt(move[3] ** 2 + move[4] ** 2 + move[5] ** 2)
            if angle > LONGEST_TURN:
                move *= LONGEST_TURN / angle
                angle = LONGEST_TURN
            T = _moved(T, centre, move)
            # the next step starts over with less: only the last one has to settle
            length = np.sqrt(move[0] ** 2 + move[1] ** 2 + move[2] ** 2)
            if length < (5e-4 if last else 2e-2) * radius and angle < (2e-5 if last else 5e-4):
                break
    return T, centre, used, count, squared, information, pull


@njit(cache=True, nogil=True)
def _moved(T: F64, centre: F64, move: F64) -> F64:
    """``T`` (4, 4) turned about ``centre`` (3,) by the rotation vector ``move[3:]`` and moved by
    ``move[:3]``.
    """
    w = move[3:]
    angle = np.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2)
    K = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    # Rodrigues; of small angles the series
    a, b = (np.sin(angle) / angle, (1 - np.cos(angle)) / angle**2) if angle > 1e-6 else (1.0, 0.5)
    R = np.eye(3) + a * K + b * (K @ K)
    out = np.eye(4)
    out[:3, :3] = R @ np.ascontiguousarray(T[:3, :3])
    out[:3, 3] = R @ (T[:3, 3] - centre) + centre + move[:3]
    return out


@njit(cache=True, nogil=True)
def _normal_equations(
    moved: F64, ray: F64, index: I64, surface: Arrays, centre: F64, kernel: float, noise: float
) -> tuple[float, F64, F64, F64, F64]:
    """Sum of the squared plane distances, those of uncertain points (``ray`` (n, 3) or (0, 3);
    variance ``noise`` without) for as much as they count; information (6, 6) and pull (2, 6) of the
    planes alone; normal equations (6, 6), (6,) of planes and points.
    """
    points, normals, planar, _, spread = surface
    information = np.zeros((6, 6))
    H = np.zeros((6, 6))
    g = np.zeros(6)
    pull = np.zeros((2, 6))
    squared = 0.0
    J = np.empty(6)
    o = np.empty(3)
    a = np.empty(3)
    for n in range(len(moved)):
        i = index[n]
        if i < 0:
            continue
        for k in range(3):
            a[k] = moved[n, k] - centre[k]
            o[k] = moved[n, k] - points[i, k]
            J[k] = normals[i, k]
        J[3], J[4], J[5] = (
            a[1] * J[2] - a[2] * J[1],
            a[2] * J[0] - a[0] * J[2],
            a[0] * J[1] - a[1] * J[0],
        )
        r = o[0] * J[0] + o[1] * J[1] + o[2] * J[2]
        across = along = off = off_target = 0.0
        if len(ray):
            off = ray[n, 0] * J[0] + ray[n, 1] * J[1] + ray[n, 2] * J[2]
            across = off * off
            along = ray[n, 0] ** 2 + ray[n, 1] ** 2 + ray[n, 2] ** 2
        if len(spread):
            off_target = spread[i, 0] * J[0] + spread[i, 1] * J[1] + spread[i, 2] * J[2]
        across += off_target * off_target
        certain = noise / (noise + across)
        squared += certain * r * r
        weight = planar[i] * certain / (1 + r * r / (kernel + across))
        for k in range(6):
            g[k] += weight * J[k] * r
            pull[0, k] += weight * J[k] * off
            pull[1, k] += weight * J[k] * off_target
            for m in range(k, 6):
                information[k, m] += weight * J[k] * J[m]
        if planar[i] < 1.0:
            # points that are not on planes (poles, leaves) hold what planes leave free, weakly
            certain = noise / (noise + along)
            weight = (
                (1 - planar[i])
                * LOOSE
                * certain
                / (1 + (o[0] * o[0] + o[1] * o[1] + o[2] * o[2]) / (kernel + along))
            )
            _add_point(H, g, a, o, weight)
    for k in range(6):
        for m in range(k):
            information[k, m] = information[m, k]
            H[k, m] = H[m, k]
    return squared, information, pull, H + information, g


@njit(cache=True, nogil=True)
def _add_point(H: F64, g: F64, a: F64, o: F64, weight: float) -> None:
    """Add weight * J^T J, above the diagonal, and weight * J^T o of the point distance ``o`` at arm
    ``a``, J = [I, -[a]x].
    """
    for k in range(3):
        H[k, k] += weight
        g[k] += weight * o[k]
    H[0, 4] += weight * a[2]
    H[0, 5] -= weight * a[1]
    H[1, 3] -= weight * a[2]
    H[1, 5] += weight * a[0]
    H[2, 3] += weight * a[1]
    H[2, 4] -= weight * a[0]
    H[3, 3] += weight * (a[1] * a[1] + a[2] * a[2])
    H[4, 4] += weight * (a[0] * a[0] + a[2] * a[2])
    H[5, 5] += weight * (a[0] * a[0] + a[1] * a[1])
    H[3, 4] -= weight * a[0] * a[1]
    H[3, 5] -= weight * a[0] * a[2]
    H[4, 5] -= weight * a[1] * a[2]
    g[3] += weight * (a[1] * o[2] - a[2] * o[1])
    g[4] += weight * (a[2] * o[0] - a[0] * o[2])
    g[5] += weight * (a[0] * o[1] - a[1] * o[0])
