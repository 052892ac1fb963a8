"""Whole simulated sessions in a folder: logs, true trajectories and the truth file of `semloc
evaluate`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from semloc_logs.errors import SemlocError
from semloc_logs.simulation.drive_plan import Plan, Route, Session, Town, plan_sessions
from semloc_logs.simulation.drives.camera_drive import CameraShot, simulate_cameras
from semloc_logs.simulation.drives.drive import DriveFrame, simulate_drive
from semloc_logs.simulation.drives.traffic import random_traffic
from semloc_logs.simulation.drives.trajectory import DAY_NS, START_NS, drive
from semloc_logs.simulation.drives.vehicle_sensors import VehicleSensors
from semloc_logs.simulation.output.drive_log import write_session
from semloc_logs.simulation.output.truth_file import write_truth
from semloc_logs.simulation.sensors.sensor import Sensor
from semloc_logs.simulation.town.street import build_street, street_ground
from semloc_logs.tables.atomic_files import replacing_file

_SPEEDS = 6.0, 8.0  # m/s, least and most of the sessions
_TRAFFIC = 0.4  # vehicles on 100 m of road


def simulate_sessions(
    directory: Path | str,
    town: Town,
    route: Route,
    sensor: Sensor,
    *,
    format: str = "mcap",
    overwrite: bool = False,
) -> Path:
    """Drive through one random town with a sensor; the path of truth.json.

    ``format`` is a name in ``drive_log.FORMATS``. SettingsError for impossible values, SemlocError
    when the files exist and ``overwrite`` is false.
    """
    plan = plan_sessions(town, route, format)
    return write_sessions(directory, plan, sensor, format=format, overwrite=overwrite)


def write_sessions(
    directory: Path | str,
    plan: Plan,
    sensor: Sensor,
    *,
    format: str | None = None,
    overwrite: bool = False,
) -> Path:
    """Simulate and write the sessions of a plan, their trajectories (.tum) and, last of all,
    truth.json; its path.

    ``format`` as in :func:`semloc_logs.simulation.output.drive_log.write_session`.
    """
    folder = Path(directory)
    truth = folder / "truth.json"
    existing = [p.name for p in (truth, *(folder / s.file for s in plan.sessions)) if p.exists()]
    if existing and not overwrite:
        raise SemlocError(
            f"{folder} already has {existing[0]}: choose another folder or overwrite it"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        truth.unlink(missing_ok=True)
    except OSError as error:
        raise SemlocError(
            f"{folder} cannot be written ({error.strerror}): choose another folder"
        ) from error
    for session in plan.sessions:
        _write_session(folder / session.file, plan, session, sensor, format)
    entries = {
        session.file: {"trajectory": Path(session.file).with_suffix(".tum").name}
        for session in plan.sessions
    }
    with replacing_file(truth) as temporary:
        temporary.write_text(json.dumps(entries, indent=2) + "\n", encoding="utf-8")
    return truth


def _write_session(
    path: Path, plan: Plan, session: Session, sensor: Sensor, format: str | None
) -> None:
    """One session as a log with its true trajectory beside it."""
    number = session.condition.number
    rng = np.random.default_rng([plan.seed, 63, number])
    ground = street_ground(plan.network, plan.seed)
    trajectory = drive(
        session.line,
        ground.slope_height,
        rng,
        start_ns=START_NS + number * DAY_NS,
        speed=float(rng.uniform(*_SPEEDS)),
        drift=sensor.drift,
    )
    traffic = random_traffic(rng, ground, [session.line], _TRAFFIC)
    world = build_street(plan.network, plan.seed, session.condition)

    seed = plan.seed + number
    frames: Iterator[DriveFrame] = iter(())
    shots: Iterator[CameraShot] = iter(())
    if sensor.is_camera:
        shots = simulate_cameras(
            world, trajectory, sensor, seed=seed, condition=session.condition, traffic=traffic
        )
    else:
        frames = simulate_drive(world, trajectory, sensor, seed=seed, traffic=traffic)
    vehicle = VehicleSensors(imu_hz=sensor.imu_hz)
    write_session(path, trajectory, frames, format=format, sensors=vehicle, shots=shots)
    write_truth(path.with_suffix(".tum"), trajectory.stamps_ns, trajectory.world_T_base)
