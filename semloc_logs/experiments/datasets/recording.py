"""A sequence of a data set, and its log: MCAP with ROS 2 messages.

Topics: ``/lidar/points`` (x y z float32; ``label`` uint32 and ``t`` uint32 nanoseconds since the
stamp where the data set has them), ``/odometry`` (frame ``odom``, child ``base_link``),
``/tf_static``, ``/camera/NAME/image_rect/compressed`` with ``/camera/NAME/camera_info``, and
``/lidar/label_space``, which names the space of the labels.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapFile
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from semloc_logs.arrays import F32, F64, I64
from semloc_logs.errors import LogError
from semloc_logs.simulation.output.drive_messages import Made, RosMessages
from semloc_logs.simulation.output.truth_file import write_truth
from semloc_logs.tables.atomic_files import replacing_file

Event = tuple[int, Made]

LIDAR = "lidar"  # frame of the points
_KINDS = {"<f4": 7, "<u4": 6}  # sensor_msgs/PointField
_WIDTH = 4  # bytes of each


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Poses (n, 4, 4) of the base frame at ascending ``stamps_ns`` (n,)."""

    stamps_ns: I64
    poses: F64


@dataclass(frozen=True, slots=True, eq=False)
class CloudFile:
    """A sweep that began at ``stamp_ns``: ``points`` (n, 3) metres in the frame of the sensor,
    ``label`` (n,) ids, and ``offset_ns`` (n,) of each point since the stamp, where there are any.
    """

    stamp_ns: int
    points: F32
    label: NDArray[np.uint32] | None = None
    offset_ns: NDArray[np.uint32] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class CameraFiles:
    """Pictures without distortion: PNG ``files`` by stamp, K (3, 3), the mounting, and metres that
    the camera sits to the right of its partner.
    """

    name: str
    matrix: F64
    base_T_camera: F64
    files: Sequence[tuple[int, Path]]
    baseline: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A sequence: ``name`` of its log, ``odometry`` that the log carries, the ``truth``, the
    sweeps, read one by one, the mounting of the LIDAR, cameras, and the space of the labels.
    """

    name: str
    odometry: Track
    truth: Track
    sweeps: Callable[[], Iterator[CloudFile]]
    base_T_lidar: F64 = field(default_factory=lambda: np.eye(4))
    cameras: Sequence[CameraFiles] = ()
    label_space: str = ""


def write_recording(recording: Recording, folder: Path) -> Path:
    """Write NAME.mcap and NAME.tum, which is its truth, to a folder; the log.

    LogError when a file of the data set cannot be read.
    """
    log = folder / f"{recording.name}.mcap"
    store = get_typestore(Stores.ROS2_HUMBLE)
    messages = RosMessages(store, ros1=False)
    first = int(recording.odometry.stamps_ns[0])
    events = heapq.merge(
        _fixed(messages, recording, first),
        _odometry(messages, recording.odometry),
        _clouds(messages, store.types, recording),
        *(_pictures(messages, camera) for camera in recording.cameras),
        key=lambda event: event[0],
    )
    with replacing_file(log) as temporary, temporary.open("wb") as stream:
        writer = McapFile(stream, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="semloc_logs")
        channels: dict[str, int] = {}
        for number, (stamp_ns, (topic, type_, message)) in enumerate(events):
            if topic not in channels:
                text = store.generate_msgdef(type_, ros_version=2)[0]
                schema = writer.register_schema(type_, "ros2msg", text.encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            data = bytes(store.serialize_cdr(message, type_))
            writer.add_message(channels[topic], stamp_ns, data, stamp_ns, number)
        writer.finish()  # type: ignore[no-untyped-call]
    write_truth(log.with_suffix(".tum"), recording.truth.stamps_ns, recording.truth.poses)
    return log


def _fixed(messages: RosMessages, recording: Recording, first_ns: int) -> Iterator[Event]:
    """Mountings and the label space, once."""
    yield first_ns, messages.mounted(first_ns, LIDAR, recording.base_T_lidar)
    for camera in recording.cameras:
        yield first_ns, messages.mounted(first_ns, _frame(camera), camera.base_T_camera)
    if recording.label_space:
        topic, type_, message = messages.label_space()
        message.data = recording.label_space
        yield first_ns, (topic, type_, message)


def _frame(camera: CameraFiles) -> str:
    return f"camera_{camera.name}_optical"


def _odometry(messages: RosMessages, track: Track) -> Iterator[Event]:
    still = np.zeros(3)
    for stamp, pose in zip(track.stamps_ns.tolist(), track.poses, strict=True):
        yield stamp, messages.odometry(stamp, pose, still, still)


def _clouds(
    messages: RosMessages, types: Mapping[str, Any], recording: Recording
) -> Iterator[Event]:
    for cloud in recording.sweeps():
        yield cloud.stamp_ns, _cloud(messages, types, cloud)


def _cloud(messages: RosMessages, types: Mapping[str, Any], cloud: CloudFile) -> Made:
    kinds = {"x": "<f4", "y": "<f4", "z": "<f4"}
    columns: dict[str, NDArray[Any]] = {axis: cloud.points[:, k] for k, axis in enumerate("xyz")}
    if cloud.label is not None:
        kinds["label"] = "<u4"
        columns["label"] = cloud.label
    if cloud.offset_ns is not None:
        kinds["t"] = "<u4"
        columns["t"] = cloud.offset_ns
    points = np.zeros(len(cloud.points), np.dtype([*kinds.items()]))
    for name, values in columns.items():
        points[name] = values
    field_of = types["sensor_msgs/msg/PointField"]
    fields = [
        field_of(name=name, offset=_WIDTH * k, datatype=_KINDS[kind], count=1)
        for k, (name, kind) in enumerate(kinds.items())
    ]
    message = types["sensor_msgs/msg/PointCloud2"](
        header=messages.header(cloud.stamp_ns, LIDAR),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=points.dtype.itemsize,
        row_step=points.dtype.itemsize * len(points),
        data=points.view(np.uint8),
        is_dense=True,
    )
    return "/lidar/points", "sensor_msgs/msg/PointCloud2", message


def _pictures(messages: RosMessages, camera: CameraFiles) -> Iterator[Event]:
    size: tuple[int, int] | None = None
    for stamp, path in camera.files:
        data = read_bytes(path)
        if size is None:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
            if image is None:
                raise LogError(f"{path} is not a picture: download it again.")
            size = (image.shape[1], image.shape[0])
        yield (
            stamp,
            messages.calibration(
                f"/camera/{camera.name}/camera_info",
                stamp,
                _frame(camera),
                size,
                camera.matrix,
                camera.baseline,
            ),
        )
        topic = f"/camera/{camera.name}/image_rect/compressed"
        yield stamp, messages.picture(topic, stamp, _frame(camera), "png", data)


# -- files of data sets


def read_bytes(path: Path) -> bytes:
    """The content of a file; LogError when it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as problem:
        raise LogError(f"{path} cannot be read ({problem.strerror or problem}).") from None


