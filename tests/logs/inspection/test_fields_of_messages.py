"""Logs whose messages set fields that change what they mean, and the same logs without."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from numpy.typing import NDArray

from semloc_logs.frames import PosedCloud
from semloc_logs.logs.inspection.inspect import inspect_log
from semloc_logs.logs.session.session import Session, SessionOptions, open_session
from semloc_logs.settings import Logs

S = 1_000_000_000
EPOCH = 1_700_000_000 * S
DEPTH, INFO = "/cam/depth/image", "/cam/depth/camera_info"
OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def wall(height: int = 48, width: int = 64, metres: float = 2.0) -> NDArray[np.uint16]:
    """A slanted wall in millimetres."""
    columns = np.linspace(0.9, 1.1, width) * metres * 1000
    return np.tile(np.rint(columns), (height, 1)).astype(np.uint16)


def depth_log(
    recorder: Callable[..., Any],
    name: str,
    picture: NDArray[Any],
    change: Callable[[Any], None] = lambda info: None,
    encoding: str = "16UC1",
) -> Any:
    """Ten pictures of a camera on a standing base; ``change`` edits its CameraInfo."""
    log = recorder("ros2", name)
    log.transform("base_link", "optical", OPTICAL, EPOCH)
    for k in range(10):
        stamp = EPOCH + k * S // 10
        log.pose(stamp, np.eye(4))
        log.camera_info(INFO, stamp, "optical", 64, 48, 50.0)
        change(log.events[-1][2])
        log.picture(DEPTH, stamp, "optical", picture, encoding)
    return log.write()


def read(path: Any, **logs: Any) -> tuple[list[PosedCloud], Session]:
    session = open_session([path], SessionOptions(stride=1, logs=Logs(**logs)))
    try:
        return list(session.clouds()), session
    finally:
        session.close()


def reported(session: Session) -> list[str]:
    return [problem.text for problem in session.problems if problem.is_reported]


def test_binning_and_region_of_a_depth_camera(recorder: Callable[..., Any]) -> None:
    full, session = read(depth_log(recorder, "full", wall()))
    assert len(full) == 10
    assert reported(session) == []
    points = full[0].points.reshape(48, 64, 3)

    def binned(info: Any) -> None:
        info.binning_x = info.binning_y = 2

    clouds, session = read(depth_log(recorder, "binned", wall()[::2, ::2], binned))
    np.testing.assert_allclose(clouds[0].points, points[::2, ::2].reshape(-1, 3), atol=1e-5)
    assert reported(session) == []

    def cut(info: Any) -> None:
        info.roi.x_offset, info.roi.y_offset = 20, 8
        info.roi.width, info.roi.height = 40, 32

    clouds, session = read(depth_log(recorder, "cut", wall()[8:40, 20:60], cut))
    np.testing.assert_allclose(clouds[0].points, points[8:40, 20:60].reshape(-1, 3), atol=1e-5)
    assert reported(session) == []

    def own(info: Any) -> None:
        binned(info)
        info.k = np.array([25.0, 0, 16, 0, 25, 12, 0, 0, 1])

    path = depth_log(recorder, "own", wall()[::2, ::2], own)
    clouds, session = read(path)
    np.testing.assert_allclose(clouds[0].points, points[::2, ::2].reshape(-1, 3), atol=1e-5)
    [text] = reported(session)
    assert f"CameraInfo {INFO} has binning 2 x 2" in text
    skipped = inspect_log(path)["skipped"]
    assert skipped == [text]


def test_a_lens_that_nobody_knows(recorder: Callable[..., Any]) -> None:
    def strange(info: Any) -> None:
        info.distortion_model = "thin_prism_fisheye"

    path = depth_log(recorder, "strange", wall(), strange)
    clouds, session = read(path)
    assert clouds == []
    named = f"CameraInfo {INFO} has the distortion model 'thin_prism_fisheye'"
    assert [text for text in reported(session) if named in text]
    problems = inspect_log(path)["problems"]
    assert isinstance(problems, list)
    assert [text for text in problems if named in text]


def test_units_of_depth(recorder: Callable[..., Any]) -> None:
    right, _ = read(depth_log(recorder, "right", wall()))
    floats = depth_log(recorder, "floats", wall().astype(np.float32), encoding="32FC1")
    clouds, session = read(floats)
    np.testing.assert_allclose(clouds[0].points, right[0].points, rtol=1e-5)
    [text] = reported(session)
    assert f"{DEPTH}: half of its depths are beyond" in text
    assert inspect_log(floats)["skipped"] == [text]
    clouds, session = read(floats, depth_unit=0.001)
    np.testing.assert_allclose(clouds[0].points, right[0].points, rtol=1e-5)
    assert reported(session) == []

    finer = depth_log(recorder, "finer", (wall() * 5).astype(np.uint16))
    clouds, _ = read(finer)
    np.testing.assert_allclose(clouds[0].points, 5 * right[0].points, rtol=1e-5)
    clouds, session = read(finer, depth_unit=0.0002)
    np.testing.assert_allclose(clouds[0].points, right[0].points, rtol=1e-5)
    assert reported(session) == []


@pytest.mark.parametrize("posed", [False, True])
def test_the_pose_of_a_foxglove_cloud_places_its_sensor(
    recorder: Callable[..., Any], posed: bool
) -> None:
    """Two metres up on the base: carving starts there."""
    log = recorder("protobuf", "cloud")
    spot = np.array([(5.0, 1.0, 0.0)], [(n, "<f4") for n in "xyz"])
    for k in range(10):
        stamp = EPOCH + k * S // 10
        log.transform("odom", "base_link", np.eye(4), stamp, "/tf")
        log.cloud("/points", stamp, "base_link", spot, late_ns=0)
        cloud = log.events[-1][2]
        assert isinstance(cloud, PointCloud)
        if posed:
            cloud.pose.position.z = 2.0
            cloud.pose.orientation.w = 1.0
    clouds, _ = read(log.write())
    height = 2.0 if posed else 0.0
    assert clouds[0].points.tolist() == [[5, 1, height]]
    assert clouds[0].origin.tolist() == [0, 0, height]


@pytest.mark.parametrize("first", [0.0, -1.0])
def test_an_imu_without_acceleration_does_not_say_where_up_is(
    recorder: Callable[..., Any], first: float
) -> None:
    log = recorder("ros2", "imu")
    spot = np.array([(5.0, 1.0, 0.0)], [(n, "<f4") for n in "xyz"])

    def three(x: float, z: float) -> Any:
        return log.make("geometry_msgs/msg/Vector3", x=x, y=0.0, z=z)

    for k in range(10):
        stamp = EPOCH + k * S // 10
        log.pose(stamp, np.eye(4))
        log.cloud("/points", stamp, "base_link", spot, late_ns=0)
        imu = log.make(
            "sensor_msgs/msg/Imu",
            header=log.header(stamp, "base_link"),
            orientation=log.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=np.r_[-1.0, np.zeros(8)],
            angular_velocity=three(0.0, 0.0),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=three(9.81, 0.0),
            linear_acceleration_covariance=np.r_[first, np.zeros(8)],
        )
        log.add("/imu", imu, stamp)
    _, session = read(log.write())
    up = session.imu_up_in_base()
    if first < 0:
        assert up is None
    else:
        assert up is not None
        assert up.tolist() == pytest.approx([1, 0, 0])
