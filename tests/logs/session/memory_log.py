"""A log in memory, and frames for it."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from pathlib import Path

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.frames import (
    Camera,
    DepthFrame,
    Frame,
    Header,
    ImageFrame,
    ImuSample,
    LidarFrame,
    PoseSample,
    TransformSample,
)
from semloc_logs.logs.log import Message, Reading, Section, Stream
from semloc_logs.logs.problems import Problem
from semloc_logs.numerics.transforms import yaw_transform

S = 1_000_000_000


EPOCH = 1_700_000_000 * S


TYPES = {
    LidarFrame: "sensor_msgs/msg/PointCloud2",
    DepthFrame: "sensor_msgs/msg/Image",
    ImageFrame: "sensor_msgs/msg/Image",
    Camera: "sensor_msgs/msg/CameraInfo",
    TransformSample: "tf2_msgs/msg/TFMessage",
    ImuSample: "sensor_msgs/msg/Imu",
}


class FakeLog:
    """Frames in memory as a log."""

    def __init__(
        self,
        frames: Iterable[Frame],
        name: str = "drive.mcap",
        pose_type: str = "nav_msgs/msg/Odometry",
    ) -> None:
        self._frames = sorted(frames, key=lambda f: f.header.log_time_ns)
        self.path = Path(name)
        self.format = "mcap"
        self.encoding = "ros2"
        times = [f.header.log_time_ns for f in self._frames]
        self.start_ns: int | None = times[0] if times else None
        self.end_ns: int | None = times[-1] if times else None
        self.problems: list[Problem] = []
        self.given = 0
        kinds = {f.header.topic: TYPES.get(type(f), pose_type) for f in self._frames}
        topics = [f.header.topic for f in self._frames]
        self.streams = [
            Stream(topic, kind, "cdr", topics.count(topic)) for topic, kind in sorted(kinds.items())
        ]

    def sections(self) -> list[Section]:
        return []

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        return iter(())

    def frames(
        self, topics: Collection[str] | None = None, reading: Reading | None = None
    ) -> Iterator[Frame]:
        for frame in self._frames:
            if topics is None or frame.header.topic in topics:
                self.given += 1
                yield frame

    def close(self) -> None:
        pass


def header(topic: str, seconds: float, frame_id: str, late: float = 0.0) -> Header:
    return Header(topic, EPOCH + round(seconds * S), EPOCH + round((seconds + late) * S), frame_id)


def sweep(seconds: float, topic: str = "/points", frame_id: str = "lidar") -> LidarFrame:
    points = np.array([[5.0, 0.0, 0.0], [0.0, 7.0, 0.0]], np.float32)
    return LidarFrame(header(topic, seconds, frame_id), points, label=np.array([1, 2], np.uint32))


def odometry(
    seconds: float, child: str = "base_link", late: float = 0.0, topic: str = "/odom"
) -> PoseSample:
    return PoseSample(
        header(topic, seconds, "odom", late), child, yaw_transform(0.0, (seconds, 0.0, 0.0))
    )


def static(parent: str, child: str, pose: F64, seconds: float = 0.0) -> TransformSample:
    return TransformSample(header("/tf_static", seconds, parent), child, pose, static=True)


def moving(
    parent: str, child: str, seconds: float, pose: F64, late: float = 0.0
) -> TransformSample:
    return TransformSample(header("/tf", seconds, parent, late), child, pose, static=False)


MOUNT = yaw_transform(np.pi / 2, (1.0, 0.0, 2.0))


def depth_camera(count: int, period: float, late: float = 0.0) -> list[Frame]:
    """Depth images with labels 0, 1, 2 ..., and poses that are recorded so late (s)."""
    info = Camera(
        header("/camera/depth/camera_info", 0.02, "optical"),
        4,
        4,
        np.array([[2.0, 0, 2], [0, 2, 2], [0, 0, 1]]),
        np.zeros(5),
        np.eye(3),
        np.zeros((3, 4)),
        "plumb_bob",
    )
    frames: list[Frame] = [info]
    for k in range(count):
        seconds = period * k
        depth = np.full((4, 4), 2.0, np.float32)
        frames.append(DepthFrame(header("/camera/depth/image", seconds, "optical"), depth))
        frames.append(
            ImageFrame(
                header("/camera/label", seconds, "optical", late=0.05),
                np.full((4, 4), k, np.uint8),
                "mono8",
            )
        )
        frames.append(odometry(seconds, "", late, topic="/camera/pose"))
    return frames
