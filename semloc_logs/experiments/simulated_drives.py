"""The simulated drives of the experiments: one vehicle with a LIDAR and a pair of cameras drives
through a town that crosses its own way.

The drive ``map`` sees all streets in both sets, ``again`` drives them the same way in the lane's
other half, ``back`` drives them the other way in the other lane: 0, 90 and 180 degrees. Under four
conditions (season, time of day, houses built and gone) there is a drive that maps a part and one
that is localised: the cross-time matrix. Seeds begin at 500, which neither training nor the
calibration has.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

from semloc_logs.arrays import F64
from semloc_logs.benchmarks.versions import files_version, room_files
from semloc_logs.simulation.conditions import Condition
from semloc_logs.simulation.drives.camera_drive import simulate_cameras
from semloc_logs.simulation.drives.drive import simulate_drive
from semloc_logs.simulation.drives.traffic import random_traffic
from semloc_logs.simulation.drives.trajectory import DAY_NS, START_NS, drive
from semloc_logs.simulation.meshes.objects import resample
from semloc_logs.simulation.output.drive_log import write_session
from semloc_logs.simulation.output.truth_file import write_truth
from semloc_logs.simulation.sensors.sensor import Sensor
from semloc_logs.simulation.town.road_network import left_of
from semloc_logs.simulation.town.road_survey import drive_network, opposite_lane
from semloc_logs.simulation.town.street import build_street, street_ground
from semloc_logs.tables.atomic_files import replacing_folder

SEED = 500
MAP, AGAIN, BACK = "map", "again", "back"
LABEL_NOISE = 0.12  # share of wrong labels
DRIFT = 0.007  # of the odometry, share of the way
_TRAFFIC = 0.4  # vehicles on 100 m of road
_CORNER = 4.0  # m over which corners are rounded
_OFFSET = 0.5  # m to the left of the mapped line that it is driven again
_REBUILT = 0.03  # share of houses from the second condition on


@dataclass(frozen=True, slots=True)
class TimeCondition:
    """A condition of the cross-time matrix."""

    name: str
    season: str
    daytime: str


TIMES = (
    TimeCondition("summer", "summer", "noon"),
    TimeCondition("autumn", "autumn", "evening"),
    TimeCondition("winter", "winter", "overcast"),
    TimeCondition("snow", "snow", "noon"),
)


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedDrive:
    """Session ``name``: the driven line (n, 2), points about every half metre, and conditions."""

    name: str
    line: F64
    condition: Condition


@dataclass(frozen=True, slots=True, eq=False)
class Town:
    """The plan (n, 3) of the streets, metres about every metre, and the drives through them.

    ``rate_hz``: sweeps and pictures a second; ``speed`` in m/s; ``pairs`` of the cross-time matrix,
    the map's condition first.
    """

    plan: F64
    drives: tuple[SimulatedDrive, ...]
    rate_hz: float
    speed: float
    pairs: tuple[tuple[TimeCondition, TimeCondition], ...]
    seed: int = SEED
    columns: int = field(default=900)  # of a turn of the LIDAR


def time_session(condition: TimeCondition, *, is_query: bool) -> str:
    """The name of a drive of the cross-time matrix."""
    return f"{condition.name}_{'query' if is_query else 'map'}"


@dataclass(frozen=True, slots=True)
class _Parts:
    """Metres along the plan between which the drives of a town go: of the queries by heading, and
    of the maps and the queries of the cross-time matrix.
    """

    queries: tuple[float, float]
    time_maps: tuple[float, float]
    time_queries: tuple[float, float]


def full_town(seed: int = SEED) -> Town:
    """Three streets, and three across them: nine crossings."""
    block = 60.0
    low = -30.0
    high = 2 * block + 30.0
    along = [(x, k * block) for k in range(3) for x in ((low, high) if k % 2 == 0 else (high, low))]
    across = [
        (k * block, y) for k in (2, 1, 0) for y in ((high, low) if k % 2 == 0 else (low, high))
    ]
    plan = _winding([*along, (high, high), *across], seed, bend=4.0)
    parts = _Parts((0.0, float(len(plan))), (0.0, 420.0), (20.0, 400.0))
    pairs = tuple((one, other) for one in TIMES for other in TIMES)
    drives = _drives(plan, parts, pairs)
    return Town(plan, drives, rate_hz=5.0, speed=7.0, pairs=pairs, seed=seed)


def quick_town(seed: int = SEED) -> Town:
    """One street, and one that crosses it, driven in one loop; half a row of the matrix."""
    corners = [(-25.0, 0.0), (25.0, 0.0), (25.0, 25.0), (0.0, 25.0), (0.0, -25.0)]
    plan = _winding(corners, seed, bend=0.0)
    summer, *_, snow = TIMES
    pairs = ((summer, summer), (summer, snow))
    drives = _drives(plan, _Parts((8.0, 38.0), (0.0, 40.0), (10.0, 35.0)), pairs)
    return Town(plan, drives, rate_hz=1.0, speed=4.0, pairs=pairs, seed=seed)


def _winding(corners: list[tuple[float, float]], seed: int, bend: float) -> F64:
    """A drive (n, 3) about every metre from corner to corner, hilly, turned at random, and bent by
    ``bend`` metres.
    """
    rng = np.random.default_rng([seed, 71])
    line = resample(np.array(corners), 1.0)
    phase = rng.uniform(0, 2 * np.pi, 4)
    turn = rng.uniform(0, 2 * np.pi)
    x, y = line.T / 95.0
    bent = line + bend * np.column_stack(
        [np.sin(2 * np.pi * y + phase[0]), np.sin(2 * np.pi * x + phase[1])]
    )
    bent = np.column_stack([gaussian_filter1d(bent[:, k], _CORNER, mode="nearest") for k in (0, 1)])
    c = np.cos(turn)
    s = np.sin(turn)
    bent = bent @ np.array([[c, s], [-s, c]])
    height = 1.5 * np.sin(np.pi * x + phase[2]) + 1.5 * np.sin(np.pi * y + phase[3])
    return np.column_stack([bent, gaussian_filter1d(height, 6.0, mode="nearest")])


def _drives(
    plan: F64, parts: _Parts, pairs: tuple[tuple[TimeCondition, TimeCondition], ...]
) -> tuple[SimulatedDrive, ...]:
    """The drives of a plan."""
    there = resample(plan[:, :2], 0.5)
    again = _beside(there)
    back = opposite_lane(there)
    drives = [
        SimulatedDrive(MAP, there, Condition(0)),
        SimulatedDrive(AGAIN, _part(again, parts.queries), Condition(1)),
        SimulatedDrive(BACK, _part(back, parts.queries)[::-1], Condition(2)),
    ]
    maps = dict.fromkeys(one for one, _ in pairs)
    queries = dict.fromkeys(other for _, other in pairs)
    for k, time in enumerate(TIMES):
        for is_query, chosen in ((False, maps), (True, queries)):
            if time not in chosen:
                continue
            condition = Condition(
                3 + 2 * k + is_query,
                time.season,
                rebuilt=_REBUILT if k else 0.0,
                daytime=time.daytime,
            )
            line = _part(again, parts.time_queries) if is_query else _part(there, parts.time_maps)
            name = time_session(time, is_query=is_query)
            drives.append(SimulatedDrive(name, line, condition))
    return tuple(drives)


def _part(line: F64, part_m: tuple[float, float]) -> F64:
    """The part of a line (n, 2) with points every half metre between two lengths."""
    first, last = (round(2 * length) for length in part_m)
    return line[first:last]


def _beside(line: F64) -> F64:
    """The line (n, 2) as it is driven again: a little to its left."""
    tangent = np.gradient(line, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    return np.asarray(line + _OFFSET * left_of(tangent))


def drives_version() -> str:
    """A hash of the code that makes the drives."""
    return files_version([*room_files(("simulation",)), Path(__file__)])


def drive_folder(folder: Path, name: str) -> Path:
    """The folder of a drive's log and truth."""
    return folder / name


