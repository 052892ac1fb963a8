"""What is in a log, at a glance: streams and their roles, calibration, pose coverage, problems.

Counts and times come from the index of the log. Poses and transforms are decoded, all of a small
log and a sample of a large one (see :mod:`~semloc_logs.logs.inspection.excerpt`); clouds and
pictures stay undecoded, apart from the first of each range sensor, whose frame decides the base
frame.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

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
from semloc_logs.logs.inspection.excerpt import Excerpt
from semloc_logs.logs.inspection.obstacles import Seen, obstacles_of
from semloc_logs.logs.inspection.verdict import (
    Command,
    Look,
    far_range,
    travelled,
    verdict_of,
)
from semloc_logs.logs.log import Log, Message, Stream
from semloc_logs.logs.messages.decode import Decoder
from semloc_logs.logs.messages.definitions import UndecodableError, parser
from semloc_logs.logs.messages.topic_clocks import TopicClocks
from semloc_logs.logs.poses.base_frame import BasePoses
from semloc_logs.logs.poses.mountings import Mountings
from semloc_logs.logs.poses.navsat import navsat_poses
from semloc_logs.logs.problems import (
    NoCloud,
    Problem,
    ProblemKind,
    Problems,
    sentences,
    sorted_problems,
    to_report,
    without_loss_of,
)
from semloc_logs.logs.roles import guess_roles
from semloc_logs.logs.sensors.camera_clouds import CameraClouds
from semloc_logs.logs.session.frame_queue import RangeFrame
from semloc_logs.logs.session.reading import reading_of
from semloc_logs.logs.session.stamp_offsets import StampOffsets, stamp_problems
from semloc_logs.settings import Logs

_TRIES = 5  # messages of a range sensor that are decoded in search of a good one
# moving transforms wait so long for the first frames of all sensors and for an edge below odom; the
# tree remembers twice as much
_TF_PATIENCE_NS = 30_000_000_000

_NEAREST = 0.3  # m; a stereo pair is searched for points between these ranges
_FARTHEST = 80.0


def inspect_log(
    path: str | Path,
    topics: Mapping[str, str] | None = None,
    *,
    full: bool = False,
    logs: Logs | None = None,
) -> dict[str, object]:
    """The object that ``semloc inspect --json`` prints for one log; ``topics`` overrules roles.

    ``logs``: the settings of reading, as they would be for fusing.

    Keys: ``path``, ``format``, ``encoding``, ``size_bytes``, ``start_ns``, ``end_ns``,
    ``duration_s``, ``streams`` (topic, type, role, count of readable messages, rate_hz),
    ``problems`` (sentences), ``skipped`` (the ones about lost data and assumptions),
    ``base_frame``, ``session_frame``, ``poses``, ``cameras``, ``sensors``, ``pictures``,
    ``frames`` (of the TF tree), ``transforms`` (its edges), ``labels``, ``complete`` (all messages
    were read: a small log, or ``full``), ``unknown`` (what only ``full`` tells), ``stamps`` (as in
    session.json), ``verdict``, the command ``suggested`` and the ``voxel_size`` (m) that suits the
    log. LogError for a file that is not a log, RoleError when an override is impossible.
    """
    settings = logs or Logs()
    log = open_log(path, settings.memory)
    try:
        return _Inspection(log, topics, settings, full=full).to_json()
    finally:
        log.close()


def refused_log(path: str | Path, reason: str) -> dict[str, object]:
    """The object of a log that :func:`inspect_log` refused for this ``reason``."""
    return {
        "path": str(path),
        "format": "",
        "start_ns": None,
        "end_ns": None,
        "streams": [],
        "problems": [reason],
        "skipped": [reason],
        "verdict": f"not ready: {reason}",
    }


class _Inspection:
    def __init__(
        self, log: Log, topics: Mapping[str, str] | None, settings: Logs, *, full: bool
    ) -> None:
        self._log = log
        self._settings = settings
        self._command = Command(str(log.path), topics or {}, settings)
        self._roles = guess_roles(log.streams, topics)
        navsat = navsat_poses(self._roles, log.streams)
        named = navsat if self._roles.pose is not None else None
        static_count = sum(s.count for s in log.streams if s.topic in self._roles.tf_static)
        mountings = Mountings(given=settings.mountings)
        self._poses = BasePoses(self._roles, static_count, named, navsat, mountings)
        self._has_fixes = navsat is not None
        self._cameras: dict[str, Camera] = {}
        self._first: dict[str, RangeFrame] = {}
        self._counts: Counter[tuple[str, str, str]] = Counter()
        self._empty: Counter[str] = Counter()
        self._tries: Counter[str] = Counter()
        self._undecodable = Problems()
        self._decoder = Decoder(self._undecodable)
        reading = reading_of(settings, self._roles, log.streams, log.path.name)
        self._clocks = TopicClocks(reading)
        self._stamp_offsets = StampOffsets(reading.offset_ns)
        self._facts: dict[str, dict[str, object]] = {}
        self._ranging = {*self._roles.ranging, *self._roles.topics("stereo_right")}
        self._pictures = {
            *self._roles.image,
            *self._roles.label_image,
            *self._roles.depth,
            *self._roles.topics("stereo_left"),
            *self._roles.topics("stereo_right"),
        }
        self._first_tf_ns: int | None = None
        self._small, self._missing = self._wanted()
        self._excerpt = Excerpt(log, self._small, self._missing, full=full)
        self._read()

        # the right camera of a pair does not decide the base frame
        right = self._first.pop(self._roles.stereo_right or "", None)
        self._right = right if isinstance(right, ImageFrame) else None
        if self._poses.base is None:
            self._poses.settle(self._sensor_frames(), is_patient=False, must=True)
        self._poses.finish()

    def _wanted(self) -> tuple[set[str], set[str]]:
        """The topics with poses and moving transforms, and those whose first messages are needed.

        All static transforms count as first messages.
        """
        roles = self._roles
        small = {*roles.tf, *roles.topics("pose")} - {*roles.tf_static}
        if self._has_fixes:
            small |= {*roles.topics("gnss"), *roles.topics("imu")}
        first = {
            *roles.tf_static,
            *roles.camera_info,
            *roles.ranging,
            *roles.topics("stereo_right"),
            *roles.topics("imu"),
            *self._pictures,
        }
        recorded = {s.topic for s in self._log.streams if s.count}
        return small, (first & recorded) - small

    def _sensor_frames(self) -> list[str]:
        right = self._roles.stereo_right
        frames = (frame for topic, frame in self._first.items() if topic != right)
        return list(dict.fromkeys(frame.header.frame_id for frame in frames))

    def _read(self) -> None:
        """Counts messages, and decodes the ones that the inspection needs."""
        roles = self._roles
        static_left = sum(s.count for s in self._log.streams if s.topic in roles.tf_static)
        always = {*self._small, *roles.tf_static}
        if self._excerpt.is_complete:
            always |= {*roles.camera_info}
        for message in self._excerpt.messages():
            topic = message.topic
            self._counts[topic, message.type, message.encoding] += 1
            if topic in always:
                self._decode(message)
            elif topic in self._missing:
                self._look_at(message)
            if topic in roles.tf_static:
                static_left -= 1
                if static_left <= 0:
                    self._missing.difference_update(roles.tf_static)
            if topic in roles.tf and self._poses.base is None:
                self._follow_transforms(message.log_time_ns)

    def _look_at(self, message: Message) -> None:
        """Takes the first good message of a sensor; the others are not decoded."""
        topic = message.topic
        if topic in self._pictures:
            self._facts.setdefault(topic, _picture_facts(message))
        if topic in self._pictures and topic not in self._ranging:
            self._missing.discard(topic)
            return
        self._tries[topic] += 1
        frames = self._decode(message)
        is_good = topic in self._first if topic in self._ranging else bool(frames)
        if is_good or self._tries[topic] >= _TRIES:
            self._missing.discard(topic)

    def _follow_transforms(self, log_time_ns: int) -> None:
        """Chooses the base frame of poses in TF before the tree forgets the oldest of them."""
        roles = self._roles
        if roles.pose not in (None, *roles.tf) or self._poses.source is not None:
            return
        if self._first_tf_ns is None:
            self._first_tf_ns = log_time_ns
        waited_ns = log_time_ns - self._first_tf_ns
        sensors = self._sensor_frames()
        has_all = not self._missing & {*roles.ranging}
        if not has_all and waited_ns < _TF_PATIENCE_NS:
            return
        frames = (*sensors, "base_link", "base_footprint")
        if any(self._poses.tree.pose_edge(frame) for frame in frames):
            must = waited_ns > _TF_PATIENCE_NS
            self._poses.settle(sensors, is_patient=not must, must=must)

    def _decode(self, message: Message) -> list[Frame]:
        frames = list(self._clocks.frames(self._decoder, message))
        for frame in frames:
            self._stamp_offsets.take(frame)
            self._take(frame)
        return frames

    def _take(self, frame: Frame) -> None:
        if isinstance(frame, TransformSample | PoseSample):
            self._poses.take(frame)
        elif isinstance(frame, Camera):
            self._cameras.setdefault(frame.header.topic, frame)
        elif isinstance(frame, ImuSample | NavSatSample):
            self._poses.take_measurement(frame)
        elif isinstance(frame, LidarFrame) and not len(frame.points):
            self._empty[frame.header.topic] += 1
        elif isinstance(frame, RangeFrame):
            self._first[frame.header.topic] = frame

    def to_json(self) -> dict[str, object]:
        """The object of :func:`inspect_log`."""
        log = self._log
        base = self._poses.base
        obstacles = obstacles_of(self._seen())
        problems = self._problems(obstacles)
        verdict = verdict_of(self._look(), problems, is_reported=bool(to_report(problems)))
        return {
            "path": str(log.path),
            "format": log.format,
            "encoding": log.encoding,
            "size_bytes": _size_bytes(log.path),
            "start_ns": log.start_ns,
            "end_ns": log.end_ns,
            "duration_s": _duration_s(log),
            "streams": [
                {
                    "topic": s.topic,
                    "type": s.type,
                    "role": self._roles.role_of_stream(s),
                    "count": self._count(s),
                    "rate_hz": self._rate(s),
                }
                for s in log.streams
            ],
            "problems": sentences(problems),
            "skipped": sentences(to_report(problems)),
            "base_frame": base.name if base else "",
            "session_frame": self._poses.session_frame,
            "stamps": self._stamp_offsets.to_json(),
            "poses": self._track(),
            "cameras": {topic: _camera(camera) for topic, camera in sorted(self._cameras.items())},
            "sensors": {topic: self._sensor(frame) for topic, frame in sorted(self._first.items())},
            "pictures": {
                topic: facts
                for topic, facts in sorted(self._facts.items())
                if topic not in self._first
            },
            "frames": self._poses.tree.frames,
            "transforms": [
                {"parent": parent, "child": child, "static": is_static}
                for parent, child, is_static in self._poses.tree.edges
            ],
            "labels": self._labels(),
            "complete": self._excerpt.is_complete,
            "unknown": self._unknown(),
            "verdict": verdict.text,
            "suggested": verdict.suggested,
            "voxel_size": verdict.voxel_size,
        }

    def _count(self, stream: Stream) -> int:
        """Messages of a stream: the ones that were read, or else as the index claims."""
        if self._excerpt.is_complete:
            return self._counts[stream.topic, stream.type, stream.encoding]
        return stream.count

    def _rate(self, stream: Stream) -> float | None:
        """Messages a second over the log; None where that has no meaning."""
        seconds = _duration_s(self._log)
        count = self._count(stream)
        if count < 2 or seconds <= 0.0 or stream.topic in self._roles.tf_static:
            return None
        return round((count - 1) / seconds, 3)

    def _track(self) -> dict[str, object]:
        """The poses in numbers; without gaps and faults where only a sample is known."""
        track = self._poses.track
        content = track.to_json()
        if not self._excerpt.is_complete:
            unknown = ("gaps", "duplicates", "backwards", "invalid", "ahead")
            length = travelled(track, is_complete=False)
            content |= dict.fromkeys(unknown) | {"length_m": round(length, 3)}
        corners = track.poses[:, :3, 3]
        extent = (corners.max(axis=0) - corners.min(axis=0)).round(3) if len(track) else None
        return content | {"extent_m": None if extent is None else extent.tolist()}

    def _labels(self) -> str:
        """Where labels come from by default: ``cloud``, ``images`` or ``geometry``."""
        if any(isinstance(f, LidarFrame) and f.label is not None for f in self._first.values()):
            return "cloud"
        return "images" if self._roles.label_of else "geometry"

    def _unknown(self) -> list[str]:
        """What only reading all messages tells."""
        if self._excerpt.is_complete:
            return []
        unknown = [
            "damaged messages, and messages that cannot be decoded",
            "gaps and faults of the poses, and the whole way that was travelled",
            "whether the track comes back to a place",
        ]
        late = sorted(self._missing & self._ranging)
        return unknown + [f"the first message of {topic}, recorded late" for topic in late]

    def _look(self) -> Look:
        late = set() if self._excerpt.is_complete else self._missing
        return Look(
            self._command,
            self._roles,
            [replace(s, count=self._count(s)) for s in self._log.streams],
            {s.topic: self._rate(s) for s in self._log.streams},
            {topic: self._range(topic) for topic in self._first},
            frozenset({*self._first, *late}),
            self._labels(),
            self._poses.track,
            self._excerpt.is_complete,
        )

    def _range(self, topic: str) -> float | None:
        frame = self._first.get(topic)
        if isinstance(frame, LidarFrame):
            return far_range(np.linalg.norm(frame.points, axis=1))
        if isinstance(frame, DepthFrame):
            return far_range(frame.depth[np.isfinite(frame.depth) & (frame.depth > 0)])
        return self._stereo_range() if isinstance(frame, ImageFrame) else None

    def _stereo_range(self) -> float | None:
        """The range of the points that the first pictures of the pair give."""
        left = self._first.get(self._roles.stereo_left or "")
        if not isinstance(left, ImageFrame) or self._right is None:
            return None
        clouds = CameraClouds(self._roles, self._poses.tree.lookup)
        clouds.calibrations.update(self._cameras)
        clouds.take(left)
        clouds.take(self._right)
        seen = clouds.points(left, _NEAREST, _FARTHEST)
        return None if isinstance(seen, NoCloud) else far_range(np.linalg.norm(seen.points, axis=1))

    # -- problems

    def _seen(self) -> Seen:
        return Seen(
            self._log.path.name,
            [replace(s, count=self._count(s)) for s in self._log.streams],
            self._roles,
            self._poses,
            self._cameras,
            self._first,
            self._right,
            self._empty,
            depth_unit=self._settings.depth_unit,
            is_complete=self._excerpt.is_complete,
        )

    def _problems(self, obstacles: Sequence[Problem]) -> list[Problem]:
        unused = {s.topic for s in self._log.streams if self._roles.role_of(s.topic) is None}
        base = self._poses.base
        return sorted_problems(
            [
                *obstacles,
                *without_loss_of(unused, self._log.problems),
                *self._undecodable,
                *self._unreadable(),
                *self._roles.notes,
                *self._poses.problems,
                *stamp_problems(self._stamp_offsets, self._roles, self._poses),
                *(base.problems if base else ()),
            ]
        )

    def _unreadable(self) -> Iterator[Problem]:
        """Streams with fewer messages than the log counts."""
        if not self._excerpt.is_complete:
            return
        for s in self._log.streams:
            count = self._counts[s.topic, s.type, s.encoding]
            if count < s.count:
                text = (
                    f"{s.topic}: only {count} of {s.count} messages can be read; "
                    f"the others are lost."
                )
                yield Problem(s.topic, ProblemKind.MESSAGE, text, lost=True)

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
                "range_m": _rounded(self._range(frame.header.topic)),
            }
        height, width = (frame.depth if isinstance(frame, DepthFrame) else frame.image).shape[:2]
        encoding = self._facts.get(frame.header.topic, {}).get("encoding", "")
        far = _rounded(self._range(frame.header.topic))
        return content | {"width": width, "height": height, "encoding": encoding, "range_m": far}


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 2)


def _size_bytes(path: Path) -> int:
    """Bytes of the file, or of the files in the folder."""
    try:
        files = [p for p in path.iterdir() if p.is_file()] if path.is_dir() else [path]
        return sum(p.stat().st_size for p in files)
    except OSError:
        return 0


def _picture_facts(message: Message) -> dict[str, object]:
    """Size and encoding of a picture, which is not decoded for it; a compressed one has no size."""
    try:
        fields = parser(message.encoding, message.type, message.definition)(message.data)
    except UndecodableError:
        return {}
    encoding = getattr(fields, "encoding", None) or getattr(fields, "format", None) or ""
    facts: dict[str, object] = {"encoding": str(encoding)}
    width = getattr(fields, "width", None)
    height = getattr(fields, "height", None)
    if isinstance(width, int) and isinstance(height, int):
        facts |= {"width": width, "height": height}
    return facts


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
