"""Simulated logs of cameras, read back by the readers of real ones."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from semloc_logs.frames import PosedCloud
from semloc_logs.logs.containers.open import open_log
from semloc_logs.logs.session.session import Session
from semloc_logs.numerics.transforms import apply
from semloc_logs.simulation.drives.camera_drive import SKY, simulate_cameras, wrong_label_image
from semloc_logs.simulation.drives.trajectory import Trajectory
from semloc_logs.simulation.meshes.world import (
    BUILDING,
    POLE,
    ROAD,
    UNLABELLED,
    WALL,
    MeshBuilder,
    Scene,
    World,
    box,
)
from semloc_logs.simulation.output.drive_log import FORMATS, write_session
from semloc_logs.simulation.sensors.camera import CAMERAS, base_T_camera, first_hits, pixel_rays
from semloc_logs.simulation.sensors.sensor import Sensor

SECOND = 10**9


@pytest.fixture(scope="module")
def yard() -> World:
    """A floor, a brick wall whose face is at x = 12, a house to the left with its face at y = 5, a
    box.
    """
    builder = MeshBuilder(lambda x, y: np.zeros_like(x))
    builder.add(box(60, 60, 0.5, z=-0.5), ROAD, ground="none")
    builder.add(box(1, 60, 6, x=12.5), WALL, ground="none")
    builder.add(box(20, 4, 8, x=5, y=7, z=-1.5), BUILDING, ground="none")
    builder.add(box(1, 1, 1, x=8, y=-2), UNLABELLED, ground="none")
    return builder.build()


def standing(seconds: float = 1.0) -> Trajectory:
    """Slowly ahead along x, without drift."""
    stamps = np.arange(0, int(seconds * SECOND) + 1, SECOND // 20) + 1000 * SECOND
    poses = np.tile(np.eye(4), (len(stamps), 1, 1))
    poses[:, 0, 3] = np.linspace(0, 0.2, len(stamps))
    return Trajectory(stamps, poses, poses)


def clouds(path: Path) -> list[PosedCloud]:
    return list(Session([open_log(path)]).clouds())


def test_masks_of_a_network_miss_edges_and_classes(yard: World) -> None:
    model = CAMERAS["depth"]
    rays = pixel_rays(model)
    pose = base_T_camera(model)
    hits = first_hits(Scene(yard), pose, rays)
    true = wrong_label_image(hits, rays, pose, 0, 0.0, 0)
    assert (true[~np.isfinite(hits.depth)] == SKY).all()
    assert np.array_equal(true[np.isfinite(hits.depth)], hits.labels[np.isfinite(hits.depth)])
    wrong: NDArray[np.bool_] = wrong_label_image(hits, rays, pose, 0, 0.12, 0) != true
    assert 0.05 < wrong.mean() < 0.25
    assert np.array_equal(wrong, wrong_label_image(hits, rays, pose, 0, 0.12, 0) != true)


@pytest.mark.parametrize(
    ("sensor", "format_"), [("depth", "protobuf"), ("depth", "bag"), ("stereo", "mcap")]
)
def test_cameras_see_floor_and_walls_where_they_are(
    yard: World, tmp_path: Path, sensor: str, format_: str
) -> None:
    path = tmp_path / f"log{FORMATS[format_]}"
    trajectory = standing()
    write_session(
        path,
        trajectory,
        [],
        shots=simulate_cameras(yard, trajectory, Sensor(sensor)),
        format=format_,
    )
    seen = clouds(path)
    assert len(seen) == 3
    for cloud in seen:
        assert cloud.session_T_base is not None
        assert cloud.label is not None
        points = apply(cloud.session_T_base, cloud.points)
        label = cloud.label
        off = np.abs(points[label == ROAD, 2])
        assert np.median(off) < 0.06
        assert np.quantile(off, 0.9) < 0.3
        assert abs(np.median(points[label == WALL, 0]) - 12) < 0.25
        assert abs(np.median(points[label == BUILDING, 1]) - 5) < 0.2
        assert not (label == POLE).any()
        assert (label != SKY).mean() > 0.98
