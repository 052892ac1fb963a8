"""A street of boxes and a ground, seen without occlusion along a drive of our own making."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from semloc_logs.arrays import F64
from semloc_logs.frames import Header, PosedCloud
from semloc_logs.logs.poses.track import PoseTrack
from semloc_logs.mapping.fit.keyframe_pairs import Clouds
from semloc_logs.mapping.keyframes import Collected
from semloc_logs.numerics.transforms import apply, exp_se3, inverse, yaw_transform

VOXEL = 0.3
TOPIC = "/points"
SECOND = 1_000_000_000


def street(length: float = 60.0) -> F64:
    """Points (n, 3) on the ground and on boxes of several sizes beside the way, 0.25 m apart."""
    rng = np.random.default_rng(4)
    step = 0.25
    x, y = np.meshgrid(np.arange(-20, length + 20, step), np.arange(-15, 15, step))
    parts = [np.c_[x.ravel(), y.ravel(), np.zeros(x.size)]]
    for left in np.arange(-18.0, length + 15.0, 7.0):
        for side in (-1.0, 1.0):
            wide, deep, high = rng.uniform([2, 2, 2], [5, 5, 5])
            front = side * rng.uniform(5, 8)
            u, z = np.meshgrid(np.arange(0, wide, step), np.arange(0, high, step))
            parts.append(np.c_[left + u.ravel(), np.full(u.size, front), z.ravel()])
            v, z = np.meshgrid(np.arange(0, deep, step), np.arange(0, high, step))
            depth = front + side * v.ravel()
            parts += [np.c_[np.full(v.size, x), depth, z.ravel()] for x in (left, left + wide)]
    points = np.concatenate(parts)
    return points + rng.normal(0, 0.01, points.shape)


def winding(seconds: F64) -> F64:
    """Poses (n, 4, 4) of a vehicle that speeds up, slows down and turns to and fro."""
    way = 3.0 * seconds + 1.5 * np.sin(0.9 * seconds)
    side = 2.0 * np.sin(way / 6.0)
    yaw = np.arctan(np.cos(way / 6.0) / 3.0)
    return np.array([yaw_transform(a, (x, y, 1.5)) for a, x, y in zip(yaw, way, side, strict=True)])


def hilly(seconds: F64) -> F64:
    """As :func:`winding`, over humps: the vehicle pitches to and fro by 3 degrees."""
    poses = winding(seconds)
    pitch = np.radians(3.0) * np.sin(1.3 * seconds)
    for pose, angle in zip(poses, pitch, strict=True):
        turn = np.array([0.0, angle, 0.0])
        pose[:] = pose @ exp_se3(np.zeros(3), turn)
    return poses


def straight(seconds: F64) -> F64:
    """Poses (n, 4, 4) at a steady 3 m/s along x."""
    return np.array([yaw_transform(0.0, (3.0 * s, 0.0, 1.5)) for s in seconds])


def seen_by_camera(points: F64, rng: np.random.Generator) -> F64:
    """Points (n, 3) within 40 degrees of x, with the noise of a depth camera: 0.3 % of the range,
    and steps of 1 % of it.
    """
    ranges = np.linalg.norm(points, axis=1)
    seen = points[:, 0] > np.cos(np.radians(40.0)) * ranges
    points = points[seen]
    ranges = ranges[seen]
    noisy = ranges * (1.0 + rng.normal(0, 0.003, len(ranges)))
    step = 0.01 * ranges
    return np.asarray(points * (np.round(noisy / step) * step / ranges)[:, None])


def drive(
    folder: Path,
    poses_of: Callable[[F64], F64] = winding,
    *,
    seconds: float = 18.0,
    clock: float = 0.0,
    fast: float = 0.0,
    base_T_assumed: F64 | None = None,
    scale: float = 1.0,
    is_fixed: bool = False,
    is_camera: bool = False,
    signs: tuple[float, float, float] = (1.0, 1.0, 1.0),
    as_written: Callable[[F64], F64] = lambda poses: poses,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    noisy: tuple[float, float] = (0.0, 0.0),
) -> tuple[Clouds, PoseTrack]:
    """Keyframes three times a second, and the poses twenty times a second, as they are written.

    The clouds are stamped ``clock`` seconds late, and ``fast`` more each second; their mounting is
    wrong by ``base_T_assumed`` (true base frame from the one of the clouds); ``scale`` times as
    large; or in the session frame.
    A LIDAR sees all around, a camera ahead. ``signs``: an axis of the clouds may be mirrored.
    ``origin``: where the sensor is in the base frame, as the log has it. In the seconds ``noisy``
    the points are anywhere.
    """
    world = street()
    rng = np.random.default_rng(5)
    times = np.arange(0.0, seconds, 0.05)
    track = PoseTrack()
    for time, pose in zip(times, as_written(poses_of(times)), strict=True):
        track.append(SECOND + round(time * 1e9), pose)
    collected = Collected(folder, VOXEL / 3)
    taken = np.arange(1.5, seconds - 1.5, 1 / 3)
    for time, pose in zip(taken, poses_of(taken), strict=True):
        points = apply(inverse(pose), world)
        points = points[np.linalg.norm(points, axis=1) < 18.0]
        if noisy[0] <= time < noisy[1]:
            points = rng.normal(0.0, 9.0, points.shape)
        if is_camera:
            points = seen_by_camera(points, rng)
        if is_fixed:
            points = apply(pose, points)
        if base_T_assumed is not None:
            points = apply(inverse(base_T_assumed), points)
        stamp_ns = SECOND + round((time + clock + fast * time) * 1e9)
        header = Header(TOPIC, stamp_ns, stamp_ns, "lidar")
        cloud = PosedCloud(
            header,
            (scale * points * signs).astype(np.float32),
            np.array(origin, np.float32),
            track.at(stamp_ns),
            None,
        )
        collected.add(cloud, np.arange(len(points)))
    return Clouds(collected, np.arange(len(collected)), VOXEL), track


@pytest.fixture(scope="session")
def streets() -> SimpleNamespace:
    """The functions of this file, for tests that cannot import it."""
    return SimpleNamespace(
        street=street, drive=drive, winding=winding, hilly=hilly, straight=straight
    )
