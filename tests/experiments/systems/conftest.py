"""A small town of textured boxes on a plane, seen by a turning LIDAR and a camera."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from semloc_logs.arrays import F64
from semloc_logs.experiments.system import Picture, Query, RankedPose, View
from semloc_logs.experiments.systems.catalogue import SystemOptions
from semloc_logs.experiments.systems.shapes.training_views import Training
from semloc_logs.numerics.transforms import inverse, yaw_transform
from semloc_logs.settings import Settings

SENSOR = np.array([0.0, 0.0, 1.8])
ROAD, BUILDING = 0, 2
INTRINSICS = np.array([[180.0, 0.0, 160.0], [0.0, 180.0, 80.0], [0.0, 0.0, 1.0]])
WIDTH, HEIGHT = 320, 160
# optical axes: x right, y down, z ahead
BASE_T_CAMERA = np.array(
    [[0.0, 0.0, 1.0, 0.3], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]]
)


@dataclass(frozen=True)
class Town:
    """Boxes (n, 2, 3), lowest and highest corner in metres, on the plane z = 0."""

    boxes: F64
    noise: F64

    def distances(self, start: F64, rays: F64) -> tuple[F64, NDArray[np.uint8]]:
        """Metres (n,) along unit ``rays`` (n, 3) to the first surface, infinite where there is
        none, and its class.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            ground = np.where(rays[:, 2] < 0, -start[2] / rays[:, 2], np.inf)
            first = ground
            label = np.full(len(rays), ROAD, np.uint8)
            for low, high in self.boxes:
                a = (low - start) / rays
                b = (high - start) / rays
                enters = np.minimum(a, b).max(1)
                leaves = np.maximum(a, b).min(1)
                hit = (enters < leaves) & (enters > 0) & (enters < first)
                first = np.where(hit, enters, first)
                label[hit] = BUILDING
        return first, label

    def brightness(self, points: F64) -> F64:
        """Of surfaces at ``points`` (n, 3): bright spots on a ground of fine and coarse noise."""
        fine, middle, coarse = (
            map_coordinates(self.noise, (points / scale).T, order=1, mode="grid-wrap")
            for scale in (0.15, 0.5, 2.0)
        )
        return np.asarray(40 * fine + 60 * coarse + 110 * (middle > 0.6))

    def view(self, world_T_base: F64, stamp_ns: int, with_picture: bool) -> View:
        azimuth, elevation = np.meshgrid(
            np.radians(np.arange(0, 360, 1.2)), np.radians(np.linspace(-24, 20, 40))
        )
        rays = np.stack(
            [
                np.cos(azimuth) * np.cos(elevation),
                np.sin(azimuth) * np.cos(elevation),
                np.sin(elevation),
            ],
            -1,
        ).reshape(-1, 3)
        start = world_T_base[:3, :3] @ SENSOR + world_T_base[:3, 3]
        far, label = self.distances(start, rays @ world_T_base[:3, :3].T)
        is_in_range = far < 40.0
        points = (SENSOR + rays[is_in_range] * far[is_in_range, None]).astype(np.float32)
        return View(
            "town",
            stamp_ns,
            points,
            label[is_in_range],
            SENSOR.astype(np.float32),
            world_T_base.copy(),
            world_T_base,
            self.picture(world_T_base) if with_picture else None,
        )

    def picture(self, world_T_base: F64) -> Picture:
        u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
        pixels = np.stack([u.ravel(), v.ravel(), np.ones(u.size)])
        rays = (np.linalg.inv(INTRINSICS) @ pixels).T
        length = np.linalg.norm(rays, axis=1)
        world_T_camera = world_T_base @ BASE_T_CAMERA
        far, _ = self.distances(
            world_T_camera[:3, 3], rays / length[:, None] @ world_T_camera[:3, :3].T
        )
        seen = np.isfinite(far) & (far < 60.0)
        depth = np.where(seen, far / length, np.nan)
        points = (rays * np.where(seen, depth, 0)[:, None]) @ world_T_camera[:3, :3].T
        grey = self.brightness(points + world_T_camera[:3, 3])
        # a lens blurs: on edges without width the detector of stable regions finds few
        grey = np.where(seen, np.clip(grey, 0, 255), 255).reshape(HEIGHT, WIDTH)
        image = np.round(gaussian_filter(grey, 0.8)).astype(np.uint8)
        return Picture(
            np.repeat(image[:, :, None], 3, axis=2),
            depth.reshape(HEIGHT, WIDTH).astype(np.float32),
            INTRINSICS,
            BASE_T_CAMERA,
        )


@dataclass(frozen=True)
class Drive:
    """Views along a straight road; the queries lie between them, some turned."""

    database: Sequence[View]
    query_at: Callable[[F64], Query]


def as_query(view: View, name: str = "query") -> Query:
    """A query of one view, whose odometry begins elsewhere and whose truth is hidden."""
    odom_T_world = yaw_transform(2.0, (7.0, -3.0, 0.5))
    hidden = replace(
        view,
        odom_T_base=odom_T_world @ view.world_T_base,
        world_T_base=np.full((4, 4), np.nan),
    )
    return Query(name, (hidden,))


@pytest.fixture(scope="session")
def town() -> Town:
    rng = np.random.default_rng(4)
    boxes = []
    for x in np.arange(-25.0, 70.0, 9.0):
        for side in (-1.0, 1.0):
            depth, width, height = rng.uniform([4, 3, 3], [8, 7, 9])
            distance = rng.uniform(6.0, 11.0)
            y = sorted((side * distance, side * (distance + depth)))
            left = x + rng.uniform(0, 2)
            boxes.append([[left, y[0], 0.0], [left + width, y[1], height]])
            if rng.random() < 0.5:  # a kiosk
                start = x + rng.uniform(0, 8)
                boxes.append([[start, side * 5.0 - 0.5, 0.0], [start + 1.2, side * 5.0 + 0.5, 2.2]])
    return Town(np.array(boxes), rng.random((48, 48, 48)))


def _drive(town: Town, step: float, with_picture: bool) -> Drive:
    database = [
        town.view(yaw_transform(0.0, (x, 0.0, 0.0)), int(x * 1e8), with_picture)
        for x in np.arange(0.0, 40.1, step)
    ]
    return Drive(
        database, lambda world_T_base: as_query(town.view(world_T_base, 10**12, with_picture))
    )


@pytest.fixture(scope="session")
def point_drive(town: Town) -> Drive:
    """Views by a LIDAR alone."""
    return _drive(town, 2.0, with_picture=False)


@pytest.fixture(scope="session")
def training(point_drive: Drive) -> Training:
    """The database of the point drive, to learn from: streets of a simulator take longer."""
    return Training("town", lambda: point_drive.database)


@pytest.fixture(scope="session")
def picture_drive(town: Town) -> Drive:
    """Views by a LIDAR and a camera."""
    return _drive(town, 4.0, with_picture=True)


@pytest.fixture(scope="session")
def options(tmp_path_factory: pytest.TempPathFactory) -> SystemOptions:
    return SystemOptions(Settings().resolved(), tmp_path_factory.mktemp("systems"), quick=True)


@pytest.fixture(scope="session")
def errors() -> Callable[[RankedPose, F64], tuple[float, float]]:
    """Metres and degrees by which a pose is wrong."""

    def of(pose: RankedPose, truth: F64) -> tuple[float, float]:
        off = inverse(truth) @ pose.world_T_base
        turn = np.degrees(np.arccos(np.clip((np.trace(off[:3, :3]) - 1) / 2, -1, 1)))
        return float(np.linalg.norm(off[:3, 3])), float(turn)

    return of
