"""Labelled sweeps through random worlds: the training data of the shipped descriptor network.

:func:`training_session` is all that training needs: every seed is another town (every sixth a hall), another sensor and another drive.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from semloc_logs.simulation.hall import build_hall, hall_walk
from semloc_logs.simulation.lidar import MODELS, LidarModel, full_sweep
from semloc_logs.simulation.network import grid_network, lane_path, random_route
from semloc_logs.simulation.street import build_street, street_ground
from semloc_logs.simulation.trajectory import poses_along, smooth_line
from semloc_logs.simulation.world import F64, Scene, World

TrainingFrame = tuple[NDArray[np.float32], F64, NDArray[np.uint8], F64]
POINTS = 60_000  # rays a sweep at most


def training_session(seed: int, frames: int = 60) -> Iterator[TrainingFrame]:
    """A drive of ``frames`` sweeps through a random street, or with every sixth seed a walk through a hall.

    Yields (points (n, 3) float32 in the base frame, sensor origin (3,) in the base frame, labels (n,) uint8 Cityscapes train ids with
    255 = none, ``world_T_base`` (4, 4)). The base frame is on the ground under the vehicle, x ahead, z up. The second part of a drive
    comes back along the first in the other direction or in the same one; poses are true. The same seed gives the same frames.
    """
    rng = np.random.default_rng([seed, 77])
    world, poses = _hall(rng, seed, frames) if seed % 6 == 5 else _street(rng, seed, frames)
    model = MODELS[str(rng.choice(["hdl64", "hdl64", "hdl64", "hdl32", "vlp32", "vlp16"]))]
    model = replace(model, height=model.height + rng.uniform(-0.3, 0.4))
    columns = min(int(POINTS * rng.uniform(0.6, 1.0) / len(model.elevations_deg)), model.columns)
    sector = (-0.9, 0.9) if rng.random() < 0.1 else None
    yield from _frames(Scene(world), poses, rng, model, columns, sector)


def _frames(
    scene: Scene, poses: F64, rng: np.random.Generator, model: LidarModel, columns: int, sector: tuple[float, float] | None
) -> Iterator[TrainingFrame]:
    base_T_lidar = np.eye(4)
    base_T_lidar[2, 3] = model.height
    for pose in poses:
        turn = full_sweep(scene, pose @ base_T_lidar, rng, model, columns=columns, max_range=60.0, sector=sector)
        points = turn.points + base_T_lidar[:3, 3].astype(np.float32)
        yield points, base_T_lidar[:3, 3].copy(), turn.labels, pose


def _street(rng: np.random.Generator, seed: int, frames: int) -> tuple[World, F64]:
    spacing = rng.uniform(1.5, 3.0)
    network = grid_network(rng, 2, 2 + int(rng.random() < 0.5), float(rng.uniform(55, 95)))
    returning = rng.random() < 0.6
    once = int(np.ceil(frames * 0.6)) if returning else frames
    route = random_route(rng, network, once * spacing + 40)
    line = smooth_line(lane_path(network, route))
    ground = street_ground(network, seed)
    poses = poses_along(line, 10 + spacing * np.arange(once), ground.slope_height, rng)
    if returning:
        back = [(road, not forwards) for road, forwards in route[::-1]]
        other = smooth_line(lane_path(network, back)) if rng.random() < 0.7 else line + rng.normal() * 0.7
        length = np.linalg.norm(np.diff(other, axis=0), axis=1).sum()
        start = max(0.0, length - once * spacing - 30) if rng.random() < 0.5 else 12.0 + rng.uniform(0, 20)
        again = poses_along(other, start + spacing * np.arange(frames - once), ground.slope_height, rng)
        poses = np.concatenate([poses, again])
    return build_street(network, seed), poses


def _hall(rng: np.random.Generator, seed: int, frames: int) -> tuple[World, F64]:
    world = build_hall(seed)
    line = smooth_line(hall_walk(seed, 0.7 * frames + 10), 0.8)
    return world, poses_along(line, 1 + 0.7 * np.arange(frames), lambda x, y: np.zeros_like(x), rng, shake=0.01)
