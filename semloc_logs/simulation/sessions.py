"""Whole simulated sessions in a folder: logs, true trajectories and the truth file of `semloc
evaluate`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semloc_logs.errors import SemlocError, SettingsError
from semloc_logs.simulation.conditions import Condition
from semloc_logs.simulation.drives.camera_drive import CameraShot, simulate_cameras
from semloc_logs.simulation.drives.drive import DriveFrame, simulate_drive
from semloc_logs.simulation.drives.traffic import random_traffic
from semloc_logs.simulation.drives.trajectory import drive, smooth_line
from semloc_logs.simulation.drives.vehicle_sensors import VehicleSensors
from semloc_logs.simulation.meshes.objects import resample
from semloc_logs.simulation.meshes.world import F64
from semloc_logs.simulation.output.drive_log import FORMATS, write_session, write_truth
from semloc_logs.simulation.sensors.camera import CAMERAS
from semloc_logs.simulation.sensors.lidar import MODELS
from semloc_logs.simulation.town.road_network import (
    RoadNetwork,
    grid_network,
    lane_path,
    random_route,
    repeating_network,
)
from semloc_logs.simulation.town.street import build_street, street_ground
from semloc_logs.simulation.town.survey import drive_network, opposite_lane, read_drive
from semloc_logs.tables.atomic_files import replacing_file

_BLOCK = 85.0  # m between crossings
_START_NS = 1_760_000_000_000_000_000
_SHORTEST_M = 50
_DAY_NS = 86_400_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """A session to simulate: file name, driven lane line (n, 2) and its conditions."""

    file: str
    line: F64
    condition: Condition


@dataclass(frozen=True, slots=True)
class Sensor:
    """The lidar or cameras by their name in ``lidar.MODELS`` or ``camera.CAMERAS``, sweeps or shots
    a second, columns a turn (None: the model's own), share of wrong labels.

    ``drift`` of the odometry as a share of the way, ``wet`` in [0, 1] how wet the road is, samples
    of the IMU a second (None: 20).
    """

    name: str = "hdl32"
    rate_hz: float = 2.0
    columns: int | None = None
    label_noise: float = 0.0
    drift: float = 0.007
    wet: float = 0.0
    imu_hz: float | None = None


def simulate_sessions(
    directory: Path | str,
    *,
    seed: int = 0,
    sessions: int = 2,
    length_m: float = 500.0,
    sensor: str = "hdl32",
    rate_hz: float = 2.0,
    format: str = "mcap",
    trajectory: Path | None = None,
    part_m: tuple[float, float] = (0.0, math.inf),
    there_and_back: bool = False,
    repeating: bool = False,
    label_noise: float = 0.0,
    drift: float = 0.007,
    wet: float = 0.0,
    imu_hz: float | None = None,
    seasons: Sequence[str] = ("summer",),
    daytimes: Sequence[str] = ("noon",),
    roadworks: float = 0.0,
    rebuilt: float = 0.0,
    overwrite: bool = False,
) -> Path:
    """Drive ``sessions`` times about ``length_m`` metres through one random town, each time by
    another route; the path of truth.json.

    With a ``trajectory`` (a TUM or KITTI file) the streets lie along a recorded drive and every
    session drives the part of it between two lengths in metres, every other one, if
    ``there_and_back``, the other way in the other lane. A ``repeating`` town has blocks that are
    copies of one another.

    Between sessions parked cars, people and a few trees change. ``seasons`` and ``daytimes`` are
    those of the sessions, over and over again; from the second session on there are ``roadworks``
    (sites a kilometre) and a share of ``rebuilt`` houses. ``sensor`` is a name in ``lidar.MODELS``
    or ``camera.CAMERAS``, ``format`` in ``log.FORMATS``. SettingsError for impossible values,
    SemlocError when the files are there already and ``overwrite`` is false.
    """
    if sessions < 1:
        raise SettingsError(f"{sessions} sessions cannot be simulated: give at least 1")
    if trajectory is None and not (math.isfinite(length_m) and 50 <= length_m <= 100_000):
        raise SettingsError(
            f"a simulated session cannot be {length_m} m long: give between 50 and 100000 m"
        )
    if format not in FORMATS:
        raise SettingsError(
            f"logs cannot be simulated as {format!r}: choose one of {', '.join(FORMATS)}"
        )
    conditions = drawn_conditions(sessions, seasons, roadworks, rebuilt, daytimes)
    if trajectory is None:
        network, lines = _town(seed, sessions, length_m, repeating)
    else:
        network, lines = _recorded(seed, sessions, trajectory, part_m, there_and_back)
    planned = [
        Session(f"session_{k}{FORMATS[format]}", line, conditions[k])
        for k, line in enumerate(lines)
    ]
    carried = Sensor(sensor, rate_hz, None, label_noise, drift, wet, imu_hz)
    return write_sessions(
        directory, network, planned, seed=seed, sensor=carried, format=format, overwrite=overwrite
    )


def _town(
    seed: int, sessions: int, length_m: float, repeating: bool
) -> tuple[RoadNetwork, list[F64]]:
    """A grid of streets, and another route through it for every session."""
    side = max(2, math.ceil(math.sqrt(length_m / _BLOCK / 2.5)))
    kind = repeating_network if repeating else grid_network
    network = kind(np.random.default_rng([seed, 61]), side, side + int(side < 3), _BLOCK)
    routes = [
        random_route(np.random.default_rng([seed, 62, k]), network, length_m + 30)
        for k in range(sessions)
    ]
    return network, [
        smooth_line(lane_path(network, route))[: int(length_m / 0.5)] for route in routes
    ]


def _recorded(
    seed: int, sessions: int, path: Path, part_m: tuple[float, float], there_and_back: bool
) -> tuple[RoadNetwork, list[F64]]:
    """Streets along a recorded drive, and a part of it for every session, every other one perhaps
    backwards in the other lane.
    """
    drive_ = read_drive(path)
    network = drive_network(np.random.default_rng([seed, 64]), drive_)
    plan = resample(drive_[:, :2], 0.5)
    if not 0 <= part_m[0] < part_m[1]:
        raise SettingsError(
            f"a drive cannot go from {part_m[0]} m to {part_m[1]} m: give two lengths along {path}, the first one smaller"
        )
    first, last = (int(np.clip(m / 0.5, 0, len(plan))) for m in part_m)
    if last - first < 2 * _SHORTEST_M:
        raise SettingsError(
            f"{path} is {len(plan) / 2:.0f} m long: give a part of at least {_SHORTEST_M} m, not {part_m[0]} to {part_m[1]} m"
        )
    other = opposite_lane(plan)[first:last][::-1]
    return network, [
        other if there_and_back and k % 2 else plan[first:last] for k in range(sessions)
    ]


def drawn_conditions(
    sessions: int,
    seasons: Sequence[str],
    roadworks: float,
    rebuilt: float,
    daytimes: Sequence[str] = ("noon",),
) -> list[Condition]:
    """The conditions of ``sessions`` sessions: seasons and times of day in turn, works and rebuilt
    houses from the second one on.
    """
    if not seasons or not daytimes:
        raise SettingsError(
            "simulated sessions need a season and a time of day: give at least one of each"
        )
    return [
        Condition(
            k,
            seasons[k % len(seasons)],
            roadworks if k else 0.0,
            rebuilt if k else 0.0,
            daytimes[k % len(daytimes)],
        )
        for k in range(sessions)
    ]


def write_sessions(
    directory: Path | str,
    network: RoadNetwork,
    sessions: Sequence[Session],
    *,
    seed: int,
    sensor: Sensor,
    format: str | None = None,
    overwrite: bool = False,
) -> Path:
    """Simulate and write the sessions, their trajectories (.tum) and, last of all, truth.json; its
    path.

    ``format`` as in :func:`semloc_logs.simulation.output.drive_log.write_session`.
    """
    if sensor.name not in (*MODELS, *CAMERAS):
        raise SettingsError(
            f"there is no simulated sensor {sensor.name!r}: choose one of {', '.join((*MODELS, *CAMERAS))}"
        )
    if not 0.05 <= sensor.rate_hz <= 10:
        raise SettingsError(
            f"a simulated sensor cannot measure {sensor.rate_hz} times a second: give between 0.05 and 10 Hz"
        )
    if not 0 <= sensor.label_noise <= 1:
        raise SettingsError(
            f"a share of {sensor.label_noise} wrong labels is impossible: give between 0 and 1"
        )
    if not 0 <= sensor.drift <= 0.2:
        raise SettingsError(
            f"simulated odometry cannot drift by {sensor.drift} of the way: give between 0 and 0.2"
        )
    if not 0 <= sensor.wet <= 1:
        raise SettingsError(f"a road cannot be wet by {sensor.wet}: give between 0 and 1")
    if sensor.imu_hz is not None and not 1 <= sensor.imu_hz <= 1000:
        raise SettingsError(
            f"a simulated IMU cannot sample {sensor.imu_hz} times a second: give between 1 and 1000 Hz"
        )
    folder = Path(directory)
    truth = folder / "truth.json"
    there = [p.name for p in (truth, *(folder / s.file for s in sessions)) if p.exists()]
    if there and not overwrite:
        raise SemlocError(f"{folder} already has {there[0]}: choose another folder or overwrite it")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        truth.unlink(missing_ok=True)
    except OSError as error:
        raise SemlocError(
            f"{folder} cannot be written ({error.strerror}): choose another folder"
        ) from error
    for session in sessions:
        _write(folder, network, session, seed, sensor, format)
    entries = {s.file: {"trajectory": Path(s.file).with_suffix(".tum").name} for s in sessions}
    with replacing_file(truth) as temporary:
        temporary.write_text(json.dumps(entries, indent=2) + "\n", encoding="utf-8")
    return truth


def _write(
    folder: Path,
    network: RoadNetwork,
    session: Session,
    seed: int,
    sensor: Sensor,
    format: str | None,
) -> None:
    number = session.condition.number
    rng = np.random.default_rng([seed, 63, number])
    ground = street_ground(network, seed)
    start_ns = _START_NS + number * _DAY_NS
    trajectory = drive(
        session.line,
        ground.slope_height,
        rng,
        start_ns=start_ns,
        speed=float(rng.uniform(6, 8)),
        drift=sensor.drift,
    )
    traffic = random_traffic(rng, ground, [session.line], 0.4)
    world = build_street(network, seed, session.condition)
    frames: Iterator[DriveFrame] = iter(())
    shots: Iterator[CameraShot] = iter(())
    if sensor.name in CAMERAS:
        shots = simulate_cameras(
            world,
            trajectory,
            sensor.name,
            rate_hz=sensor.rate_hz,
            seed=seed + number,
            condition=session.condition,
            traffic=traffic,
            label_noise=sensor.label_noise,
        )
    else:
        frames = simulate_drive(
            world,
            trajectory,
            MODELS[sensor.name],
            rate_hz=sensor.rate_hz,
            seed=seed + number,
            columns=sensor.columns,
            traffic=traffic,
            label_noise=sensor.label_noise,
            wet=sensor.wet,
        )
    carried = VehicleSensors(imu_hz=sensor.imu_hz)
    write_session(
        folder / session.file, trajectory, frames, format=format, sensors=carried, shots=shots
    )
    write_truth((folder / session.file).with_suffix(".tum"), trajectory)
