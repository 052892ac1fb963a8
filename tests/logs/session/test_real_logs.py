"""Logs recorded by others, where they are at hand."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from semloc_logs.errors import LogError
from semloc_logs.frames import DepthFrame, LidarFrame
from semloc_logs.logs.containers.open import open_log
from semloc_logs.logs.log import Log
from semloc_logs.logs.problems import sentences


def frames(log: Log) -> Counter[tuple[str, str]]:
    return Counter((f.header.topic, type(f).__name__) for f in log.frames())


@pytest.mark.parametrize(
    "name", ["empty-file.bag", "not_a_bag.bag", "lfs_pointer.bag", "lfs_pointer.mcap"]
)
def test_files_that_are_not_logs_are_refused(shared: Callable[[str], Path], name: str) -> None:
    with pytest.raises(LogError, match=name):
        open_log(shared(f"odd_logs/{name}"))


def test_a_log_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no such file"):
        open_log(tmp_path / "no such file")


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        (
            "nav2_turtlebot.mcap",
            {
                ("/amcl_pose", "PoseSample"): 135,
                ("/odom", "PoseSample"): 2639,
                ("/tf", "TransformSample"): 7284,
            }
            | {("/tf_static", "TransformSample"): 29},
        ),
        (
            "husky_imu_gnss_odometry.bag",
            {
                ("/fix", "NavSatSample"): 989,
                ("/husky_velocity_controller/odom", "PoseSample"): 3952,
                ("/imu/data", "ImuSample"): 11865,
            },
        ),
        (
            "example-lz4.bag",
            {("/tf", "TransformSample"): 2688, ("/tf_static", "TransformSample"): 1},
        ),
        (
            "example-bz2.bag",
            {("/tf", "TransformSample"): 2688, ("/tf_static", "TransformSample"): 1},
        ),
        ("one_cloud_lz4.bag", {("/pointcloud2", "LidarFrame"): 1}),
        (
            "foxglove_json_camera.mcap",
            {
                ("/camera_calibration", "Camera"): 10,
                ("/camera_calibration/custom", "Camera"): 10,
                ("/image/compressed", "ImageFrame"): 10,
            },
        ),
        (
            "tf_example_ros2",
            {("/tf", "TransformSample"): 517, ("/tf_static", "TransformSample"): 1},
        ),
        ("no-messages.bag", {}),
        ("example-unsorted-chunks.bag", {}),
        ("ros2_message_zstd", {}),
        ("ros2_no_metadata", {}),
        ("chatter_no_metadata.db3", {}),
    ],
)
def test_odd_logs_are_read_without_a_problem(
    shared: Callable[[str], Path], name: str, expected: dict[tuple[str, str], int]
) -> None:
    log = open_log(shared(f"odd_logs/{name}"))
    assert frames(log) == expected
    assert sum(s.count for s in log.streams) == sum(1 for _ in log.messages())
    assert log.problems == []


def test_a_type_without_definition_is_named_and_the_rest_read(
    shared: Callable[[str], Path],
) -> None:
    log = open_log(shared("odd_logs/ros2_utm_drive_a"))
    assert frames(log) == {
        ("/gps", "NavSatSample"): 107,
        ("/odometry", "PoseSample"): 2143,
        ("/vehicle_pose", "PoseSample"): 2034,
    }
    [sentence] = sentences(log.problems)
    assert sentence.startswith(
        "/vehicle_command_ackermann: messages of type "
        "ackermann_msgs/msg/AckermannDriveStamped cannot be decoded"
    )


def test_the_conformance_files_of_the_format(shared: Callable[[str], Path]) -> None:
    paths = sorted(shared("odd_logs/mcap_conformance").glob("*.mcap"))
    assert len(paths) > 300
    for path in paths:
        log = open_log(path)
        kind = path.stem.split("-")[0]
        count = sum(1 for _ in log.messages())
        assert count == {"OneMessage": 1, "TenMessages": 10, "TenMessagesOneAttachment": 10}.get(
            kind, 0
        ), path
        assert count == sum(s.count for s in log.streams), path
        assert list(log.frames()) == []
        assert log.problems == [], path
        log.close()


def test_a_truncated_drive(shared: Callable[[str], Path], tmp_path: Path) -> None:
    whole = shared("logs/basement_a.mcap").read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole[: len(whole) * 6 // 10])
    log = open_log(path)
    count_of_topic = Counter(m.topic for m in log.messages())
    assert sum(count_of_topic.values()) >= 60
    assert {s.topic: s.count for s in log.streams} == count_of_topic
    assert len(log.problems) == 1
    assert "cut.mcap" in sentences(log.problems)[0]


def test_labels_of_a_real_sweep(shared: Callable[[str], Path]) -> None:
    [sweep] = open_log(shared("logs/kitti00_000052.mcap")).frames(["/velodyne_points"])
    assert isinstance(sweep, LidarFrame)
    assert sweep.label is not None
    assert len(sweep.points) == len(sweep.label) > 50_000
    # road, building, vegetation of SemanticKITTI
    assert {40, 50, 70} <= set((sweep.label & 0xFFFF).tolist())


@pytest.mark.parametrize("name", ["room_a.mcap", "room_b"])
def test_depth_of_a_real_room(shared: Callable[[str], Path], name: str) -> None:
    topics = ["/camera/depth/image", "/camera/depth/image/compressedDepth"]
    depth = next(open_log(shared(f"logs/{name}")).frames(topics))
    assert isinstance(depth, DepthFrame)
    assert depth.depth.shape == (480, 640)
    assert 0.3 < float(np.median(depth.depth[depth.depth > 0])) < 5
