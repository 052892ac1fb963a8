"""From a data set's folder to views: a street of a few sweeps, as KITTI records it."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from semloc_logs.engines import Serial
from semloc_logs.errors import SemlocError
from semloc_logs.experiments.datasets.conversion import import_dataset
from semloc_logs.experiments.log_views import LIDAR, STEREO, fused_views, recorded_logs
from semloc_logs.experiments.view_pictures import depth_of_points
from semloc_logs.settings import load

FOCAL = 100.0
FRAMES = 8
WALL_X = 15.0  # m from the first LIDAR, across the street


def scene(moved: float) -> np.ndarray:
    """Ground 1.7 m below the LIDAR, and a wall ahead, nearer by ``moved`` metres."""
    x, y = (g.ravel() for g in np.mgrid[-12:14:0.25, -8:8:0.25])
    ground = np.column_stack([x, y, np.full(len(x), -1.7)])
    y, z = (g.ravel() for g in np.mgrid[-6:6:0.15, -1.5:3:0.15])
    wall = np.column_stack([np.full(len(y), WALL_X - moved), y, z])
    return np.concatenate([ground[ground[:, 0] < WALL_X - moved], wall]).astype(np.float32)


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    """A folder of KITTI odometry with one sequence; the camera sits at the LIDAR."""
    root = tmp_path / "dataset"
    sequence = root / "sequences" / "00"
    (sequence / "velodyne").mkdir(parents=True)
    (root / "poses").mkdir()
    projection = f"{FOCAL} 0 60 0 0 {FOCAL} 40 0 0 0 1 0"
    lines = [f"P{k}: {projection}" for k in range(4)]
    (sequence / "calib.txt").write_text("\n".join([*lines, "Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0"]) + "\n")
    (sequence / "times.txt").write_text("".join(f"{0.1 * k:.6e}\n" for k in range(FRAMES)))
    poses = "".join(f"1 0 0 0 0 1 0 0 0 0 1 {1.2 * k:.3f}\n" for k in range(FRAMES))
    (root / "poses" / "00.txt").write_text(poses)
    for camera in (2, 3):
        (sequence / f"image_{camera}").mkdir()
    for k in range(FRAMES):
        data = b"".join(struct.pack("<4f", *point, 0.1) for point in scene(1.2 * k).tolist())
        (sequence / "velodyne" / f"{k:06d}.bin").write_bytes(data)
        for camera in (2, 3):
            path = sequence / f"image_{camera}" / f"{k:06d}.png"
            # red, green, blue of OpenCV's order
            assert cv2.imwrite(str(path), np.full((80, 120, 3), (10 * k, 20, 200), np.uint8))
    return root


def test_a_sequence_becomes_views_with_truth_pictures_and_depth(
    kitti: Path, tmp_path: Path
) -> None:
    truth, logs = import_dataset("kitti", kitti, tmp_path / "logs")
    recorded = recorded_logs(logs, truth)
    store = fused_views(recorded, LIDAR, tmp_path / "maps", load().resolved(), Serial())
    assert store.names == ["kitti_00"]
    assert len(store) == FRAMES
    assert store.has_pictures
    assert np.allclose(store.world_T_base[:, 0, 3], 1.2 * np.arange(FRAMES), atol=1e-6)
    assert np.allclose((store.headings_deg + 180) % 360, 180.0, atol=1e-6)

    view = store[3]
    assert view.picture is not None
    assert view.picture.image.shape == (80, 120, 3)
    assert view.picture.image[0, 0].tolist() == [200, 20, 30]
    assert view.picture.intrinsics.tolist() == [[FOCAL, 0, 60], [0, FOCAL, 40], [0, 0, 1]]
    # straight ahead is the wall; at the lower edge the ground: 1.7 m below, 100 px a metre at 1 m
    assert view.picture.depth[38, 60] == pytest.approx(WALL_X - 3.6, abs=0.1)
    assert view.picture.depth[75, 60] == pytest.approx(1.7 * FOCAL / 35, rel=0.08)
    # odometry is level, and moves as the truth does
    moved = store[5].odom_T_base[:3, 3] - view.odom_T_base[:3, 3]
    assert np.linalg.norm(moved) == pytest.approx(2.4, abs=1e-3)

    hidden = store.hidden(3)
    assert np.isnan(hidden.world_T_base).all()
    assert np.array_equal(hidden.points, view.points)
    assert [v.stamp_ns for v in store.selection([5, 1])] == [store[5].stamp_ns, store[1].stamp_ns]


def test_a_second_time_reads_the_files_that_are_there(kitti: Path, tmp_path: Path) -> None:
    truth, logs = import_dataset("kitti", kitti, tmp_path / "logs")
    recorded = recorded_logs(logs, truth)
    fused_views(recorded, LIDAR, tmp_path / "maps", load().resolved(), Serial())
    stamp = (tmp_path / "maps/pictures/lidar/kitti_00/pictures.json").stat().st_mtime_ns
    fused_views(recorded, LIDAR, tmp_path / "maps", load().resolved(), Serial())
    assert (tmp_path / "maps/pictures/lidar/kitti_00/pictures.json").stat().st_mtime_ns == stamp


def test_a_log_without_stereo_gives_no_stereo_views(kitti: Path, tmp_path: Path) -> None:
    for path in (kitti / "sequences/00").glob("image_*/*.png"):
        path.unlink()
    truth, logs = import_dataset("kitti", kitti, tmp_path / "logs")
    with pytest.raises(SemlocError, match="kitti_00"):
        fused_views(
            recorded_logs(logs, truth), STEREO, tmp_path / "maps", load().resolved(), Serial()
        )


def test_points_behind_a_surface_of_few_points_are_hidden() -> None:
    K = np.array([[100.0, 0, 50], [0, 100.0, 50], [0, 0, 1]])
    y = np.arange(-0.2, 0.21, 0.05)
    fence = np.array([(x, v, 2.0) for x in y for v in y])
    behind = np.array([(x, v, 8.0) for x in np.arange(-0.5, 0.51, 0.07) for v in (0.0, 0.03)])
    depth = depth_of_points(np.concatenate([fence, behind]), K, (100, 100))
    assert depth[50, 50] == pytest.approx(2.0)
    assert np.nanmax(depth[45:56, 45:56]) == pytest.approx(2.0)
    assert np.isnan(depth[5, 5])
    assert np.isnan(depth_of_points(np.array([[0.0, 0.0, -1.0]]), K, (10, 10))).all()
