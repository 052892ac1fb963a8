"""Point-to-plane ICP with a robust kernel, and the information of what it finds."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit

from semloc_logs.alignment.surface import Arrays, Surface, look_at, nearest_points
from semloc_logs.arrays import F64, I64

Pair = tuple[float, float]
LEAST_POINTS = 12  # that an alignment needs
KERNEL = 0.15  # of the robust weights, in units of the radius
LOOSE = 0.1  # weight of points that are not on planes
LONGEST_TURN = 0.2  # of one increment, radians
DAMPING = 1e-6  # of the normal equations, in units of their trace
# an increment of less than this, in units of the radius and in radians, ends a step; the next step
# starts over anyway, so only the last one has to settle
SETTLED = (2e-2, 5e-4)
SETTLED_AT_LAST = (5e-4, 2e-5)
SMALL_ANGLE = 1e-6  # rad: below it the series of sine and cosine is exact


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A transform and how well it fits.

    ``target_T_query``; ``inliers`` share and ``count`` of query points within the last radius;
    ``rmse`` of their plane distances (m); ``information`` (6, 6), of (translation, rotation) as
    left increments about the query's centre ``centre`` in the target frame, in units of 1 / (plane
    distance noise)^2; ``range_bias`` (2, 6): the right side of its equations if all uncertain
    points of the query, or of the target, were a standard deviation too far; ``ground_bias``
    (3, 6): the same if level ground was off (:mod:`.level_ground`).
    """

    target_T_query: F64
    inliers: float
    count: int
    rmse: float
    information: F64
    centre: F64
    range_bias: F64
    ground_bias: F64 = field(default_factory=lambda: np.zeros((3, 6)))


@dataclass(frozen=True, slots=True)
class Step:
    """One radius of a fit: correspondences are within ``radius`` metres.

    At most ``iterations`` times, with every ``stride``-th query point.
    """

    radius: float
    iterations: int
    stride: int = 1


@dataclass(frozen=True, slots=True)
class Weighting:
    """What points weigh, and the start.

    ``noise`` of planes whose points are certain (m): an uncertain point weighs as much as it leaves
    across the plane. ``hold``: as many points on planes hold the middle of the query where it
    starts; it may turn about it.
    """

    noise: float = 0.05
    hold: float = 0.0


def align(
    query: F64,
    surface: Surface,
    target_T_query: F64,
    steps: tuple[Step, ...],
    spread: F64 | None = None,
    weighting: Weighting = Weighting(),
) -> Fit:
    """Refine ``target_T_query`` for ``query`` points (n, 3) step by step.

    Gauss-Newton on the distances to the target's tangent planes (point distances where the surface
    is not planar), Cauchy weights. A step of no iterations moves nothing: the fit is the given
    transform's. ``spread`` (n, 3) is one standard deviation of each point along its ray, metres.
    """
    radii, iterations, strides = (
        np.array([getattr(step, name) for step in steps])
        for name in ("radius", "iterations", "stride")
    )
    T, centre, used, count, squared, information, bias = _align(
        np.ascontiguousarray(query, float),
        np.zeros((0, 3)) if spread is None else np.ascontiguousarray(spread, float),
        surface.arrays,
        np.array(target_T_query, float),
        (radii.astype(float), iterations.astype(np.int64), strides.astype(np.int64)),
        (float(weighting.noise) ** 2, float(weighting.hold)),
    )
    if count < LEAST_POINTS:
        return Fit(T, 0.0, count, float("inf"), np.zeros((6, 6)), centre, np.zeros((2, 6)))
    return Fit(T, count / used, count, float(np.sqrt(squared / count)), information, centre, bias)


