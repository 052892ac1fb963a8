"""A session: one log, or several recorded back to back, read once as clouds with poses in bounded
memory.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Concatenate, ParamSpec

import numpy as np
from numpy.typing import NDArray

from semloc_logs.errors import LogError, RoleError
from semloc_logs.frames import F64, Camera, ImageFrame, LabelNames, PosedCloud
from semloc_logs.logs.containers.open import open_log
from semloc_logs.logs.log import Log, Stream
from semloc_logs.logs.poses.base_frame import BasePoses, PoseSource
from semloc_logs.logs.poses.imu_gravity import up_in_base, up_in_session
from semloc_logs.logs.poses.navsat import navsat_poses
from semloc_logs.logs.poses.trajectory_file import FilePoses, TrajectoryFile
from semloc_logs.logs.roles import Roles, find_roles, no_sensor
from semloc_logs.logs.sensors.camera_clouds import PictureClouds
from semloc_logs.logs.sensors.depth import USUAL_NOISE, RangeNoise
from semloc_logs.logs.session.cloud_builder import BaseClouds
from semloc_logs.logs.session.duplicate_topics import Copies
from semloc_logs.logs.session.image_relay import ShownPictures
from semloc_logs.logs.session.lidar_odometry import LidarOdometry
from semloc_logs.logs.session.merge import merged_frames, merged_streams
from semloc_logs.logs.session.one_pass import CloudPass
from semloc_logs.logs.session.summary import Conclusion, conclude
from semloc_logs.logs.session.tally import without_unused

_P = ParamSpec("_P")


class Session:
    """Clouds with poses from ``logs``. What is known grows with the pass of :meth:`clouds`; a
    second call reads the files again.

    ``topics`` overrules roles; points outside of the ranges (m, from the sensor) are dropped.
    ``stride`` keeps every n-th pixel of every n-th row of depth images, and shrinks stereo pictures
    n-fold; None: 2 above 200,000 pixels, stereo pictures stay as they are up to half a million.
    ``noise``: how uncertain their ranges are. ``poses`` is a file of poses, and ``odometry``
    "lidar" makes poses of the sweeps: either replaces what the log says. RoleError when the streams
    leave open what to use, or have nothing to make clouds from.
    """

    def __init__(
        self,
        logs: Sequence[Log],
        topics: Mapping[str, str] | None = None,
        *,
        min_range: float = 0.5,
        max_range: float = 80.0,
        stride: int | None = None,
        noise: RangeNoise = USUAL_NOISE,
        poses: TrajectoryFile | None = None,
        odometry: str = "none",
    ) -> None:
        self.logs = list(logs)
        self.streams: list[Stream] = merged_streams(self.logs)
        self.name = " + ".join(log.path.name for log in self.logs)
        self._poses = poses
        self._odometry = odometry == "lidar" and poses is None
        try:
            self.roles: Roles = self._find_roles(topics or {})
        except RoleError as error:
            raise RoleError(f"{self.name}: {error}") from error
        if not self.roles.ranging:
            raise RoleError(f"{self.name}: {no_sensor(self.streams)}")
        self.min_range, self.max_range, self.stride = min_range, max_range, stride
        self._noise = noise
        self._is_told = "lidar" in (topics or {})
        self._pass = self._new_pass(ShownPictures())
        self._conclusion = Conclusion()

    def _find_roles(self, topics: Mapping[str, str]) -> Roles:
        """The roles; poses from elsewhere leave the log's own pose topic unused, and unambiguous."""
        if self._poses is None and not self._odometry:
            return find_roles(self.streams, topics)
        roles = find_roles(self.streams, {**topics, "pose": "none"})
        # of several logs some may have a depth camera and poses
        if self._odometry and not roles.lidar:
            self._odometry = False
            return find_roles(self.streams, topics)
        return roles

    def _pose_source(self) -> PoseSource | None:
        """Where poses come from if not from a stream of the log."""
        main = self.roles.ranging[0]
        if self._poses is not None:
            return FilePoses(
                self._poses, main, sum(s.count for s in self.streams if s.topic == main)
            )
        if self._odometry:
            return LidarOdometry(main, min_range=self.min_range, max_range=self.max_range)
        return None

    # -- what is known
    # -------------------------------------------------------------------------------------------------------------

    @property
    def base_frame(self) -> str:
        """Name of the base frame; "" until the first cloud was given."""
        return self._pass.where.base.name if self._pass.where.base else ""

    @property
    def session_frame(self) -> str:
        """Name of the frame that the poses are in; "" until it is known, and without poses."""
        return self._pass.where.session_frame

    @property
    def skipped(self) -> list[str]:
        """Sentences about data that could not be used."""
        unused = {s.topic for s in self.streams if self.roles.role_of(s.topic) is None}
        said = [
            self._told(log, p) for log in self.logs for p in without_unused(log.problems, unused)
        ]
        return list(dict.fromkeys([*said, *self._pass.pictures.lost, *self._conclusion.lost]))

    def _told(self, log: Log, problem: str) -> str:
        return (
            f"{log.path.name}: {problem}"
            if len(self.logs) > 1 and not problem.startswith(log.path.name)
            else problem
        )

    @property
    def problems(self) -> list[str]:
        """Everything worth saying: lost data first, then what was assumed."""
        assumed = self._pass.where.base.notes if self._pass.where.base else ()
        said = [self._told(log, p) for log in self.logs for p in log.problems]
        return list(
            dict.fromkeys(
                [
                    *self.skipped,
                    *said,
                    *self._pass.pictures.notes,
                    *assumed,
                    *self.roles.notes,
                    *self._conclusion.notes,
                ]
            )
        )

    @property
    def cameras(self) -> dict[str, Camera]:
        """The newest calibration of each picture topic that has one."""
        known = self._pass.pictures.cameras
        return {topic: known[info] for topic, info in self.roles.info_of.items() if info in known}

    @property
    def label_names(self) -> dict[str, LabelNames]:
        """What the log says of the labels of each topic, as far as it does: the first message
        counts.
        """
        return {
            topic: self._pass.meanings[source]
            for topic, source in self.roles.names_of.items()
            if source in self._pass.meanings
        }

    def trajectory(self) -> tuple[NDArray[np.int64], F64]:
        """Stamps (n,) and ``session_T_base`` (n, 4, 4) of all poses; complete once :meth:`clouds`
        is exhausted.
        """
        return self._pass.where.track.stamps_ns.copy(), self._pass.where.track.poses

    def pose_at(self, stamp_ns: int) -> F64 | None:
        """``session_T_base`` (4, 4) at a time that the pass has reached; None where the poses have
        a gap.
        """
        return self._pass.where.track.at(stamp_ns)

    def base_T(self, frame_id: str, stamp_ns: int) -> F64 | None:
        """``base_T_frame`` (4, 4) at a time that the pass has reached; None when nothing says where
        that frame is.
        """
        return self._pass.where.base_T(frame_id, stamp_ns)

    def base_T_sensors(self) -> dict[str, F64]:
        """``base_T_sensor`` (4, 4) by frame id of every sensor that gave a cloud, and of the
        cameras, at their last known time.
        """
        found = dict(self._pass.made.sensors)
        for camera in self._pass.pictures.cameras.values():
            pose = self._pass.where.base_T(camera.header.frame_id, camera.header.stamp_ns)
            if pose is not None:
                found.setdefault(camera.header.frame_id, pose)
        return found

    def imu_up_in_base(self) -> F64 | None:
        """Unit vector (3,) that points up in the base frame: the robust mean of the accelerometer;
        None without a usable IMU.
        """
        return up_in_base(self._pass.accelerometer, self._pass.where)

    def imu_up_in_session(self) -> F64 | None:
        """As :meth:`imu_up_in_base`, in the session frame: every sample is turned by the pose at
        its time, so the base may tilt.
        """
        return up_in_session(self._pass.accelerometer, self._pass.where)

    def to_json(self) -> dict[str, object]:
        """What was read and how, for session.json."""
        track = self._pass.where.track
        tally = self._pass.tally
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
                    "role": self.roles.role_of(s.topic),
                    "count": s.count,
                }
                for s in self.streams
            ],
            "roles": self.roles.to_json(),
            "base_frame": self.base_frame,
            "session_frame": self.session_frame,
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
            "sweeps_deskewed": self._pass.made.deskewed,
            "poses": track.to_json(),
            "pose_source": self._pass.where.source.to_json()
            if self._pass.where.source
            else {"kind": "log"},
            "problems": self.problems,
        }

    def close(self) -> None:
        """Closes the logs."""
        for log in self.logs:
            log.close()

    # -- the pass over the logs
    # ----------------------------------------------------------------------------------------------------

    def clouds(
        self,
        on_image: Callable[[ImageFrame], None] | None = None,
        images: Collection[str] | None = None,
    ) -> Iterator[PosedCloud]:
        """All clouds in the order of their recording, points in the base frame.

        A frame waits until poses and transforms have passed its time, at most 64 at once; one that
        then has no pose is counted and left out, unless the log has no pose stream at all: then
        ``session_T_base`` is None. Colour pictures are decoded only for ``on_image``, which gets
        each of them before the clouds up to its time: those of the topics ``images`` (pictures or
        label images), by default of all pictures.
        """
        self._pass = self._new_pass(
            ShownPictures(on_image, self.roles.image if images is None else images)
        )
        self._conclusion = Conclusion()
        yield from self._pass.clouds(merged_frames(self.logs, self._pass.topics))
        self._conclusion = conclude(self._pass, self.name, self.roles.pose)

    def _new_pass(self, shown: ShownPictures) -> CloudPass:
        roles = self.roles
        static_count = sum(s.count for s in self.streams if s.topic in roles.tf_static)
        navsat = navsat_poses(roles, self.streams)
        # as the pose topic, and not as what is left
        named = navsat if roles.pose is not None else None
        where = BasePoses(roles, static_count, self._pose_source() or named, navsat)
        pictures = PictureClouds(roles, where.tree.lookup, stride=self.stride, noise=self._noise)
        # who names several LIDARs wants them all
        copies = Copies() if len(roles.lidar) > 1 and not self._is_told else None
        made = BaseClouds(
            roles, where, pictures, copies, min_range=self.min_range, max_range=self.max_range
        )
        return CloudPass(roles, where, pictures, made, shown)


def _of_files(
    of_logs: Callable[Concatenate[Sequence[Log], _P], Session],
) -> Callable[Concatenate[Sequence[Path], _P], Session]:
    """The function :func:`open_session`, whose other arguments are those of a Session."""

    def opened(paths: Sequence[Path], /, *args: _P.args, **options: _P.kwargs) -> Session:
        if not paths:
            raise LogError("A session needs at least one log: none was named.")
        logs: list[Log] = []
        try:
            logs.extend(open_log(Path(path)) for path in paths)
            logs.sort(key=lambda log: (log.start_ns is None, log.start_ns or 0))
            return of_logs(logs, *args, **options)
        except BaseException:
            for log in logs:
                log.close()
            raise

    return opened


open_session = _of_files(Session)
"""Opens the files of one session, sorted by time, with the arguments of :class:`Session`. LogError for one that cannot be read."""
