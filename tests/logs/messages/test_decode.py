"""Messages of ROS 1, ROS 2, protobuf and JSON to frames."""

from __future__ import annotations

import base64
import json
import math
import struct
from typing import Any

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from semloc_logs.frames import (
    Camera,
    DepthFrame,
    ImageFrame,
    ImuSample,
    LabelNames,
    LidarFrame,
    NavSatSample,
    PoseSample,
    Region,
    TransformSample,
)
from semloc_logs.logs.log import Definition, Message
from semloc_logs.logs.messages.decode import Decoder
from semloc_logs.logs.problems import Problems, sentences

STORES = {"cdr": get_typestore(Stores.ROS2_HUMBLE), "ros1": get_typestore(Stores.ROS1_NOETIC)}
NOTHING = Definition("", "", b"")
LOG_TIME = 9_000_000_000


class Ros:
    """Builds messages of one generation and decodes their bytes."""

    def __init__(self, encoding: str) -> None:
        self.encoding = encoding
        self.store = STORES[encoding]
        self.problems = Problems()
        self.decoder = Decoder(self.problems)

    def make(self, type_: str, /, **fields: Any) -> Any:
        return self.store.types[type_](**fields)

    def header(self, sec: int = 5, nanosec: int = 7, frame_id: str = "lidar") -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        extra = {"seq": 3} if self.encoding == "ros1" else {}
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id, **extra)

    def pose(self, xyz: tuple[float, float, float], q: tuple[float, float, float, float]) -> Any:
        return self.make(
            "geometry_msgs/msg/Pose",
            position=self.make("geometry_msgs/msg/Point", x=xyz[0], y=xyz[1], z=xyz[2]),
            orientation=self.make("geometry_msgs/msg/Quaternion", x=q[0], y=q[1], z=q[2], w=q[3]),
        )

    def frames(
        self, message: Any, topic: str = "/t", definition: Definition = NOTHING
    ) -> list[Any]:
        name = message.__msgtype__
        serialize = (
            self.store.serialize_cdr if self.encoding == "cdr" else self.store.serialize_ros1
        )
        return self.decoder.frames(
            Message(topic, name, self.encoding, LOG_TIME, serialize(message, name), definition)
        )


@pytest.fixture(params=["cdr", "ros1"])
def ros(request: pytest.FixtureRequest) -> Ros:
    return Ros(request.param)


QUARTER_TURN = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))
TURNED = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]


def odometry(ros: Ros, q: tuple[float, float, float, float]) -> Any:
    zero = ros.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    pose = ros.make(
        "geometry_msgs/msg/PoseWithCovariance", pose=ros.pose((1, 2, 3), q), covariance=np.zeros(36)
    )
    twist = ros.make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
    twist = ros.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36))
    return ros.make(
        "nav_msgs/msg/Odometry",
        header=ros.header(frame_id="odom"),
        child_frame_id="base",
        pose=pose,
        twist=twist,
    )


def test_odometry(ros: Ros) -> None:
    [frame] = ros.frames(odometry(ros, QUARTER_TURN), "/odom")
    assert isinstance(frame, PoseSample)
    assert (frame.header.topic, frame.header.stamp_ns, frame.header.log_time_ns) == (
        "/odom",
        5_000_000_007,
        LOG_TIME,
    )
    assert (frame.header.frame_id, frame.child_frame_id) == ("odom", "base")
    np.testing.assert_allclose(frame.frame_T_child, TURNED, atol=1e-12)


@pytest.mark.parametrize(
    "q", [(0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, math.nan), (math.inf, 0.0, 0.0, 1.0)]
)
def test_impossible_rotations_are_skipped_and_counted(
    ros: Ros, q: tuple[float, float, float, float]
) -> None:
    assert ros.frames(odometry(ros, q)) == []
    assert ros.frames(odometry(ros, q)) == []
    [sentence] = sentences(ros.problems)
    assert sentence.startswith(
        "/t: 2 messages skipped; the first because nav_msgs/msg/Odometry at log "
        "time 9000000000 ns: "
    )


def test_pose_stamped_and_with_covariance(ros: Ros) -> None:
    pose = ros.pose((1, 2, 3), QUARTER_TURN)
    [frame] = ros.frames(ros.make("geometry_msgs/msg/PoseStamped", header=ros.header(), pose=pose))
    assert isinstance(frame, PoseSample)
    assert frame.child_frame_id == ""
    np.testing.assert_allclose(frame.frame_T_child, TURNED, atol=1e-12)
    pose = ros.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36))
    [frame] = ros.frames(
        ros.make("geometry_msgs/msg/PoseWithCovarianceStamped", header=ros.header(), pose=pose)
    )
    np.testing.assert_allclose(frame.frame_T_child, TURNED, atol=1e-12)


