"""Writes small logs: ROS 2 and protobuf as MCAP, ROS 1 as a bag."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from mcap.writer import Writer
from mcap_protobuf.schema import build_file_descriptor_set
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

from semloc_logs.arrays import F64
from semloc_logs.numerics.transforms import translation_quaternion

STORES = {"ros2": get_typestore(Stores.ROS2_HUMBLE), "ros1": get_typestore(Stores.ROS1_NOETIC)}
DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
FOXGLOVE = {"u1": 1, "i1": 2, "u2": 3, "i2": 4, "u4": 5, "i4": 6, "f4": 7, "f8": 8}


class Recorder:
    """A log of ``kind`` ros2, ros1 or protobuf; :meth:`write` sorts messages by log time."""

    def __init__(self, path: Path, kind: str = "ros2") -> None:
        self.kind, self.path = kind, path.with_suffix(".bag" if kind == "ros1" else ".mcap")
        self.store = STORES.get(kind, STORES["ros2"])
        self.events: list[tuple[int, str, Any]] = []

    def make(self, type_: str, /, **fields: Any) -> Any:
        return self.store.types[type_](**fields)

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        stamp = self.make(
            "builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9
        )
        return self.make(
            "std_msgs/msg/Header",
            stamp=stamp,
            frame_id=frame_id,
            **({"seq": 0} if self.kind == "ros1" else {}),
        )

    def add(self, topic: str, message: Any, log_time_ns: int) -> None:
        """Any message."""
        self.events.append((log_time_ns, topic, message))

    def cloud(
        self,
        topic: str,
        stamp_ns: int,
        frame_id: str,
        points: NDArray[np.void],
        *,
        late_ns: int = 150_000_000,
        **changes: Any,
    ) -> None:
        """A cloud of records such as ``[('x', '<f4'), ...]``; ``changes`` replaces fields."""
        named = [
            (n, points.dtype.fields[n]) for n in points.dtype.names or () if points.dtype.fields
        ]
        if self.kind == "protobuf":
            m = PointCloud(
                frame_id=frame_id, point_stride=points.dtype.itemsize, data=points.tobytes()
            )
            m.timestamp.FromNanoseconds(stamp_ns)
            for name, (kind, offset, *_) in named:
                m.fields.add(name=name, offset=offset, type=FOXGLOVE[kind.str[1:]])
            self.add(topic, m, stamp_ns + late_ns)
            return
        fields = [
            self.make(
                "sensor_msgs/msg/PointField",
                name=n,
                offset=o,
                datatype=DATATYPES[k.str[1:]],
                count=1,
            )
            for n, (k, o, *_) in named
        ]
        size = points.dtype.itemsize
        given = {
            "height": 1,
            "width": len(points),
            "fields": fields,
            "is_bigendian": False,
            "point_step": size,
            "is_dense": True,
        }
        given |= {"row_step": size * len(points), "data": np.frombuffer(points.tobytes(), np.uint8)}
        message = self.make(
            "sensor_msgs/msg/PointCloud2",
            header=self.header(stamp_ns, frame_id),
            **(given | changes),
        )
        self.add(topic, message, stamp_ns + late_ns)

    def picture(
        self, topic: str, stamp_ns: int, frame_id: str, pixels: NDArray[Any], encoding: str
    ) -> None:
        """A raw picture (h, w)."""
        height, width = pixels.shape[:2]
        data = np.frombuffer(pixels.tobytes(), np.uint8)
        given = {
            "height": height,
            "width": width,
            "encoding": encoding,
            "is_bigendian": 0,
            "step": len(data) // height,
            "data": data,
        }
        self.add(
            topic,
            self.make("sensor_msgs/msg/Image", header=self.header(stamp_ns, frame_id), **given),
            stamp_ns,
        )

    def camera_info(
        self, topic: str, stamp_ns: int, frame_id: str, width: int, height: int, focal: float
    ) -> None:
        """A pinhole camera."""
        names = ("k", "d", "r", "p") if self.kind == "ros2" else ("K", "D", "R", "P")
        matrix = np.array([focal, 0, width / 2, 0, focal, height / 2, 0, 0, 1.0 if focal else 0.0])
        roi = self.make(
            "sensor_msgs/msg/RegionOfInterest",
            x_offset=0,
            y_offset=0,
            height=0,
            width=0,
            do_rectify=False,
        )
        given: dict[str, Any] = dict(
            zip(names, (matrix, np.zeros(5), np.zeros(9), np.zeros(12)), strict=True)
        )
        given |= {"distortion_model": "plumb_bob", "binning_x": 0, "binning_y": 0, "roi": roi}
        message = self.make(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(stamp_ns, frame_id),
            height=height,
            width=width,
            **given,
        )
        self.add(topic, message, stamp_ns)

    def transform(
        self, parent: str, child: str, pose: F64, stamp_ns: int, topic: str = "/tf_static"
    ) -> None:
        """A transform ``parent_T_child`` (4, 4)."""
        t, q = translation_quaternion(pose)
        if self.kind == "protobuf":
            m = FrameTransform(parent_frame_id=parent, child_frame_id=child)
            m.timestamp.FromNanoseconds(stamp_ns)
            m.translation.x, m.translation.y, m.translation.z = (float(v) for v in t)
            m.rotation.x, m.rotation.y, m.rotation.z, m.rotation.w = (float(v) for v in q)
            self.add(topic, m, stamp_ns)
            return
        vector = self.make(
            "geometry_msgs/msg/Vector3", **dict(zip("xyz", (float(v) for v in t), strict=True))
        )
        turn = self.make(
            "geometry_msgs/msg/Quaternion", **dict(zip("xyzw", (float(v) for v in q), strict=True))
        )
        moved = self.make("geometry_msgs/msg/Transform", translation=vector, rotation=turn)
        edge = self.make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(stamp_ns, parent),
            child_frame_id=child,
            transform=moved,
        )
        self.add(topic, STORES["ros2"].types["tf2_msgs/msg/TFMessage"](transforms=[edge]), stamp_ns)

    def pose(
        self,
        stamp_ns: int,
        pose: F64,
        *,
        late_ns: int = 0,
        log_time_ns: int | None = None,
        frames: tuple[str, str] = ("odom", "base_link"),
    ) -> None:
        """``odom_T_base_link`` (4, 4), or of other frames: Odometry, in protobuf a transform."""
        if self.kind == "protobuf":
            self.transform(*frames, pose, stamp_ns, "/tf")
            return
        t, q = translation_quaternion(pose)
        point = self.make(
            "geometry_msgs/msg/Point", **dict(zip("xyz", (float(v) for v in t), strict=True))
        )
        turn = self.make(
            "geometry_msgs/msg/Quaternion", **dict(zip("xyzw", (float(v) for v in q), strict=True))
        )
        zero = self.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        where = self.make("geometry_msgs/msg/Pose", position=point, orientation=turn)
        twist = self.make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
        message = self.make(
            "nav_msgs/msg/Odometry",
            header=self.header(stamp_ns, frames[0]),
            child_frame_id=frames[1],
            pose=self.make(
                "geometry_msgs/msg/PoseWithCovariance", pose=where, covariance=np.zeros(36)
            ),
            twist=self.make(
                "geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)
            ),
        )
        self.add("/odom", message, stamp_ns + late_ns if log_time_ns is None else log_time_ns)

    def write(self) -> Path:
        """The file."""
        self.events.sort(key=lambda e: e[0])
        if self.kind == "ros1":
            self._write_bag()
        else:
            self._write_mcap()
        return self.path

    def _write_mcap(self) -> None:
        channels: dict[tuple[str, str], int] = {}
        with self.path.open("wb") as file:
            writer = Writer(file)
            writer.start("ros2" if self.kind == "ros2" else "")
            for log_time, topic, m in self.events:
                name = m.DESCRIPTOR.full_name if self.kind == "protobuf" else m.__msgtype__
                key = (topic, name)
                if key not in channels:
                    if self.kind == "protobuf":
                        schema = writer.register_schema(
                            name,
                            "protobuf",
                            build_file_descriptor_set(m).SerializeToString(),
                        )
                        channels[key] = writer.register_channel(topic, "protobuf", schema)
                    else:
                        text = self.store.generate_msgdef(m.__msgtype__, ros_version=2)[0].encode()
                        channels[key] = writer.register_channel(
                            topic, "cdr", writer.register_schema(m.__msgtype__, "ros2msg", text)
                        )
                data = (
                    m.SerializeToString()
                    if self.kind == "protobuf"
                    else bytes(self.store.serialize_cdr(m, m.__msgtype__))
                )
                writer.add_message(
                    channels[key], log_time=log_time, publish_time=log_time, data=data
                )
            writer.finish()  # type: ignore[no-untyped-call]

    def _write_bag(self) -> None:
        connections: dict[str, Any] = {}
        self.path.unlink(missing_ok=True)
        with BagWriter(self.path) as bag:
            for log_time, topic, m in self.events:
                # ROS 1 has no tf2_msgs in the store; its transforms are laid out as in ROS 2 apart
                # from the header's seq
                if topic not in connections:
                    connections[topic] = bag.add_connection(
                        topic, m.__msgtype__, **_ros1_type(m, self.store)
                    )
                bag.write(connections[topic], log_time, _ros1_bytes(m, self.store))


def _ros1_type(m: Any, store: Any) -> Mapping[str, Any]:
    if m.__msgtype__ == "tf2_msgs/msg/TFMessage":
        text, _ = store.generate_msgdef("geometry_msgs/msg/TransformStamped", ros_version=1)
        separator = "=" * 80
        head, _, rest = text.partition(separator)
        text = (
            f"geometry_msgs/TransformStamped[] transforms\n{separator}\n"
            f"MSG: geometry_msgs/TransformStamped\n{head}{separator}{rest}"
        )
        return {"msgdef": text, "md5sum": "94810edda583a504dfda3829e70d7eec"}
    return {"typestore": store}


def _ros1_bytes(m: Any, store: Any) -> bytes:
    if m.__msgtype__ == "tf2_msgs/msg/TFMessage":
        edges = b"".join(bytes(store.serialize_ros1(e, e.__msgtype__)) for e in m.transforms)
        return len(m.transforms).to_bytes(4, "little") + edges
    return bytes(store.serialize_ros1(m, m.__msgtype__))


@pytest.fixture
def recorder(tmp_path: Path) -> Callable[..., Recorder]:
    """``recorder(kind, name)`` gives an empty log of ros2, ros1 or protobuf."""

    def make(kind: str = "ros2", name: str = "drive") -> Recorder:
        return Recorder(tmp_path / name, kind)

    return make
