"""What is in a log, at a glance: streams and their roles, calibration, pose coverage, problems.

One pass counts all messages and decodes the small ones (poses, transforms, calibrations). Clouds
and pictures stay undecoded, apart from the first of each range sensor, whose frame decides the base
frame.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from semloc_logs.errors import LogError
from semloc_logs.frames import (
    Camera,
    DepthFrame,
    Frame,
    ImageFrame,
    ImuSample,
    LidarFrame,
    NavSatSample,
    PoseSample,
    TransformSample,
)
from semloc_logs.logs.containers.open import open_log
from semloc_logs.logs.log import Log, Message
from semloc_logs.logs.messages.decode import Decoder
from semloc_logs.logs.messages.stamps import time_range, utc
from semloc_logs.logs.poses.base_frame import BasePoses
from semloc_logs.logs.poses.navsat import navsat_poses
from semloc_logs.logs.problems import (
    Problem,
    ProblemKind,
    Problems,
    sentences,
    sorted_problems,
    to_report,
    without_loss_of,
)
from semloc_logs.logs.role_types import no_sensor
from semloc_logs.logs.roles import guess_roles
from semloc_logs.logs.sensors.depth import Unprojector
from semloc_logs.logs.sensors.rectification import rectification
from semloc_logs.logs.sensors.stereo_pairs import is_rectified
from semloc_logs.logs.session.frame_queue import RangeFrame
from semloc_logs.logs.session.pose_problems import never_moves, no_poses

_TRIES = 5  # messages of a range sensor that are decoded in search of a good one
# a sensor that starts so far outside of the poses has another clock
_OTHER_CLOCK_NS = 60_000_000_000


def inspect_log(path: str | Path, topics: Mapping[str, str] | None = None) -> dict[str, object]:
    """The object that ``semloc inspect --json`` prints for one log; ``topics`` overrules roles.

    Keys: ``path``, ``format``, ``encoding``, ``start_ns``, ``end_ns``, ``duration_s``, ``streams``
    (topic, type, role, count of readable messages), ``problems`` (sentences), ``skipped`` (the ones
    about lost data), ``base_frame``, ``session_frame``, ``poses``, ``cameras``, ``sensors``,
    ``frames`` (of the TF tree). LogError for a file that is not a log, RoleError when an override
    is impossible.
    """
    log = open_log(path)
    try:
        return _Inspection(log, topics).to_json()
    finally:
        log.close()


class _Inspection:
    def __init__(self, log: Log, topics: Mapping[str, str] | None) -> None:
        self._log = log
        self._roles = guess_roles(log.streams, topics)
        navsat = navsat_poses(self._roles, log.streams)
        named = navsat if self._roles.pose is not None else None
        self._poses = BasePoses(self._roles, 0, named, navsat)
        self._has_fixes = navsat is not None
        self._cameras: dict[str, Camera] = {}
        self._first: dict[str, RangeFrame] = {}
        self._counts: Counter[tuple[str, str, str]] = Counter()
        self._empty: Counter[str] = Counter()
        self._imu_frame: str | None = None
        self._tries: Counter[str] = Counter()
        self._undecodable = Problems()
        self._decoder = Decoder(self._undecodable)
        self._read()

        # the right camera of a pair does not decide the base frame
        right = self._first.pop(self._roles.stereo_right or "", None)
        self._right = right if isinstance(right, ImageFrame) else None
        sensors = list(dict.fromkeys(frame.header.frame_id for frame in self._first.values()))
        self._poses.settle(sensors, is_patient=False, must=True)
        self._poses.finish()

    def _read(self) -> None:
        """Counts all messages, and decodes the ones that the inspection needs."""
        roles = self._roles
        small = {*roles.tf, *roles.tf_static, *roles.camera_info, *roles.topics("pose")}
        if self._has_fixes:
            small |= {*roles.topics("gnss"), *roles.topics("imu")}
        ranging = {*roles.ranging, *roles.topics("stereo_right")}
        for message in self._log.messages():
            topic = message.topic
            self._counts[topic, message.type, message.encoding] += 1
            if (
                topic in small
                or (topic in ranging and topic not in self._first)
                or (topic == roles.imu and self._imu_frame is None)
            ):
                self._decode(message, is_large=topic in ranging)

    def _decode(self, message: Message, *, is_large: bool) -> None:
        if is_large:
            self._tries[message.topic] += 1
            if self._tries[message.topic] > _TRIES:
                return
        for frame in self._decoder.frames(message):
            self._take(frame)

    def _take(self, frame: Frame) -> None:
        if isinstance(frame, TransformSample | PoseSample):
            self._poses.take(frame)
        elif isinstance(frame, Camera):
            self._cameras.setdefault(frame.header.topic, frame)
        elif isinstance(frame, ImuSample | NavSatSample):
            if isinstance(frame, ImuSample):
                self._imu_frame = frame.header.frame_id
            self._poses.take_measurement(frame)
        elif isinstance(frame, LidarFrame) and not len(frame.points):
            self._empty[frame.header.topic] += 1
        elif isinstance(frame, RangeFrame):
            self._first[frame.header.topic] = frame

    def to_json(self) -> dict[str, object]:
        """The object of :func:`inspect_log`."""
        log = self._log
        base = self._poses.base
        problems = self._problems()
        return {
            "path": str(log.path),
            "format": log.format,
            "encoding": log.encoding,
            "start_ns": log.start_ns,
            "end_ns": log.end_ns,
            "duration_s": _duration_s(log),
            "streams": [
                {
                    "topic": s.topic,
                    "type": s.type,
                    "role": self._roles.role_of(s.topic),
                    "count": self._counts[s.topic, s.type, s.encoding],
                }
                for s in log.streams
            ],
            "problems": sentences(problems),
            "skipped": sentences(to_report(problems)),
            "base_frame": base.name if base else "",
            "session_frame": self._poses.session_frame,
            "poses": self._poses.track.to_json(),
            "cameras": {topic: _camera(camera) for topic, camera in sorted(self._cameras.items())},
            "sensors": {topic: self._sensor(frame) for topic, frame in sorted(self._first.items())},
            "frames": self._poses.tree.frames,
        }

    # -- problems

    def _problems(self) -> list[Problem]:
        unused = {s.topic for s in self._log.streams if self._roles.role_of(s.topic) is None}
        base = self._poses.base
        return sorted_problems(
            [
                *self._obstacles(),
                *without_loss_of(unused, self._log.problems),
                *self._undecodable,
                *self._unreadable(),
                *self._roles.notes,
                *(base.problems if base else ()),
            ]
        )

    def _unreadable(self) -> Iterator[Problem]:
        """Streams with fewer messages than the log counts."""
        for s in self._log.streams:
            count = self._counts[s.topic, s.type, s.encoding]
            if count < s.count:
                text = (
                    f"{s.topic}: only {count} of {s.count} messages can be read; "
                    f"the others are lost."
                )
                yield Problem(s.topic, ProblemKind.MESSAGE, text, lost=True)

    def _obstacles(self) -> list[Problem]:
        """Problems that keep the log, or a part of it, from being fused; nothing is lost yet."""
        roles = self._roles
        if not self._counts:
            return [_obstacle("", ProblemKind.FILE, f"{self._log.path.name} holds no messages.")]
        obstacles = list(roles.problems)
        if not roles.ranging:
            obstacles.append(_obstacle("", ProblemKind.ROLE, no_sensor(self._log.streams)))
        base = self._poses.base
        if base is not None and base.pose_frame is None and not roles.problems:
            obstacles.append(no_poses())
        elif not len(self._poses.track) and not roles.problems:
            text = f"{roles.pose or 'TF'} gave no usable pose."
            obstacles.append(_obstacle(roles.pose or "", ProblemKind.POSE, text))
        for topic, count in sorted(self._empty.items()):
            clouds = f"{count} cloud{'s' if count > 1 else ''}"
            text = f"{topic}: no point with a position in the first {clouds}."
            obstacles.append(_obstacle(topic, ProblemKind.FRAME, text))
        for topic in roles.depth:
            obstacles += self._depth_obstacles(topic)
        obstacles += self._stereo_obstacles()
        obstacles += self._pose_obstacles()
        for topic, frame in self._first.items():
            obstacles += self._sensor_obstacles(topic, frame)
        return obstacles

    def _depth_obstacles(self, topic: str) -> Iterator[Problem]:
        info = self._roles.info_of.get(topic)
        frame = self._first.get(topic)
        if info is None or info not in self._cameras:
            text = (
                f"{topic} has no CameraInfo: it cannot become points; record it, or name it with "
                f"--topic camera_info=TOPIC."
            )
            yield _obstacle(topic, ProblemKind.CALIBRATION, text)
        elif isinstance(frame, DepthFrame):
            try:
                Unprojector(self._cameras[info], *frame.depth.shape, rectified="rect" in topic)
            except LogError as error:
                yield _obstacle(topic, ProblemKind.CALIBRATION, str(error))

    def _stereo_obstacles(self) -> list[Problem]:
        roles = self._roles
        if roles.stereo_left is None or roles.stereo_right is None:
            return []
        pair = (roles.stereo_left, roles.stereo_right)
        left_camera, right_camera = (self._cameras.get(roles.info_of.get(t, "")) for t in pair)
        obstacles = [
            _obstacle(
                topic,
                ProblemKind.CALIBRATION,
                f"{topic} has no CameraInfo: the pair cannot become points; record it, or name "
                f"both with --topic camera_info=TOPIC,TOPIC.",
            )
            for topic, camera in zip(pair, (left_camera, right_camera), strict=True)
            if camera is None
        ]
        left = self._first.get(pair[0])
        right = self._right
        if left_camera is None or right_camera is None:
            return obstacles
        if not isinstance(left, ImageFrame) or right is None:
            return obstacles

        if left.image.shape[:2] != right.image.shape[:2]:
            sizes = " and ".join(f"{i.shape[1]} x {i.shape[0]}" for i in (left.image, right.image))
            text = (
                f"{pair[0]}, {pair[1]} have pictures of {sizes} pixels: "
                f"a stereo pair needs the same size."
            )
            return [_obstacle(pair[0], ProblemKind.FRAME, text)]
        right_T_left = self._poses.tree.lookup(
            right.header.frame_id, left.header.frame_id, left.header.stamp_ns
        )
        try:
            rectification(
                left_camera,
                right_camera,
                left.image.shape[:2],
                right_T_left,
                rectified=is_rectified(roles),
            )
        except LogError as error:
            obstacles.append(_obstacle(pair[0], ProblemKind.CALIBRATION, str(error)))
        return obstacles

    def _pose_obstacles(self) -> list[Problem]:
        track = self._poses.track
        source = self._poses.source
        obstacles = [replace(p, lost=False) for p in source.problems] if source else []
        name = source.name if source else self._roles.pose or "TF"
        obstacles += never_moves(name, track)
        if gaps := track.gaps():
            longest = max(gaps, key=lambda gap: gap[1] - gap[0])
            count = "a gap" if len(gaps) == 1 else f"{len(gaps)} gaps, the longest"
            text = (
                f"The poses have {count} from {time_range(*longest)}: "
                f"frames in it get no pose and are left out."
            )
            obstacles.append(_obstacle(name, ProblemKind.POSE, text))
        return obstacles

    def _sensor_obstacles(self, topic: str, frame: RangeFrame) -> Iterator[Problem]:
        """A missing transform to the base frame, or another clock than the clock of the poses."""
        track = self._poses.track
        base = self._poses.base
        stamp_ns = frame.header.stamp_ns
        frame_id = frame.header.frame_id
        if (
            base is not None
            and not self._poses.tree.connected(base.name, frame_id)
            and base.assumed != frame_id.lstrip("/")
            and not self._poses.is_fixed(frame_id)
        ):
            text = (
                f"No transform leads from '{frame_id}', the frame of {topic}, to the base frame "
                f"'{base.name}': its frames are left out; record /tf_static."
            )
            yield _obstacle(topic, ProblemKind.TRANSFORM, text)
        start_ns = track.start_ns
        end_ns = track.end_ns
        if start_ns is None or end_ns is None:
            return
        if not start_ns - _OTHER_CLOCK_NS < stamp_ns < end_ns + _OTHER_CLOCK_NS:
            text = (
                f"{topic} starts at {utc(stamp_ns)} but the poses cover "
                f"{time_range(start_ns, end_ns)}: frames without a pose are left out; where the "
                f"clocks differ, give --set logs.time_offset.{topic}=SECONDS."
            )
            yield _obstacle(topic, ProblemKind.POSE, text)

    def _sensor(self, frame: RangeFrame) -> dict[str, object]:
        base_T_sensor = self._poses.base_T(frame.header.frame_id, frame.header.stamp_ns)
        content: dict[str, object] = {
            "frame_id": frame.header.frame_id,
            "base_T_sensor": None if base_T_sensor is None else base_T_sensor.tolist(),
        }
        if isinstance(frame, LidarFrame):
            return content | {
                "points": len(frame.points),
                "labels": frame.label is not None,
                "point_times": frame.offset_ns is not None,
            }
        height, width = (frame.depth if isinstance(frame, DepthFrame) else frame.image).shape[:2]
        return content | {"width": width, "height": height}


def _obstacle(topic: str, kind: ProblemKind, text: str) -> Problem:
    return Problem(topic, kind, text, lost=False)


def _duration_s(log: Log) -> float:
    if log.start_ns is None or log.end_ns is None:
        return 0.0
    return round((log.end_ns - log.start_ns) * 1e-9, 3)


def _camera(camera: Camera) -> dict[str, object]:
    return {
        "frame_id": camera.header.frame_id,
        "width": camera.width,
        "height": camera.height,
        "K": camera.K.tolist(),
        "D": camera.D.tolist(),
        "model": camera.model,
    }
