"""What an inertial sensor and a satellite receiver of the vehicle measure along its true
trajectory.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64, I64
from semloc_logs.numerics.transforms import interpolate
from semloc_logs.numerics.wgs84 import E2, SEMI_MAJOR
from semloc_logs.simulation.drives.trajectory import Trajectory

GRAVITY = 9.80665  # m/s^2
ANTENNA = np.array([-0.6, 0.0, 1.5])  # in the base frame (m)
DATUM = 49.01, 8.42, 115.0  # degrees, degrees, m: where the world's origin lies; x is east, y north


@dataclass(frozen=True, slots=True)
class VehicleSensors:
    """How well the vehicle measures itself; standard deviations.

    Samples of the IMU a second (None: one for each pose), its noise and constant bias (m/s^2,
    rad/s); fixes a second (0: no receiver), their horizontal error (m), which wanders over
    ``fix_seconds`` and is half as large again in height, and kilometres between outages of 50 to
    200 m.
    """

    imu_hz: float | None = None
    force_noise: float = 0.05
    force_bias: float = 0.04
    rate_noise: float = 0.002
    rate_bias: float = 0.002
    fix_hz: float = 5.0
    fix_noise: float = 1.5
    fix_seconds: float = 30.0
    outage_km: float = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Inertial:
    """Specific force (n, 3) in m/s^2, at rest +9.81 upwards, and angular rate (n, 3) in rad/s of
    the base frame at ``stamps_ns`` (n,).
    """

    stamps_ns: I64
    force: F64
    rate: F64


@dataclass(frozen=True, slots=True, eq=False)
class Fixes:
    """Latitude and longitude in degrees and height in metres (n, 3) of the antenna; ``status`` (n,)
    as in NavSatFix: 0 fix, -1 none.
    """

    stamps_ns: I64
    geodetic: F64
    status: NDArray[np.int8]


def motion(trajectory: Trajectory) -> tuple[F64, F64, F64]:
    """Specific force (m/s^2), angular rate (rad/s) and velocity (m/s), (n, 3) each, in the base
    frame at every pose.
    """
    seconds = (trajectory.stamps_ns - trajectory.stamps_ns[0]) * 1e-9
    pose = trajectory.world_T_base
    velocity = np.gradient(pose[:, :3, 3], seconds, axis=0)
    acceleration = np.gradient(velocity, seconds, axis=0) + np.array([0.0, 0.0, GRAVITY])
    back = np.swapaxes(pose[:, :3, :3], 1, 2)
    step = (
        Rotation.from_matrix(back[:-1] @ pose[1:, :3, :3]).as_rotvec() / np.diff(seconds)[:, None]
    )
    force, speed = (np.einsum("nij,nj->ni", back, v) for v in (acceleration, velocity))
    return force, np.concatenate([step, step[-1:]]), speed


def inertial(trajectory: Trajectory, sensors: VehicleSensors, rng: np.random.Generator) -> Inertial:
    """Samples of an IMU at the base frame: the truth, a bias that stays, and noise."""
    force, rate, _ = motion(trajectory)
    stamps = trajectory.stamps_ns
    if sensors.imu_hz is not None:
        stamps_ns = np.arange(
            stamps[0], stamps[-1] + 1, round(1e9 / sensors.imu_hz), dtype=np.int64
        )
        seconds = (stamps_ns - stamps[0]) * 1e-9
        known = (stamps - stamps[0]) * 1e-9
        force, rate = (
            np.column_stack([np.interp(seconds, known, v[:, k]) for k in range(3)])
            for v in (force, rate)
        )
        stamps = stamps_ns
    force = (
        force
        + rng.normal(size=3) * sensors.force_bias
        + rng.normal(size=force.shape) * sensors.force_noise
    )
    rate = (
        rate
        + rng.normal(size=3) * sensors.rate_bias
        + rng.normal(size=rate.shape) * sensors.rate_noise
    )
    return Inertial(stamps, force, rate)


def fixes(trajectory: Trajectory, sensors: VehicleSensors, rng: np.random.Generator) -> Fixes:
    """Fixes of a receiver whose error wanders, and that hears nothing along some stretches of the
    road.
    """
    stamps = trajectory.stamps_ns
    stamps_ns = np.arange(stamps[0], stamps[-1] + 1, round(1e9 / sensors.fix_hz), dtype=np.int64)
    pose = interpolate(stamps, trajectory.world_T_base, stamps_ns)
    antenna = pose[:, :3, 3] + pose[:, :3, :3] @ ANTENNA
    slow = sensors.fix_seconds * sensors.fix_hz
    # white noise smoothed by a Gaussian of that width, brought back to a standard deviation of one;
    # padded, so that the ends are alike
    pad = int(4 * slow) + 1
    wander = gaussian_filter1d(rng.normal(size=(len(stamps_ns) + 2 * pad, 3)), slow, axis=0)[
        pad : pad + len(stamps_ns)
    ] * np.sqrt(2 * np.sqrt(np.pi) * slow)
    error = (
        (0.95 * wander + 0.31 * rng.normal(size=wander.shape))
        * sensors.fix_noise
        * [0.707, 0.707, 1.5]
    )
    way = np.concatenate(
        [[0.0], np.cumsum(np.linalg.norm(np.diff(pose[:, :3, 3], axis=0), axis=1))]
    )
    status = np.zeros(len(stamps_ns), np.int8)
    begin = float(rng.exponential(1000.0 * sensors.outage_km))
    while begin < way[-1]:
        end = begin + float(rng.uniform(50.0, 200.0))
        status[(way >= begin) & (way < end)] = -1
        begin = end + float(rng.exponential(1000.0 * sensors.outage_km))
    return Fixes(stamps_ns, geodetic(antenna + error), status)


def geodetic(enu: F64, datum: tuple[float, float, float] = DATUM) -> F64:
    """East, north, up (n, 3) about ``datum`` -> latitude, longitude (degrees) and height over the
    ellipsoid (m) of WGS 84, (n, 3).

    Heights by repeated substitution (Hofmann-Wellenhof et al., GNSS, 2008, section 8.2.1): exact to
    a micrometre near the ground.
    """
    lat = np.radians(datum[0])
    lon = np.radians(datum[1])
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    north = np.cross(up, east)
    n = SEMI_MAJOR / np.sqrt(1 - E2 * np.sin(lat) ** 2)
    origin = np.array(
        [(n + datum[2]) * up[0], (n + datum[2]) * up[1], (n * (1 - E2) + datum[2]) * up[2]]
    )
    x, y, z = (origin + enu @ np.stack([east, north, up])).T
    around = np.hypot(x, y)
    latitude = np.full(len(enu), lat)
    for _ in range(6):
        n = SEMI_MAJOR / np.sqrt(1 - E2 * np.sin(latitude) ** 2)
        latitude = np.arctan2(z + E2 * n * np.sin(latitude), around)
    n = SEMI_MAJOR / np.sqrt(1 - E2 * np.sin(latitude) ** 2)
    height = around * np.cos(latitude) + z * np.sin(latitude) - SEMI_MAJOR**2 / n
    return np.column_stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), height])
