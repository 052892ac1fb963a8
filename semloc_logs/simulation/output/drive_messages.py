"""The messages of a simulated drive: of ROS 1, of ROS 2, or of Foxglove in protobuf.

Every method gives (topic, type, message), or None where the schemas have no such message.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.numerics.transforms import translation_quaternion
from semloc_logs.simulation.drives.drive import TURN_NS, DriveFrame
from semloc_logs.simulation.drives.vehicle_sensors import ANTENNA

LABEL_SPACE = "cityscapes"
LATCHED = ("/tf_static", "/lidar/label_space", "/camera/label_space")
Made = tuple[str, str, Any]
# kind, offset
_FIELDS = (
    ("x", "<f4", 0),
    ("y", "<f4", 4),
    ("z", "<f4", 8),
    ("label", "<u2", 12),
    ("ring", "<u2", 14),
    ("t", "<u4", 16),
)
_POINT = np.dtype([(name, kind) for name, kind, _ in _FIELDS])
_ROS_KINDS = {"<f4": 7, "<u2": 4, "<u4": 6}  # sensor_msgs/PointField
_FOXGLOVE_KINDS = {"<f4": 7, "<u2": 3, "<u4": 5}  # foxglove.PackedElementField


class Messages(Protocol):
    """Makes messages of what the vehicle measures; frames ``odom``, ``base_link``, ``lidar`` and
    ``gnss``; times in nanoseconds.
    """

    def mounted(self, stamp_ns: int, child: str, base_T_child: F64) -> Made: ...

    def label_space(self, topic: str = ...) -> Made | None: ...

    def picture(
        self, topic: str, stamp_ns: int, frame_id: str, format_: str, data: bytes
    ) -> Made: ...

    def calibration(
        self,
        topic: str,
        stamp_ns: int,
        frame_id: str,
        size: tuple[int, int],
        matrix: F64,
        baseline: float,
    ) -> Made: ...

    def cloud(self, frame: DriveFrame) -> Made: ...

    def odometry(self, stamp_ns: int, odom_T_base: F64, speed: F64, rate: F64) -> Made: ...

    def imu(self, stamp_ns: int, force: F64, rate: F64) -> Made | None: ...

    def fix(self, stamp_ns: int, geodetic: F64, status: int, sigma: float) -> Made | None: ...


def _matrices(matrix: F64, baseline: float) -> tuple[F64, F64, F64]:
    """K, R and P of a camera without distortion that sits ``baseline`` metres to the right of its
    partner.
    """
    return matrix, np.eye(3), np.column_stack([matrix, [-matrix[0, 0] * baseline, 0.0, 0.0]])


def antenna() -> F64:
    """``base_T_gnss`` (4, 4)."""
    out = np.eye(4)
    out[:3, 3] = ANTENNA
    return out


def _records(frame: DriveFrame) -> NDArray[np.void]:
    sweep = frame.sweep
    points = np.zeros(len(sweep.points), _POINT)
    for k, axis in enumerate("xyz"):
        points[axis] = sweep.points[:, k]
    points["label"], points["ring"], points["t"] = (
        sweep.labels,
        sweep.ring,
        np.round(sweep.turn * TURN_NS),
    )
    return points


class RosMessages:
    """Messages of ROS 1 or ROS 2, of the types of a rosbags type store."""

    def __init__(self, store: Any, ros1: bool) -> None:
        self._types: dict[str, Any] = store.types
        self._ros1 = ros1

    def _make(self, type_: str, **fields: Any) -> Any:
        return self._types[type_](**fields)

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        """A std_msgs/Header."""
        stamp = self._make(
            "builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9
        )
        extra = {"seq": 0} if self._ros1 else {}
        return self._make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id, **extra)

    def _vector(self, v: Iterable[float], type_: str = "Vector3") -> Any:
        x, y, z = (float(c) for c in v)
        return self._make(f"geometry_msgs/msg/{type_}", x=x, y=y, z=z)

    def _quaternion(self, q: F64) -> Any:
        return self._make(
            "geometry_msgs/msg/Quaternion",
            x=float(q[0]),
            y=float(q[1]),
            z=float(q[2]),
            w=float(q[3]),
        )

    def mounted(self, stamp_ns: int, child: str, base_T_child: F64) -> Made:
        t, q = translation_quaternion(base_T_child)
        pose = self._make(
            "geometry_msgs/msg/Transform", translation=self._vector(t), rotation=self._quaternion(q)
        )
        header = self.header(stamp_ns, "base_link")
        edge = self._make(
            "geometry_msgs/msg/TransformStamped",
            header=header,
            child_frame_id=child,
            transform=pose,
        )
        return (
            "/tf_static",
            "tf2_msgs/msg/TFMessage",
            self._make("tf2_msgs/msg/TFMessage", transforms=[edge]),
        )

    def label_space(self, topic: str = "/lidar/label_space") -> Made:
        return topic, "std_msgs/msg/String", self._make("std_msgs/msg/String", data=LABEL_SPACE)

    def picture(self, topic: str, stamp_ns: int, frame_id: str, format_: str, data: bytes) -> Made:
        kind = "sensor_msgs/msg/CompressedImage"
        header = self.header(stamp_ns, frame_id)
        return (
            topic,
            kind,
            self._make(kind, header=header, format=format_, data=np.frombuffer(data, np.uint8)),
        )

    def calibration(
        self,
        topic: str,
        stamp_ns: int,
        frame_id: str,
        size: tuple[int, int],
        matrix: F64,
        baseline: float,
    ) -> Made:
        kind = "sensor_msgs/msg/CameraInfo"
        matrices = dict(
            zip(
                "KRPD",
                (*(m.ravel() for m in _matrices(matrix, baseline)), np.zeros(5)),
                strict=True,
            )
        )
        info = self._make(
            kind,
            header=self.header(stamp_ns, frame_id),
            width=size[0],
            height=size[1],
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=self._make(
                "sensor_msgs/msg/RegionOfInterest",
                x_offset=0,
                y_offset=0,
                height=0,
                width=0,
                do_rectify=False,
            ),
            **{name if self._ros1 else name.lower(): value for name, value in matrices.items()},
        )
        return topic, kind, info

    def cloud(self, frame: DriveFrame) -> Made:
        points = _records(frame)
        fields = [
            self._make(
                "sensor_msgs/msg/PointField",
                name=name,
                offset=offset,
                datatype=_ROS_KINDS[kind],
                count=1,
            )
            for name, kind, offset in _FIELDS
        ]
        cloud = self._make(
            "sensor_msgs/msg/PointCloud2",
            header=self.header(frame.stamp_ns, "lidar"),
            height=1,
            width=len(points),
            fields=fields,
            is_bigendian=False,
            point_step=_POINT.itemsize,
            row_step=_POINT.itemsize * len(points),
            data=points.view(np.uint8),
            is_dense=True,
        )
        return "/lidar/points", "sensor_msgs/msg/PointCloud2", cloud

    def odometry(self, stamp_ns: int, odom_T_base: F64, speed: F64, rate: F64) -> Made:
        t, q = translation_quaternion(odom_T_base)
        none = np.zeros(36)
        where = self._make(
            "geometry_msgs/msg/Pose",
            position=self._vector(t, "Point"),
            orientation=self._quaternion(q),
        )
        twist = self._make(
            "geometry_msgs/msg/Twist", linear=self._vector(speed), angular=self._vector(rate)
        )
        odometry = self._make(
            "nav_msgs/msg/Odometry",
            header=self.header(stamp_ns, "odom"),
            child_frame_id="base_link",
            pose=self._make("geometry_msgs/msg/PoseWithCovariance", pose=where, covariance=none),
            twist=self._make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=none),
        )
        return "/odometry", "nav_msgs/msg/Odometry", odometry

    def imu(self, stamp_ns: int, force: F64, rate: F64) -> Made:
        imu = self._make(
            "sensor_msgs/msg/Imu",
            header=self.header(stamp_ns, "base_link"),
            orientation=self._quaternion(np.array([0.0, 0.0, 0.0, 1.0])),
            orientation_covariance=np.array([-1.0] + [0.0] * 8),  # -1: without orientation
            angular_velocity=self._vector(rate),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=self._vector(force),
            linear_acceleration_covariance=np.zeros(9),
        )
        return "/imu", "sensor_msgs/msg/Imu", imu

    def fix(self, stamp_ns: int, geodetic: F64, status: int, sigma: float) -> Made:
        known = status >= 0
        fix = self._make(
            "sensor_msgs/msg/NavSatFix",
            header=self.header(stamp_ns, "gnss"),
            status=self._make("sensor_msgs/msg/NavSatStatus", status=status, service=1),
            latitude=float(geodetic[0]) if known else float("nan"),
            longitude=float(geodetic[1]) if known else float("nan"),
            altitude=float(geodetic[2]) if known else float("nan"),
            position_covariance=np.diag([0.5, 0.5, 2.25]).ravel() * sigma**2,
            position_covariance_type=2,
        )
        return "/gnss", "sensor_msgs/msg/NavSatFix", fix


class FoxgloveMessages:
    """Messages of Foxglove's schemas as protobuf: there is none for an IMU, nor for the name of a
    label space.
    """

    def mounted(self, stamp_ns: int, child: str, base_T_child: F64) -> Made:
        return self._edge("/tf_static", stamp_ns, "base_link", child, base_T_child)

    def label_space(self, topic: str = "/lidar/label_space") -> Made | None:
        return None

    def picture(self, topic: str, stamp_ns: int, frame_id: str, format_: str, data: bytes) -> Made:
        from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

        picture = CompressedImage(frame_id=frame_id, format=format_, data=data)
        picture.timestamp.FromNanoseconds(stamp_ns)
        return topic, "foxglove.CompressedImage", picture

    def calibration(
        self,
        topic: str,
        stamp_ns: int,
        frame_id: str,
        size: tuple[int, int],
        matrix: F64,
        baseline: float,
    ) -> Made:
        from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration

        K, R, P = (m.ravel().tolist() for m in _matrices(matrix, baseline))
        calibration = CameraCalibration(
            frame_id=frame_id, width=size[0], height=size[1], K=K, R=R, P=P
        )
        calibration.timestamp.FromNanoseconds(stamp_ns)
        return topic, "foxglove.CameraCalibration", calibration

    def cloud(self, frame: DriveFrame) -> Made:
        from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

        cloud = PointCloud(
            frame_id="lidar", point_stride=_POINT.itemsize, data=_records(frame).tobytes()
        )
        cloud.timestamp.FromNanoseconds(frame.stamp_ns)
        cloud.pose.orientation.w = 1.0
        for name, kind, offset in _FIELDS:
            cloud.fields.add(name=name, offset=offset, type=_FOXGLOVE_KINDS[kind])
        return "/lidar/points", "foxglove.PointCloud", cloud

    def odometry(self, stamp_ns: int, odom_T_base: F64, speed: F64, rate: F64) -> Made:
        return self._edge("/tf", stamp_ns, "odom", "base_link", odom_T_base)

    def imu(self, stamp_ns: int, force: F64, rate: F64) -> Made | None:
        return None

    def fix(self, stamp_ns: int, geodetic: F64, status: int, sigma: float) -> Made | None:
        from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix

        if status < 0:
            return None
        latitude, longitude, altitude = (float(v) for v in geodetic)
        covariance = (np.diag([0.5, 0.5, 2.25]).ravel() * sigma**2).tolist()
        fix = LocationFix(
            frame_id="gnss",
            latitude=latitude,
            longitude=longitude,
            altitude=altitude,
            position_covariance=covariance,
            position_covariance_type=LocationFix.DIAGONAL_KNOWN,
        )
        fix.timestamp.FromNanoseconds(stamp_ns)
        return "/gnss", "foxglove.LocationFix", fix

    def _edge(
        self, topic: str, stamp_ns: int, parent: str, child: str, parent_T_child: F64
    ) -> Made:
        from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform

        t, q = translation_quaternion(parent_T_child)
        edge = FrameTransform(parent_frame_id=parent, child_frame_id=child)
        edge.timestamp.FromNanoseconds(stamp_ns)
        edge.translation.x, edge.translation.y, edge.translation.z = (float(v) for v in t)
        edge.rotation.x, edge.rotation.y, edge.rotation.z, edge.rotation.w = (float(v) for v in q)
        return topic, "foxglove.FrameTransform", edge
