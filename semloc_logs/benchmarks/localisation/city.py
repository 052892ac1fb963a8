"""The simulated city of the localisation benchmark: one drive that maps it, and query drives under
several conditions.

A drive of its own makes the city: three winding streets one after the other, then across all of
them three more. The first half is the database. Queries come from the same streets in the same and
the opposite direction and in snow, from the streets that cross, and from a city that the database
does not have. Seeds begin at 300, which neither training nor the calibration has. Logs are kept in
a folder.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

from semloc_logs.arrays import F64
from semloc_logs.simulation.conditions import Condition
from semloc_logs.simulation.drive_plan import Plan, Session
from semloc_logs.simulation.meshes.objects import resample
from semloc_logs.simulation.sensors.sensor import Sensor
from semloc_logs.simulation.sessions import write_sessions
from semloc_logs.simulation.town.road_network import left_of
from semloc_logs.simulation.town.road_survey import drive_network, opposite_lane
from semloc_logs.tables.atomic_files import replacing_folder

SEED = 300
BLOCK, BEYOND = 60.0, 30.0  # m between streets, and of a street beyond the last crossing
LABEL_NOISE, DRIFT = 0.12, 0.007  # share of wrong labels; of the odometry, share of the way
SENSORS = {
    "lidar": Sensor("hdl32", 2.0, 900, LABEL_NOISE, DRIFT),
    "camera": Sensor("stereo", 2.0, None, LABEL_NOISE, DRIFT),
}
DATABASE = "database"
SAME, OPPOSITE, CROSSING, SEASON, UNSEEN = "0", "180", "90", "season", "unseen"
CONDITIONS = (SAME, CROSSING, OPPOSITE, SEASON, UNSEEN)


@dataclass(frozen=True, slots=True)
class WorldDrive:
    """One log: session ``name`` in its own folder of ``folder``, with a ``sensor`` of ``SENSORS``,
    driven in a ``condition``.
    """

    folder: Path
    name: str
    sensor: str
    condition: str

    @property
    def log(self) -> Path:
        return self.folder / self.name / f"{self.name}.mcap"

    @property
    def truth(self) -> Path:
        return self.log.with_suffix(".tum")


def world_drives(folder: Path) -> list[WorldDrive]:
    """The database's drive, and one of each condition and sensor."""
    queries = [
        WorldDrive(folder, f"{condition}_{sensor}", sensor, condition)
        for condition in CONDITIONS
        for sensor in SENSORS
    ]
    return [WorldDrive(folder, DATABASE, "lidar", DATABASE), *queries]


def world_path(seed: int) -> tuple[F64, int]:
    """A drive (n, 3) in metres about every metre through both sets of streets, and the number of
    points of the first set.
    """
    rng = np.random.default_rng([seed, 71])
    low = -BEYOND
    high = 2 * BLOCK + BEYOND
    along = [(x, k * BLOCK) for k in range(3) for x in ((low, high) if k % 2 == 0 else (high, low))]
    across = [
        (x, y)
        for k in (2, 1, 0)
        for x, y in (
            (k * BLOCK, high if k % 2 == 0 else low),
            (k * BLOCK, low if k % 2 == 0 else high),
        )
    ]
    corners = np.array([*along, (high, high), *across])
    line = resample(corners, 1.0)
    first = int(np.argmin(np.linalg.norm(line - corners[len(along) - 1], axis=1)))
    phase = rng.uniform(0, 2 * np.pi, 4)
    turn = rng.uniform(0, 2 * np.pi)
    x, y = line.T / 95.0
    bent = line + 7.0 * np.column_stack(
        [np.sin(2 * np.pi * y + phase[0]), np.sin(2 * np.pi * x + phase[1])]
    )
    bent = np.column_stack([gaussian_filter1d(bent[:, k], 5.0, mode="nearest") for k in (0, 1)])
    bent = bent @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    height = 1.5 * np.sin(2 * np.pi * x / 2 + phase[2]) + 1.5 * np.sin(2 * np.pi * y / 2 + phase[3])
    return np.column_stack([bent, gaussian_filter1d(height, 6.0, mode="nearest")]), first


def _line(plan: F64, first: int, condition: str) -> F64:
    """What is driven of ``plan`` (n, 2), points about every metre, of which the first ``first`` are
    the database's.
    """
    database = resample(plan[:first], 0.5)
    if condition == DATABASE:
        return database
    if condition == CROSSING:
        return resample(plan[first : first + 3 * (len(plan) - first) // 4], 0.5)
    n = len(database)
    if condition == OPPOSITE:
        return opposite_lane(database)[n // 4 : 2 * n // 3][::-1]
    if condition == UNSEEN:
        return database[: n // 6]
    part = database[n // 5 : 3 * n // 5]
    tangent = np.gradient(part, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return part + (0.5 if condition == SAME else -0.4) * left_of(tangent)


def simulate_drive_log(drive: WorldDrive) -> str:
    """Write the log of ``drive`` and its true trajectory, unless they exist; returns its name."""
    if drive.log.exists():
        return drive.name
    seed = SEED + (drive.condition == UNSEEN)
    path, first = world_path(seed)
    network = drive_network(np.random.default_rng([seed, 64]), path)
    number = (DATABASE, *CONDITIONS).index(drive.condition)
    condition = Condition(
        number,
        "snow" if drive.condition == SEASON else "summer",
        rebuilt=0.03 if drive.condition == SEASON else 0.0,
    )
    session = Session(drive.log.name, _line(path[:, :2], first, drive.condition), condition)
    with replacing_folder(drive.log.parent) as temporary:
        write_sessions(temporary, Plan(network, [session], seed), SENSORS[drive.sensor])
    return drive.name
