"""Labelled scans to measure fusion with: sweeps along a street, depth images of a room, sweeps of a
log.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.errors import LogError
from semloc_logs.simulation.meshes.world import Scene

SWEEP_POINTS = 120_000
DEPTH_SHAPE = 480, 640
_SPACING = 1.2  # m between sweeps


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """Points (n, 3) in metres in the sensor frame, Cityscapes train ids (n,) with 255 = none,
    ``map_T_sensor`` (4, 4).
    """

    points: NDArray[np.float32]
    label: NDArray[np.uint8]
    map_T_sensor: F64


def street_sweeps(count: int = 12, points: int = SWEEP_POINTS, seed: int = 8) -> list[Scan]:
    """Sweeps 1.2 m apart of a simulated sensor of 64 beams along a street, ``points`` each (fewer
    if it cannot see so many).

    Their mean range is about 10 m, as in real sweeps, and 98 % or more of the points are
    within 50 m.
    """
    from semloc_logs.simulation.drives.trajectory import poses_along, smooth_line
    from semloc_logs.simulation.sensors.lidar import SweepOptions, full_sweep
    from semloc_logs.simulation.sensors.lidar_models import MODELS
    from semloc_logs.simulation.town.road_network import grid_network, lane_path, random_route
    from semloc_logs.simulation.town.street import build_street, street_ground

    rng = np.random.default_rng(seed)
    network = grid_network(rng, 2, 3, 85.0)
    line = smooth_line(lane_path(network, random_route(rng, network, 40.0 + count * _SPACING)))
    poses = poses_along(
        line,
        20.0 + _SPACING * np.arange(count, dtype=np.float64),
        street_ground(network, seed).slope_height,
        rng,
    )
    scene = Scene(build_street(network, seed))
    model = MODELS["hdl64"]
    poses[:, :3, 3] += poses[:, :3, 2] * model.height
    out = []
    for pose in poses:
        turn = full_sweep(scene, pose, rng, model, SweepOptions(columns=points // 50))
        some = np.linspace(0, len(turn.points) - 1, min(points, len(turn.points))).astype(np.int64)
        out.append(Scan(turn.points[some], turn.labels[some], pose))
    return out


def town_sweeps(seed: int, count: int = 3) -> list[Scan]:
    """Whole sweeps of a simulated sensor of 64 beams, ``count`` of them 35 m apart, through the
    town of a seed with its traffic.
    """
    from semloc_logs.simulation.drives.traffic import random_traffic
    from semloc_logs.simulation.drives.trajectory import poses_along, smooth_line
    from semloc_logs.simulation.sensors.lidar import SweepOptions, full_sweep
    from semloc_logs.simulation.sensors.lidar_models import MODELS
    from semloc_logs.simulation.town.road_network import grid_network, lane_path, random_route
    from semloc_logs.simulation.town.street import build_street, street_ground

    rng = np.random.default_rng([seed, 43])
    network = grid_network(rng, 2, 3, 85.0)
    line = smooth_line(lane_path(network, random_route(rng, network, 60.0 + 35.0 * count)))
    ground = street_ground(network, seed)
    poses = poses_along(
        line, 20.0 + 35.0 * np.arange(count, dtype=np.float64), ground.slope_height, rng
    )
    scene = Scene(build_street(network, seed))
    model = MODELS["hdl64"]
    traffic = random_traffic(rng, ground, [line], 0.4)
    out = []
    for k, pose in enumerate(poses):
        moving = traffic.scene(5.0 * k, pose)
        pose[:3, 3] += pose[:3, 2] * model.height
        turn = full_sweep(scene, pose, rng, model, SweepOptions(traffic=moving))
        out.append(Scan(turn.points, turn.labels, pose))
    return out


def depth_images(count: int = 6, shape: tuple[int, int] = DEPTH_SHAPE, seed: int = 1) -> list[Scan]:
    """Depth images (height, width) of a camera that turns in a furnished room of 7 x 5 x 2.7 m, a
    point for every pixel.

    x right, y down, z forward, 60 degrees wide; noise grows with the square of the depth, 8 mm at 2
    m.
    """
    height, width = shape
    scene = _room()
    rng = np.random.default_rng(seed)
    focal = 0.5 * width / np.tan(np.radians(30))
    u, v = np.meshgrid(np.arange(width) - (width - 1) / 2, np.arange(height) - (height - 1) / 2)
    rays = np.stack([u / focal, v / focal, np.ones_like(u)], -1).reshape(-1, 3)
    out = []
    for k in range(count):
        yaw = 0.15 + 0.12 * k
        tilt = np.radians(-10)
        forward = np.array([np.cos(yaw) * np.cos(tilt), np.sin(yaw) * np.cos(tilt), np.sin(tilt)])
        right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
        pose[:3, 3] = -2.6 + 0.1 * k, -0.8, 1.4
        directions = (rays @ pose[:3, :3].T).astype(np.float32)
        true, triangle, _ = scene.cast(
            np.broadcast_to(pose[:3, 3].astype(np.float32), directions.shape), directions
        )
        depth = true + rng.normal(size=len(true)) * 0.002 * true**2
        seen = (triangle >= 0) & (depth > 0.3)
        out.append(
            Scan(
                (rays * depth[:, None])[seen].astype(np.float32), scene.labels[triangle][seen], pose
            )
        )
    return out


def _room() -> Scene:
    """Four walls, floor, ceiling and some furniture."""
    from semloc_logs.simulation.meshes.world import MeshBuilder, box

    room = MeshBuilder(lambda x, y: np.zeros_like(x))
    for size, place in (
        ((7.4, 5.4, 0.2), (0.0, 0.0, -0.2)),
        ((7.4, 5.4, 0.2), (0.0, 0.0, 2.7)),
        ((0.2, 5.4, 2.7), (3.6, 0.0, 0.0)),
        ((0.2, 5.4, 2.7), (-3.6, 0.0, 0.0)),
        ((7.4, 0.2, 2.7), (0.0, 2.6, 0.0)),
        ((7.4, 0.2, 2.7), (0.0, -2.6, 0.0)),
    ):
        room.add(box(*size, *place), 2)
    for size, place in (
        ((1.6, 0.8, 0.75), (0.4, 0.9, 0.0)),
        ((0.5, 0.5, 1.1), (-0.4, -0.3, 0.0)),
        ((0.6, 2.0, 2.0), (3.2, -1.2, 0.0)),
        ((2.0, 1.0, 0.5), (0.8, 2.0, 0.0)),
    ):
        room.add(box(*size, *place), 255)
    return Scene(room.build())


def log_sweeps(log: Path, count: int = 12, *, repeat: bool = True) -> list[Scan]:
    """The first ``count`` clouds of a log with their recorded labels, if any.

    With ``repeat`` a log of fewer clouds is seen again from poses each 1.2 m further on, so that no
    scan meets a map of itself only. LogError without any cloud.
    """
    from semloc_logs.labels.space import guess_space, to_cityscapes
    from semloc_logs.logs.session.session import SessionOptions, open_session

    session = open_session([log], SessionOptions(max_range=100.0))
    seen: list[Scan] = []
    try:
        for cloud in session.clouds():
            map_T_sensor = (
                np.eye(4) if cloud.session_T_base is None else cloud.session_T_base.copy()
            )
            map_T_sensor[:3, 3] = map_T_sensor[:3, :3] @ cloud.origin + map_T_sensor[:3, 3]
            label = np.full(len(cloud.points), 255, np.uint8)
            if cloud.label is not None:
                label = to_cityscapes(cloud.label, guess_space(cloud.label))
            # the base frame's axes serve as the sensor's
            seen.append(Scan(cloud.points - cloud.origin, label, map_T_sensor))
            if len(seen) == count:
                break
    finally:
        session.close()
    if not seen:
        raise LogError(
            f"{log} has no cloud to measure fusion with: name a log of a lidar or a depth camera."
        )
    if not repeat:
        return seen
    home = seen[0].map_T_sensor[:3, 3].copy()
    out = []
    for k in range(count):
        scan = seen[k % len(seen)]
        turn = k // len(seen)
        pose = scan.map_T_sensor.copy()
        pose[:3, 3] += pose[:3, 0] * _SPACING * turn - home
        out.append(Scan(scan.points, scan.label, pose))
    return out
