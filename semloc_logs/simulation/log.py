"""Simulated drives as logs: ROS 2 MCAP or ROS 1 bag, with the true trajectory beside them.

Topics: ``/lidar/points`` (x y z float32, ``label`` uint16 Cityscapes train ids, ``ring`` uint16, ``t`` uint32 nanoseconds since the stamp),
``/odometry`` (frame ``odom``, child ``base_link``, drifting), ``/imu`` (in ``base_link``), ``/tf_static`` (``base_link`` to ``lidar``) and
``/lidar/label_space``, one std_msgs/String that names the label space of the points.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapFile
from rosbags.rosbag1 import Writer as BagFile
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from semloc_logs.errors import LogError
from semloc_logs.geometry import translation_quaternion
from semloc_logs.simulation.drive import TURN_NS, DriveFrame
from semloc_logs.simulation.trajectory import Trajectory
from semloc_logs.simulation.world import F64

LABEL_SPACE = "cityscapes"
FORMATS = {"mcap": ".mcap", "bag": ".bag"}
_LATENCY_NS = 4_000_000  # from the end of a measurement to the log
_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("label", "<u2"), ("ring", "<u2"), ("t", "<u4")])
_DATATYPES = {"<f4": 7, "<u2": 4, "<u4": 6}
_LATCHED = "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n"
Event = tuple[int, str, str, Any]  # log time, topic, type, message


class _Sink(Protocol):
    store: Any
    ros1: bool

    def write(self, topic: str, type_: str, log_time_ns: int, message: Any) -> None: ...


class _Mcap:
    ros1 = False

    def __init__(self, file: Any) -> None:
        self.store = get_typestore(Stores.ROS2_HUMBLE)
        self._file = McapFile(file, compression=CompressionType.ZSTD)
        self._file.start(profile="ros2", library="semloc_logs")
        self._channels: dict[str, int] = {}
        self._count: dict[str, int] = {}

    def write(self, topic: str, type_: str, log_time_ns: int, message: Any) -> None:
        if topic not in self._channels:
            schema = self._file.register_schema(type_, "ros2msg", self.store.generate_msgdef(type_, ros_version=2)[0].encode())
            latched = {"offered_qos_profiles": _LATCHED} if topic in ("/tf_static", "/lidar/label_space") else {}
            self._channels[topic] = self._file.register_channel(topic, "cdr", schema, metadata=latched)
        data = self.store.serialize_cdr(message, type_)
        count = self._count[topic] = self._count.get(topic, -1) + 1
        self._file.add_message(self._channels[topic], log_time_ns, bytes(data), log_time_ns, count)

    def finish(self) -> None:
        self._file.finish()  # type: ignore[no-untyped-call]


class _Bag:
    ros1 = True

    def __init__(self, file: BagFile) -> None:
        self.store = get_typestore(Stores.ROS1_NOETIC)
        self.store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
        self._file = file
        self._connections: dict[str, Any] = {}

    def write(self, topic: str, type_: str, log_time_ns: int, message: Any) -> None:
        if topic not in self._connections:
            latching = 1 if topic in ("/tf_static", "/lidar/label_space") else None
            self._connections[topic] = self._file.add_connection(topic, type_, typestore=self.store, latching=latching)
        self._file.write(self._connections[topic], log_time_ns, self.store.serialize_ros1(message, type_))


@contextmanager
def _sink(path: Path) -> Iterator[_Sink]:
    """A log that appears under its name when everything is in it."""
    part = path.with_name(path.name + ".part")
    part.unlink(missing_ok=True)
    try:
        if path.suffix == ".bag":
            file = BagFile(part)
            file.set_compression(BagFile.CompressionFormat.LZ4)
            with file:
                yield _Bag(file)
        else:
            with part.open("wb") as stream:
                mcap = _Mcap(stream)
                yield mcap
                mcap.finish()
        part.replace(path)
    except OSError as error:
        raise LogError(f"{path} cannot be written ({error.strerror or error}): choose another folder or make room") from error
    finally:
        part.unlink(missing_ok=True)


def write_session(path: Path, trajectory: Trajectory, frames: Iterable[DriveFrame]) -> int:
    """Write a drive as the log ``path`` (.mcap or .bag), sweep by sweep; the number of sweeps. LogError when that is not possible."""
    if path.suffix not in FORMATS.values():
        raise LogError(f"{path} is neither .mcap nor .bag: give the simulated log one of these endings")
    sweeps = 0
    with _sink(path) as sink:
        messages = _Messages(sink)
        for log_time, topic, type_, message in heapq.merge(
            messages.vehicle(trajectory), messages.lidar(frames, int(trajectory.stamps_ns[0])), key=lambda event: event[0]
        ):
            sink.write(topic, type_, log_time, message)
            sweeps += topic == "/lidar/points"
    return sweeps


def write_truth(path: Path, trajectory: Trajectory) -> None:
    """``world_T_base`` as a TUM file: seconds with 9 decimals, translation in metres, quaternion xyzw."""
    translation, quaternion = translation_quaternion(trajectory.world_T_base)
    rows = [
        f"{stamp // 10**9}.{stamp % 10**9:09d} " + " ".join(f"{v:.9f}" for v in (*t, *q))
        for stamp, t, q in zip(trajectory.stamps_ns.tolist(), translation, quaternion, strict=True)
    ]
    path.write_text("\n".join(rows) + "\n", encoding="ascii")


class _Messages:
    """Turns a drive into the messages of a log, of ROS 1 or of ROS 2."""

    def __init__(self, sink: _Sink) -> None:
        self._types: dict[str, Any] = sink.store.types
        self._ros1 = sink.ros1

    def _make(self, type_: str, **fields: Any) -> Any:
        return self._types[type_](**fields)

    def _header(self, stamp_ns: int, frame_id: str) -> Any:
        stamp = self._make("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        extra = {"seq": 0} if self._ros1 else {}
        return self._make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id, **extra)

    def _vector(self, v: Iterable[float], type_: str = "Vector3") -> Any:
        x, y, z = (float(c) for c in v)
        return self._make(f"geometry_msgs/msg/{type_}", x=x, y=y, z=z)

    def _quaternion(self, q: F64) -> Any:
        return self._make("geometry_msgs/msg/Quaternion", x=float(q[0]), y=float(q[1]), z=float(q[2]), w=float(q[3]))

    def lidar(self, frames: Iterable[DriveFrame], first_ns: int) -> Iterator[Event]:
        """``/tf_static`` and ``/lidar/label_space`` once, then the sweeps."""
        for k, frame in enumerate(frames):
            if k == 0:
                t, q = translation_quaternion(frame.base_T_lidar)
                pose = self._make("geometry_msgs/msg/Transform", translation=self._vector(t), rotation=self._quaternion(q))
                header = self._header(first_ns, "base_link")
                edge = self._make("geometry_msgs/msg/TransformStamped", header=header, child_frame_id="lidar", transform=pose)
                yield first_ns, "/tf_static", "tf2_msgs/msg/TFMessage", self._make("tf2_msgs/msg/TFMessage", transforms=[edge])
                yield first_ns, "/lidar/label_space", "std_msgs/msg/String", self._make("std_msgs/msg/String", data=LABEL_SPACE)
            yield frame.stamp_ns + TURN_NS + _LATENCY_NS, "/lidar/points", "sensor_msgs/msg/PointCloud2", self._cloud(frame)

    def _cloud(self, frame: DriveFrame) -> Any:
        sweep = frame.sweep
        points = np.zeros(len(sweep.points), _POINT)
        for k, axis in enumerate("xyz"):
            points[axis] = sweep.points[:, k]
        points["label"], points["ring"], points["t"] = sweep.labels, sweep.ring, np.round(sweep.turn * TURN_NS)
        fields = [
            self._make("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=_DATATYPES[kind.str], count=1)
            for name, (kind, offset) in ((n, _POINT.fields[n][:2]) for n in _POINT.names or () if _POINT.fields)
        ]
        return self._make(
            "sensor_msgs/msg/PointCloud2",
            header=self._header(frame.stamp_ns, "lidar"),
            height=1,
            width=len(points),
            fields=fields,
            is_bigendian=False,
            point_step=_POINT.itemsize,
            row_step=_POINT.itemsize * len(points),
            data=points.view(np.uint8),
            is_dense=True,
        )

    def vehicle(self, trajectory: Trajectory) -> Iterator[Event]:
        """``/odometry`` and ``/imu`` at every pose of the trajectory."""
        translation, quaternion = translation_quaternion(trajectory.odom_T_base)
        force, rate, speed = _inertial(trajectory)
        none = np.zeros(36)
        for k, stamp in enumerate(trajectory.stamps_ns.tolist()):
            where = self._make(
                "geometry_msgs/msg/Pose", position=self._vector(translation[k], "Point"), orientation=self._quaternion(quaternion[k])
            )
            twist = self._make("geometry_msgs/msg/Twist", linear=self._vector(speed[k]), angular=self._vector(rate[k]))
            odometry = self._make(
                "nav_msgs/msg/Odometry",
                header=self._header(stamp, "odom"),
                child_frame_id="base_link",
                pose=self._make("geometry_msgs/msg/PoseWithCovariance", pose=where, covariance=none),
                twist=self._make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=none),
            )
            yield stamp + _LATENCY_NS, "/odometry", "nav_msgs/msg/Odometry", odometry
            imu = self._make(
                "sensor_msgs/msg/Imu",
                header=self._header(stamp, "base_link"),
                orientation=self._quaternion(np.array([0.0, 0.0, 0.0, 1.0])),
                orientation_covariance=np.array([-1.0] + [0.0] * 8),  # -1: there is no orientation
                angular_velocity=self._vector(rate[k]),
                angular_velocity_covariance=np.zeros(9),
                linear_acceleration=self._vector(force[k]),
                linear_acceleration_covariance=np.zeros(9),
            )
            yield stamp + _LATENCY_NS, "/imu", "sensor_msgs/msg/Imu", imu


def _inertial(trajectory: Trajectory) -> tuple[F64, F64, F64]:
    """Specific force (m/s^2), angular rate (rad/s) and velocity (m/s) in the base frame at every pose, with a little noise."""
    seconds = (trajectory.stamps_ns - trajectory.stamps_ns[0]) * 1e-9
    pose, rng = trajectory.world_T_base, np.random.default_rng([len(seconds), 51])
    velocity = np.gradient(pose[:, :3, 3], seconds, axis=0)
    acceleration = np.gradient(velocity, seconds, axis=0) + np.array([0.0, 0.0, 9.80665])
    back = np.swapaxes(pose[:, :3, :3], 1, 2)
    step = Rotation.from_matrix(back[:-1] @ pose[1:, :3, :3]).as_rotvec() / np.diff(seconds)[:, None]
    rate = np.concatenate([step, step[-1:]])
    force = np.einsum("nij,nj->ni", back, acceleration) + rng.normal(size=rate.shape) * 0.05
    return force, rate + rng.normal(size=rate.shape) * 0.002, np.einsum("nij,nj->ni", back, velocity)
