"""Inertial sensor, satellite receiver and odometry: errors of a known size."""

from __future__ import annotations

import numpy as np
import pytest

from semloc_logs.arrays import F64
from semloc_logs.logs.poses.navsat import LocalFrame
from semloc_logs.numerics.transforms import inverse
from semloc_logs.simulation.drives.trajectory import (
    Trajectory,
    drifting_odometry,
    drive,
    smooth_line,
)
from semloc_logs.simulation.drives.vehicle_sensors import (
    ANTENNA,
    DATUM,
    GRAVITY,
    VehicleSensors,
    fixes,
    geodetic,
    inertial,
)

PERFECT = VehicleSensors(force_noise=0.0, force_bias=0.0, rate_noise=0.0, rate_bias=0.0)


def standing(seconds: float = 60.0) -> Trajectory:
    stamps = np.arange(0, int(seconds * 1e9), 50_000_000)
    poses = np.tile(np.eye(4), (len(stamps), 1, 1))
    return Trajectory(stamps, poses, poses)


@pytest.fixture(scope="module")
def long_drive() -> Trajectory:
    corners = np.array([[0.0, 0], [700, 0], [700, 500], [100, 500], [100, 1000], [900, 1000]])
    return drive(
        smooth_line(corners), lambda x, y: 0 * x, np.random.default_rng(0), start_ns=10**18
    )


def test_at_rest_an_imu_feels_gravity_alone() -> None:
    samples = inertial(standing(), PERFECT, np.random.default_rng(0))
    np.testing.assert_allclose(samples.force, np.tile([0, 0, GRAVITY], (1200, 1)), atol=1e-9)
    np.testing.assert_allclose(samples.rate, 0, atol=1e-12)


def test_bias_stays_and_noise_does_not() -> None:
    sensors = VehicleSensors(force_noise=0.1, force_bias=0.5, rate_noise=0.01, rate_bias=0.05)
    samples = inertial(standing(), sensors, np.random.default_rng(1))
    off = samples.force - [0, 0, GRAVITY]
    np.testing.assert_allclose(off.std(axis=0), 0.1, rtol=0.08)
    np.testing.assert_allclose(samples.rate.std(axis=0), 0.01, rtol=0.08)
    first = off[:600].mean(axis=0)
    second = off[600:].mean(axis=0)
    np.testing.assert_allclose(first, second, atol=0.02)
    assert 0.1 < np.linalg.norm(first) < 2.0


def test_an_imu_samples_as_often_as_asked_and_feels_a_turn() -> None:
    angle = np.linspace(0, 2 * np.pi, 1257)
    poses = np.tile(np.eye(4), (len(angle), 1, 1))
    poses[:, :2, 3] = 20 * np.column_stack([np.sin(angle), 1 - np.cos(angle)])
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(angle)
    poses[:, 1, 0], poses[:, 0, 1] = np.sin(angle), -np.sin(angle)
    stamps = np.arange(len(angle), dtype=np.int64) * 50_000_000  # once round in 62.8 s: 0.1 rad/s
    samples = inertial(
        Trajectory(stamps, poses, poses),
        VehicleSensors(100.0, 0.0, 0.0, 0.0, 0.0),
        np.random.default_rng(0),
    )
    assert (np.diff(samples.stamps_ns) == 10_000_000).all()
    middle = slice(200, -200)
    np.testing.assert_allclose(
        samples.rate[middle], np.tile([0, 0, 0.1], (len(samples.rate[middle]), 1)), atol=1e-4
    )
    # v^2 / r = 0.01 * 20 to the left
    np.testing.assert_allclose(
        samples.force[middle],
        np.tile([0, 0.2, GRAVITY], (len(samples.force[middle]), 1)),
        atol=1e-3,
    )


def test_geodetic_is_the_inverse_of_the_local_frame() -> None:
    enu = np.array([[0.0, 0, 0], [1500, -2500, 40], [-30_000, 12_000, -100]])
    local = LocalFrame(*DATUM)
    np.testing.assert_allclose([local.position(*row) for row in geodetic(enu)], enu, atol=1e-5)
    np.testing.assert_allclose(geodetic(enu[:1])[0], DATUM, atol=1e-9)


