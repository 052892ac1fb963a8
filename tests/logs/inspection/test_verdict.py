"""Whether a log can be used, and with which command."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from rosbags.typesys.stores.ros2_humble import sensor_msgs__msg__LaserScan as LaserScan

from semloc_logs.arrays import F64
from semloc_logs.logs.inspection import units
from semloc_logs.logs.inspection.inspect import inspect_log
from semloc_logs.logs.inspection.inspect_text import WIDTH, inspect_text
from semloc_logs.logs.inspection.verdict import comes_back, is_planar, voxel_size
from semloc_logs.logs.poses.track import PoseTrack
from semloc_logs.numerics.transforms import yaw_transform

S = 1_000_000_000
XYZ = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
XYZL = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("label", "<u4")])


def cloud(reach: float, *, flat: bool = False) -> np.ndarray[Any, Any]:
    """Points whose coordinates are below ``reach`` (m); ``flat``: a 2-D scan."""
    points = np.random.default_rng(1).uniform(-reach, reach, (200, 3)).astype("<f4")
    if flat:
        points[:, 2] = 0.0
    return points.view(XYZ)[:, 0]


def straight(second: int) -> float:
    return 2.0 * second


def there_and_back(second: int) -> float:
    return 2.0 * min(second, 100 - second)


def drive(
    log: Any, place: Callable[[int], float] | None = straight, points: Any = None
) -> dict[str, Any]:
    """100 s with a LIDAR and odometry at 1 Hz; ``place``: metres along a line at a second."""
    log.transform("base_link", "lidar", np.eye(4), 0)
    for k in range(101):
        log.cloud("/points", k * S, "lidar", cloud(40.0) if points is None else points, late_ns=0)
        if place is not None:
            log.pose(k * S, yaw_transform(0.0, (place(k), 0.0, 0.0)))
    content: dict[str, Any] = dict(inspect_log(log.write()))
    return content


def test_a_straight_drive_never_comes_back(recorder: Any) -> None:
    content = drive(recorder())
    # 10 m at 0.30 m voxels and 1 % of 200 m
    assert content["verdict"] == (
        "ready: LIDAR 1 Hz with poses, 200.0 m, labels from geometry; the track never comes back "
        "within 12.0 m of itself: closures need a second log of the place; suggested: "
        f"{content['suggested']}"
    )
    assert content["suggested"] == f"semloc run {content['path']} -w work"


def test_a_drive_there_and_back_can_close_with_itself(recorder: Any) -> None:
    content = drive(recorder(), there_and_back)
    assert (
        "ready: LIDAR 1 Hz with poses, 200.0 m, labels from geometry; suggested"
        in (content["verdict"])
    )


def test_a_short_drive_is_too_short(recorder: Any) -> None:
    content = drive(recorder(), lambda second: 0.2 * second)
    assert (
        "too short for closures within the log (20.0 m of at least 50.0 m)" in (content["verdict"])
    )


def test_a_room_wants_small_voxels(recorder: Any) -> None:
    content = drive(recorder(), points=cloud(2.0))
    assert content["sensors"]["/points"]["range_m"] < 3.5
    assert content["suggested"].endswith("-w work --set fusion.voxel_size=0.05")
    assert "small voxels" in content["verdict"]
    # a street needs none of that
    street = drive(recorder(name="street"))
    assert street["suggested"].endswith("-w work")
    assert "small voxels suit" not in street["verdict"]


@pytest.mark.parametrize(
    ("far", "size"), [(2.9, 0.05), (8.0, 0.10), (18.4, 0.30), (80.0, 0.30), (None, 0.30)]
)
def test_voxel_sizes_of_ranges(far: float | None, size: float) -> None:
    assert voxel_size(far) == size


def test_recorded_labels_are_named(recorder: Any) -> None:
    labelled = np.zeros(200, XYZL)
    for name in "xyz":
        labelled[name] = cloud(40.0)[name]
    content = drive(recorder(), points=labelled)
    assert content["labels"] == "cloud"
    assert "labels in the cloud" in content["verdict"]


def test_without_poses_single_frames_are_left(recorder: Any) -> None:
    content = drive(recorder(), None)
    assert content["verdict"].startswith("ready for single frames only: LIDAR 1 Hz without poses")
    assert content["suggested"].endswith("-w work --odometry lidar")


def test_a_plane_is_not_mapped(recorder: Any) -> None:
    content = drive(recorder(), points=cloud(20.0, flat=True))
    assert content["verdict"].startswith("not ready: /points: all points lie in one plane: a 2-D")
    assert content["suggested"] == ""
    assert any("2-D scan cannot be mapped" in problem for problem in content["problems"])


def test_a_wall_is_not_a_2d_scan() -> None:
    wall = np.random.default_rng(1).uniform(-5, 5, (200, 3)).astype(np.float32)
    wall[:, 0] = 4.0
    assert not is_planar(wall)
    scan = np.random.default_rng(1).uniform(-5, 5, (200, 3)).astype(np.float32)
    scan[:, 0] = 0.0
    assert is_planar(scan)


def test_a_laser_scan_is_not_mapped(recorder: Any) -> None:
    log = recorder()
    for k in range(3):
        ranges = np.full(10, 5.0, np.float32)
        scan = LaserScan(
            log.header(k * S, "laser"), -1.0, 1.0, 0.2, 0.0, 0.1, 0.1, 30.0, ranges, ranges
        )
        log.add("/scan", scan, k * S)
        log.pose(k * S, np.eye(4))
    content = inspect_log(log.write())
    assert str(content["verdict"]).startswith(
        "not ready: /scan (sensor_msgs/msg/LaserScan): a 2-D scan cannot be mapped; record "
    )


def test_a_missing_calibration_stands_in_the_way(recorder: Any) -> None:
    log = recorder()
    log.transform("base_link", "camera_optical", np.eye(4), S)
    for k in range(1, 4):
        log.picture("/depth/image", k * S, "camera_optical", np.full((8, 8), 2000, "<u2"), "16UC1")
        log.pose(k * S, np.eye(4))
    content = inspect_log(log.write())
    assert str(content["verdict"]).startswith("not ready: /depth/image has no CameraInfo")

    log.camera_info("/depth/camera_info", S, "camera_optical", 8, 8, 10.0)
    content = inspect_log(log.write())
    assert str(content["verdict"]).startswith("ready: depth camera 1 Hz with poses")


def test_chosen_topics_are_in_the_command(recorder: Any) -> None:
    log = recorder()
    for k in range(3):
        log.cloud("/a", k * S, "lidar", cloud(40.0), late_ns=0)
        log.cloud("/b", k * S, "lidar", cloud(30.0), late_ns=0)
        log.pose(k * S, np.eye(4))
    content = inspect_log(log.write(), {"lidar": "/b"})
    assert str(content["suggested"]).endswith("-w work --topic lidar=/b")


def test_ambiguous_poses_stand_in_the_way(recorder: Any) -> None:
    log = recorder()
    log.cloud("/points", 0, "lidar", cloud(40.0), late_ns=0)
    log.pose(0, np.eye(4))
    log.add("/b/odom", log.events[-1][2], 1)
    content = inspect_log(log.write())
    assert "choose one with --topic pose=/b/odom or --topic pose=/odom" in str(content["verdict"])
    assert str(content["verdict"]).startswith("not ready: ")


def track(positions: F64) -> PoseTrack:
    out = PoseTrack()
    for k, position in enumerate(positions):
        out.append(k * S, yaw_transform(0.0, tuple(position)))
    return out


def test_a_loop_comes_back_and_a_spiral_does_not() -> None:
    angle = np.linspace(0.0, 2 * np.pi, 200)
    circle = np.stack([50 * np.cos(angle), 50 * np.sin(angle), 0 * angle], axis=1)
    assert comes_back(track(circle), reach=5.0, apart=50.0)
    assert not comes_back(track(circle[:100]), reach=5.0, apart=50.0)
    # within reach, but on the same stretch of road
    assert not comes_back(track(circle[:20]), reach=60.0, apart=50.0)
    # standing still is not coming back
    assert not comes_back(track(np.zeros((50, 3))), reach=5.0, apart=50.0)


def test_the_text_fits_80_columns(recorder: Any) -> None:
    content = drive(recorder(), points=cloud(2.0))
    path = "recordings/of/november/drive_through_the_old_town_2026.mcap"
    suggested = content["suggested"].replace(content["path"], path)
    verdict = content["verdict"].replace(content["path"], path)
    text = inspect_text(content | {"path": path, "suggested": suggested, "verdict": verdict})
    lines = text.splitlines()
    assert max(map(len, lines)) <= WIDTH
    # the command can be pasted as it is
    command = text.partition("Suggested")[2].replace("\\\n", " ")
    assert shlex.split(command) == shlex.split(suggested)
    assert "lidar         /points" in lines
    assert any(line.startswith("pose          /odom") for line in lines)
    assert "101 messages, 1 Hz, PointCloud2, 200 points in the first" in text
    assert "1970-01-01 00:00:00 to 1970-01-01 00:01:40 UTC" in text
    assert "200.0 m, in 1 min 40 s" in text
    assert "Frames        base_link\n                lidar" in text


def test_units() -> None:
    assert [units.distance(m) for m in (0.018, 28.896, 999.96, 1234.0)] == [
        "2 cm",
        "28.9 m",
        "1.0 km",
        "1.2 km",
    ]
    assert [units.duration(s) for s in (43.499, 59.99, 97.0, 7384.0)] == [
        "43.5 s",
        "60.0 s",
        "1 min 37 s",
        "2 h 03 min",
    ]
    assert [units.size(b) for b in (12, 34_100, 30_685_169, 10**11, 2 * 10**12)] == [
        "12 B",
        "34.1 kB",
        "30.7 MB",
        "100 GB",
        "2 TB",
    ]
    assert [units.rate(h) for h in (0.0123, 1.977, 9.98, 18.04, 29.97)] == [
        "0.012 Hz",
        "2 Hz",
        "10 Hz",
        "18 Hz",
        "30 Hz",
    ]
