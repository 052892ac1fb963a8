"""Point-to-plane ICP with a robust kernel, and the information of what it finds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.alignment.surface import Surface
from semloc_logs.geometry import apply, exp_se3

F64 = NDArray[np.float64]
LEAST_POINTS = 12  # that an alignment needs
KERNEL = 0.15  # of the robust weights, in units of the radius
LOOSE = 0.1  # weight of points that are not on planes
LONGEST_TURN = 0.2  # of one step, radians


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """``target_T_query``; ``inliers`` share and ``count`` of query points within the last radius; ``rmse`` of their plane distances (m);
    ``information`` (6, 6), of (translation, rotation) as left increments about the query's centre ``centre`` in the target frame,
    in units of 1 / (plane distance noise)^2."""

    target_T_query: F64
    inliers: float
    count: int
    rmse: float
    information: F64
    centre: F64


@dataclass(frozen=True, slots=True)
class Step:
    """Correspondences within ``radius`` metres, at most ``iterations`` times, with every ``stride``-th query point."""

    radius: float
    iterations: int
    stride: int = 1


def align(query: F64, surface: Surface, target_T_query: F64, steps: tuple[Step, ...]) -> Fit:
    """Refine ``target_T_query`` for ``query`` points (n, 3) step by step.

    Gauss-Newton on the distances to the target's tangent planes (point distances where the surface is not planar), Cauchy weights. A
    step of no iterations moves nothing: the fit is that of the given transform.
    """
    T = target_T_query.copy()
    fit = Fit(T, 0.0, 0, float("inf"), np.zeros((6, 6)), T[:3, 3].copy())
    for s in steps:
        some = query[:: s.stride]
        last = s is steps[-1]
        for _ in range(max(s.iterations, 1)):
            moved = apply(T, some)
            fit, H, g = _linearised(moved, surface, T, s.radius)
            if fit.count < LEAST_POINTS:
                return fit
            if s.iterations == 0:
                break
            move = -np.linalg.solve(H + 1e-6 * np.trace(H) * np.eye(6), g)
            turned = float(np.linalg.norm(move[3:]))
            if turned > LONGEST_TURN:
                move *= LONGEST_TURN / turned
            T = _about(fit.centre, exp_se3(move[:3], move[3:])) @ T
            # the next step starts over with less: only the last one has to settle
            if np.linalg.norm(move[:3]) < (5e-4 if last else 2e-2) * s.radius and turned < (2e-5 if last else 5e-4):
                break
    return Fit(T, fit.inliers, fit.count, fit.rmse, fit.information, fit.centre)


def _about(centre: F64, turn: F64) -> F64:
    """``turn`` (4, 4) about ``centre`` (3,)."""
    out = turn.copy()
    out[:3, 3] += centre - turn[:3, :3] @ centre
    return out


def _linearised(moved: F64, surface: Surface, T: F64, radius: float) -> tuple[Fit, F64, F64]:
    """The fit of ``moved`` query points as they lie, and the normal equations (6, 6), (6,) of a better one."""
    if not len(moved):
        return Fit(T, 0.0, 0, float("inf"), np.zeros((6, 6)), T[:3, 3].copy()), np.zeros((6, 6)), np.zeros(6)
    centre = moved.mean(0)
    index = surface.nearest(moved, radius)
    count = int(np.count_nonzero(index >= 0))
    if count < LEAST_POINTS:
        return Fit(T, 0.0, count, float("inf"), np.zeros((6, 6)), centre), np.zeros((6, 6)), np.zeros(6)
    surface.look_at(index[index >= 0])
    information, H, g, squared = _normal_equations(
        moved, index, surface.points, surface.normals, surface.planar, centre, (KERNEL * radius) ** 2
    )
    return Fit(T, count / len(moved), count, float(np.sqrt(squared / count)), information, centre), H, g


@njit(cache=True, nogil=True)
def _normal_equations(
    moved: F64, index: NDArray[np.int64], points: F64, normals: F64, planar: F64, centre: F64, kernel: float
) -> tuple[F64, F64, F64, float]:
    """Information of the planes alone; normal equations of planes and points; sum of the squared plane distances."""
    information, loose = np.zeros((6, 6)), np.zeros((6, 6))
    g, squared = np.zeros(6), 0.0
    J, o, a = np.empty(6), np.empty(3), np.empty(3)
    for n in range(len(moved)):
        i = index[n]
        if i < 0:
            continue
        for k in range(3):
            a[k] = moved[n, k] - centre[k]
            o[k] = moved[n, k] - points[i, k]
            J[k] = normals[i, k]
        J[3], J[4], J[5] = a[1] * J[2] - a[2] * J[1], a[2] * J[0] - a[0] * J[2], a[0] * J[1] - a[1] * J[0]
        r = o[0] * J[0] + o[1] * J[1] + o[2] * J[2]
        squared += r * r
        weight = planar[i] / (1 + r * r / kernel)
        for k in range(6):
            g[k] += weight * J[k] * r
            for m in range(k, 6):
                information[k, m] += weight * J[k] * J[m]
        if planar[i] < 1.0:
            # points that are not on planes (poles, leaves) hold what planes leave free, weakly
            weight = (1 - planar[i]) * LOOSE / (1 + (o[0] * o[0] + o[1] * o[1] + o[2] * o[2]) / kernel)
            _add_point(loose, g, a, o, weight)
    for k in range(6):
        for m in range(k):
            information[k, m] = information[m, k]
            loose[k, m] = loose[m, k]
    return information, information + loose, g, squared


@njit(cache=True, nogil=True)
def _add_point(H: F64, g: F64, a: F64, o: F64, weight: float) -> None:
    """Add weight * J^T J, above the diagonal, and weight * J^T o of the point distance ``o`` at arm ``a``, J = [I, -[a]x]."""
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