def write_drive(town: Town, drive_: SimulatedDrive, folder: Path) -> Path:
    """Simulate a drive, unless its log is there: NAME/NAME.mcap and NAME/NAME.tum; the log."""
    target = drive_folder(folder, drive_.name)
    log = target / f"{drive_.name}.mcap"
    if log.exists():
        return log
    number = drive_.condition.number
    network = drive_network(np.random.default_rng([town.seed, 64]), town.plan)
    ground = street_ground(network, town.seed)
    world = build_street(network, town.seed, drive_.condition)
    rng = np.random.default_rng([town.seed, 63, number])
    trajectory = drive(
        drive_.line,
        ground.slope_height,
        rng,
        start_ns=START_NS + number * DAY_NS,
        speed=town.speed,
        drift=DRIFT,
    )
    traffic = random_traffic(rng, ground, [drive_.line], _TRAFFIC)
    seed = town.seed + number
    lidar = Sensor("hdl32", town.rate_hz, town.columns, LABEL_NOISE, DRIFT)
    cameras = Sensor("stereo", town.rate_hz, None, LABEL_NOISE, DRIFT)
    frames = simulate_drive(world, trajectory, lidar, seed=seed, traffic=traffic)
    shots = simulate_cameras(
        world, trajectory, cameras, seed=seed, condition=drive_.condition, traffic=traffic
    )
    with replacing_folder(target) as temporary:
        write_session(temporary / log.name, trajectory, frames, shots=shots)
        write_truth(temporary / f"{drive_.name}.tum", trajectory.stamps_ns, trajectory.world_T_base)
    return log