@njit(cache=True, nogil=True)
def _align(
    query: F64,
    spread: F64,
    surface: Arrays,
    start: F64,
    steps: tuple[F64, I64, I64],
    weighting: Pair,
) -> tuple[F64, F64, int, int, float, F64, F64]:
    """The transform, the points' centre, their numbers, squares, information and range bias.

    The numbers are of the points that were used and of those that met a surface.
    """
    T = start
    centre = start[:3, 3].copy()
    count = 0
    used = 0
    squared = 0.0
    information = np.zeros((6, 6))
    bias = np.zeros((2, 6))
    radii, iterations, strides = steps
    noise, hold = weighting
    query_centre = _mean(query) if hold > 0 else np.zeros(3)
    for step in range(len(radii)):
        radius = radii[step]
        stride = strides[step]
        settled = SETTLED_AT_LAST if step == len(radii) - 1 else SETTLED
        some = query[::stride]
        moved = np.empty((len(some), 3))
        ray = np.zeros((len(some) if len(spread) else 0, 3))
        used = len(some)
        for _ in range(max(iterations[step], 1)):
            centre = _transformed(T, some, moved)
            _turned(T, spread[::stride], ray)
            index = nearest_points(surface, moved, radius)
            count = int((index >= 0).sum())
            if count < LEAST_POINTS:
                centre = centre if used else T[:3, 3].copy()
                return T, centre, used, count, 0.0, information, bias
            look_at(surface, index)
            kernel = (KERNEL * radius) ** 2
            squared, information, bias, H, g = _normal_equations(
                moved, ray, index, surface, centre, (kernel, noise)
            )
            if iterations[step] == 0:
                break
            _add_hold(H, g, T, start, query_centre, hold / stride)
            T, length, angle = _increment(T, centre, H, g)
            if length < settled[0] * radius and angle < settled[1]:
                break
    return T, centre, used, count, squared, information, bias


@njit(cache=True, nogil=True)
def _mean(points: F64) -> F64:
    mean = np.zeros(3)
    for n in range(len(points)):
        for k in range(3):
            mean[k] += points[n, k] / len(points)
    return mean


@njit(cache=True, nogil=True)
def _transformed(T: F64, points: F64, moved: F64) -> F64:
    """The mean (3,) of ``points`` (n, 3) under ``T``, which go into ``moved``."""
    centre = np.zeros(3)
    for n in range(len(points)):
        for k in range(3):
            moved[n, k] = (
                T[k, 0] * points[n, 0] + T[k, 1] * points[n, 1] + T[k, 2] * points[n, 2] + T[k, 3]
            )
            centre[k] += moved[n, k] / len(points)
    return centre


@njit(cache=True, nogil=True)
def _turned(T: F64, spread: F64, ray: F64) -> None:
    """Vectors ``spread`` (n, 3) in the target's axes, into ``ray``."""
    for n in range(len(ray)):
        s = spread[n]
        for k in range(3):
            ray[n, k] = T[k, 0] * s[0] + T[k, 1] * s[1] + T[k, 2] * s[2]


@njit(cache=True, nogil=True)
def _add_hold(H: F64, g: F64, T: F64, start: F64, query_centre: F64, hold: float) -> None:
    """Add to the normal equations what holds the query's centre where it started."""
    for k in range(3):
        moved = start[k, 3] - T[k, 3]
        for m in range(3):
            moved += (start[k, m] - T[k, m]) * query_centre[m]
        g[k] -= hold * moved
        H[k, k] += hold


@njit(cache=True, nogil=True)
def _increment(T: F64, centre: F64, H: F64, g: F64) -> tuple[F64, float, float]:
    """``T`` after one step of Gauss-Newton; how far it moved (m) and turned (rad)."""
    move = -np.linalg.solve(H + DAMPING * np.trace(H) * np.eye(6), g)
    angle = np.sqrt(move[3] ** 2 + move[4] ** 2 + move[5] ** 2)
    if angle > LONGEST_TURN:
        move *= LONGEST_TURN / angle
        angle = LONGEST_TURN
    length = np.sqrt(move[0] ** 2 + move[1] ** 2 + move[2] ** 2)
    return _moved(T, centre, move), length, angle


