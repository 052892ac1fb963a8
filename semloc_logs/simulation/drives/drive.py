"""Simulated drives: what sensor and odometry of a vehicle give while it drives through a world, one
sweep after the other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.numerics.transforms import apply, interpolate
from semloc_logs.simulation.drives.traffic import Traffic
from semloc_logs.simulation.drives.trajectory import Trajectory
from semloc_logs.simulation.meshes.world import Scene, World
from semloc_logs.simulation.sensors.label_errors import corrupt_labels
from semloc_logs.simulation.sensors.lidar import Sweep, SweepOptions, full_sweep
from semloc_logs.simulation.sensors.lidar_models import MODELS, LidarModel
from semloc_logs.simulation.sensors.sensor import Sensor

TURN_NS = 100_000_000  # duration of a sweep
POSES_A_TURN = 21  # of the sensor: every 5 ms, of a trajectory's pose every 50
PHASE = 0.37  # s by which the sensors of two drives of consecutive seeds begin apart


@dataclass(frozen=True, slots=True, eq=False)
class DriveFrame:
    """A sweep that began at ``stamp_ns``; points in the moving sensor's frame, ``base_T_lidar`` and
    the poses (4, 4) at the beginning.
    """

    stamp_ns: int
    world_T_base: F64
    odom_T_base: F64
    base_T_lidar: F64
    sweep: Sweep


def mounting(model: LidarModel) -> F64:
    """``base_T_lidar`` (4, 4): the sensor over the front axle at the model's height."""
    base_T_lidar = np.eye(4)
    base_T_lidar[:3, 3] = 0.3, 0.0, model.height
    return base_T_lidar


def simulate_drive(
    world: World,
    trajectory: Trajectory,
    sensor: Sensor,
    *,
    seed: int = 0,
    traffic: Traffic | None = None,
) -> Iterator[DriveFrame]:
    """Sweeps of a lidar along a trajectory, one at a time."""
    scene = Scene(world)
    model = MODELS[sensor.name]
    base_T_lidar = mounting(model)
    rng = np.random.default_rng([seed, 41])
    stamps = trajectory.stamps_ns
    first = int(stamps[0])
    for number, stamp in enumerate(
        range(first, int(stamps[-1]) - TURN_NS + 1, round(1e9 / sensor.rate_hz))
    ):
        during = stamp + np.linspace(0, TURN_NS, POSES_A_TURN).astype(np.int64)
        path = interpolate(stamps, trajectory.world_T_base, during)
        start = path[0]
        moment = (stamp - first) * 1e-9
        moving = traffic.scene(moment, start) if traffic else None
        lidar = start @ base_T_lidar
        options = SweepOptions(
            columns=sensor.columns,
            traffic=moving,
            path=path @ base_T_lidar,
            moment=moment + PHASE * seed,
            wet=sensor.wet,
        )
        turn = full_sweep(scene, lidar, rng, model, options)
        if sensor.label_noise > 0:
            labels = corrupt_labels(
                apply(lidar, turn.points),
                turn.labels,
                seed,
                sensor.label_noise,
                frame=number,
                beyond=turn.beyond,
            )
            turn = replace(turn, labels=labels)
        odom = interpolate(stamps, trajectory.odom_T_base, np.array([stamp]))[0]
        yield DriveFrame(stamp, start, odom, base_T_lidar, turn)
