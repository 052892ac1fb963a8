"""Simulated drives as logs: MCAP with ROS 2 or protobuf messages, ROS 1 bag or ROS 2 bag directory.

Topics: ``/lidar/points`` (x y z float32, ``label`` uint16 Cityscapes train ids, ``ring`` uint16,
``t`` uint32 nanoseconds since the stamp), ``/odometry`` (frame ``odom``, child ``base_link``,
drifting), ``/imu`` (in ``base_link``), ``/gnss`` (of an antenna ``gnss``), ``/tf_static``
(``base_link`` to ``lidar`` and ``gnss``) and ``/lidar/label_space``, one std_msgs/String that names
the label space of the points. In protobuf the odometry is a foxglove.FrameTransform on ``/tf``, and
there is neither an IMU nor a label space.
"""

from __future__ import annotations

import errno
import heapq
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapFile
from mcap_protobuf.schema import build_file_descriptor_set
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag1 import Writer as BagFile
from rosbags.rosbag2 import Writer as BagFolder
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from semloc_logs.errors import LogError
from semloc_logs.simulation.drives.camera_drive import CameraShot
from semloc_logs.simulation.drives.drive import TURN_NS, DriveFrame
from semloc_logs.simulation.drives.trajectory import Trajectory
from semloc_logs.simulation.drives.vehicle_sensors import VehicleSensors, fixes, inertial, motion
from semloc_logs.simulation.output.camera_log import camera_events
from semloc_logs.simulation.output.drive_messages import (
    LATCHED,
    FoxgloveMessages,
    Made,
    Messages,
    RosMessages,
    antenna,
)
from semloc_logs.tables.atomic_files import replacing_file, replacing_folder

FORMATS = {
    "mcap": ".mcap",
    "protobuf": ".mcap",
    "bag": ".bag",
    "ros2": "",
}  # endings; a ROS 2 bag is a directory
_LATENCY_NS = 4_000_000  # from the end of a measurement to the log
_LATCHED_TEXT = """\
- history: 1
  depth: 1
  reliability: 1
  durability: 1
  deadline: {sec: 0, nsec: 0}
  lifespan: {sec: 0, nsec: 0}
  liveliness: 1
  liveliness_lease_duration: {sec: 0, nsec: 0}
  avoid_ros_namespace_conventions: false
"""  # every field: readers of bags want them all
_LATCHED_QOS = Qos(
    QosHistory.KEEP_LAST,
    1,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    QosTime(0, 0),
    QosTime(0, 0),
    QosLiveliness.AUTOMATIC,
    QosTime(0, 0),
    False,
)
Event = tuple[int, Made]  # log time and message


class _Sink(Protocol):
    messages: Messages

    def write(self, topic: str, type_: str, log_time_ns: int, message: Any) -> None: ...


class _Mcap:
    """MCAP of ROS 2 messages, or of protobuf."""

    def __init__(self, file: Any, *, protobuf: bool) -> None:
        self._store = None if protobuf else get_typestore(Stores.ROS2_HUMBLE)
        self.messages: Messages = (
            FoxgloveMessages() if self._store is None else RosMessages(self._store, ros1=False)
        )
        self._file = McapFile(file, compression=CompressionType.ZSTD)
        self._file.start(profile="" if protobuf else "ros2", library="semloc_logs")
        self._channels: dict[str, int] = {}
        self._count: dict[str, int] = {}

    def write(self, topic: str, type_: str, log_time_ns: int, message: Any) -> None:
        if topic not in self._channels:
            if self._store is None:
                schema = self._file.register_schema(
                    type_, "protobuf", build_file_descriptor_set(type(message)).SerializeToString()
                )
            else:
                text = self._store.generate_msgdef(type_, ros_version=2)[0]
                schema = self._file.register_schema(type_, "ros2msg", text.encode())
            latched = (
                {"offered_qos_profiles": _LATCHED_TEXT}
                if topic in LATCHED and self._store is not None
                else {}
            )
            encoding = "protobuf" if self._store is None else "cdr"
            self._channels[topic] = self._file.register_channel(
                topic, encoding, schema, metadata=latched
            )
        data = (
            message.SerializeToString()
            if self._store is None
            else bytes(self._store.serialize_cdr(message, type_))
        )
        count = self._count[topic] = self._count.get(topic, -1) + 1
        self._file.add_message(self._channels[topic], log_time_ns, data, log_time_ns, count)

    def finish(self) -> None:
        self._file.finish()  # type: ignore[no-untyped-call]


class _Bag:
    """ROS 1 bag."""

    def __init__(self, file: BagFile) -> None:
        self._store = get_typestore(Stores.ROS1_NOETIC)
        self._store.register(
            get_types_from_msg(
                "geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"
            )
        )
        self.messages: Messages = RosMessages(self._store, ros1=True)
        self._file = file
        self._connections: dict[str, Any] = {}

    def write(self, topic: str, type_: str, log_time_ns: int, message: Any) -> None:
        if topic not in self._connections:
            latching = 1 if topic in LATCHED else None
            self._connections[topic] = self._file.add_connection(
                topic, type_, typestore=self._store, latching=latching
            )
        self._file.write(
            self._connections[topic], log_time_ns, self._store.serialize_ros1(message, type_)
        )