@njit(cache=True, nogil=True)
def _moved(T: F64, centre: F64, move: F64) -> F64:
    """``T`` (4, 4) moved by ``move[:3]`` and turned about ``centre`` (3,) by ``move[3:]``.

    The turn is a rotation vector.
    """
    w = move[3:]
    angle = np.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2)
    K = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    # Rodrigues; of small angles the series
    a = np.sin(angle) / angle if angle > SMALL_ANGLE else 1.0
    b = (1 - np.cos(angle)) / angle**2 if angle > SMALL_ANGLE else 0.5
    R = np.eye(3) + a * K + b * (K @ K)
    out = np.eye(4)
    out[:3, :3] = R @ np.ascontiguousarray(T[:3, :3])
    out[:3, 3] = R @ (T[:3, 3] - centre) + centre + move[:3]
    return out


@njit(cache=True, nogil=True)
def _normal_equations(
    moved: F64, ray: F64, index: I64, surface: Arrays, centre: F64, variances: Pair
) -> tuple[float, F64, F64, F64, F64]:
    """Squared distances, information (6, 6), range bias (2, 6); normal equations (6, 6), (6,).

    The squares are summed over plane distances; uncertain points count by their weight.
    ``variances``: of the robust kernel, and of certain planes. ``ray`` is (n, 3), or (0, 3) where
    points are certain. The first three are of planes alone,
    the normal equations of planes and points.
    """
    points, normals, planar, _, spread = surface
    kernel, noise = variances
    information = np.zeros((6, 6))
    H = np.zeros((6, 6))
    g = np.zeros(6)
    bias = np.zeros((2, 6))
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
        J[3] = a[1] * J[2] - a[2] * J[1]
        J[4] = a[2] * J[0] - a[0] * J[2]
        J[5] = a[0] * J[1] - a[1] * J[0]
        r = _dot(o, J)
        off = _dot(ray[n], J) if len(ray) else 0.0
        off_target = _dot(spread[i], J) if len(spread) else 0.0
        along = ray[n, 0] ** 2 + ray[n, 1] ** 2 + ray[n, 2] ** 2 if len(ray) else 0.0
        across = off * off + off_target * off_target
        certain = noise / (noise + across)
        squared += certain * r * r
        weight = planar[i] * certain / (1 + r * r / (kernel + across))
        _add_plane(information, g, bias, J, (weight, r, off, off_target))
        if planar[i] < 1.0:
            # points that are not on planes (poles, leaves) hold what planes leave free, weakly
            certain = noise / (noise + along)
            loose = (1 - planar[i]) * LOOSE * certain
            _add_point(H, g, a, o, loose / (1 + _dot(o, o) / (kernel + along)))
    _mirror(information)
    _mirror(H)
    return squared, information, bias, H + information, g


@njit(cache=True, nogil=True)
def _dot(a: F64, b: F64) -> float:
    """The scalar product of the first three values of each."""
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@njit(cache=True, nogil=True)
def _add_plane(
    information: F64, g: F64, bias: F64, J: F64, plane: tuple[float, float, float, float]
) -> None:
    """Add weight * J^T J, above the diagonal, weight * J^T r, and the biases.

    ``plane``: weight, distance r, and how far a standard deviation of the query's point and of the
    target's lies across the plane.
    """
    weight, r, off, off_target = plane
    for k in range(6):
        g[k] += weight * J[k] * r
        bias[0, k] += weight * J[k] * off
        bias[1, k] += weight * J[k] * off_target
        for m in range(k, 6):
            information[k, m] += weight * J[k] * J[m]


@njit(cache=True, nogil=True)
def _mirror(H: F64) -> None:
    """Copy the half above the diagonal below it."""
    for k in range(6):
        for m in range(k):
            H[k, m] = H[m, k]


@njit(cache=True, nogil=True)
def _add_point(H: F64, g: F64, a: F64, o: F64, weight: float) -> None:
    """Add weight * J^T J, above the diagonal, and weight * J^T o; J = [I, -[a]x].

    ``o`` (3,) is the distance to a point, at the arm ``a`` (3,).
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
