"""Inspection of real and odd logs: the promised keys, and no error but ours."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from semloc_logs.errors import LogError, RoleError
from semloc_logs.logs.inspection.inspect import inspect_log
from semloc_logs.numerics import transforms
from semloc_logs.settings import Logs

STORE = get_typestore(Stores.ROS1_NOETIC)
S = 1_000_000_000


def inspect(path: Path, topics: dict[str, str] | None = None) -> dict[str, Any]:
    inspection = inspect_log(path, topics)
    content: dict[str, Any] = json.loads(json.dumps(inspection, allow_nan=False))
    assert {"path", "format", "start_ns", "end_ns", "streams", "problems"} <= set(content)
    assert set(content["skipped"]) <= set(content["problems"])
    return content


def write_odometry_bag(path: Path, topics: tuple[str, ...], seconds: int = 20) -> None:
    """A ROS 1 bag whose odometry topics stand still."""
    T = STORE.types
    header_type = T["std_msgs/msg/Header"]
    odometry_type = T["nav_msgs/msg/Odometry"]
    time_type = T["builtin_interfaces/msg/Time"]
    pose = T["geometry_msgs/msg/Pose"](
        T["geometry_msgs/msg/Point"](1.0, 2.0, 3.0),
        T["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
    )
    zero = T["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    covariance = np.zeros(36)
    with Writer(path) as writer:
        for topic in topics:
            connection = writer.add_connection(topic, odometry_type.__msgtype__, typestore=STORE)
            for k in range(seconds * 2):
                stamp = 1_700_000_000 * S + k * S // 2
                message = odometry_type(
                    header_type(k, time_type(stamp // S, stamp % S), "odom"),
                    "base_link",
                    T["geometry_msgs/msg/PoseWithCovariance"](pose, covariance),
                    T["geometry_msgs/msg/TwistWithCovariance"](
                        T["geometry_msgs/msg/Twist"](zero, zero), covariance
                    ),
                )
                writer.write(
                    connection, stamp, STORE.serialize_ros1(message, odometry_type.__msgtype__)
                )


def test_ambiguity_is_a_problem_and_not_an_error(tmp_path: Path) -> None:
    write_odometry_bag(tmp_path / "two.bag", ("/a/odom", "/b/odom"))
    content = inspect(tmp_path / "two.bag")
    assert any(
        "--topic pose=/a/odom or --topic pose=/b/odom" in problem for problem in content["problems"]
    )
    assert [s["role"] for s in content["streams"]] == [None, None]
    chosen = inspect(tmp_path / "two.bag", {"pose": "/b/odom"})
    assert [s["role"] for s in chosen["streams"]] == [None, "pose"]
    assert chosen["poses"]["count"] == 40
    with pytest.raises(RoleError, match="no topic '/c'"):
        inspect_log(tmp_path / "two.bag", {"pose": "/c"})


def test_settings_of_reading_hold_and_are_in_the_suggested_command(recorder: Any) -> None:
    log = recorder("ros2")
    points = np.array([(x, y, x * y / 9) for x in range(1, 9) for y in range(9)], "f4,f4,f4")
    points.dtype.names = ("x", "y", "z")
    for k in range(40):
        pose = transforms.yaw_transform(0.0, (0.5 * k, 0.0, 0.0))
        log.pose(100 * S + k * S // 2, pose)
        log.cloud("/points", 500 * S + k * S // 2, "lidar", points, late_ns=-400 * S)
    path = log.write()
    as_it_is = inspect(path)
    assert any(p.startswith("/points starts at") for p in as_it_is["problems"])
    assert as_it_is["sensors"]["/points"]["base_T_sensor"][2] == [0, 0, 1, 0]
    settings = Logs(time_offset={"points": -400}, mountings={"lidar": (0, 0, 2, 0, 0, 0, 1)})
    tried = inspect_log(path, logs=settings)
    sensor: Any = tried["sensors"]
    assert sensor["/points"]["base_T_sensor"][2] == [0, 0, 1, 2]
    assert not any("starts at" in problem for problem in cast(Any, tried["problems"]))
    suggested = str(tried["suggested"])
    assert "--set logs.time_offset.points=-400.0" in suggested
    assert "--set 'logs.mountings.lidar=[0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 1.0]'" in suggested
    with pytest.raises(LogError, match="time_offset names /none"):
        inspect_log(path, logs=Logs(time_offset={"/none": 1.0}))


def test_odometry_that_was_never_filled_in(tmp_path: Path) -> None:
    write_odometry_bag(tmp_path / "still.bag", ("/odom",))
    content = inspect(tmp_path / "still.bag")
    assert any(
        "/odom gives the same position for 20 s" in problem for problem in content["problems"]
    )
    assert content["skipped"] == []
    assert (content["base_frame"], content["session_frame"], content["duration_s"]) == (
        "base_link",
        "odom",
        19.5,
    )


def test_no_log_at_all(tmp_path: Path) -> None:
    (tmp_path / "text.mcap").write_text("hello")
    with pytest.raises(LogError):
        inspect_log(tmp_path / "text.mcap")
    with pytest.raises(LogError, match="does not exist"):
        inspect_log(tmp_path / "nowhere.mcap")


@pytest.mark.parametrize(
    ("name", "base", "poses", "roles"),
    [
        ("basement_a.mcap", "base_link", 88, {"lidar": 88, "pose": 88, "tf_static": 1}),
        ("basement_b.bag", "base_link", 87, {"lidar": 87, "pose": 87, "tf_static": 1}),
        (
            "room_a.mcap",
            "camera_optical",
            125,
            {"depth": 125, "image": 125, "camera_info": 250, "pose": 125},
        ),
        (
            "room_b",
            "camera_optical",
            125,
            {"depth": 125, "image": 125, "camera_info": 250, "pose": 125},
        ),
        ("kitti00_000850.mcap", "base_link", 1, {"lidar": 1, "pose": 1, "tf_static": 1}),
        (
            "kitti_drive_camera_lidar.mcap",
            "velodyne",
            0,
            {"lidar": 24, "image": 24, "camera_info": 24, "tf_static": 1},
        ),
        (
            "euroc_v101_stereo.bag",
            "imu",
            97,
            {"stereo_left": 32, "stereo_right": 32, "camera_info": 64, "pose": 97, "tf_static": 1},
        ),
    ],
)
def test_recorded_logs(
    shared: Callable[[str], Path], name: str, base: str, poses: int, roles: dict[str, int]
) -> None:
    content = inspect(shared(f"logs/{name}"))
    assert content["base_frame"] == base
    assert content["poses"]["count"] == poses
    count_of_role: dict[str, int] = {}
    for stream in content["streams"]:
        count_of_role[stream["role"]] = count_of_role.get(stream["role"], 0) + stream["count"]
    assert count_of_role == roles
    assert content["skipped"] == []


def test_odd_logs_give_an_answer_or_a_log_error(shared: Callable[[str], Path]) -> None:
    unreadable = {"empty-file.bag", "lfs_pointer.bag", "lfs_pointer.mcap", "not_a_bag.bag"}
    for name in unreadable:
        shared(f"odd_logs/{name}")
    paths = [p for p in sorted(shared("odd_logs").iterdir()) if p.name != "mcap_conformance"]
    paths += sorted(shared("odd_logs/mcap_conformance").iterdir())
    refused = {}
    for path in paths:
        try:
            inspect(path)
        except LogError as error:
            refused[path.name] = str(error)
    assert all(sentence.endswith(".") for sentence in refused.values())
    assert set(refused) == unreadable


@pytest.mark.parametrize("name", ["basement_a.mcap", "basement_b.bag"])
def test_cut_off_and_scribbled_logs(
    shared: Callable[[str], Path], name: str, tmp_path: Path
) -> None:
    data = shared(f"logs/{name}").read_bytes()
    rng = np.random.default_rng(5)
    whole = inspect(shared(f"logs/{name}"))
    for share in (0.9, 0.5, 0.1):
        path = tmp_path / name
        path.write_bytes(data[: int(len(data) * share)])
        content = inspect(path)
        assert content["skipped"]
        assert sum(s["count"] for s in content["streams"]) < sum(
            s["count"] for s in whole["streams"]
        )
    for _ in range(3):
        damaged = bytearray(data)
        start = int(rng.integers(len(data) // 10, len(data) * 9 // 10))
        damaged[start : start + 4096] = rng.bytes(4096)
        (tmp_path / name).write_bytes(damaged)
        assert inspect(tmp_path / name)["skipped"]


def test_tf_alone_gives_poses(shared: Callable[[str], Path]) -> None:
    content = inspect(shared("odd_logs/tf_example.bag"))
    assert (content["poses"]["count"], content["base_frame"], content["session_frame"]) == (
        517,
        "base_link",
        "odom",
    )
    assert "base_footprint" in content["frames"]


def test_undecodable_topics_without_a_role_lose_nothing(shared: Callable[[str], Path]) -> None:
    content = inspect(shared("odd_logs/ros2_utm_drive_a"))
    assert any("ackermann_msgs" in problem for problem in content["problems"])
    assert content["skipped"] == []
