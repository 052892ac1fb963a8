"""Labelled clouds through random worlds: the training data of the shipped descriptor network.

Every seed is another place: of twelve, nine are towns, one is a hall, one a forest and one a
furnished room. Each is mapped by one drive and, in most scenes, queried by a second one: with
another sensor, from another lane or in the other direction, in another season, among other parked
cars. About ten seconds a scene on one core.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.numerics.transforms import apply
from semloc_logs.simulation.conditions import SEASONS, Condition
from semloc_logs.simulation.drives.traffic import Traffic, random_traffic
from semloc_logs.simulation.drives.trajectory import poses_along, smooth_line
from semloc_logs.simulation.meshes.world import Scene, World
from semloc_logs.simulation.sensors.camera import CAMERAS, CameraModel, camera_points
from semloc_logs.simulation.sensors.label_errors import corrupt_labels
from semloc_logs.simulation.sensors.lidar import SweepOptions, full_sweep
from semloc_logs.simulation.sensors.lidar_models import MODELS, LidarModel
from semloc_logs.simulation.town.forest import build_forest
from semloc_logs.simulation.town.hall import build_hall, hall_walk
from semloc_logs.simulation.town.road_network import (
    RoadNetwork,
    grid_network,
    lane_path,
    path_network,
    random_route,
)
from semloc_logs.simulation.town.room import build_room, room_walk
from semloc_logs.simulation.town.street import build_street, street_ground

RAYS = 60_000  # a sweep at most
RANGE = 60.0  # m
CAMERA_STEP = 3  # every third pixel and row of a camera is cast
QUERY_FRAMES = 36  # frames of the second drive
LABEL_NOISE = 0.02, 0.2  # share of wrong labels of a session, least and most
KINDS = {5: "hall", 8: "forest", 11: "room"}  # by seed modulo 12; the others are streets
ROOM_SCALE = 6.0  # a room in voxels of 0.05 m looks as one six times as large in voxels of 0.30 m
Rng = np.random.Generator


@dataclass(frozen=True, slots=True, eq=False)
class TrainingFrame:
    """``points`` (n, 3) and sensor ``origin`` (3,) float32 in the base frame, on the ground under
    the vehicle, x ahead, z up; ``labels`` (n,) Cityscapes train ids, 255 = none, some of them
    wrong; ``world_T_base`` (4, 4), true; ``sigma`` (n,) along the ray, of cameras.
    """

    points: NDArray[np.float32]
    origin: NDArray[np.float32]
    labels: NDArray[np.uint8]
    world_T_base: F64
    sigma: NDArray[np.float32] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class TrainingScene:
    """Frames of the drive that maps a place, and of the query drive; these may be the same."""

    mapped: list[TrainingFrame]
    queries: list[TrainingFrame]


@dataclass(frozen=True, slots=True, eq=False)
class _Drive:
    world: World
    world_T_base: F64
    seconds: F64
    traffic: Traffic | None


@dataclass(frozen=True, slots=True)
class _Rig:
    """A sensor on a vehicle; ``columns`` and ``sector`` (azimuths) limit a lidar."""

    model: LidarModel | CameraModel
    columns: int = 0
    sector: tuple[float, float] | None = None
    label_noise: float = 0.0

    def frame(
        self, scene: Scene, pose: F64, rng: Rng, moving: Scene | None, seed: int, number: int
    ) -> TrainingFrame:
        """What it sees from ``pose`` (4, 4) of the base."""
        if isinstance(self.model, CameraModel):
            points, origin, labels, sigma = camera_points(
                scene, pose, rng, self.model, traffic=moving, step=CAMERA_STEP
            )
        else:
            base_T_lidar = np.eye(4)
            base_T_lidar[2, 3] = self.model.height
            lidar = pose @ base_T_lidar
            options = SweepOptions(self.columns, RANGE, self.sector, moving)
            turn = full_sweep(scene, lidar, rng, self.model, options)
            origin = base_T_lidar[:3, 3].astype(np.float32)
            points = turn.points + origin
            labels = turn.labels
            sigma = None
        wrong = corrupt_labels(apply(pose, points), labels, seed, self.label_noise, frame=number)
        return TrainingFrame(points, origin, wrong, pose, sigma)


def training_scene(seed: int, frames: int = 60) -> TrainingScene:
    """A drive of ``frames`` frames through a random place of the kind that ``KINDS`` gives the
    seed, and another one there.

    The second part of most drives comes back along the first in the other direction or in the same
    one. Of two scenes in five the mapped frames are also the query frames, as in the paper. The
    same arguments give the same frames. A room is enlarged by ``ROOM_SCALE``.
    """
    rng = np.random.default_rng([seed, 77])
    kind = KINDS.get(seed % 12, "street")
    if kind == "hall":
        mapping, querying = _hall(rng, seed, frames)
    elif kind == "room":
        mapping, querying = _room(rng, seed, frames)
    else:
        mapping, querying = _street(rng, seed, frames, forest=kind == "forest")
    rig = _rig(rng, kind)
    scale = ROOM_SCALE if kind == "room" else 1.0
    mapped = [_enlarged(f, scale) for f in _frames(mapping, rng, rig, 2 * seed)]
    if querying is None:
        return TrainingScene(mapped, mapped)
    other = rig if rng.random() < 0.4 else _rig(rng, kind)
    return TrainingScene(
        mapped, [_enlarged(f, scale) for f in _frames(querying, rng, other, 2 * seed + 1)]
    )


def _enlarged(frame: TrainingFrame, scale: float) -> TrainingFrame:
    if scale == 1.0:
        return frame
    pose = frame.world_T_base.copy()
    pose[:3, 3] *= scale
    factor = np.float32(scale)
    sigma = None if frame.sigma is None else frame.sigma * factor
    return TrainingFrame(frame.points * factor, frame.origin * factor, frame.labels, pose, sigma)


def _rig(rng: Rng, kind: str) -> _Rig:
    """A random sensor: in rooms a depth camera four times in five, elsewhere a lidar two times in
    three, else a camera.
    """
    noise = float(rng.uniform(*LABEL_NOISE))
    if rng.random() < (0.8 if kind == "room" else 0.34):
        camera = CAMERAS["depth" if kind in ("hall", "room") else "stereo"]
        height = camera.mount_height + rng.uniform(-0.3, 0.4)
        yaw = float(rng.choice([0.0, 0.0, math.pi / 2, -math.pi / 2, math.pi]))
        return _Rig(replace(camera, mount_height=height, yaw=yaw), label_noise=noise)
    model = MODELS[
        str(rng.choice(["hdl64", "hdl64", "hdl32", "vlp32", "vlp16", "vlp16", "rosette", "raster"]))
    ]
    if kind == "room":
        model = replace(model, height=1.2)
    blind = {"hall": 1.0, "room": 0.3}.get(kind) or float(rng.uniform(1.5, 3.5))
    model = replace(
        model,
        height=model.height + rng.uniform(-0.3, 0.4),
        noise=rng.uniform(0.01, 0.03),
        min_range=blind,
    )
    columns = min(int(RAYS * rng.uniform(0.6, 1.0) / len(model.elevations_deg)), model.columns)
    return _Rig(model, columns, (-0.9, 0.9) if rng.random() < 0.1 else None, label_noise=noise)


def _frames(drive: _Drive, rng: Rng, rig: _Rig, seed: int) -> Iterator[TrainingFrame]:
    scene = Scene(drive.world)
    for number, (pose, seconds) in enumerate(zip(drive.world_T_base, drive.seconds, strict=True)):
        moving = drive.traffic.scene(float(seconds), pose) if drive.traffic else None
        yield rig.frame(scene, pose, rng, moving, seed, number)


def _network(rng: Rng, length: float) -> RoadNetwork:
    """A few blocks of a town, or one winding road."""
    if rng.random() < 0.8:
        return grid_network(rng, 2, 2 + int(rng.random() < 0.5), float(rng.uniform(55, 95)))
    turning = np.cumsum(rng.normal(size=12)) * rng.uniform(0.02, 0.2) + rng.uniform(0, 6.3)
    steps = np.column_stack([np.cos(turning), np.sin(turning)]) * (length + 60) / 12
    return path_network(
        rng, smooth_line(np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]), 12.0)
    )


def _condition(rng: Rng, number: int) -> Condition:
    season = str(rng.choice(SEASONS, p=[0.55, 0.15, 0.15, 0.15]))
    works = float(rng.choice([0.0, 0.0, 4.0]))
    rebuilt = float(rng.choice([0.0, 0.0, 0.08]))
    return Condition(number, season, works, rebuilt)


def _street(
    rng: Rng, seed: int, frames: int, *, forest: bool = False
) -> tuple[_Drive, _Drive | None]:
    spacing = float(rng.uniform(1.5, 3.0))
    returning = rng.random() < 0.5
    once = int(np.ceil(frames * 0.6)) if returning else frames
    network = _network(rng, once * spacing)
    route = random_route(rng, network, once * spacing + 40)
    line = smooth_line(lane_path(network, route))
    back = smooth_line(lane_path(network, [(road, not forwards) for road, forwards in route[::-1]]))
    ground = street_ground(network, seed)
    start = 12.0
    speed = float(rng.uniform(5, 10))

    def again(count: int) -> F64:
        """Along the first drive once more, the other way round or beside it."""
        if rng.random() < 0.6:
            begin = max(0.0, 0.5 * len(back) - once * spacing - 30)
            return poses_along(
                back, begin + spacing * np.arange(count, dtype=np.float64), ground.slope_height, rng
            )
        beside = line + rng.normal() * 0.7
        times = start + rng.uniform(0, 20) + spacing * np.arange(count, dtype=np.float64)
        return poses_along(beside, times, ground.slope_height, rng)

    def drive(poses: F64, condition: Condition) -> _Drive:
        seconds = np.arange(len(poses), dtype=np.float64) * spacing / speed
        traffic = random_traffic(rng, ground, [line, back], float(rng.choice([0.0, 0.6, 1.5])))
        world = (
            build_forest(network, seed, condition)
            if forest
            else build_street(network, seed, condition)
        )
        return _Drive(world, poses, seconds, traffic)

    poses = poses_along(
        line, start + spacing * np.arange(once, dtype=np.float64), ground.slope_height, rng
    )
    if returning:
        poses = np.concatenate([poses, again(frames - once)])
    mapping = drive(poses, _condition(rng, 0))
    return mapping, drive(
        again(min(QUERY_FRAMES, once)), _condition(rng, 1)
    ) if rng.random() < 0.6 else None


def _hall(rng: Rng, seed: int, frames: int) -> tuple[_Drive, _Drive | None]:
    line = smooth_line(hall_walk(seed, 0.7 * frames + 10), 0.8)
    world = build_hall(seed)

    def drive(walked: F64, count: int) -> _Drive:
        poses = poses_along(
            walked,
            1 + 0.7 * np.arange(count, dtype=np.float64),
            lambda x, y: np.zeros_like(x),
            rng,
            shake=0.01,
        )
        return _Drive(world, poses, np.arange(count, dtype=np.float64), None)

    return drive(line, frames), drive(
        line[::-1], min(QUERY_FRAMES, frames)
    ) if rng.random() < 0.6 else None


def _room(rng: Rng, seed: int, frames: int) -> tuple[_Drive, _Drive | None]:
    """Walks with a sensor in the hand: nodding, by up to 30 degrees down."""
    step = 0.12
    line = smooth_line(room_walk(seed, step * frames + 3), 0.25)

    def walk(along: F64, count: int, condition: int) -> _Drive:
        places = 0.5 + step * np.arange(count, dtype=np.float64)
        poses = poses_along(along, places, lambda x, y: np.zeros_like(x), rng, shake=0.05)
        nod = np.eye(3)
        pitch = float(rng.uniform(-0.1, 0.5))
        nod[[0, 0, 2, 2], [0, 2, 0, 2]] = (
            math.cos(pitch),
            math.sin(pitch),
            -math.sin(pitch),
            math.cos(pitch),
        )
        poses[:, :3, :3] = poses[:, :3, :3] @ nod
        return _Drive(build_room(seed, condition), poses, np.arange(count, dtype=np.float64), None)

    again = walk(line[::-1], min(QUERY_FRAMES, frames), 1) if rng.random() < 0.6 else None
    return walk(line, frames, 0), again
