"""Clouds, images, calibrations, accelerations and fixes of ROS."""

from __future__ import annotations

import math
import struct
from typing import Any

import cv2
import numpy as np
import pytest

from semloc_logs.frames import (
    Camera,
    DepthFrame,
    ImageFrame,
    ImuSample,
    LidarFrame,
    NavSatSample,
    Region,
)
from semloc_logs.logs.problems import sentences
from tests.logs.messages.encoded import Ros


def cloud(ros: Ros, width: int, data: bytes) -> Any:
    fields = [
        ros.make("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=kind, count=1)
        for name, offset, kind in (("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("label", 12, 6))
    ]
    return ros.make(
        "sensor_msgs/msg/PointCloud2",
        header=ros.header(),
        height=1,
        width=width,
        fields=fields,
        is_bigendian=False,
        point_step=16,
        row_step=min(16 * width, 2**32 - 1),
        data=np.frombuffer(data, np.uint8),
        is_dense=True,
    )


def test_point_cloud(ros: Ros) -> None:
    [frame] = ros.frames(cloud(ros, 2, struct.pack("<fffIfffI", 1, 2, 3, 40, 0, 0, 0, 50)))
    assert isinstance(frame, LidarFrame)
    assert frame.points.tolist() == [[1, 2, 3]]
    assert frame.label is not None
    assert frame.label.tolist() == [40]


def test_a_cloud_that_claims_more_than_it_has_is_named(ros: Ros) -> None:
    assert ros.frames(cloud(ros, 2**31, b"\0" * 16)) == []
    assert "2147483648 x 1 points" in sentences(ros.problems)[0]


def image(ros: Ros, encoding: str, data: bytes, width: int, height: int, step: int) -> Any:
    return ros.make(
        "sensor_msgs/msg/Image",
        header=ros.header(),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=step,
        data=np.frombuffer(data, np.uint8),
    )


def test_images_and_depth(ros: Ros) -> None:
    [frame] = ros.frames(image(ros, "mono8", bytes([1, 2, 3, 4]), 2, 2, 2))
    assert isinstance(frame, ImageFrame)
    assert frame.image.tolist() == [[1, 2], [3, 4]]
    assert frame.encoding == "mono8"
    [frame] = ros.frames(image(ros, "16UC1", struct.pack("<HH", 1500, 65535), 2, 1, 4))
    assert isinstance(frame, DepthFrame)
    np.testing.assert_allclose(frame.depth, [[1.5, 0]])
    [frame] = ros.frames(image(ros, "16UC1", struct.pack("<HH", 7, 8), 2, 1, 4), "/segmentation")
    assert isinstance(frame, ImageFrame)
    assert frame.image.tolist() == [[7, 8]]


def test_compressed_images(ros: Ros) -> None:
    def compressed(format_: str, data: bytes) -> Any:
        return ros.make(
            "sensor_msgs/msg/CompressedImage",
            header=ros.header(),
            format=format_,
            data=np.frombuffer(data, np.uint8),
        )

    pixels = np.array([[0, 1500, 65535]], np.uint16)
    png = bytes(cv2.imencode(".png", pixels)[1])
    [frame] = ros.frames(
        compressed("16UC1; compressedDepth png", b"\0" * 12 + png), "/d/compressedDepth"
    )
    assert isinstance(frame, DepthFrame)
    np.testing.assert_allclose(frame.depth, [[0, 1.5, 0]])
    [frame] = ros.frames(compressed("16UC1; png compressed", png))
    assert isinstance(frame, DepthFrame)
    [frame] = ros.frames(compressed("png", png), "/labels")
    assert isinstance(frame, ImageFrame)
    assert frame.image.tolist() == pixels.tolist()


def camera_info(ros: Ros, focal: float) -> Any:
    values = {
        "k": [focal, 0, 2, 0, focal, 3, 0, 0, 1],
        "d": [0.1, 0.2],
        "r": [0.0] * 9,
        "p": [0.0] * 12,
    }
    if ros.encoding == "ros1":
        values = {k.upper(): v for k, v in values.items()}
    roi = ros.make(
        "sensor_msgs/msg/RegionOfInterest",
        x_offset=0,
        y_offset=0,
        height=0,
        width=0,
        do_rectify=False,
    )
    arrays = {k: np.array(v, float) for k, v in values.items()}
    head = {"header": ros.header(), "height": 6, "width": 4, "distortion_model": "plumb_bob"}
    return ros.make(
        "sensor_msgs/msg/CameraInfo", **head, **arrays, binning_x=0, binning_y=0, roi=roi
    )


def test_camera_info(ros: Ros) -> None:
    [frame] = ros.frames(camera_info(ros, 100.0))
    assert isinstance(frame, Camera)
    assert (frame.width, frame.height, frame.model) == (4, 6, "plumb_bob")
    assert frame.K.tolist() == [[100, 0, 2], [0, 100, 3], [0, 0, 1]]
    assert frame.D.tolist() == [0.1, 0.2]
    assert frame.R.tolist() == np.eye(3).tolist()
    assert frame.P.tolist() == [[100, 0, 2, 0], [0, 100, 3, 0], [0, 0, 1, 0]]
    assert (frame.binning, frame.roi) == ((1, 1), Region(0, 0, 0, 0))
    assert ros.frames(camera_info(ros, 0.0)) == []
    assert "not calibrated" in sentences(ros.problems)[0]
    binned = camera_info(ros, 100.0)
    binned.binning_x, binned.binning_y = 2, 3
    binned.roi.x_offset, binned.roi.y_offset, binned.roi.width, binned.roi.height = 4, 5, 6, 7
    [frame] = ros.frames(binned)
    assert isinstance(frame, Camera)
    assert (frame.binning, frame.roi) == ((2, 3), Region(4, 5, 6, 7))


def test_imu_and_nav_sat(ros: Ros) -> None:
    rate, force = (ros.make("geometry_msgs/msg/Vector3", x=x, y=2.0, z=3.0) for x in (0.5, 9.0))
    covariances = {
        f"{n}_covariance": np.zeros(9)
        for n in ("orientation", "angular_velocity", "linear_acceleration")
    }
    orientation = ros.pose((0, 0, 0), (0, 0, 0, 0)).orientation
    parts = {"orientation": orientation, "angular_velocity": rate, "linear_acceleration": force}
    [frame] = ros.frames(
        ros.make("sensor_msgs/msg/Imu", header=ros.header(), **parts, **covariances)
    )
    assert isinstance(frame, ImuSample)
    assert frame.acceleration.tolist() == [9, 2, 3]
    assert frame.angular_velocity.tolist() == [0.5, 2, 3]
    assert frame.orientation is None  # a quaternion of zeros is none
    parts["orientation"] = ros.pose((0, 0, 0), (0, 0, 0.6, 0.8)).orientation
    [frame] = ros.frames(
        ros.make("sensor_msgs/msg/Imu", header=ros.header(), **parts, **covariances)
    )
    assert isinstance(frame, ImuSample)
    assert frame.orientation is not None
    assert frame.orientation.tolist() == [0, 0, 0.6, 0.8]
    # the IMU has no estimate of it
    covariances["orientation_covariance"] = np.r_[-1.0, np.zeros(8)]
    [frame] = ros.frames(
        ros.make("sensor_msgs/msg/Imu", header=ros.header(), **parts, **covariances)
    )
    assert isinstance(frame, ImuSample)
    assert frame.orientation is None

    # the same for the others, whose values then mean nothing
    force.x = math.nan
    covariances["linear_acceleration_covariance"] = np.r_[-1.0, np.zeros(8)]
    [frame] = ros.frames(
        ros.make("sensor_msgs/msg/Imu", header=ros.header(), **parts, **covariances)
    )
    assert isinstance(frame, ImuSample)
    assert np.isnan(frame.acceleration).all()
    assert frame.angular_velocity.tolist() == [0.5, 2, 3]
    covariances["linear_acceleration_covariance"] = np.zeros(9)
    assert (
        ros.frames(ros.make("sensor_msgs/msg/Imu", header=ros.header(), **parts, **covariances))
        == []
    )
    assert "not finite" in sentences(ros.problems)[0]
    ros.problems.forget_skipped(None)

    def fix(status: int, latitude: float, kind: int = 0, variance: float = 0.0) -> list[Any]:
        s = ros.make("sensor_msgs/msg/NavSatStatus", status=status, service=1)
        rest = {
            "position_covariance": np.diag([variance] * 3).ravel(),
            "position_covariance_type": kind,
        }
        position = {"latitude": latitude, "longitude": 8.5, "altitude": 400.0}
        return ros.frames(
            ros.make(
                "sensor_msgs/msg/NavSatFix", header=ros.header(), status=s, **position, **rest
            ),
            "/fix",
        )

    [frame] = fix(0, 47.25)
    assert isinstance(frame, NavSatSample)
    assert (frame.latitude_deg, frame.longitude_deg, frame.altitude) == (47.25, 8.5, 400.0)
    assert frame.covariance is None
    for variance, kind, known in (
        (4.0, 2, True),
        (4.0, 0, False),
        (-4.0, 2, False),
        (math.inf, 2, False),
    ):
        [frame] = fix(0, 47.25, kind, variance)
        assert isinstance(frame, NavSatSample)
        assert (None if frame.covariance is None else frame.covariance.tolist()) == (
            np.diag([4.0] * 3).tolist() if known else None
        )
    [frame] = fix(-1, math.nan)
    assert not frame.has_fix
    assert sentences(ros.problems) == []  # a receiver without a fix is not a problem of the log
    # a driver that never sets the status has a fix where it has a position
    [frame] = fix(-2, 47.25)
    assert frame.has_fix
    assert fix(0, math.nan) == []
    assert len(sentences(ros.problems)) == 1


@pytest.mark.parametrize("altitude", [math.nan, math.inf, -1e7])
def test_a_fix_without_an_altitude_is_a_position(ros: Ros, altitude: float) -> None:
    covariance = np.diag([4.0, 9.0, math.nan]).ravel()
    covariance[2] = covariance[6] = math.nan
    [frame] = ros.frames(
        ros.make(
            "sensor_msgs/msg/NavSatFix",
            header=ros.header(),
            status=ros.make("sensor_msgs/msg/NavSatStatus", status=0, service=1),
            latitude=47.25,
            longitude=8.5,
            altitude=altitude,
            position_covariance=covariance,
            position_covariance_type=2,
        )
    )
    assert isinstance(frame, NavSatSample)
    assert math.isnan(frame.altitude)
    assert frame.covariance is not None
    assert np.diag(frame.covariance)[:2].tolist() == [4, 9]
    assert sentences(ros.problems) == []