def read_records(path: Path, kind: str, columns: int = 1) -> NDArray[Any]:
    """The numbers of a binary file, (n, columns); LogError when its size does not fit."""
    data = read_bytes(path)
    size = np.dtype(kind).itemsize * columns
    if len(data) % size:
        raise LogError(f"{path} has {len(data)} bytes, not a multiple of {size}: copy it again.")
    return np.frombuffer(data, kind).reshape(-1, columns)


def read_numbers(path: Path, columns: Iterable[int] = (), delimiter: str | None = None) -> F64:
    """The numbers of a text file, (n, m); a line that begins with letters is left out. LogError
    when another line is not of numbers, or has too few for ``columns``.
    """
    needed = max(columns, default=0)
    rows: list[list[float]] = []
    for number, line in enumerate(read_bytes(path).decode("ascii", "replace").splitlines(), 1):
        text = line.strip()
        if not text or text[0].isalpha() or text[0] == "#":
            continue
        words = text.split(delimiter)
        try:
            values = [float(word) for word in words]
        except ValueError:
            raise LogError(
                f"{path}, line {number}: {text[:40]!r} is not a row of numbers."
            ) from None
        if len(values) <= needed or (rows and len(values) != len(rows[0])):
            raise LogError(f"{path}, line {number} has {len(values)} numbers.")
        rows.append(values)
    if not rows:
        raise LogError(f"{path} has no numbers.")
    return np.array(rows)


def sequences_with(folder: Path, part: str, wanted: str) -> list[Path]:
    """``folder`` itself where it has the folder ``part``, else all folders in it that have it.

    LogError without any; ``wanted`` tells in words what to give instead.
    """
    folders = [folder] if (folder / part).is_dir() else sorted(folder.glob("*/"))
    folders = [p for p in folders if (p / part).is_dir()]
    if not folders:
        raise LogError(f"{folder} has no {part}/: give {wanted}.")
    return folders


def numbered(folder: Path, ending: str) -> list[tuple[int, Path]]:
    """The files of a folder whose names are numbers, in their order."""
    frames = [(int(p.stem), p) for p in folder.glob(f"*{ending}") if p.stem.isdigit()]
    return sorted(frames)
