"""Vehicle trajectories along driven lines, and the odometry that a drifting estimator would make of
them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64
from semloc_logs.numerics.transforms import inverse
from semloc_logs.simulation.meshes.objects import resample

POSES_HZ = 20.0  # of a trajectory
START_NS = 1_760_000_000_000_000_000  # of the first drive
DAY_NS = 86_400_000_000_000  # to the next one


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses of the base frame (on the ground under the vehicle): true ``world_T_base`` and drifting
    ``odom_T_base`` (n, 4, 4).
    """

    stamps_ns: NDArray[np.int64]
    world_T_base: F64
    odom_T_base: F64


def smooth_line(line: F64, sigma: float = 2.5) -> F64:
    """A driven line (n, 2) with corners rounded over about ``sigma`` metres, points about every
    half metre.
    """
    points = resample(line, 0.5)
    return np.column_stack(
        [gaussian_filter1d(points[:, k], sigma / 0.5, mode="nearest") for k in (0, 1)]
    )


def poses_along(
    line: F64,
    distances: F64,
    height: Callable[[F64, F64], F64],
    rng: np.random.Generator,
    shake: float = 0.004,
) -> F64:
    """``world_T_base`` (m, 4, 4) at arc lengths ``distances`` (m,) of a smooth line.

    Yaw is from the tangent, roll and pitch from ``height``.
    """
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    position = np.column_stack([np.interp(distances, along, line[:, k]) for k in (0, 1)])
    ahead = np.column_stack(
        [np.interp(np.minimum(distances + 0.6, along[-1]), along, line[:, k]) for k in (0, 1)]
    )
    behind = np.column_stack(
        [np.interp(np.maximum(distances - 0.6, 0), along, line[:, k]) for k in (0, 1)]
    )
    yaw = np.arctan2(*(ahead - behind).T[::-1])
    heading = np.column_stack([np.cos(yaw), np.sin(yaw)])
    left = np.column_stack([-heading[:, 1], heading[:, 0]])
    z = height(*position.T)
    rise = _slope(height, position, heading)
    tilt = _slope(height, position, left)
    noise = gaussian_filter1d(rng.normal(size=(len(distances), 2)), 2.0, axis=0) * 2.5 * shake
    out = np.tile(np.eye(4), (len(distances), 1, 1))
    euler = np.column_stack([yaw, -np.arctan(rise) + noise[:, 0], np.arctan(tilt) + noise[:, 1]])
    out[:, :3, :3] = Rotation.from_euler("ZYX", euler).as_matrix()
    out[:, :2, 3], out[:, 2, 3] = position, z
    return out


def _slope(
    height: Callable[[F64, F64], F64], position: F64, direction: F64, step: float = 1.3
) -> F64:
    ahead = position + step * direction
    behind = position - step * direction
    return (height(*ahead.T) - height(*behind.T)) / (2 * step)


def drive(
    line: F64,
    height: Callable[[F64, F64], F64],
    rng: np.random.Generator,
    *,
    start_ns: int,
    speed: float = 7.0,
    drift: float = 0.007,
) -> Trajectory:
    """A car drives all of a smooth line at about ``speed`` m/s, slower in bends.

    Poses come at ``POSES_HZ`` from ``start_ns`` on; the odometry has a ``drift``
    (:func:`drifting_odometry`).
    """
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    tangent = np.gradient(line, along, axis=0)
    bend = np.linalg.norm(gaussian_filter1d(np.gradient(tangent, along, axis=0), 4, axis=0), axis=1)
    wander = gaussian_filter1d(rng.normal(size=len(along)), 60, mode="nearest") * 2.0
    pace = np.clip(
        np.minimum(speed + wander, np.sqrt(1.8 / np.maximum(bend, 1e-3))), 2.0, 1.5 * speed
    )
    pace = gaussian_filter1d(pace, 8, mode="nearest")
    seconds = np.concatenate([[0.0], np.cumsum(np.diff(along) / pace[1:])])
    times = np.arange(0.0, seconds[-1], 1.0 / POSES_HZ)
    poses = poses_along(line, np.interp(times, seconds, along), height, rng)
    stamps = start_ns + np.round(times * 1e9).astype(np.int64)
    return Trajectory(stamps, poses, drifting_odometry(poses, rng, drift))


def drifting_odometry(world_T_base: F64, rng: np.random.Generator, drift: float = 0.007) -> F64:
    """``odom_T_base`` (n, 4, 4) starting at identity, wrong by about ``drift`` of the way after
    some hundred metres.

    The scale is wrong by a constant, the heading by a rate that wanders over 40 m, and every step
    by a little of its own.
    """
    steps = inverse(world_T_base[:-1]) @ world_T_base[1:]
    length = np.linalg.norm(steps[:, :3, 3], axis=1, keepdims=True)
    way = np.cumsum(length)
    nodes = np.arange(0.0, (way[-1] if len(way) else 0.0) + 2.0)
    rate = gaussian_filter1d(
        rng.normal(size=(len(nodes), 3)), 40, axis=0, mode="nearest"
    ) * np.sqrt(2 * np.sqrt(np.pi) * 40)
    bias = np.column_stack([np.interp(way, nodes, rate[:, k]) for k in range(3)]) * [
        0.15,
        0.15,
        1.0,
    ]
    turn = 0.01 * drift * bias * length + 0.004 * drift * rng.normal(size=bias.shape) * np.sqrt(
        length
    )
    wrong = steps.copy()
    wrong[:, :3, 3] = steps[:, :3, 3] * (1 + 0.6 * drift * rng.normal()) + 0.3 * drift * rng.normal(
        size=bias.shape
    ) * np.sqrt(length)
    wrong[:, :3, :3] = steps[:, :3, :3] @ Rotation.from_rotvec(turn).as_matrix()
    out = np.tile(np.eye(4), (len(steps) + 1, 1, 1))
    for k, step in enumerate(wrong):
        out[k + 1] = out[k] @ step
    return out
