"""Labelled sweeps through random worlds: the training data of the shipped descriptor network.

:func:`training_session` is all that training needs: every seed is another town (every sixth a hall), another sensor and another drive.
About two seconds a session on one core. Labels are true; :func:`semloc_logs.simulation.lidar.corrupt_labels` makes a network's of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semloc_logs.simulation.conditions import Condition
from semloc_logs.simulation.hall import build_hall, hall_walk
from semloc_logs.simulation.lidar import MODELS, LidarModel, full_sweep
from semloc_logs.simulation.network import RoadNetwork, grid_network, lane_path, path_network, random_route
from semloc_logs.simulation.street import build_street, street_ground
from semloc_logs.simulation.traffic import Traffic, random_traffic
from semloc_logs.simulation.trajectory import poses_along, smooth_line
from semloc_logs.simulation.world import F64, Scene, World

TrainingFrame = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8], F64]
RAYS = 60_000  # a sweep at most
RANGE = 60.0  # m


@dataclass(frozen=True, slots=True, eq=False)
class _Drive:
    world: World
    world_T_base: F64
    seconds: F64
    traffic: Traffic | None


def training_session(seed: int, frames: int = 60) -> Iterator[TrainingFrame]:
    """A drive of ``frames`` sweeps through a random street, or with every sixth seed a walk through a hall.

    Yields (points (n, 3) float32 and sensor origin (3,) float32 in the base frame, labels (n,) uint8 Cityscapes train ids with
    255 = none, ``world_T_base`` (4, 4)). The base frame is on the ground under the vehicle, x ahead, z up. The second part of most drives
    comes back along the first in the other direction or in the same one; poses are true. The same arguments give the same frames.
    """
    rng = np.random.default_rng([seed, 77])
    drive = _hall(rng, seed, frames) if seed % 6 == 5 else _street(rng, seed, frames)
    model = MODELS[str(rng.choice(["hdl64", "hdl64", "hdl64", "hdl32", "vlp32", "vlp16"]))]
    blind = 1.0 if drive.traffic is None else float(rng.uniform(1.5, 3.5))
    model = replace(model, height=model.height + rng.uniform(-0.3, 0.4), noise=rng.uniform(0.01, 0.03), min_range=blind)
    columns = min(int(RAYS * rng.uniform(0.6, 1.0) / len(model.elevations_deg)), model.columns)
    sector = (-0.9, 0.9) if rng.random() < 0.1 else None
    yield from _frames(drive, rng, model, columns, sector)


def _frames(
    drive: _Drive, rng: np.random.Generator, model: LidarModel, columns: int, sector: tuple[float, float] | None
) -> Iterator[TrainingFrame]:
    base_T_lidar = np.eye(4)
    base_T_lidar[2, 3] = model.height
    origin = base_T_lidar[:3, 3].astype(np.float32)
    scene = Scene(drive.world)
    for pose, seconds in zip(drive.world_T_base, drive.seconds, strict=True):
        moving = drive.traffic.scene(float(seconds), pose) if drive.traffic else None
        turn = full_sweep(scene, pose @ base_T_lidar, rng, model, columns=columns, max_range=RANGE, sector=sector, traffic=moving)
        yield turn.points + origin, origin.copy(), turn.labels, pose


def _network(rng: np.random.Generator, length: float) -> RoadNetwork:
    """A few blocks of a town, or one winding road."""
    if rng.random() < 0.8:
        return grid_network(rng, 2, 2 + int(rng.random() < 0.5), float(rng.uniform(55, 95)))
    turning = np.cumsum(rng.normal(size=12)) * rng.uniform(0.02, 0.2) + rng.uniform(0, 6.3)
    steps = np.column_stack([np.cos(turning), np.sin(turning)]) * (length + 60) / 12
    return path_network(rng, smooth_line(np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]), 12.0))


def _street(rng: np.random.Generator, seed: int, frames: int) -> _Drive:
    spacing = float(rng.uniform(1.5, 3.0))
    returning = rng.random() < 0.6
    once = int(np.ceil(frames * 0.6)) if returning else frames
    network = _network(rng, once * spacing)
    route = random_route(rng, network, once * spacing + 40)
    line = smooth_line(lane_path(network, route))
    back = smooth_line(lane_path(network, [(road, not forwards) for road, forwards in route[::-1]]))
    ground = street_ground(network, seed)
    poses = poses_along(line, 10 + spacing * np.arange(once, dtype=np.float64), ground.slope_height, rng)
    if returning:
        opposite = rng.random() < 0.7
        other = back if opposite else line + rng.normal() * 0.7
        start = max(0.0, 0.5 * len(other) - once * spacing - 30) if opposite else 12.0 + rng.uniform(0, 20)
        again = poses_along(other, start + spacing * np.arange(frames - once, dtype=np.float64), ground.slope_height, rng)
        poses = np.concatenate([poses, again])
    seconds = np.arange(frames, dtype=np.float64) * spacing / rng.uniform(5, 10)
    traffic = random_traffic(rng, ground, [line, back], float(rng.choice([0.0, 0.6, 1.5])))
    return _Drive(build_street(network, seed, _condition(seed)), poses, seconds, traffic)


def _condition(seed: int) -> Condition:
    """Every other scene in summer, some of them with roadworks and scaffolds."""
    rng = np.random.default_rng([seed, 78])
    season = str(rng.choice(["summer", "summer", "summer", "autumn", "winter", "snow"]))
    return Condition(0, season, float(rng.choice([0.0, 0.0, 8.0])), float(rng.choice([0.0, 0.0, 0.1])))


def _hall(rng: np.random.Generator, seed: int, frames: int) -> _Drive:
    line = smooth_line(hall_walk(seed, 0.7 * frames + 10), 0.8)
    poses = poses_along(line, 1 + 0.7 * np.arange(frames, dtype=np.float64), lambda x, y: np.zeros_like(x), rng, shake=0.01)
    return _Drive(build_hall(seed), poses, np.arange(frames, dtype=np.float64), None)
