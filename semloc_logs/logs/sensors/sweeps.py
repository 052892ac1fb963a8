"""LIDAR sweeps -> points in the base frame, freed of the vehicle's own motion during the sweep."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.arrays import F32, F64
from semloc_logs.frames import LidarFrame
from semloc_logs.logs.messages.point_times import LONGEST_SWEEP_NS
from semloc_logs.numerics import transforms

_BIN_NS = 1_000_000  # within a millisecond a vehicle at 30 m/s moves 3 cm

PosesAt = Callable[[NDArray[np.int64]], tuple[F64, NDArray[np.bool_]]]


def sweep_in_base(
    frame: LidarFrame,
    base_T_sensor: F64,
    poses_at: PosesAt | None,
    *,
    min_range: float,
    max_range: float,
    centre: F32 | None = None,
) -> tuple[F32, NDArray[np.uint32] | None, bool]:
    """Points (n, 3) of a sweep in the base frame at its stamp, labels, and whether deskewed.

    ``poses_at`` gives ``session_T_base`` (m, 4, 4) at stamps (m,) and which of them are known;
    without all of them, or without point times, the sweep stays as it was measured. Points nearer
    than ``min_range`` or beyond ``max_range`` (m, from the sensor) are dropped. ``centre`` (3,):
    the sensor in the base frame where it is not the origin of the points.
    """
    with np.errstate(over="ignore"):  # damaged floats may be 1e38
        if centre is not None:
            rays = in_base(base_T_sensor, frame.points) - centre
        else:
            rays = frame.points if frame.origin is None else frame.points - frame.origin
        squared = np.einsum("ni,ni->n", rays, rays)
    kept = (squared >= min_range**2) & (squared <= max_range**2)
    points = frame.points[kept]
    label = None if frame.label is None else frame.label[kept]
    if frame.offset_ns is not None and poses_at is not None and len(points):
        moved = deskew(
            points, frame.offset_ns[kept], frame.header.stamp_ns, base_T_sensor, poses_at
        )
        if moved is not None:
            return moved, label, True
    return in_base(base_T_sensor, points), label, False


def in_base(base_T_sensor: F64, points: F32) -> F32:
    """Points (n, 3) of a sensor in the base frame.

    In single precision: a hundred metres to 0.01 mm.
    """
    return _move(
        np.ascontiguousarray(points, np.float32),
        np.zeros(len(points), np.int64),
        base_T_sensor[None],
    )


@njit(cache=True, nogil=True)
def _move(points: F32, index: NDArray[np.int64], poses: F64) -> F32:
    """Points (n, 3), each moved by its pose ``poses[index]`` (m, 4, 4).

    A loop, because gathered poses are five times the points' bytes.
    """
    out = np.empty_like(points)
    for i in range(len(points)):
        m = poses[index[i]]
        x = points[i, 0]
        y = points[i, 1]
        z = points[i, 2]
        for k in range(3):
            out[i, k] = m[k, 0] * x + m[k, 1] * y + m[k, 2] * z + m[k, 3]
    return out


def deskew(
    points: F32, offset_ns: NDArray[np.int64], stamp_ns: int, base_T_sensor: F64, poses_at: PosesAt
) -> F32 | None:
    """Points (n, 3) measured at ``stamp_ns + offset_ns``, in the base frame at ``stamp_ns``.

    None without poses at all of these times.
    """
    first = int(offset_ns.min())
    last = int(offset_ns.max())
    if (
        last == first
        or last - first > LONGEST_SWEEP_NS
        or max(abs(first), abs(last)) > 2 * LONGEST_SWEEP_NS
    ):
        return None
    bins = (offset_ns - first) // _BIN_NS
    centres = (
        stamp_ns + first + np.arange(int(bins.max()) + 1, dtype=np.int64) * _BIN_NS + _BIN_NS // 2
    )
    # the last bin's centre may lie behind the last point: no pose is needed there
    stamps = np.append(np.minimum(centres, stamp_ns + last), stamp_ns)
    poses, known = poses_at(stamps)
    if not known.all():
        return None
    base_T_moving = transforms.inverse(poses[-1]) @ poses[:-1] @ base_T_sensor
    return _move(np.ascontiguousarray(points, np.float32), bins, base_T_moving)
