"""A map of points as a log: at each station a cloud of the points that are seen.

``/stations/points`` has the clouds in the frame of the base, ``/stations/odometry`` the poses of a
tour, which a trajectory replaces.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from semloc_logs.arrays import F64
from semloc_logs.errors import LogError
from semloc_logs.logs.containers.base import BaseLog
from semloc_logs.logs.containers.map_stations import Stations, Views, tour
from semloc_logs.logs.containers.memory import Memory
from semloc_logs.logs.containers.point_files import read_points
from semloc_logs.logs.log import MAP_FORMAT, Definition, Message, Section, Stream
from semloc_logs.logs.problems import ProblemKind
from semloc_logs.numerics.transforms import apply, inverse, translation_quaternion

POINTS = "/stations/points"
ODOMETRY = "/stations/odometry"
LABEL_SPACE = "/stations/label_space"
BASE_FRAME = "base_link"
MAP_FRAME = "map"
TYPES = {
    POINTS: "sensor_msgs/msg/PointCloud2",
    ODOMETRY: "nav_msgs/msg/Odometry",
    LABEL_SPACE: "std_msgs/msg/String",
}
_SECTION = 16  # stations


class PointMapLog(BaseLog):
    """A PCD, PLY, LAS or LAZ file. ``along``: the stations of a trajectory, else a tour is made.

    LogError for a damaged file, and for one without ground unless there is a trajectory.
    """

    def __init__(
        self,
        path: Path,
        memory: Memory | None = None,
        along: Callable[[], Stations] | None = None,
    ) -> None:
        super().__init__(path, MAP_FORMAT, memory=memory)
        self._map = read_points(path, self._memory)
        try:
            self._stations = tour(self._map.xyz) if along is None else along()
        except LogError as error:
            raise LogError(f"{path} cannot be used as a map: {error}") from error
        if self._map.skipped:
            text = f"{self._map.skipped} points of the map have no finite coordinates."
            self._problems.add(text, topic=POINTS, kind=ProblemKind.FRAME)
        self._views = Views(self._map.xyz)
        self.encoding = "ros2"
        stamps = self._stations.stamps_ns
        self.start_ns = int(stamps[0])
        self.end_ns = int(stamps[-1])
        counts = {POINTS: len(stamps)}
        if self._stations.is_tour:
            poses = (sum(1 for _ in self._stations.between(k)) for k in range(len(stamps)))
            counts[ODOMETRY] = sum(poses)
        if self._map.label_space and self._map.label is not None:
            counts[LABEL_SPACE] = 1
        self.streams = [Stream(t, TYPES[t], "cdr", n) for t, n in sorted(counts.items())]

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """The messages of ``topics`` (None: of all), station after station."""
        return self._load(0, len(self._stations.stamps_ns), topics)

    def sections(self) -> list[Section]:
        """A few stations each."""
        stamps = self._stations.stamps_ns
        out = []
        for first in range(0, len(stamps), _SECTION):
            last = min(first + _SECTION, len(stamps))
            messages = partial(self._load, first, last)
            nbytes = self.path.stat().st_size * (last - first) // len(stamps)
            topics = frozenset(s.topic for s in self.streams)
            end_ns = int(stamps[min(last, len(stamps) - 1)])  # poses lead to the next station
            section = Section(int(stamps[first]), end_ns, nbytes, topics, messages)
            out.append(section)
        return out

    def close(self) -> None:
        """The file is closed already."""

    def _load(self, first: int, last: int, topics: Collection[str] | None) -> Iterator[Message]:
        known = {s.topic for s in self.streams}
        wanted = known if topics is None else known & set(topics)
        for station in range(first, last):
            stamp_ns = int(self._stations.stamps_ns[station])
            pose = self._stations.poses[station]
            if LABEL_SPACE in wanted and station == 0:
                yield _message(LABEL_SPACE, stamp_ns, _string(self._map.label_space))
            if POINTS in wanted:
                yield _message(POINTS, stamp_ns, self._cloud(stamp_ns, pose))
            if ODOMETRY in wanted:
                for at_ns, there in self._stations.between(station):
                    yield _message(ODOMETRY, at_ns, _odometry(at_ns, there))

    def _cloud(self, stamp_ns: int, pose: F64) -> Any:
        rows = self._views.seen(pose[:3, 3])
        xyz = apply(inverse(pose), self._map.xyz[rows])
        kinds = [(c, "<f4") for c in "xyz"]
        if self._map.label is not None:
            kinds.append(("label", "<u4"))
        points = np.zeros(len(rows), kinds)
        points["x"], points["y"], points["z"] = xyz.T
        if self._map.label is not None:
            points["label"] = self._map.label[rows]
        return _point_cloud(stamp_ns, points)


def _message(topic: str, stamp_ns: int, message: Any) -> Message:
    type_ = TYPES[topic]
    data = bytes(_store().serialize_cdr(message, type_))
    return Message(topic, type_, "cdr", stamp_ns, data, Definition(type_, "", b""))


@cache
def _store() -> Any:
    return get_typestore(Stores.ROS2_HUMBLE)


def _make(type_: str, **fields: Any) -> Any:
    return _store().types[type_](**fields)


def _header(stamp_ns: int, frame_id: str) -> Any:
    stamp = _make("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return _make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


def _string(text: str) -> Any:
    return _make("std_msgs/msg/String", data=text)


def _point_cloud(stamp_ns: int, points: NDArray[Any]) -> Any:
    kinds = {"f": 7, "u": 6}  # FLOAT32, UINT32
    fields = [
        _make(
            "sensor_msgs/msg/PointField",
            name=name,
            offset=4 * number,
            datatype=kinds[points.dtype[name].kind],
            count=1,
        )
        for number, name in enumerate(points.dtype.names or ())
    ]
    return _make(
        TYPES[POINTS],
        header=_header(stamp_ns, BASE_FRAME),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=points.dtype.itemsize,
        row_step=points.nbytes,
        data=points.view(np.uint8),
        is_dense=True,
    )


def _odometry(stamp_ns: int, map_T_base: F64) -> Any:
    t, q = translation_quaternion(map_T_base)
    zero = _make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    pose = _make(
        "geometry_msgs/msg/Pose",
        position=_make("geometry_msgs/msg/Point", **dict(zip("xyz", t.tolist(), strict=True))),
        orientation=_make(
            "geometry_msgs/msg/Quaternion", **dict(zip("xyzw", q.tolist(), strict=True))
        ),
    )
    none = np.zeros(36)
    twist = _make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
    return _make(
        TYPES[ODOMETRY],
        header=_header(stamp_ns, MAP_FRAME),
        child_frame_id=BASE_FRAME,
        pose=_make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=none),
        twist=_make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=none),
    )