@pytest.mark.parametrize(
    ("topic", "static"), [("/tf", False), ("/tf_static", True), ("/robot/tf_static", True)]
)
def test_tf_yields_every_transform(topic: str, static: bool) -> None:
    ros = Ros("cdr")
    pose = ros.pose((1, 2, 3), QUARTER_TURN)
    translation = ros.make("geometry_msgs/msg/Vector3", x=1.0, y=2.0, z=3.0)
    transform = ros.make(
        "geometry_msgs/msg/Transform", translation=translation, rotation=pose.orientation
    )
    edges = [
        ros.make(
            "geometry_msgs/msg/TransformStamped",
            header=ros.header(frame_id="a"),
            child_frame_id=c,
            transform=transform,
        )
        for c in ("b", "c")
    ]
    frames = ros.frames(ros.make("tf2_msgs/msg/TFMessage", transforms=edges), topic)
    assert [(f.header.frame_id, f.child_frame_id, f.static) for f in frames] == [
        ("a", "b", static),
        ("a", "c", static),
    ]
    assert all(isinstance(f, TransformSample) for f in frames)
    np.testing.assert_allclose(frames[1].frame_T_child, TURNED, atol=1e-12)


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


IMU_LIKE = (
    b"geometry_msgs/Vector3 linear_acceleration\n"
    b"geometry_msgs/Vector3 angular_velocity\n"
    b"std_msgs/Header header\n"
)


def test_the_definition_in_the_log_beats_the_standard_one() -> None:
    ros = Ros("cdr")
    data = struct.pack("<4B6d2iI5s", 0, 1, 0, 0, 1, 2, 3, 4, 5, 6, 8, 9, 5, b"base\0")
    definition = Definition("sensor_msgs/msg/Imu", "ros2msg", IMU_LIKE)
    [frame] = ros.decoder.frames(Message("/i", "sensor_msgs/msg/Imu", "cdr", 1, data, definition))
    assert isinstance(frame, ImuSample)
    assert frame.acceleration.tolist() == [1, 2, 3]
    assert frame.angular_velocity.tolist() == [4, 5, 6]
    assert (frame.header.stamp_ns, frame.header.frame_id) == (8_000_000_009, "base")


def test_idl_definitions() -> None:
    idl = """================================================================================
IDL: geometry_msgs/msg/PoseStamped
#include "geometry_msgs/msg/Pose.idl"
module geometry_msgs { module msg { struct PoseStamped {
  std_msgs::msg::Header header;
  geometry_msgs::msg::Pose pose;
}; }; };
"""
    ros = Ros("cdr")
    message = ros.make(
        "geometry_msgs/msg/PoseStamped", header=ros.header(), pose=ros.pose((1, 2, 3), QUARTER_TURN)
    )
    [frame] = ros.frames(
        message, "/p", Definition("geometry_msgs/msg/PoseStamped", "ros2idl", idl.encode())
    )
    np.testing.assert_allclose(frame.frame_T_child, TURNED, atol=1e-12)
    assert sentences(ros.problems) == []


@pytest.mark.parametrize(
    ("encoding", "text"),
    [
        ("ros2msg", b"this is not a definition ["),
        ("ros2msg", b"foo_msgs/Missing header"),
        ("ros2msg", b"std_msgs/Header[1000000000] header"),
        ("ros2msg", b"string[1000000000] header"),
        ("ros2msg", b"sensor_msgs/Imu header"),
        ("ros2idl", b"module {"),
        ("ros2idl", b"const long X = 1 << 100000000000;"),
        ("omg", b"struct"),
        ("ros2msg", b"\xff\xfe\0"),
    ],
)
def test_definitions_that_cannot_be_used_are_named(encoding: str, text: bytes) -> None:
    ros = Ros("cdr")
    definition = Definition("sensor_msgs/msg/Imu", encoding, text)
    for _ in range(2):
        assert (
            ros.decoder.frames(
                Message(
                    "/i", "sensor_msgs/msg/Imu", "cdr", 1, b"\0\1\0\0" + b"\0" * 400, definition
                )
            )
            == []
        )
    [sentence] = sentences(ros.problems)
    assert sentence.startswith("/i: 2 messages skipped")


def test_cut_off_messages_are_named(ros: Ros) -> None:
    message = odometry(ros, QUARTER_TURN)
    serialize = ros.store.serialize_cdr if ros.encoding == "cdr" else ros.store.serialize_ros1
    data = bytes(serialize(message, "nav_msgs/msg/Odometry"))
    for size in range(len(data) - 8):
        assert (
            ros.decoder.frames(
                Message("/o", "nav_msgs/msg/Odometry", ros.encoding, 1, data[:size], NOTHING)
            )
            == []
        )
    assert sentences(ros.problems)[0].startswith(f"/o: {len(data) - 8} messages skipped")


