"""A session: one log, or several recorded back to back, read once as clouds with poses in bounded memory."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semloc_logs import geometry
from semloc_logs.errors import LogError, RoleError
from semloc_logs.frames import F64, Camera, DepthFrame, Frame, ImageFrame, ImuSample, LidarFrame, PosedCloud, PoseSample, TransformSample
from semloc_logs.logs.base_frame import BaseFrame, choose_base_frame
from semloc_logs.logs.clouds import LONGEST_SWEEP_NS, Unprojector, depth_metres, label_ids, sweep_in_base
from semloc_logs.logs.gravity import Accelerometer
from semloc_logs.logs.log import Log, Stream
from semloc_logs.logs.merge import merged_frames, merged_streams
from semloc_logs.logs.open import open_log
from semloc_logs.logs.poses import PoseTrack
from semloc_logs.logs.roles import Roles, find_roles, stem
from semloc_logs.logs.transforms import TransformTree, frame_name

MAX_WAITING = 64  # frames that wait for their pose and transforms
MAX_WAITING_BYTES = 512 << 20
LABEL_TOLERANCE_NS = 15_000_000  # a label image belongs to a depth image within half a period at 30 Hz
_TF_PATIENCE = 16  # frames to wait for a better pose edge in TF than one that is not called odom
_LATE_TF_NS = 1_000_000_000  # a pose waits so long for the transform that leads to the base frame


def open_session(
    paths: Sequence[Path],
    topics: Mapping[str, str] | None = None,
    *,
    min_range: float = 0.5,
    max_range: float = 80.0,
    stride: int | None = None,
) -> Session:
    """Opens the logs of one session; ``topics`` overrules roles, points outside of the ranges (m, from the sensor) are dropped.

    ``stride`` keeps every n-th pixel of every n-th row of depth images; None: 2 above 200,000 pixels. LogError for a log that cannot
    be read, RoleError when the streams leave open what to use, or have nothing to make clouds from.
    """
    if not paths:
        raise LogError("A session needs at least one log: none was named.")
    logs: list[Log] = []
    try:
        logs.extend(open_log(Path(path)) for path in paths)
        logs.sort(key=lambda log: (log.start_ns is None, log.start_ns or 0))
        return Session(logs, topics, min_range=min_range, max_range=max_range, stride=stride)
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
    ) -> None:
        self.logs = list(logs)
        self.streams: list[Stream] = merged_streams(self.logs)
        self.name = " + ".join(log.path.name for log in self.logs)
        try:
            self.roles: Roles = find_roles(self.streams, topics)
        except RoleError as error:
            raise RoleError(f"{self.name}: {error}") from error
        if not self.roles.lidar and not self.roles.depth:
            raise RoleError(f"{self.name}: {_no_sensor(self.roles, self.streams)}")
        self.min_range, self.max_range, self.stride = min_range, max_range, stride
        self._begin()

    def _begin(self) -> None:
        self._tree = TransformTree()
        self._track = PoseTrack()
        self._poses: deque[tuple[int, F64]] = deque()  # raw, until the base frame and its transform are known
        self._pose_child: str | None = None
        self._pose_edge: tuple[str, str] | None = None
        self._base: BaseFrame | None = None
        self._waiting: deque[LidarFrame | DepthFrame | ImageFrame] = deque()
        self._waiting_bytes = 0
        self._labels: dict[str, deque[DepthFrame | ImageFrame]] = {}
        self._cameras: dict[str, Camera] = {}
        self._unprojectors: dict[str, tuple[Camera, Unprojector | None]] = {}
        self._sensors: dict[str, F64] = {}
        self._static_times: set[tuple[str, int]] = set()
        self._image_end: int | None = None
        self._accelerometer = Accelerometer()
        self._seen: Counter[str] = Counter()
        self._used: Counter[str] = Counter()
        self._left_out: Counter[tuple[str, str]] = Counter()
        self._spans: dict[str, tuple[int, int]] = {}
        self._deskewed = 0
        self._notes: dict[str, None] = dict.fromkeys(self.roles.notes)
        self._lost: dict[str, None] = {}
        self.session_frame = ""

    # -- what is known -------------------------------------------------------------------------------------------------------------

    @property
    def base_frame(self) -> str:
        """Name of the base frame; "" until the first cloud was given."""
        return self._base.name if self._base else ""

    @property
    def skipped(self) -> list[str]:
        """Sentences about data that could not be used."""
        several = len(self.logs) > 1
        said = [f"{log.path.name}: {p}" if several else p for log in self.logs for p in log.problems]
        return list(dict.fromkeys([*said, *self._lost]))

    @property
    def problems(self) -> list[str]:
        """Everything worth saying: lost data first, then what was assumed."""
        return list(dict.fromkeys([*self.skipped, *self._notes]))

    @property
    def cameras(self) -> dict[str, Camera]:
        """The newest calibration of each picture topic that has one."""
        return {t: self._cameras[info] for t, info in self.roles.info_of.items() if info in self._cameras}

    def trajectory(self) -> tuple[NDArray[np.int64], F64]:
        """Stamps (n,) and ``session_T_base`` (n, 4, 4) of all poses; complete once :meth:`clouds` is exhausted."""
        return self._track.stamps_ns.copy(), self._track.poses

    def pose_at(self, stamp_ns: int) -> F64 | None:
        """``session_T_base`` (4, 4) at a time that the pass has reached; None where the poses have a gap."""
        return self._track.at(stamp_ns)

    def base_T_sensors(self) -> dict[str, F64]:
        """``base_T_sensor`` (4, 4) by frame id of every sensor that gave a cloud, and of the cameras, at their last known time."""
        found = dict(self._sensors)
        for camera in self._cameras.values():
            if camera.header.frame_id not in found and self._base is not None:
                pose = self._base.base_T(self._tree, camera.header.frame_id, camera.header.stamp_ns)
                if pose is not None:
                    found[camera.header.frame_id] = pose
        return found

    def imu_up_in_base(self) -> F64 | None:
        """Unit vector (3,) that points up in the base frame: the robust mean of the accelerometer; None without a usable IMU."""
        base_T_imu, up = self._base_T_imu(), self._accelerometer.up()
        return None if base_T_imu is None or up is None else base_T_imu[:3, :3] @ up

    def imu_up_in_session(self) -> F64 | None:
        """As :meth:`imu_up_in_base`, in the session frame: every sample is turned by the pose at its time, so the base may tilt."""
        base_T_imu = self._base_T_imu()
        if base_T_imu is None or not len(self._track):
            return None

        def rotations_at(stamps_ns: NDArray[np.int64]) -> tuple[F64, NDArray[np.bool_]]:
            poses, known = self._track.at_many(stamps_ns)
            return poses[:, :3, :3] @ base_T_imu[:3, :3], known

        return self._accelerometer.up(rotations_at)

    def _base_T_imu(self) -> F64 | None:
        frame_id = self._accelerometer.frame_id
        if frame_id is None or self._base is None:
            return None
        return self._base.base_T(self._tree, frame_id, self._track.end_ns or 0)

    def to_json(self) -> dict[str, object]:
        """What was read and how, for session.json."""
        topics = (*self.roles.lidar, *self.roles.depth)
        left_out: dict[str, dict[str, int]] = {t: {} for t in topics}
        for (topic, reason), count in sorted(self._left_out.items()):
            left_out[topic][reason] = count
        return {
            "logs": [
                {"path": str(log.path), "format": log.format, "encoding": log.encoding, "start_ns": log.start_ns, "end_ns": log.end_ns}
                for log in self.logs
            ],
            "streams": [{"topic": s.topic, "type": s.type, "role": self.roles.role_of(s.topic), "count": s.count} for s in self.streams],
            "roles": self.roles.to_json(),
            "base_frame": self.base_frame,
            "session_frame": self.session_frame,
            "base_T_sensors": {frame: pose.ravel().tolist() for frame, pose in sorted(self.base_T_sensors().items())},
            "frames": {t: {"seen": self._seen[t], "used": self._used[t], "left_out": left_out[t]} for t in topics},
            "sweeps_deskewed": self._deskewed,
            "poses": {
                "count": len(self._track), "start_ns": self._track.start_ns, "end_ns": self._track.end_ns,
                "duplicates": self._track.duplicates, "backwards": self._track.backwards, "invalid": self._track.invalid,
                "gaps": len(self._track.gaps()), "length_m": round(self._track.length(), 3),
            },
            "problems": self.problems,
        }  # fmt: skip

    def close(self) -> None:
        """Closes the logs."""
        for log in self.logs:
            log.close()

    # -- the pass over the logs ----------------------------------------------------------------------------------------------------

    def clouds(self, on_image: Callable[[ImageFrame], None] | None = None) -> Iterator[PosedCloud]:
        """All clouds in the order of their recording, with pose, points in the base frame.

        A frame waits until poses and transforms have passed its time, at most 64 at once; one that then has no pose is counted and left
        out, unless the log has no pose stream at all: then ``session_T_base`` is None. Colour pictures are decoded only for
        ``on_image``, which gets each of them before the clouds up to its time.
        """
        self._begin()
        roles = self.roles
        info_of = {roles.info_of[t] for t in (*roles.depth, *roles.image) if t in roles.info_of}
        topics = {*roles.lidar, *roles.depth, *info_of, *roles.label_of.values(), *roles.tf, *roles.tf_static}
        topics |= set(roles.topics("pose")) | set(roles.topics("imu")) | (set(roles.image) if on_image else set())
        self._wants_images = on_image is not None and bool(roles.image)
        for frame in merged_frames(self.logs, topics):
            self._take(frame, on_image)
            yield from self._ready_clouds(is_end=False)
        self._move_poses(is_end=True)
        yield from self._ready_clouds(is_end=True)
        self._conclude()

    def _take(self, frame: Frame, on_image: Callable[[ImageFrame], None] | None) -> None:
        topic, roles = frame.header.topic, self.roles
        if isinstance(frame, TransformSample):
            self._take_transform(frame)
        elif isinstance(frame, PoseSample):
            if topic == roles.pose:
                self._take_pose(frame)
        elif isinstance(frame, Camera):
            self._cameras[topic] = frame
        elif isinstance(frame, ImuSample):
            self._accelerometer.add(frame)
        elif isinstance(frame, LidarFrame | DepthFrame | ImageFrame):
            if topic in roles.lidar or topic in roles.depth:
                self._wait(frame)
            elif topic in roles.label_of.values() and not isinstance(frame, LidarFrame):
                self._labels.setdefault(topic, deque(maxlen=MAX_WAITING + 8)).append(frame)
            elif isinstance(frame, ImageFrame) and on_image is not None:
                self._image_end = max(self._image_end or frame.header.stamp_ns, frame.header.stamp_ns)
                on_image(frame)

    def _take_transform(self, sample: TransformSample) -> None:
        topic = sample.header.topic
        if topic == self.roles.pose and topic not in (*self.roles.tf, *self.roles.tf_static):
            self._take_pose(sample)
            return
        self._tree.add(sample)
        if topic in self.roles.tf_static:
            self._static_times.add((topic, sample.header.log_time_ns))
        edge = (frame_name(sample.header.frame_id), frame_name(sample.child_frame_id))
        if edge == self._pose_edge and not sample.static:
            self._poses.append((sample.header.stamp_ns, sample.frame_T_child))
            self._move_poses()

    def _take_pose(self, sample: PoseSample | TransformSample) -> None:
        if self._pose_child is None:
            self._pose_child = frame_name(sample.child_frame_id)
            self.session_frame = frame_name(sample.header.frame_id)
        self._poses.append((sample.header.stamp_ns, sample.frame_T_child))
        self._move_poses()

    def _move_poses(self, is_end: bool = False) -> None:
        """Raw poses -> poses of the base frame, as soon as the transform between the two is known at their time."""
        base = self._base
        if base is None or base.pose_frame is None:
            return
        while self._poses:
            stamp_ns, pose = self._poses[0]
            child_T_base = self._tree.lookup(base.pose_frame, base.name, stamp_ns)
            if child_T_base is None and not is_end and self._poses[-1][0] - stamp_ns < _LATE_TF_NS:
                return
            self._poses.popleft()
            if child_T_base is not None:
                self._track.append(stamp_ns, pose @ child_T_base)

    def _wait(self, frame: LidarFrame | DepthFrame | ImageFrame) -> None:
        topic, stamp_ns = frame.header.topic, frame.header.stamp_ns
        self._seen[topic] += 1
        first, last = self._spans.get(topic, (stamp_ns, stamp_ns))
        self._spans[topic] = (min(first, stamp_ns), max(last, stamp_ns))
        self._waiting.append(frame)
        self._waiting_bytes += _size(frame)

    def _ready_clouds(self, is_end: bool) -> Iterator[PosedCloud]:
        while self._waiting:
            is_full = len(self._waiting) > MAX_WAITING or self._waiting_bytes > MAX_WAITING_BYTES
            must = is_end or is_full
            if self._base is None and not self._settle_base(must):
                if not must:
                    return
                self._drop(self._pop(), "no pose")  # poses are there to come, but not within reach of this frame
                continue
            if not must and not self._is_ready(self._waiting[0]):
                return
            cloud = self._cloud(self._pop())
            if cloud is not None:
                yield cloud

    def _pop(self) -> LidarFrame | DepthFrame | ImageFrame:
        frame = self._waiting.popleft()
        self._waiting_bytes -= _size(frame)
        return frame

    def _settle_base(self, must: bool) -> bool:
        """Chooses the base frame once the transforms that decide it are there, or when it ``must`` be chosen now."""
        roles, tree = self.roles, self._tree
        sensors = list(dict.fromkeys(f.header.frame_id for f in sorted(self._waiting, key=self._importance)))
        if roles.pose is not None and roles.pose not in roles.tf:
            if self._pose_child is None:
                return False
            child: str | None = self._pose_child
        else:
            edge = tree.pose_edge(sensors[0])
            if not must and roles.tf and (edge is None or (not edge[0].endswith("odom") and len(self._waiting) < _TF_PATIENCE)):
                return False
            child = edge[1] if edge else None
            self._pose_edge = edge
        if not must and not self._tf_is_settled(sensors, child):
            self._pose_edge = None
            return False
        self._base = choose_base_frame(tree, sensors, child, roles.pose)
        self._notes.update(dict.fromkeys(self._base.notes))
        if self._pose_edge is not None:
            self.session_frame = self._pose_edge[0]
            track = tree.track(*self._pose_edge)
            if track is not None:
                self._poses.extend(zip(track.stamps_ns.tolist(), track.poses, strict=True))
        self._move_poses()
        return True

    def _importance(self, frame: Frame) -> int:
        """Sensors that share the namespace of the pose stream first: a pose without child frame is theirs."""
        own = (self.roles.pose or "").strip("/").split("/")[:-1]
        return 0 if own and frame.header.topic.strip("/").split("/")[: len(own)] == own else 1

    def _tf_is_settled(self, sensors: Sequence[str], child: str | None) -> bool:
        roles, tree = self.roles, self._tree
        if child == "" or not (roles.tf or roles.tf_static):
            return True
        if all(tree.connected("base_link", f) for f in (*sensors, *([child] if child else []))):
            return True
        expected = sum(s.count for s in self.streams if s.topic in roles.tf_static)
        return not roles.tf and len(self._static_times) >= expected

    def _is_ready(self, frame: LidarFrame | DepthFrame | ImageFrame) -> bool:
        base, stamp_ns = self._base, frame.header.stamp_ns
        if base is None or base.base_T(self._tree, frame.header.frame_id, stamp_ns) is None:
            return False
        if base.pose_frame is not None and (self._track.end_ns is None or self._track.end_ns < stamp_ns + _sweep_ns(frame)):
            return False
        if self._wants_images and (self._image_end is None or self._image_end < stamp_ns):
            return False
        info, label = self.roles.info_of.get(frame.header.topic), self.roles.label_of.get(frame.header.topic)
        if isinstance(frame, LidarFrame) or (info is not None and info not in self._cameras):
            return isinstance(frame, LidarFrame)
        return label is None or bool(self._labels.get(label)) and self._labels[label][-1].header.stamp_ns >= stamp_ns

    # -- one frame -----------------------------------------------------------------------------------------------------------------

    def _cloud(self, frame: LidarFrame | DepthFrame | ImageFrame) -> PosedCloud | None:
        base, header = self._base, frame.header
        base_T_sensor = None if base is None else base.base_T(self._tree, header.frame_id, header.stamp_ns)
        if base is None or base_T_sensor is None:
            return self._drop(frame, "no transform")
        pose = None if base.pose_frame is None else self._track.at(header.stamp_ns)
        if base.pose_frame is not None and pose is None:
            return self._drop(frame, "no pose")
        label = None
        if isinstance(frame, LidarFrame):
            poses_at = None if pose is None else self._track.at_many
            limits = {"min_range": self.min_range, "max_range": self.max_range}
            points, label, is_deskewed = sweep_in_base(frame, base_T_sensor, poses_at, **limits)
            self._deskewed += is_deskewed
        else:
            found = self._unproject(frame)
            if found is None:
                return None
            points = geometry.apply(base_T_sensor, found[0]).astype(np.float32)
            label = found[1]
        if not len(points):
            return self._drop(frame, "no points")
        self._sensors[header.frame_id] = base_T_sensor
        self._used[header.topic] += 1
        return PosedCloud(header, points, base_T_sensor[:3, 3].astype(np.float32), pose, label)

    def _unproject(self, frame: DepthFrame | ImageFrame) -> tuple[NDArray[np.float32], NDArray[np.uint32] | None] | None:
        topic = frame.header.topic
        depth = depth_metres(frame)
        if depth is None:
            return self._drop(frame, "no depth")
        camera = self._cameras.get(self.roles.info_of.get(topic, ""))
        if camera is None:
            return self._drop(frame, "no calibration")
        known = self._unprojectors.get(topic)
        if known is None or not _same_calibration(known[0], camera):
            try:
                unprojector: Unprojector | None = Unprojector(
                    camera, *depth.shape, rectified="rect" in topic.rpartition("/")[2], stride=self.stride
                )
            except LogError as error:
                self._lost.setdefault(str(error))
                unprojector = None
            known = self._unprojectors[topic] = (camera, unprojector)
        if known[1] is None:
            return self._drop(frame, "unusable calibration")
        points, pixels = known[1].points(depth, self.min_range, self.max_range)
        label = self._label_image(frame, depth.shape)
        return points, None if label is None else label.reshape(-1)[pixels]

    def _label_image(self, frame: DepthFrame | ImageFrame, shape: tuple[int, ...]) -> NDArray[np.uint32] | None:
        candidates = self._labels.get(self.roles.label_of.get(frame.header.topic, ""))
        if not candidates:
            return None
        nearest = min(candidates, key=lambda c: abs(c.header.stamp_ns - frame.header.stamp_ns))
        if abs(nearest.header.stamp_ns - frame.header.stamp_ns) > LABEL_TOLERANCE_NS:
            return None
        ids = label_ids(nearest)
        if ids is None or ids.shape != shape:
            self._notes.setdefault(
                f"{nearest.header.topic} is not used: it is no picture of ids of the same size as {frame.header.topic}; "
                f"--topic label_image=TOPIC names another."
            )
            return None
        return ids