def _errors(trajectory: Trajectory, sensors: VehicleSensors, seed: int) -> tuple[F64, np.ndarray]:
    seen = fixes(trajectory, sensors, np.random.default_rng(seed))
    local = LocalFrame(*DATUM)
    index = np.searchsorted(trajectory.stamps_ns, seen.stamps_ns)
    pose = trajectory.world_T_base[index]
    true = pose[:, :3, 3] + pose[:, :3, :3] @ ANTENNA
    return np.array([local.position(*row) for row in seen.geodetic]) - true, seen.status


def test_fixes_are_a_metre_or_two_off_and_wander(long_drive: Trajectory) -> None:
    parts = [_errors(long_drive, VehicleSensors(fix_noise=1.5), seed)[0] for seed in range(8)]
    error = np.concatenate(parts)
    assert np.hypot(*error[:, :2].T).mean() == pytest.approx(1.5 * np.sqrt(np.pi) / 2, rel=0.25)
    assert error[:, 2].std() == pytest.approx(1.5 * 1.5, rel=0.3)
    # a second later nearly the same error, two minutes later another one
    soon, late = ([np.corrcoef(e[:-n, 0], e[n:, 0])[0, 1] for e in parts] for n in (5, 600))
    assert np.mean(soon) > 0.75
    assert np.mean(late) < 0.5


def test_outages_are_streets_long(long_drive: Trajectory) -> None:
    way = np.concatenate(
        [
            [0.0],
            np.cumsum(np.linalg.norm(np.diff(long_drive.world_T_base[:, :3, 3], axis=0), axis=1)),
        ]
    )
    metres = np.interp(
        fixes(long_drive, VehicleSensors(), np.random.default_rng(0)).stamps_ns,
        long_drive.stamps_ns,
        way,
    )
    lengths = []
    for seed in range(6):
        status = fixes(
            long_drive, VehicleSensors(outage_km=0.4), np.random.default_rng(seed)
        ).status
        edges = np.flatnonzero(np.diff(status))
        assert set(np.unique(status)) <= {-1, 0}
        if status[0] == 0 and len(edges) > 1:
            lengths += [
                metres[b] - metres[a] for a, b in zip(edges[::2], edges[1::2], strict=False)
            ]
    assert len(lengths) > 10
    assert min(lengths) > 40
    assert max(lengths) < 330  # two that meet
    assert not fixes(
        long_drive, VehicleSensors(outage_km=1e9), np.random.default_rng(0)
    ).status.any()


def kitti_error(truth: F64, estimate: F64) -> tuple[float, float]:
    """Mean translation error (share) and rotation error (rad/m) over segments of 100, 200, ... 800
    m (Geiger et al., CVPR 2012).
    """
    way = np.concatenate(
        [[0.0], np.cumsum(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1))]
    )
    moved = []
    turned = []
    for first in range(0, len(truth), 40):
        for length in range(100, 801, 100):
            last = int(np.searchsorted(way, way[first] + length))
            if last < len(truth):
                true = inverse(truth[first]) @ truth[last]
                got = inverse(estimate[first]) @ estimate[last]
                error = inverse(got) @ true
                moved.append(np.linalg.norm(error[:3, 3]) / length)
                turned.append(np.arccos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1)) / length)
    return float(np.mean(moved)), float(np.mean(turned))


@pytest.mark.parametrize("drift", [0.005, 0.01])
def test_odometry_drifts_as_much_as_asked_by_the_measure_of_kitti(
    long_drive: Trajectory, drift: float
) -> None:
    errors = [
        kitti_error(
            long_drive.world_T_base,
            drifting_odometry(long_drive.world_T_base, np.random.default_rng(s), drift),
        )
        for s in range(12)
    ]
    moved, turned = np.mean(errors, axis=0)
    assert moved == pytest.approx(drift, rel=0.35)
    assert 0.0 < np.degrees(turned) < 0.02
