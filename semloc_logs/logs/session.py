"""A session: one log, or several recorded back to back, read once as clouds with poses in bounded memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semloc_logs.errors import LogError, RoleError
from semloc_logs.frames import (
    F64,
    Camera,
    DepthFrame,
    Frame,
    ImageFrame,
    ImuSample,
    LabelNames,
    LidarFrame,
    NavSatSample,
    PosedCloud,
    PoseSample,
    TransformSample,
)
from semloc_logs.logs.base_frame import BasePoses, PoseSource
from semloc_logs.logs.copies import Copies
from semloc_logs.logs.depth import USUAL_NOISE, RangeNoise, label_ids
from semloc_logs.logs.gravity import Accelerometer
from semloc_logs.logs.log import Log, Stream
from semloc_logs.logs.merge import merged_frames, merged_streams
from semloc_logs.logs.navsat import navsat_poses
from semloc_logs.logs.odometry import LidarOdometry
from semloc_logs.logs.open import open_log
from semloc_logs.logs.picture_clouds import PictureClouds
from semloc_logs.logs.roles import Roles, find_roles, no_sensor
from semloc_logs.logs.stamps import StampOrder
from semloc_logs.logs.standstill import Standstill
from semloc_logs.logs.sweeps import LONGEST_SWEEP_NS, in_base, sweep_in_base
from semloc_logs.logs.tally import COPY, Tally, never_moves, no_poses, refused, smeared, without_unused
from semloc_logs.logs.trajectory_file import FilePoses, TrajectoryFile

MAX_WAITING = 64  # frames that wait for their pose and transforms
MAX_WAITING_BYTES = 512 << 20
_TF_PATIENCE = 16  # frames to wait for a better pose edge in TF than one that is not called odom

RangeFrame = LidarFrame | DepthFrame | ImageFrame


def open_session(
    paths: Sequence[Path],
    topics: Mapping[str, str] | None = None,
    *,
    min_range: float = 0.5,
    max_range: float = 80.0,
    stride: int | None = None,
    noise: RangeNoise = USUAL_NOISE,
    poses: TrajectoryFile | None = None,
    odometry: str = "none",
) -> Session:
    """Opens the logs of one session; ``topics`` overrules roles, points outside of the ranges (m, from the sensor) are dropped.

    ``stride`` keeps every n-th pixel of every n-th row of depth images, and shrinks stereo pictures n-fold; None: 2 above 200,000 pixels,
    stereo pictures stay as they are up to half a million. ``noise``: how uncertain their ranges are. ``poses`` is a file of poses, and
    ``odometry`` "lidar" makes poses of the sweeps: either replaces what the log says. LogError for a log or file that cannot
    be read, RoleError when the streams leave open what to use, or have nothing to make clouds from.
    """
    if not paths:
        raise LogError("A session needs at least one log: none was named.")
    logs: list[Log] = []
    try:
        logs.extend(open_log(Path(path)) for path in paths)
        logs.sort(key=lambda log: (log.start_ns is None, log.start_ns or 0))
        return Session(logs, topics, min_range=min_range, max_range=max_range, stride=stride, noise=noise, poses=poses, odometry=odometry)
    except BaseException:
        for log in logs:
            log.close()
        raise


class Session:
    """Clouds with poses from ``logs``. What is known grows with the pass of :meth:`clouds`; a second call reads the files again."""

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
        self._poses, self._odometry = poses, odometry == "lidar" and poses is None
        try:
            self.roles: Roles = self._find_roles(topics or {})
        except RoleError as error:
            raise RoleError(f"{self.name}: {error}") from error
        if not self.roles.ranging:
            raise RoleError(f"{self.name}: {no_sensor(self.streams)}")
        self.min_range, self.max_range, self.stride = min_range, max_range, stride
        self._noise = noise
        self._is_told = "lidar" in (topics or {})
        self._begin()

    def _find_roles(self, topics: Mapping[str, str]) -> Roles:
        """The roles; poses from elsewhere leave the log's own pose topic unused, and unambiguous."""
        if self._poses is None and not self._odometry:
            return find_roles(self.streams, topics)
        roles = find_roles(self.streams, {**topics, "pose": "none"})
        if self._odometry and not roles.lidar:  # of several logs some may have a depth camera and poses
            self._odometry = False
            return find_roles(self.streams, topics)
        return roles

    def _pose_source(self) -> PoseSource | None:
        """Where poses come from if not from a stream of the log."""
        main = self.roles.ranging[0]
        if self._poses is not None:
            return FilePoses(self._poses, main, sum(s.count for s in self.streams if s.topic == main))
        if self._odometry:
            return LidarOdometry(main, min_range=self.min_range, max_range=self.max_range)
        return None

    def _begin(self) -> None:
        static_count = sum(s.count for s in self.streams if s.topic in self.roles.tf_static)
        navsat = navsat_poses(self.roles, self.streams)
        named = navsat if self.roles.pose is not None else None  # as the pose topic, and not as what is left
        self._where = BasePoses(self.roles, static_count, self._pose_source() or named, navsat)
        self._pictures = PictureClouds(self.roles, self._where.tree.lookup, stride=self.stride, noise=self._noise)
        self._accelerometer = Accelerometer()
        self._tally = Tally()
        self._standstill = Standstill()
        self._order: dict[str, StampOrder] = {}
        self._set_back: set[int] = set()  # ids of waiting frames
        # who names several LIDARs wants them all
        self._copies = Copies() if len(self.roles.lidar) > 1 and not self._is_told else None
        self._waiting: deque[RangeFrame] = deque()
        self._waiting_bytes = 0
        self._sensors: dict[str, F64] = {}
        self._image_stamps: dict[str, deque[int]] = {}  # by topic that on_image wants, the newest last
        self._meanings: dict[str, LabelNames] = {}
        self._deskewed = 0
        self._lost: list[str] = []
        self._notes: list[str] = list(self.roles.notes)

    # -- what is known -------------------------------------------------------------------------------------------------------------

    @property
    def base_frame(self) -> str:
        """Name of the base frame; "" until the first cloud was given."""
        return self._where.base.name if self._where.base else ""

    @property
    def session_frame(self) -> str:
        """Name of the frame that the poses are in; "" until it is known, and without poses."""
        return self._where.session_frame

    @property
    def skipped(self) -> list[str]:
        """Sentences about data that could not be used."""
        unused = {s.topic for s in self.streams if self.roles.role_of(s.topic) is None}
        said = [self._told(log, p) for log in self.logs for p in without_unused(log.problems, unused)]
        return list(dict.fromkeys([*said, *self._pictures.lost, *self._lost]))

    def _told(self, log: Log, problem: str) -> str:
        return f"{log.path.name}: {problem}" if len(self.logs) > 1 and not problem.startswith(log.path.name) else problem

    @property
    def problems(self) -> list[str]:
        """Everything worth saying: lost data first, then what was assumed."""
        assumed = self._where.base.notes if self._where.base else ()
        said = [self._told(log, p) for log in self.logs for p in log.problems]
        return list(dict.fromkeys([*self.skipped, *said, *self._pictures.notes, *assumed, *self._notes]))

    @property
    def cameras(self) -> dict[str, Camera]:
        """The newest calibration of each picture topic that has one."""
        known = self._pictures.cameras
        return {topic: known[info] for topic, info in self.roles.info_of.items() if info in known}

    @property
    def label_names(self) -> dict[str, LabelNames]:
        """What the log says of the labels of each topic, as far as it does: the first message counts."""
        return {topic: self._meanings[source] for topic, source in self.roles.names_of.items() if source in self._meanings}

    def trajectory(self) -> tuple[NDArray[np.int64], F64]:
        """Stamps (n,) and ``session_T_base`` (n, 4, 4) of all poses; complete once :meth:`clouds` is exhausted."""
        return self._where.track.stamps_ns.copy(), self._where.track.poses

    def pose_at(self, stamp_ns: int) -> F64 | None:
        """``session_T_base`` (4, 4) at a time that the pass has reached; None where the poses have a gap."""
        return self._where.track.at(stamp_ns)

    def base_T(self, frame_id: str, stamp_ns: int) -> F64 | None:
        """``base_T_frame`` (4, 4) at a time that the pass has reached; None when nothing says where that frame is."""
        return self._where.base_T(frame_id, stamp_ns)

    def base_T_sensors(self) -> dict[str, F64]:
        """``base_T_sensor`` (4, 4) by frame id of every sensor that gave a cloud, and of the cameras, at their last known time."""
        found = dict(self._sensors)
        for camera in self._pictures.cameras.values():
            pose = self._where.base_T(camera.header.frame_id, camera.header.stamp_ns)
            if pose is not None:
                found.setdefault(camera.header.frame_id, pose)
        return found

    def imu_up_in_base(self) -> F64 | None:
        """Unit vector (3,) that points up in the base frame: the robust mean of the accelerometer; None without a usable IMU."""
        base_T_imu, up = self._base_T_imu(), self._accelerometer.up()
        return None if base_T_imu is None or up is None else base_T_imu[:3, :3] @ up

    def imu_up_in_session(self) -> F64 | None:
        """As :meth:`imu_up_in_base`, in the session frame: every sample is turned by the pose at its time, so the base may tilt."""
        base_T_imu = self._base_T_imu()
        if base_T_imu is None or not len(self._where.track):
            return None
        base_R_imu = base_T_imu[:3, :3]

        def rotations_at(stamps_ns: NDArray[np.int64]) -> tuple[F64, NDArray[np.bool_]]:
            poses, known = self._where.track.at_many(stamps_ns)
            return poses[:, :3, :3] @ base_R_imu, known

        return self._accelerometer.up(rotations_at)

    def _base_T_imu(self) -> F64 | None:
        frame_id = self._accelerometer.frame_id
        return None if frame_id is None else self._where.base_T(frame_id, self._where.track.end_ns or 0)

    def to_json(self) -> dict[str, object]:
        """What was read and how, for session.json."""
        track, tally = self._where.track, self._tally
        return {
            "logs": [
                {"path": str(log.path), "format": log.format, "encoding": log.encoding, "start_ns": log.start_ns, "end_ns": log.end_ns}
                for log in self.logs
            ],
            "streams": [{"topic": s.topic, "type": s.type, "role": self.roles.role_of(s.topic), "count": s.count} for s in self.streams],
            "roles": self.roles.to_json(),
            "base_frame": self.base_frame,
            "session_frame": self.session_frame,
            "base_T_sensors": {frame: pose.tolist() for frame, pose in sorted(self.base_T_sensors().items())},
            "frames": {
                topic: {"seen": tally.seen[topic], "used": tally.used[topic], "left_out": tally.left_out(topic)}
                for topic in self.roles.ranging
            },
            "sweeps_deskewed": self._deskewed,
            "poses": track.to_json(),
            "pose_source": self._where.source.to_json() if self._where.source else {"kind": "log"},
            "problems": self.problems,
        }

    def close(self) -> None:
        """Closes the logs."""
        for log in self.logs:
            log.close()

    # -- the pass over the logs ----------------------------------------------------------------------------------------------------

    def clouds(self, on_image: Callable[[ImageFrame], None] | None = None, images: Collection[str] | None = None) -> Iterator[PosedCloud]:
        """All clouds in the order of their recording, points in the base frame.

        A frame waits until poses and transforms have passed its time, at most 64 at once; one that then has no pose is counted and left
        out, unless the log has no pose stream at all: then ``session_T_base`` is None. Colour pictures are decoded only for
        ``on_image``, which gets each of them before the clouds up to its time: those of the topics ``images`` (pictures or label
        images), by default of all pictures.
        """
        self._begin()
        roles = self.roles
        topics = {*roles.ranging, *roles.topics("stereo_right"), *roles.label_of.values(), *roles.tf, *roles.tf_static}
        topics |= {roles.info_of[t] for t in (*topics, *roles.image, *roles.label_image) if t in roles.info_of}
        wanted = set(roles.image if images is None else images) if on_image else set()
        topics |= {*roles.topics("pose"), *roles.topics("imu"), *roles.topics("gnss"), *roles.label_info} | wanted
        self._image_stamps = {topic: deque(maxlen=4 * MAX_WAITING) for topic in sorted(wanted)}
        for frame in merged_frames(self.logs, topics):
            self._take(frame, on_image)
            yield from self._ready(is_end=False)
        self._where.finish()
        yield from self._ready(is_end=True)
        self._conclude()

    def _take(self, frame: Frame, on_image: Callable[[ImageFrame], None] | None) -> None:
        topic, roles = frame.header.topic, self.roles
        if isinstance(frame, TransformSample | PoseSample):
            self._where.take(frame)
        elif isinstance(frame, Camera):
            self._pictures.cameras[topic] = frame
        elif isinstance(frame, ImuSample):
            self._accelerometer.add(frame)
            self._where.show(frame)
        elif isinstance(frame, NavSatSample):
            self._where.show(frame)
        elif isinstance(frame, LabelNames):
            self._meanings.setdefault(topic, frame)
        elif isinstance(frame, RangeFrame):
            if topic in roles.ranging:
                self._tally.saw(topic, frame.header.stamp_ns)
                self._where.show(frame)
                if isinstance(frame, LidarFrame):
                    self._tally.measured(frame)
                    if not len(frame.points):
                        self._tally.leave_out(topic, "empty")
                        return
                if not self._order.setdefault(topic, StampOrder()).accepts(frame.header.stamp_ns):
                    self._set_back.add(id(frame))
                self._waiting.append(frame)
                self._waiting_bytes += _size(frame)
            if not isinstance(frame, LidarFrame):
                self._take_picture(frame, on_image)

    def _take_picture(self, frame: DepthFrame | ImageFrame, on_image: Callable[[ImageFrame], None] | None) -> None:
        topic = frame.header.topic
        self._pictures.take(frame)
        if on_image is None or topic not in self._image_stamps:
            return
        self._image_stamps[topic].append(frame.header.stamp_ns)
        if isinstance(frame, DepthFrame):  # labels in 16 bits that were decoded as if they were depth
            frame = ImageFrame(frame.header, np.minimum(label_ids(frame), 0xFFFF).astype(np.uint16), "mono16")
        on_image(frame)

    def _ready(self, *, is_end: bool) -> Iterator[PosedCloud]:
        """Clouds of the frames that need not wait any longer, first come first served."""
        while self._waiting:
            must = is_end or len(self._waiting) > MAX_WAITING or self._waiting_bytes > MAX_WAITING_BYTES
            if self._where.base is None:
                sensors = list(dict.fromkeys(f.header.frame_id for f in sorted(self._waiting, key=self._importance)))
                self._where.settle(sensors, is_patient=len(self._waiting) < _TF_PATIENCE, must=must)
                # poses that have not even begun are out of reach of a frame that cannot wait
                if self._where.base is None and not must:
                    return
            if not must and not self._has_all(self._waiting[0]):
                return
            frame = self._waiting.popleft()
            self._waiting_bytes -= _size(frame)
            cloud = self._cloud(frame, is_end=is_end)
            if id(frame) in self._set_back:
                self._set_back.remove(id(frame))
                # the pose at its time is that of an earlier frame
                cloud = cloud if isinstance(cloud, str) or cloud.session_T_base is None else "back in time"
            if isinstance(cloud, str):
                self._tally.leave_out(frame.header.topic, cloud)
            else:
                self._tally.used[frame.header.topic] += 1
                yield cloud

    def _importance(self, frame: RangeFrame) -> int:
        """Sensors that share the namespace of the pose stream first: a pose without child frame is theirs."""
        own = (self.roles.pose or "").strip("/").split("/")[:-1]
        return 0 if own and frame.header.topic.strip("/").split("/")[: len(own)] == own else 1

    def _has_all(self, frame: RangeFrame) -> bool:
        stamp_ns = frame.header.stamp_ns
        if any(self.roles.info_of.get(t) not in {None, *self._pictures.cameras} for t in self._image_stamps):
            return False
        for stamps in self._image_stamps.values():  # poses have to reach the first picture that is not earlier
            following = next((s for s in stamps if s >= stamp_ns), None)
            if following is None or not self._where.poses_have_passed(following):
                return False
        if not isinstance(frame, LidarFrame) and not self._pictures.has_all(frame):
            return False
        where = self._where
        return where.poses_have_passed(stamp_ns + _sweep_ns(frame)) and where.transforms_have_passed(frame.header.frame_id, stamp_ns)

    def _cloud(self, frame: RangeFrame, *, is_end: bool) -> PosedCloud | str:
        """The cloud of a frame, or the reason why there is none."""
        header, base = frame.header, self._where.base
        if base is None:
            return "no pose"
        base_T_sensor = self._where.base_T(header.frame_id, header.stamp_ns)
        if base_T_sensor is None:
            return "no transform"
        # before the poses have come so far, nobody knows whether the frame lies in a gap: the nearest pose serves at the end only
        is_known = base.pose_frame is not None and (is_end or self._where.poses_have_passed(header.stamp_ns))
        pose = self._where.track.at(header.stamp_ns) if is_known else None
        extra: dict[str, str] = {}
        if base.pose_frame is not None and pose is None:
            return "no pose"
        sigma = None
        if isinstance(frame, LidarFrame):
            if self._copies is not None and self._copies.is_copy(header.topic, header.stamp_ns, in_base(base_T_sensor, frame.points)):
                return COPY
            poses_at = None if pose is None else self._where.track.at_many
            points, label, is_deskewed = sweep_in_base(frame, base_T_sensor, poses_at, min_range=self.min_range, max_range=self.max_range)
            self._deskewed += is_deskewed
        else:
            found = self._pictures.points(frame, self.min_range, self.max_range)
            if isinstance(found, str):
                return found
            points, label, sigma = in_base(base_T_sensor, found.points), found.label, found.sigma
            label_topic = self.roles.label_of.get(header.topic)
            if label is not None and label_topic is not None:
                extra = {"label_topic": label_topic, "label_form": "colours" if label_topic in self._pictures.labels.coloured else "ids"}
        if not len(points):
            return "no points"
        self._sensors[header.frame_id] = base_T_sensor
        if pose is not None and header.topic == self.roles.ranging[0] and not self._where.track.moves:
            self._standstill.add(points, pose)
        return PosedCloud(header, points, base_T_sensor[:3, 3].astype(np.float32), pose, label, extra, sigma)

    def _conclude(self) -> None:
        track = self._where.track
        self._lost.extend(self._tally.sentences((track.start_ns, track.end_ns)))
        self._notes.extend(self._tally.remarks())
        self._notes.extend([] if self._copies is None else self._copies.sentences())
        if track.invalid:
            self._lost.append(f"{track.invalid} poses are no rigid transforms and were left out.")
        source = self._where.source
        if source is not None:
            self._lost.extend(source.problems)
            self._notes.extend(source.notes)
        name = source.name if source else self.roles.pose or "TF"
        # every publisher of TF may repeat what others said: nothing is lost by that
        (self._notes if name == "TF" and not track.backwards + track.ahead else self._lost).extend(refused(name, track))
        if self._standstill.shift and not track.moves:
            self._lost.append(smeared(name, self._standstill.shift))
        else:
            self._notes.extend(never_moves(name, track))
        if self._where.base is not None and self._where.base.pose_frame is None:
            self._notes.append(no_poses(self.name))


def _size(frame: RangeFrame) -> int:
    if isinstance(frame, LidarFrame):
        return frame.points.nbytes + sum(a.nbytes for a in (frame.label, frame.offset_ns, frame.ring) if a is not None)
    return frame.depth.nbytes if isinstance(frame, DepthFrame) else frame.image.nbytes


def _sweep_ns(frame: RangeFrame) -> int:
    """How long after the stamp the last point was measured."""
    if not isinstance(frame, LidarFrame) or frame.offset_ns is None or not len(frame.offset_ns):
        return 0
    return min(max(0, int(frame.offset_ns.max())), LONGEST_SWEEP_NS)
