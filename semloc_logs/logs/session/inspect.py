"""What is in a log, at a glance: streams and their roles, calibration, pose coverage, and what
stands in the way of using it.

One pass counts all messages and decodes the small ones (poses, transforms, calibrations). Clouds
and pictures stay undecoded, apart from the first of each range sensor, whose frame decides the base
frame.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
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
from semloc_logs.logs.poses.base_frame import BasePoses
from semloc_logs.logs.poses.navsat import navsat_poses
from semloc_logs.logs.problems import Problems
from semloc_logs.logs.roles import guess_roles, no_sensor
from semloc_logs.logs.sensors.depth import Unprojector
from semloc_logs.logs.sensors.rectification import rectification
from semloc_logs.logs.sensors.stereo_pairs import is_rectified
from semloc_logs.logs.session.tally import never_moves, no_poses, span, without_unused

_TRIES = 5  # messages of a range sensor that are decoded in search of a good one
# a sensor that starts so far outside of the poses has another clock
_OTHER_CLOCK_NS = 60_000_000_000


def inspect_log(path: str | Path, topics: Mapping[str, str] | None = None) -> dict[str, object]:
    """The answer of ``semloc inspect --json`` for one log; ``topics`` overrules roles.

    Keys: ``path``, ``format``, ``encoding``, ``start_ns``, ``end_ns``, ``duration_s``, ``streams``
    (topic, type, role, count as found), ``problems`` (sentences), ``skipped`` (those of them that
    are about lost data), ``base_frame``, ``session_frame``, ``poses``, ``cameras``, ``sensors``,
    ``frames`` (of the TF tree). LogError when it is no log, RoleError when an override is
    impossible.
    """
    log = open_log(path)
    try:
        return _Inspection(log, topics).to_json()
    finally:
        log.close()


class _Inspection:
    def __init__(self, log: Log, topics: Mapping[str, str] | None) -> None:
        self.log = log
        self.roles = guess_roles(log.streams, topics)
        navsat = navsat_poses(self.roles, log.streams)
        self.where = BasePoses(
            self.roles, 0, navsat if self.roles.pose is not None else None, navsat
        )
        self._makes_poses = navsat is not None
        self.cameras: dict[str, Camera] = {}
        self.first: dict[str, LidarFrame | DepthFrame | ImageFrame] = {}
        self.counts: Counter[tuple[str, str, str]] = Counter()
        self.empty: Counter[str] = Counter()
        self.imu_frame: str | None = None
        self._tries: Counter[str] = Counter()
        self._undecodable = Problems()
        self._decoder = Decoder(self._undecodable)
        self._pass()
        # says nothing about the base frame
        right = self.first.pop(self.roles.stereo_right or "", None)
        self.right = right if isinstance(right, ImageFrame) else None
        sensors = list(dict.fromkeys(frame.header.frame_id for frame in self.first.values()))
        self.where.settle(sensors, is_patient=False, must=True)
        self.where.finish()

    def _pass(self) -> None:
        roles = self.roles
        small = {*roles.tf, *roles.tf_static, *roles.camera_info, *roles.topics("pose")}
        if self._makes_poses:
            small |= {*roles.topics("gnss"), *roles.topics("imu")}
        ranged = {*roles.ranging, *roles.topics("stereo_right")}
        for message in self.log.messages():
            topic = message.topic
            self.counts[topic, message.type, message.encoding] += 1
            if (
                topic in small
                or (topic in ranged and topic not in self.first)
                or (topic == roles.imu and self.imu_frame is None)
            ):
                self._look_at(message, is_large=topic in ranged)

    def _look_at(self, message: Message, *, is_large: bool) -> None:
        if is_large:
            self._tries[message.topic] += 1
            if self._tries[message.topic] > _TRIES:
                return
        for frame in self._decoder.frames(message):
            self._take(frame)

    def _take(self, frame: Frame) -> None:
        if isinstance(frame, TransformSample | PoseSample):
            self.where.take(frame)
        elif isinstance(frame, Camera):
            self.cameras.setdefault(frame.header.topic, frame)
        elif isinstance(frame, ImuSample | NavSatSample):
            if isinstance(frame, ImuSample):
                self.imu_frame = frame.header.frame_id
            self.where.show(frame)
        elif isinstance(frame, LidarFrame) and not len(frame.points):
            self.empty[frame.header.topic] += 1
        elif isinstance(frame, LidarFrame | DepthFrame | ImageFrame):
            self.first[frame.header.topic] = frame

    def to_json(self) -> dict[str, object]:
        log = self.log
        base = self.where.base
        is_timed = log.start_ns is not None and log.end_ns is not None
        streams = [
            {
                "topic": s.topic,
                "type": s.type,
                "role": self.roles.role_of(s.topic),
                "count": self.counts[s.topic, s.type, s.encoding],
            }
            for s in log.streams
        ]
        return {
            "path": str(log.path),
            "format": log.format,
            "encoding": log.encoding,
            "start_ns": log.start_ns,
            "end_ns": log.end_ns,
            "duration_s": round(((log.end_ns or 0) - (log.start_ns or 0)) * 1e-9, 3)
            if is_timed
            else 0.0,
            "streams": streams,
            "problems": list(
                dict.fromkeys(
                    [
                        *self._skipped(),
                        *self._obstacles(),
                        *log.problems,
                        *self.roles.notes,
                        *(base.notes if base else ()),
                    ]
                )
            ),
            "skipped": self._skipped(),
            "base_frame": base.name if base else "",
            "session_frame": self.where.session_frame,
            "poses": self.where.track.to_json(),
            "cameras": {topic: _camera(camera) for topic, camera in sorted(self.cameras.items())},
            "sensors": {topic: self._sensor(frame) for topic, frame in sorted(self.first.items())},
            "frames": self.where.tree.frames,
        }

    def _skipped(self) -> list[str]:
        unused = {s.topic for s in self.log.streams if self.roles.role_of(s.topic) is None}
        skipped = [*without_unused(self.log.problems, unused), *self._undecodable.sentences()]
        for s in self.log.streams:
            found = self.counts[s.topic, s.type, s.encoding]
            if found < s.count:
                skipped.append(
                    f"{s.topic}: only {found} of {s.count} messages can be read; what the others held is lost."
                )
        return list(dict.fromkeys(skipped))

    def _obstacles(self) -> list[str]:
        """What keeps the log from being fused, or only part of it."""
        roles = self.roles
        told = list(self.roles.problems)
        if not self.counts:
            return [f"{self.log.path.name} holds no messages."]
        if not roles.ranging:
            told.append(no_sensor(self.log.streams))
        if not len(self.where.track) and not roles.problems:
            told.append(no_poses(self.log.path.name))
        for topic, count in sorted(self.empty.items()):
            told.append(
                f"{topic}: no point with a position in the first {count} cloud{'s' if count > 1 else ''}."
            )
        for topic in roles.depth:
            told.extend(self._depth_obstacles(topic))
        told.extend(self._stereo_obstacles())
        told.extend(self._pose_obstacles())
        return told

    def _depth_obstacles(self, topic: str) -> list[str]:
        info = self.roles.info_of.get(topic)
        frame = self.first.get(topic)
        if info is None or info not in self.cameras:
            return [
                f"{topic} has no CameraInfo: it cannot become points; record it, or name it with --topic camera_info=TOPIC."
            ]
        if isinstance(frame, DepthFrame):
            try:
                Unprojector(self.cameras[info], *frame.depth.shape, rectified="rect" in topic)
            except LogError as error:
                return [str(error)]
        return []

    def _stereo_obstacles(self) -> list[str]:
        roles = self.roles
        if roles.stereo_left is None or roles.stereo_right is None:
            return []
        pair = (roles.stereo_left, roles.stereo_right)
        cameras = {topic: self.cameras.get(roles.info_of.get(topic, "")) for topic in pair}
        told = [
            f"{topic} has no CameraInfo: the pair cannot become points; record it, or name both with --topic camera_info=TOPIC,TOPIC."
            for topic, camera in cameras.items()
            if camera is None
        ]
        left, (left_camera, right_camera) = self.first.get(pair[0]), cameras.values()
        if (
            left_camera is None
            or right_camera is None
            or not isinstance(left, ImageFrame)
            or self.right is None
        ):
            return told
        if left.image.shape[:2] != self.right.image.shape[:2]:
            sizes = " and ".join(
                f"{i.shape[1]} x {i.shape[0]}" for i in (left.image, self.right.image)
            )
            return [
                f"{pair[0]}, {pair[1]} have pictures of {sizes} pixels: a stereo pair needs the same size."
            ]
        right_T_left = self.where.tree.lookup(
            self.right.header.frame_id, left.header.frame_id, left.header.stamp_ns
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
            told.append(str(error))
        return told

    def _pose_obstacles(self) -> list[str]:
        track = self.where.track
        base = self.where.base
        source = self.where.source
        told = [*source.problems, *source.notes] if source else []
        told += never_moves(source.name if source else self.roles.pose or "TF", track)
        if gaps := track.gaps():
            longest = max(gaps, key=lambda gap: gap[1] - gap[0])
            count = "a gap" if len(gaps) == 1 else f"{len(gaps)} gaps, the longest"
            told.append(
                f"The poses have {count} from {span(*longest)}: frames in it get no pose and are left out."
            )
        for topic, frame in self.first.items():
            stamp_ns = frame.header.stamp_ns
            frame_id = frame.header.frame_id
            if (
                base is not None
                and not self.where.tree.connected(base.name, frame_id)
                and base.assumed != frame_id.lstrip("/")
            ):
                told.append(
                    f"No transform leads from '{frame_id}', the frame of {topic}, to the base frame '{base.name}': "
                    f"its frames are left out; record /tf_static."
                )
            start_ns = track.start_ns
            end_ns = track.end_ns
            if (
                start_ns is not None
                and end_ns is not None
                and not start_ns - _OTHER_CLOCK_NS < stamp_ns < end_ns + _OTHER_CLOCK_NS
            ):
                told.append(
                    f"{topic} starts at {span(stamp_ns, stamp_ns)} but the poses cover {span(start_ns, end_ns)}: "
                    f"their header stamps come from different clocks; record both with the same."
                )
        return told

    def _sensor(self, frame: LidarFrame | DepthFrame | ImageFrame) -> dict[str, object]:
        base_T_sensor = self.where.base_T(frame.header.frame_id, frame.header.stamp_ns)
        told: dict[str, object] = {
            "frame_id": frame.header.frame_id,
            "base_T_sensor": None if base_T_sensor is None else base_T_sensor.tolist(),
        }
        if isinstance(frame, LidarFrame):
            return told | {
                "points": len(frame.points),
                "labels": frame.label is not None,
                "point_times": frame.offset_ns is not None,
            }
        height, width = (frame.depth if isinstance(frame, DepthFrame) else frame.image).shape[:2]
        return told | {"width": width, "height": height}


def _camera(camera: Camera) -> dict[str, object]:
    return {
        "frame_id": camera.header.frame_id,
        "width": camera.width,
        "height": camera.height,
        "K": camera.K.tolist(),
        "D": camera.D.tolist(),
        "model": camera.model,
    }