class _Bag2:
    """ROS 2 bag: a directory of an SQLite file and metadata.yaml."""

    def __init__(self, folder: BagFolder) -> None:
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        self.messages: Messages = RosMessages(self._store, ros1=False)
        self._folder = folder
        self._connections: dict[str, Any] = {}

    def write(self, topic: str, type_: str, log_time_ns: int, message: Any) -> None:
        if topic not in self._connections:
            latched = [_LATCHED_QOS] if topic in LATCHED else []
            self._connections[topic] = self._folder.add_connection(
                topic, type_, typestore=self._store, offered_qos_profiles=latched
            )
        self._folder.write(
            self._connections[topic], log_time_ns, self._store.serialize_cdr(message, type_)
        )


@contextmanager
def _sink(path: Path, format_: str) -> Iterator[_Sink]:
    """A log that appears under its name when everything is in it."""
    try:
        path.parent.stat()  # a folder that is not there is an error, and not created
        if format_ == "ros2":
            with _bag_folder(path) as folder:
                yield folder
        else:
            with replacing_file(path) as temporary, _file_sink(temporary, format_) as sink:
                yield sink
    except OSError as error:
        raise LogError(
            f"{path} cannot be written ({error.strerror or error}): "
            "choose another folder or make room"
        ) from error


@contextmanager
def _file_sink(path: Path, format_: str) -> Iterator[_Sink]:
    """A bag or an MCAP file."""
    if format_ == "bag":
        path.unlink()  # this writer makes the file itself
        file = BagFile(path)
        file.set_compression(BagFile.CompressionFormat.LZ4)
        with file:
            yield _Bag(file)
    else:
        with path.open("wb") as stream:
            mcap = _Mcap(stream, protobuf=format_ == "protobuf")
            yield mcap
            mcap.finish()


@contextmanager
def _bag_folder(path: Path) -> Iterator[_Sink]:
    """A ROS 2 bag; only an earlier bag or an empty folder is replaced."""
    if path.exists() and not (path / "metadata.yaml").exists() and any(path.iterdir()):
        raise OSError(errno.ENOTEMPTY, "Directory not empty")
    with replacing_folder(path) as temporary:
        whole = temporary / path.name  # the files in a bag are called after it
        with BagFolder(whole, version=8) as folder:
            yield _Bag2(folder)
        for file in sorted(whole.iterdir()):
            file.rename(temporary / file.name)
        whole.rmdir()


def write_session(
    path: Path,
    trajectory: Trajectory,
    frames: Iterable[DriveFrame],
    *,
    format: str | None = None,
    sensors: VehicleSensors | None = None,
    shots: Iterable[CameraShot] = (),
) -> int:
    """Write a drive as the log ``path``, sweep by sweep; returns the number of sweeps.

    LogError when it cannot be written.

    ``shots`` are what cameras record (:mod:`semloc_logs.simulation.output.camera_log` has their
    topics).

    ``format`` is a name in ``FORMATS``; without, the ending decides: .mcap (ROS 2 messages), .bag,
    or none for a ROS 2 bag directory.
    """
    if format is None:
        format = next((name for name, suffix in FORMATS.items() if suffix == path.suffix), None)
    if format is None or FORMATS.get(format) != path.suffix:
        raise LogError(
            f"{path} is neither .mcap nor .bag nor a directory: "
            "give the simulated log the ending of its format"
        )
    sweeps = 0
    with _sink(path, format) as sink:
        first = int(trajectory.stamps_ns[0])
        events = heapq.merge(
            *_vehicle(sink.messages, trajectory, sensors or VehicleSensors()),
            _lidar(sink.messages, frames, first),
            camera_events(shots, sink.messages, first),
            key=lambda event: event[0],
        )
        for log_time, (topic, type_, message) in events:
            sink.write(topic, type_, log_time, message)
            sweeps += topic == "/lidar/points"
    return sweeps


def _lidar(messages: Messages, frames: Iterable[DriveFrame], first_ns: int) -> Iterator[Event]:
    """Mountings and label space once, then the sweeps."""
    for k, frame in enumerate(frames):
        if k == 0:
            yield first_ns, messages.mounted(first_ns, "lidar", frame.base_T_lidar)
            yield first_ns, messages.mounted(first_ns, "gnss", antenna())
            space = messages.label_space()
            if space is not None:
                yield first_ns, space
        yield frame.stamp_ns + TURN_NS + _LATENCY_NS, messages.cloud(frame)


def _vehicle(
    messages: Messages, trajectory: Trajectory, sensors: VehicleSensors
) -> list[Iterator[Event]]:
    """Odometry at every pose of the trajectory, samples of the IMU, and fixes."""
    rng = np.random.default_rng([len(trajectory.stamps_ns), 51])
    imu = inertial(trajectory, sensors, rng)
    _, rate, speed = motion(trajectory)

    def odometry() -> Iterator[Event]:
        for k, stamp in enumerate(trajectory.stamps_ns.tolist()):
            yield (
                stamp + _LATENCY_NS,
                messages.odometry(stamp, trajectory.odom_T_base[k], speed[k], rate[k]),
            )

    def samples() -> Iterator[Event]:
        for k, stamp in enumerate(imu.stamps_ns.tolist()):
            made = messages.imu(stamp, imu.force[k], imu.rate[k])
            if made is not None:
                yield stamp + _LATENCY_NS, made

    def satellites() -> Iterator[Event]:
        if sensors.fix_hz <= 0:
            return
        seen = fixes(trajectory, sensors, rng)
        for k, stamp in enumerate(seen.stamps_ns.tolist()):
            made = messages.fix(stamp, seen.geodetic[k], int(seen.status[k]), sensors.fix_noise)
            if made is not None:
                yield stamp + 20 * _LATENCY_NS, made

    return [odometry(), samples(), satellites()]