# -- Foxglove


def descriptors(message: Any) -> Definition:
    file_of: dict[str, Any] = {}

    def add(file: Any) -> None:
        if file.name not in file_of:
            for dependency in file.dependencies:
                add(dependency)
            file_of[file.name] = file

    add(message.DESCRIPTOR.file)
    files = FileDescriptorSet()
    for file in file_of.values():
        file.CopyToProto(files.file.add())
    return Definition(message.DESCRIPTOR.full_name, "protobuf", files.SerializeToString())


def protobuf_frames(message: Any, topic: str = "/t") -> tuple[list[Any], Problems]:
    problems = Problems()
    definition = descriptors(message)
    m = Message(
        topic, definition.name, "protobuf", LOG_TIME, message.SerializeToString(), definition
    )
    return list(Decoder(problems).frames(m)), problems


def json_frames(name: str, value: Any, topic: str = "/t") -> tuple[list[Any], Problems]:
    problems = Problems()
    data = value if isinstance(value, bytes) else json.dumps(value).encode()
    return list(
        Decoder(problems).frames(
            Message(topic, name, "json", LOG_TIME, data, Definition(name, "jsonschema", b"{}"))
        )
    ), problems


def test_protobuf_point_cloud_with_its_pose() -> None:
    m = PointCloud(frame_id="lidar", point_stride=14, data=struct.pack("<fffH", 1, 0, 0, 7))
    m.timestamp.seconds, m.timestamp.nanos = 5, 7
    m.pose.position.x, m.pose.position.y, m.pose.position.z = 1, 2, 3
    m.pose.orientation.z, m.pose.orientation.w = QUARTER_TURN[2:]
    for name, offset, kind in (("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("label", 12, 3)):
        m.fields.add(name=name, offset=offset, type=kind)
    [frame], _ = protobuf_frames(m)
    assert isinstance(frame, LidarFrame)
    np.testing.assert_allclose(frame.points, [[1, 3, 3]], atol=1e-6)
    assert frame.label is not None
    assert frame.label.tolist() == [7]
    assert (frame.header.stamp_ns, frame.header.frame_id) == (5_000_000_007, "lidar")
    assert frame.origin is not None
    assert frame.origin.tolist() == [1, 2, 3]
    # a position without a rotation
    m.pose.ClearField("orientation")
    [frame], _ = protobuf_frames(m)
    assert frame.points.tolist() == [[2, 2, 3]]
    assert frame.origin.tolist() == [1, 2, 3]
    m.pose.position.x = math.nan
    frames, problems = protobuf_frames(m)
    assert frames == []
    assert "not finite" in sentences(problems)[0]
    m.ClearField("pose")
    [frame], _ = protobuf_frames(m)
    assert frame.points.tolist() == [[1, 0, 0]]
    assert frame.origin is None
    m.fields[1].type = 0
    frames, problems = protobuf_frames(m)
    assert frames == []
    assert "its field y has the unknown type 0" in sentences(problems)[0]


def test_protobuf_transforms_and_images() -> None:
    m = FrameTransforms()
    for child in ("b", "c"):
        t = m.transforms.add(parent_frame_id="a", child_frame_id=child)
        t.translation.x, t.translation.y, t.translation.z = 1, 2, 3
        t.rotation.z, t.rotation.w = QUARTER_TURN[2:]
    frames, _ = protobuf_frames(m, "/tf")
    assert [(f.header.frame_id, f.child_frame_id, f.static) for f in frames] == [
        ("a", "b", False),
        ("a", "c", False),
    ]
    np.testing.assert_allclose(frames[0].frame_T_child, TURNED, atol=1e-12)
    [frame], _ = protobuf_frames(
        RawImage(width=2, height=1, step=4, encoding="16UC1", data=struct.pack("<HH", 1000, 0))
    )
    assert isinstance(frame, DepthFrame)
    np.testing.assert_allclose(frame.depth, [[1, 0]])


def test_json_messages() -> None:
    time = {"sec": 5, "nsec": 7}
    pose = {
        "position": {"x": 1, "y": 2, "z": 3},
        "orientation": dict(zip("xyzw", QUARTER_TURN, strict=True)),
    }
    [frame], _ = json_frames(
        "foxglove.PoseInFrame", {"timestamp": time, "frame_id": "odom", "pose": pose}
    )
    assert isinstance(frame, PoseSample)
    assert (frame.header.stamp_ns, frame.header.frame_id) == (5_000_000_007, "odom")
    np.testing.assert_allclose(frame.frame_T_child, TURNED, atol=1e-12)
    odometry = {"timestamp": time, "frame_id": "odom", "body_frame_id": "base", "pose": pose}
    [frame], _ = json_frames("foxglove.Odometry", odometry)
    assert isinstance(frame, PoseSample)
    assert (frame.header.frame_id, frame.child_frame_id) == ("odom", "base")
    np.testing.assert_allclose(frame.frame_T_child, TURNED, atol=1e-12)
    fields = [{"name": n, "offset": 4 * k, "type": 7} for k, n in enumerate("xyz")]
    data = base64.b64encode(struct.pack("<fff", 1, 2, 3)).decode()
    cloud = {"timestamp": time, "frame_id": "l", "point_stride": 12, "fields": fields, "data": data}
    [frame], _ = json_frames("foxglove.PointCloud", cloud)
    assert frame.points.tolist() == [[1, 2, 3]]
    fix = {"timestamp": time, "frame_id": "g", "latitude": 47.25, "longitude": 8.5, "altitude": 400}
    [frame], _ = json_frames("foxglove.LocationFix", fix)
    assert isinstance(frame, NavSatSample)
    assert frame.latitude_deg == 47.25
    del fix["altitude"]
    [frame], _ = json_frames("foxglove.LocationFix", fix)
    assert isinstance(frame, NavSatSample)
    assert math.isnan(frame.altitude)
    del fix["latitude"]
    frames, problems = json_frames("foxglove.LocationFix", fix)
    assert frames == []
    assert "latitude or longitude is not on Earth" in sentences(problems)[0]
    calibration = {
        "timestamp": time,
        "width": 4,
        "height": 6,
        "distortion_model": "",
        "K": [9, 0, 2, 0, 9, 3, 0, 0, 1],
        "D": [],
    }
    [frame], _ = json_frames("foxglove.CameraCalibration", calibration)
    assert isinstance(frame, Camera)
    assert frame.K[0, 0] == 9


@pytest.mark.parametrize(
    "value",
    [
        b"",
        b"{",
        b"[]",
        b"[" * 100_000,
        {},
        {"timestamp": 5},
        {"timestamp": {"sec": "x", "nsec": []}},
        {"pose": [1], "frame_id": 3},
    ],
)
def test_json_without_sense_is_named(value: Any) -> None:
    frames, problems = json_frames("foxglove.PoseInFrame", value)
    assert frames == []
    assert len(sentences(problems)) == 1


def test_types_of_no_use_are_no_problem() -> None:
    problems = Problems()
    assert (
        Decoder(problems).frames(Message("/c", "std_msgs/msg/String", "cdr", 1, b"", NOTHING)) == []
    )
    assert sentences(problems) == []


def test_impossible_times_are_named() -> None:
    frames, problems = json_frames(
        "foxglove.LocationFix",
        {"timestamp": {"sec": 1 << 60, "nsec": 0}, "latitude": 1, "longitude": 2},
    )
    assert frames == []
    assert "is impossible" in sentences(problems)[0]


def test_the_meaning_of_labels() -> None:
    """A LabelInfo without a definition in the log, and the name of a label space."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(
        get_types_from_msg("uint16 class_id\nstring class_name", "vision_msgs/msg/VisionClass")
    )
    store.register(
        get_types_from_msg(
            "std_msgs/Header header\nVisionClass[] class_map\nfloat32 threshold",
            "vision_msgs/msg/LabelInfo",
        )
    )
    types: Any = store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=3, nanosec=4)
    classes = [
        types["vision_msgs/msg/VisionClass"](class_id=i, class_name=n)
        for i, n in ((0, "road"), (7, "tree"))
    ]
    message = types["vision_msgs/msg/LabelInfo"](
        header=types["std_msgs/msg/Header"](stamp=stamp, frame_id="cam"),
        class_map=classes,
        threshold=0.5,
    )
    problems = Problems()
    data = bytes(store.serialize_cdr(message, "vision_msgs/msg/LabelInfo"))
    (frame,) = Decoder(problems).frames(
        Message("/label_info", "vision_msgs/msg/LabelInfo", "cdr", 1, data, NOTHING)
    )
    assert isinstance(frame, LabelNames)
    assert frame.names == {0: "road", 7: "tree"}
    assert frame.header.stamp_ns == 3_000_000_004
    text = bytes(
        store.serialize_cdr(
            types["std_msgs/msg/String"](data="semantickitti"), "std_msgs/msg/String"
        )
    )
    (frame,) = Decoder(problems).frames(
        Message("/lidar/label_space", "std_msgs/msg/String", "cdr", 9, text, NOTHING)
    )
    assert isinstance(frame, LabelNames)
    assert frame.space == "semantickitti"
    assert (
        Decoder(problems).frames(
            Message("/chatter", "std_msgs/msg/String", "cdr", 9, text, NOTHING)
        )
        == []
    )
    assert sentences(problems) == []
