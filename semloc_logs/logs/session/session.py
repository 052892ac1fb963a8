"""A session: one log, or several recorded back to back, read once as clouds with poses.

Memory is bounded, whatever the length of the logs.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.errors import LogError, RoleError
from semloc_logs.frames import Camera, ImageFrame, LabelNames, PosedCloud
from semloc_logs.logs.containers.base import merged_streams
from semloc_logs.logs.containers.open import open_log
from semloc_logs.logs.log import Log, Stream
from semloc_logs.logs.poses.base_frame import BasePoses, PoseSource
from semloc_logs.logs.poses.imu_gravity import up_in_base, up_in_session
from semloc_logs.logs.poses.lidar_odometry import LidarOdometry
from semloc_logs.logs.poses.mountings import NO_MOUNTINGS, Mountings
from semloc_logs.logs.poses.navsat import NavSatPoses, navsat_poses
from semloc_logs.logs.poses.tf_tree import Change, Edge, frame_name
from semloc_logs.logs.poses.track import PoseTrack
from semloc_logs.logs.poses.trajectory_file import FilePoses, TrajectoryFile, stations_along
from semloc_logs.logs.problems import (
    Problem,
    ProblemKind,
    sentences,
    sorted_problems,
    without_loss_of,
)
from semloc_logs.logs.role_types import no_sensor
from semloc_logs.logs.roles import Roles, find_roles
from semloc_logs.logs.sensors.camera_clouds import CameraClouds
from semloc_logs.logs.sensors.depth import USUAL_NOISE, RangeNoise
from semloc_logs.logs.session.cloud_builder import CloudBuilder, RangeLimits
from semloc_logs.logs.session.duplicate_topics import DuplicateTopics
from semloc_logs.logs.session.image_relay import ImageRelay
from semloc_logs.logs.session.merge import merged_frames
from semloc_logs.logs.session.one_pass import CloudPass
from semloc_logs.logs.session.reading import reading_of
from semloc_logs.logs.session.stamp_offsets import StampOffsets, lead, pose_topic, steady_shift
from semloc_logs.logs.session.summary import conclude
from semloc_logs.settings import Logs

_SHARE_OF_WAITING = 4  # frames that wait take at most this part of the memory of a log


@dataclass(frozen=True, slots=True)
class SessionOptions:
    """How to read a session.

    ``topics`` overrules roles: role -> topic. Points outside of the ranges (m, from the sensor) are
    dropped. ``stride`` keeps every n-th pixel of every n-th row of depth images, and shrinks stereo
    pictures n-fold; None: 2 above 200,000 pixels, stereo pictures stay as they are up to half a
    million. ``noise``: how uncertain their ranges are. ``poses`` is a file of poses, and
    ``odometry`` "lidar" makes poses from the sweeps: either replaces the poses of the log.
    ``logs``: the settings of reading; ``mountings``: static transforms from elsewhere.
    """

    topics: Mapping[str, str] = field(default_factory=dict)
    min_range: float = 0.5
    max_range: float = 80.0
    stride: int | None = None
    noise: RangeNoise = USUAL_NOISE
    poses: TrajectoryFile | None = None
    odometry: Literal["none", "lidar"] = "none"
    logs: Logs = field(default_factory=Logs)
    mountings: Mountings = NO_MOUNTINGS


def open_session(paths: Sequence[Path], options: SessionOptions | None = None) -> Session:
    """Opens the files of one session, sorted by time.

    LogError for a file that cannot be read, RoleError as in :class:`Session`.
    """
    if not paths:
        raise LogError("A session needs at least one log: none was named.")
    logs: list[Log] = []
    try:
        given = options or SessionOptions()
        along = None if given.poses is None else partial(stations_along, given.poses)
        logs.extend(open_log(path, given.logs.memory, along) for path in paths)
        logs.sort(key=lambda log: (log.start_ns is None, log.start_ns or 0))
        return Session(logs, options)
    except BaseException:
        for log in logs:
            log.close()
        raise


class Session:
    """Clouds with poses from ``logs``; properties grow with the pass of :meth:`clouds`.

    A second pass reads the files again. RoleError when the streams leave their roles open, or have
    nothing to make clouds from.
    """

    def __init__(self, logs: Sequence[Log], options: SessionOptions | None = None) -> None:
        self.logs = list(logs)
        self.streams: list[Stream] = merged_streams(self.logs)
        self.name = " + ".join(log.path.name for log in self.logs)
        self._options = options or SessionOptions()
        try:
            self.roles: Roles = self._find_roles()
        except RoleError as error:
            raise type(error)(f"{self.name}: {error}") from error
        if not self.roles.ranging:
            raise RoleError(self._without_sensor())
        self._reading = reading_of(self._options.logs, self.roles, self.streams, self.name)
        self._pass = self._new_pass(ImageRelay())
        self._conclusion: list[Problem] = []

    def _without_sensor(self) -> str:
        """Why there is nothing to make clouds from; damaged parts may have held it."""
        problems = [problem for log in self.logs for problem in log.problems]
        damage = sentences(p for p in problems if p.kind is ProblemKind.FILE and p.lost)
        reason = f"{self.name} holds no messages."
        if any(stream.count for stream in self.streams):
            reason = f"{self.name}: {no_sensor(self.streams)}"
        return " ".join([*damage, reason])

    @property
    def _wants_odometry(self) -> bool:
        return self._options.odometry == "lidar" and self._options.poses is None

    def _find_roles(self) -> Roles:
        """The roles; poses from elsewhere leave the log's own pose topic unused."""
        topics = self._options.topics
        if self._options.poses is None and not self._wants_odometry:
            return find_roles(self.streams, topics)
        roles = find_roles(self.streams, {**topics, "pose": "none"})
        # of several logs some may have a depth camera and poses
        if self._wants_odometry and not roles.lidar:
            return find_roles(self.streams, topics)
        return roles

    def _pose_source(self) -> PoseSource | None:
        """The source of poses that replaces the streams of the log, if any."""
        options = self._options
        main = self.roles.ranging[0]
        if options.poses is not None:
            count = sum(s.count for s in self.streams if s.topic == main)
            return FilePoses(options.poses, main, count)
        if self._wants_odometry and self.roles.lidar:
            return LidarOdometry(main, min_range=options.min_range, max_range=options.max_range)
        return None

    # -- known so far

    @property
    def base_frame(self) -> str:
        """Name of the base frame; "" until the first cloud was given."""
        return self._pass.poses.base.name if self._pass.poses.base else ""

    @property
    def session_frame(self) -> str:
        """Name of the frame that the poses are in; "" until it is known, and without poses."""
        return self._pass.poses.session_frame

    @property
    def stamp_offsets(self) -> StampOffsets:
        """Log times less header stamps of the topics that the pass has read."""
        return self._pass.stamp_offsets

    def lead_of(self, topic: str) -> float:
        """By how much (s) stamps of a topic are later than they can be; 0 where they are not."""
        poses = pose_topic(self.stamp_offsets, self.roles, self._pass.poses)
        return 0.0 if poses is None else lead(self.stamp_offsets, topic, poses)

    def shift_of(self, topic: str) -> float:
        """By how much (s) its stamps are earlier beside its recording than the ones of the poses.

        0 where that is not steady.
        """
        poses = pose_topic(self.stamp_offsets, self.roles, self._pass.poses)
        return 0.0 if poses is None else steady_shift(self.stamp_offsets, topic, poses)

    def time_offset_of(self, topic: str) -> float:
        """What the settings add to the stamps of a topic (s)."""
        return self.stamp_offsets.added(topic)

    def off_stamp_of(self, topic: str) -> float:
        """From the header of sweeps to their nearest point (s), where most are far off; else 0."""
        return self._pass.tally.off_stamp(topic)

    def sweep_span_of(self, topic: str) -> float:
        """From the first to the last point of a sweep (s); 0 without times of points."""
        return self._pass.tally.sweep_span(topic)

    def mounting_changes(self, frame_id: str) -> dict[Edge, Change]:
        """Static transforms between the base frame and a frame that the log changed, by edge."""
        tree = self._pass.poses.tree
        path = tree.path(self.base_frame, frame_name(frame_id)) or []
        steps = {*pairwise(path), *((b, a) for a, b in pairwise(path))}
        return {edge: change for edge, change in sorted(tree.changes.items()) if edge in steps}

    def fixed_mounting(self, frame_id: str) -> F64 | None:
        """``base_T_frame`` (4, 4) of another frame that does not move in the base frame; else None.

        Complete after the pass.
        """
        frame = frame_name(frame_id)
        tree = self._pass.poses.tree
        path = [] if frame == self.base_frame else tree.path(self.base_frame, frame) or []
        moving = {frozenset((parent, child)) for parent, child, static in tree.edges if not static}
        if not path or any(frozenset(edge) in moving for edge in pairwise(path)):
            return None
        return self.base_T_sensors().get(frame_id)

    def repeats(self, topic: str) -> str:
        """What is wrong where a sensor repeats measurements while the poses move; else empty."""
        return self._pass.repeats.text(topic, self.track)

    @property
    def is_frozen(self) -> bool:
        """Whether the surroundings move while the poses stand still, for a while or always."""
        return self._pass.builder.standstill.worst is not None

    def is_stuck(self, topic: str) -> bool:
        """Whether the clock of the stamps of a topic stands still while it is recorded."""
        offset = self.stamp_offsets.of(topic)
        return offset is not None and offset.is_stuck

    @property
    def problems(self) -> list[Problem]:
        """All problems: lost data first, then assumptions."""
        unused = {s.topic for s in self.streams if self.roles.role_of(s.topic) is None}
        base = self._pass.poses.base
        return sorted_problems(
            [
                *without_loss_of(unused, self._log_problems()),
                *self._pass.cameras.problems,
                *(base.problems if base else ()),
                *self._options.mountings.problems,
                *self.roles.notes,
                *self._conclusion,
            ]
        )

    def _log_problems(self) -> Iterator[Problem]:
        for log in self.logs:
            for problem in log.problems:
                yield problem.of_log(log.path.name) if len(self.logs) > 1 else problem

    @property
    def cameras(self) -> dict[str, Camera]:
        """The newest calibration of each picture topic that has one."""
        known = self._pass.cameras.calibrations
        return {topic: known[info] for topic, info in self.roles.info_of.items() if info in known}

    @property
    def label_names(self) -> dict[str, LabelNames]:
        """The meaning of the labels of each topic, where the log names it: its first message."""
        return {
            topic: self._pass.meanings[source]
            for topic, source in self.roles.names_of.items()
            if source in self._pass.meanings
        }

    @property
    def track(self) -> PoseTrack:
        """The poses of the base frame; complete after the pass."""
        return self._pass.poses.track

    @property
    def pose_name(self) -> str:
        """The topic of the poses, TF, or the source that replaces them."""
        source = self._pass.poses.source
        return source.name if source else self.roles.pose or "TF"

    @property
    def are_poses_fixes(self) -> bool:
        """Whether the poses are fixes of a receiver, which scatter by half a metre or more."""
        return isinstance(self._pass.poses.source, NavSatPoses)

    def trajectory(self) -> tuple[NDArray[np.int64], F64]:
        """Stamps (n,) and ``session_T_base`` (n, 4, 4) of all poses; complete after the pass."""
        track = self._pass.poses.track
        return track.stamps_ns.copy(), track.poses

    def fixes(self) -> dict[str, Any]:
        """Columns of the table ``fixes``; complete after the pass."""
        return self._pass.fixes.columns(self.base_T)

    def pose_at(self, stamp_ns: int) -> F64 | None:
        """``session_T_base`` (4, 4) at a time that the pass has reached; None in a gap."""
        return self._pass.poses.track.at(stamp_ns)

    def base_T(self, frame_id: str, stamp_ns: int) -> F64 | None:
        """``base_T_frame`` (4, 4) at a time that the pass has reached; None without a transform."""
        return self._pass.poses.base_T(frame_id, stamp_ns)

    def base_T_sensors(self) -> dict[str, F64]:
        """``base_T_sensor`` (4, 4) by frame id: sensors that gave a cloud, and cameras.

        At the last time that each is known.
        """
        base_T_sensors = dict(self._pass.builder.sensors)
        for camera in self._pass.cameras.calibrations.values():
            pose = self._pass.poses.base_T(camera.header.frame_id, camera.header.stamp_ns)
            if pose is not None:
                base_T_sensors.setdefault(camera.header.frame_id, pose)
        return base_T_sensors

    def imu_up_in_base(self) -> F64 | None:
        """Unit vector (3,) that points up in the base frame; None without a usable IMU.

        It is the robust mean of the accelerometer.
        """
        return up_in_base(self._pass.accelerometer, self._pass.poses)

    def imu_up_in_session(self) -> F64 | None:
        """As :meth:`imu_up_in_base`, in the session frame.

        Every sample is turned by the pose at its time, so the base may tilt.
        """
        return up_in_session(self._pass.accelerometer, self._pass.poses)

    def to_json(self) -> dict[str, object]:
        """The streams, their roles, frames and problems, for session.json."""
        poses = self._pass.poses
        tally = self._pass.tally
        root = poses.tree.root_above(self.base_frame) if self.base_frame else None
        return {
            "logs": [
                {
                    "path": str(log.path),
                    "format": log.format,
                    "encoding": log.encoding,
                    "start_ns": log.start_ns,
                    "end_ns": log.end_ns,
                }
                for log in self.logs
            ],
            "streams": [
                {
                    "topic": s.topic,
                    "type": s.type,
                    "role": self.roles.role_of_stream(s),
                    "count": s.count,
                }
                for s in self.streams
            ],
            "roles": self.roles.to_json(),
            "base_frame": self.base_frame,
            "session_frame": self.session_frame,
            "vehicle_root": None
            if root is None
            else {"frame": root[0], "base_T_root": root[1].tolist()},
            "base_T_sensors": {
                frame: pose.tolist() for frame, pose in sorted(self.base_T_sensors().items())
            },
            "frames": {
                topic: {
                    "seen": tally.seen[topic],
                    "used": tally.used[topic],
                    "left_out": tally.left_out(topic),
                }
                for topic in self.roles.ranging
            },
            "stamps": self.stamp_offsets.to_json(),
            "sweeps_deskewed": self._pass.builder.deskewed,
            "poses": poses.track.to_json(),
            "pose_source": poses.source.to_json() if poses.source else {"kind": "log"},
            "problems": sentences(self.problems),
        }

    def close(self) -> None:
        """Closes the logs."""
        for log in self.logs:
            log.close()

    # -- the pass over the logs

    def clouds(
        self,
        on_image: Callable[[ImageFrame], None] | None = None,
        images: Collection[str] | None = None,
    ) -> Iterator[PosedCloud]:
        """All clouds in the order of their recording, points in the base frame.

        A frame waits until poses and transforms have passed its time, within limits of time and
        memory; one that then has no pose is counted and left out, unless the log has no pose
        stream at all: then ``session_T_base`` is None. Colour pictures are decoded only for
        ``on_image``, which gets each of them before the clouds up to its time: pictures of the
        topics ``images`` (pictures or label images), by default of all picture topics.
        """
        relay = ImageRelay(on_image, self.roles.image if images is None else images)
        self._pass = self._new_pass(relay)
        self._conclusion = []
        yield from self._pass.clouds(merged_frames(self.logs, self._pass.topics, self._reading))
        self._conclusion = conclude(self._pass, self.roles)

    def _new_pass(self, relay: ImageRelay) -> CloudPass:
        roles = self.roles
        options = self._options
        static_count = sum(s.count for s in self.streams if s.topic in roles.tf_static)
        navsat = navsat_poses(roles, self.streams)
        # fixes that are named as the pose topic are not only a fallback
        named = navsat if roles.pose is not None else None
        mountings = replace(options.mountings, given=options.logs.mountings)
        poses = BasePoses(roles, static_count, self._pose_source() or named, navsat, mountings)
        cameras = CameraClouds(
            roles,
            poses.tree.lookup,
            stride=options.stride,
            noise=options.noise,
            depth_unit=options.logs.depth_unit,
        )
        # a user who names several LIDARs wants them all
        may_repeat = len(roles.lidar) > 1 and "lidar" not in options.topics
        duplicates = DuplicateTopics() if may_repeat else None
        limits = RangeLimits(options.min_range, options.max_range)
        builder = CloudBuilder(roles, poses, cameras, duplicates, limits)
        most_bytes = self._options.logs.memory // _SHARE_OF_WAITING
        stamp_offsets = StampOffsets(self._reading.offset_ns)
        return CloudPass(roles, poses, builder, relay, stamp_offsets, most_bytes)
