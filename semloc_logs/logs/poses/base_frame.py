"""The base frame of a log, the vehicle, and its pose at any time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.errors import LogError
from semloc_logs.frames import Frame, Header, PoseSample, TransformSample
from semloc_logs.logs.messages.stamps import utc
from semloc_logs.logs.poses.mountings import NO_MOUNTINGS, Mountings, matrix
from semloc_logs.logs.poses.pose_stream import FEWEST, PoseStream
from semloc_logs.logs.poses.publishers import EdgePublishers
from semloc_logs.logs.poses.tf_tree import Edge, TransformTree, frame_name
from semloc_logs.logs.poses.track import PoseTrack
from semloc_logs.logs.problems import Problem, ProblemKind
from semloc_logs.logs.roles import Roles
from semloc_logs.logs.topic_pairs import shared
from semloc_logs.numerics.transforms import inverse

BASE_LINK = "base_link"
# frames of REP 105, and of LIDAR-inertial odometry, in which the world stands still
_FIXED_FRAMES = {"map", "odom", "world", "earth", "camera_init"}
_VEHICLE_FRAMES = {BASE_LINK, "base_footprint", "base", "body", "vehicle", "ego_vehicle"}
_LATE_TF_NS = 1_000_000_000  # a pose waits so long for the transform that leads to the base frame


@dataclass(frozen=True)
class BaseFrame:
    """``name`` of the base frame; ``pose_frame`` whose pose the stream gives (None without poses).

    ``assumed`` is the one sensor frame that nothing connects with the base and that is therefore
    taken to be the base itself. ``problems`` name the assumptions.
    """

    name: str
    pose_frame: str | None
    assumed: str | None = None
    problems: tuple[Problem, ...] = ()


@dataclass(frozen=True, slots=True)
class PoseTopic:
    """The stream that the poses come from, as far as the base frame depends on it.

    ``child``: the frame that it gives the pose of, "" where it names none, None without poses.
    ``topic``: its name in sentences. ``is_of_sensor``: it stands in the namespace of a range
    sensor, as the output of the sensor's own SLAM does.
    """

    child: str | None
    topic: str
    is_of_sensor: bool = False


def choose_base_frame(
    tree: TransformTree,
    sensors: Sequence[str],
    stream: PoseTopic,
    given: Collection[str] = (),
) -> BaseFrame:
    """The base frame: ``base_link`` where TF connects it with a sensor and the pose.

    Else the frame that the pose belongs to; the sensor's own frame where the pose names none and
    TF has no mounting of the sensor, or without a pose. ``sensors``: frame ids of the range
    sensors, the most important first. ``given``: frames whose mounting in the base frame the user
    gave; it is in the tree already.
    """
    sensors = [frame_name(s) for s in sensors]
    reachable = _has_base_link(tree, sensors)
    first = sensors[0] if sensors else (BASE_LINK if reachable else "")
    if stream.child is None:
        return BaseFrame(BASE_LINK if reachable else first, None)

    child = frame_name(stream.child)
    if not child:
        if first in given or not sensors:
            return BaseFrame(BASE_LINK, BASE_LINK)
        has_mounting = reachable and first != BASE_LINK
        if has_mounting and not stream.is_of_sensor:
            return BaseFrame(BASE_LINK, BASE_LINK, problems=(_unnamed_base(first, stream),))
        is_settled = stream.is_of_sensor and not has_mounting
        return BaseFrame(
            first, first, problems=() if is_settled else (_unnamed_child(first, stream),)
        )

    name = BASE_LINK if reachable and tree.connected(BASE_LINK, child) else child
    if not sensors or any(tree.connected(name, s) for s in sensors):
        return BaseFrame(name, child)
    if first in _FIXED_FRAMES:  # nothing that moves has such a name
        return BaseFrame(name, child)
    return BaseFrame(
        child, child, assumed=first, problems=(_unconnected_sensor(first, child, stream.topic),)
    )


def _has_base_link(tree: TransformTree, sensors: Sequence[str]) -> bool:
    """Whether ``base_link`` is connected with a sensor, or known where there are none."""
    if not sensors:
        return BASE_LINK in tree.frames
    return any(tree.connected(BASE_LINK, sensor) for sensor in sensors)


def _unnamed_child(sensor: str, stream: PoseTopic) -> Problem:
    """The frame of a pose is assumed.

    It cannot be another where the sensor's own SLAM publishes the pose.
    """
    text = (
        f"{stream.topic} does not name the frame whose pose it is: it is taken as the pose of the "
        f"sensor frame '{sensor}'; where it is another, {_give_mounting(sensor)}."
    )
    topic = stream.topic
    return Problem(topic, ProblemKind.POSE, text, lost=False, assumed=not stream.is_of_sensor)


def _unnamed_base(sensor: str, stream: PoseTopic) -> Problem:
    """The frame of a pose is assumed to be the vehicle's, which the sensor is mounted on."""
    text = (
        f"{stream.topic} does not name the frame whose pose it is: it is taken as the pose of "
        f"'{BASE_LINK}', which transforms connect with the sensor frame '{sensor}'; where it is "
        f"the pose of '{sensor}', give --set logs.mountings.{sensor}=[0,0,0,0,0,0,1]."
    )
    return Problem(stream.topic, ProblemKind.POSE, text, lost=False, assumed=True)


def _unconnected_sensor(sensor: str, child: str, pose_topic: str) -> Problem:
    text = (
        f"No transform connects the sensor frame '{sensor}' with '{child}', the frame of "
        f"{pose_topic}: they are taken as one; record /tf_static, or {_give_mounting(sensor)}."
    )
    return Problem("", ProblemKind.TRANSFORM, text, lost=False, assumed=True)


def _give_mounting(sensor: str) -> str:
    return (
        f"give the pose of '{sensor}' in the frame of the poses with "
        f"--set logs.mountings.{sensor}=[x,y,z,qx,qy,qz,qw]"
    )


class PoseSource(Protocol):
    """Poses that are not a stream of the log: of a file, or made from other streams.

    ``name`` is used in sentences; ``child`` is the frame that its poses belong to, "" for the base
    frame, None while it is unknown; ``is_over``: no more poses will come. ``problems`` are missing
    poses (lost) and assumptions.
    """

    @property
    def name(self) -> str: ...
    @property
    def session_frame(self) -> str: ...
    @property
    def child(self) -> str | None: ...
    @property
    def is_over(self) -> bool: ...
    @property
    def problems(self) -> list[Problem]: ...

    def take(self, frame: Frame) -> None:
        """A frame of the log, in the order of recording."""

    def poses(self, base_T: Callable[[str, int], F64 | None]) -> Iterator[tuple[int, F64]]:
        """Stamps (ns) and ``session_T_child`` (4, 4) that are new since the last call.

        ``base_T`` gives ``base_T_frame`` of a frame at a time.
        """

    def finish(self) -> None:
        """All frames of the log have been seen."""

    def to_json(self) -> dict[str, object]:
        """For session.json."""


class BasePoses:
    """Poses and transforms of a log as they come -> ``session_T_base`` and ``base_T_sensor``.

    Poses stay raw until :meth:`settle` has chosen the base frame. ``static_count``: static TF
    messages that are still to come, from the log's own statistics; once all have come, no frame
    has to wait for more. ``source`` gives the poses instead of the log's pose topic and TF,
    ``fallback`` gives them when neither has any. ``mountings`` are known from the start.
    """

    def __init__(
        self,
        roles: Roles,
        static_count: int = 0,
        source: PoseSource | None = None,
        fallback: PoseSource | None = None,
        mountings: Mountings = NO_MOUNTINGS,
    ) -> None:
        self.tree = TransformTree()
        self.track = PoseTrack()
        self.base: BaseFrame | None = None
        self.session_frame = ""
        self._roles = roles
        self.source = source
        self._fallback = fallback
        self._has_topic = (
            source is None
            and roles.pose is not None
            and roles.pose not in (*roles.tf, *roles.tf_static)
        )
        self._stream = PoseStream(roles.pose or "", roles.pose_frame)
        self._child: str | None = None  # of the poses of a topic, once the base frame is chosen
        self._publishers = EdgePublishers()
        self._edge: Edge | None = None
        self._turned: set[Edge] = set()  # parent and child of moving edges that were upside down
        self._raw: deque[tuple[int, F64]] = deque()
        self._static_count = static_count
        self._static_times: set[tuple[str, int]] = set()
        self._given = mountings.given_poses
        self._base_T_base_axes = np.eye(4)
        for edge in (*mountings.own, *mountings.lent):
            header = Header("", 0, 0, edge.parent)
            self.tree.add(TransformSample(header, edge.child, matrix(edge.pose), static=True))

    @property
    def edge(self) -> Edge | None:
        """The edge of TF that gives the poses; None where another source does."""
        return self._edge

    def take(self, sample: PoseSample | TransformSample) -> None:
        """A sample of the pose topic or of TF."""
        header = sample.header
        if self._has_topic and header.topic == self._roles.pose:
            if self._stream.take(sample):
                self._raw.append((header.stamp_ns, sample.frame_T_child))
                self._move()
        elif isinstance(sample, TransformSample):
            sample = self._upright(sample)
            header = sample.header
            if header.topic in self._roles.tf_static:
                sample = replace(sample, static=True)
                self._static_times.add((header.topic, header.log_time_ns))
            if not self._publishers.accepts(sample):
                return
            self.tree.add(sample)
            if (
                self._edge == (frame_name(header.frame_id), frame_name(sample.child_frame_id))
                and not sample.static
            ):
                self._raw.append((header.stamp_ns, sample.frame_T_child))
                self._move()

    def _upright(self, sample: TransformSample) -> TransformSample:
        """A moving transform of a fixed frame in a frame of the vehicle, the other way round."""
        parent = frame_name(sample.header.frame_id)
        child = frame_name(sample.child_frame_id)
        is_vehicle = parent.rpartition("/")[2] in _VEHICLE_FRAMES
        if sample.static or not is_vehicle or child.rpartition("/")[2] not in _FIXED_FRAMES:
            return sample
        self._turned.add((parent, child))
        return replace(
            sample,
            header=replace(sample.header, frame_id=child),
            child_frame_id=parent,
            frame_T_child=inverse(sample.frame_T_child),
        )

    def settle(self, sensors: Sequence[str], *, is_patient: bool, must: bool) -> bool:
        """Chooses the base frame once its transforms have come, or now if it ``must``.

        False: not yet. ``is_patient``: a pose edge in TF that is not called odom may still be
        topped by a better one. With a pose topic that has no message yet, the result stays False
        even if it must: its frame is unknown.
        """
        edge = None
        kind = None
        has_pose_stream = self.source is not None or self._has_topic
        if has_pose_stream:
            kind = self._stream.best(partial(self._is_connected, sensors))
            child = (kind and kind.child) if self.source is None else self.source.child
            # poses of several frames or publishers may come in turns
            may_be_mixed = self.source is None and self._stream.count < FEWEST
            if child is None or (may_be_mixed and is_patient and not must):
                return False
        else:
            edge = self._pose_edge(sensors)
            may_improve = edge is None or (is_patient and not edge[0].endswith("odom"))
            if not must and self._roles.tf and may_improve:
                return False
            child = self._child_of(edge)

        if edge is not None:
            fixed = self._fixed_above(edge[0], None)
        elif kind is not None and self.source is None:
            fixed = self._fixed_above(kind.parent, kind.child)
        else:
            fixed = self._fixed_above(self.session_frame, None)
        sensors = [s for s in sensors if frame_name(s) not in fixed]
        if not must and not self._is_settled(sensors, child):
            return False
        if not has_pose_stream and edge is None:
            self.source = self._fallback
        self._fallback = None
        self.base = self._choose(sensors, child)
        if edge is not None:
            self._follow(edge)
        elif kind is not None and self.source is None:
            self.session_frame = kind.parent
            self._child = kind.child
            self._raw.extend(self._stream.choose(kind, partial(self._is_connected, sensors)))
        self._pull()
        self._move()
        return True

    def _is_connected(self, sensors: Sequence[str], frame: str) -> bool:
        """Whether transforms connect a frame with a sensor."""
        return any(self.tree.connected(frame, sensor) for sensor in sensors)

    @property
    def problems(self) -> list[Problem]:
        """Poses and transforms that are left out, because others of the same name are used."""
        turned = [
            Problem(
                "",
                ProblemKind.TRANSFORM,
                f"TF gives the fixed frame '{child}' below '{parent}', a frame of the vehicle: it"
                f" is read as the pose of '{parent}' in '{child}'.",
                lost=False,
            )
            for parent, child in sorted(self._turned)
        ]
        return [
            *turned,
            *self._other_parents(),
            *self._stream.problems(),
            *self._publishers.problems(self._edge),
        ]

    def _other_parents(self) -> list[Problem]:
        """Poses of TF end where their frame gets another parent, in which it is somewhere else."""
        track = None if self._edge is None else self.tree.track(*self._edge)
        if self._edge is None or track is None or track.end_ns is None:
            return []
        used, child = self._edge
        others = [
            parent
            for parent, other_child, _ in self.tree.edges
            if other_child == child and parent != used and self._follows(track, parent, child)
        ]
        if not others:
            return []
        names = " and ".join(f"'{parent}'" for parent in others)
        text = (
            f"TF gives '{child}' in '{used}' until {utc(track.end_ns)}, and afterwards in {names}:"
            f" only its poses in '{used}' are used; cut the log there, or record one parent of"
            f" '{child}'."
        )
        return [Problem("", ProblemKind.TRANSFORM, text, lost=True)]

    def _follows(self, track: PoseTrack, parent: str, child: str) -> bool:
        """Whether a moving edge begins when ``track`` is over, and goes on beyond a gap of it."""
        other = self.tree.track(parent, child)
        if other is None or other.first_ns is None or other.end_ns is None or track.end_ns is None:
            return False
        last_ns = track.end_ns
        return other.first_ns > last_ns and other.end_ns > last_ns + track.gap_limit_ns()

    def _child_of(self, edge: Edge | None) -> str | None:
        """The frame that the poses of a TF edge, or without one of the fallback, belong to."""
        if edge is not None:
            return edge[1]
        return None if self._fallback is None else self._fallback.child

    def _follow(self, edge: Edge) -> None:
        """Takes the poses of a TF edge, beginning with the remembered ones."""
        self._edge = edge
        self.session_frame = edge[0]
        track = self.tree.track(*edge)
        if track is not None:
            self._raw.extend(zip(track.stamps_ns.tolist(), track.poses, strict=True))

    def _choose(self, sensors: Sequence[str], child: str | None) -> BaseFrame:
        source = self.source
        if source is None:
            topic = self._roles.pose or "TF"
            is_of_sensor = any(shared(topic, t) for t in self._roles.ranging)
            stream = PoseTopic(child, topic, is_of_sensor)
            return self._choose_with_given(sensors, stream)
        self.session_frame = source.session_frame
        if not child:
            base = self._choose_with_given(sensors, PoseTopic(None, source.name))
            return replace(base, pose_frame=base.name)
        known = {*self.tree.frames, *map(frame_name, sensors)}
        if frame_name(child) not in known:
            raise LogError(
                f"{source.name} gives the poses of '{child}', but the log has no such frame: "
                f"name one of {', '.join(sorted(known))}."
            )
        return self._choose_with_given(sensors, PoseTopic(child, source.name))

    def _choose_with_given(self, sensors: Sequence[str], stream: PoseTopic) -> BaseFrame:
        """The base frame, once the mountings that the user gave are in the tree."""
        if not self._given:
            return choose_base_frame(self.tree, sensors, stream)
        first = frame_name(sensors[0]) if sensors else BASE_LINK
        if stream.child and not self.tree.connected(BASE_LINK, stream.child):
            parent = frame_name(stream.child)
        elif stream.child or first in self._given or stream.child is None:
            parent = BASE_LINK
        else:
            parent = first
        for frame, pose in self._given.items():
            if frame == parent:  # measurements in it have axes of their own
                self._base_T_base_axes = pose
                continue
            self.tree.fix(parent, frame, pose)
        return choose_base_frame(self.tree, sensors, stream, self._given)

    def _fixed_above(self, session_frame: str, child: str | None) -> set[str]:
        """The frame that the poses of ``child`` are in, and the frames above it."""
        if not session_frame or session_frame == child:
            return set()
        return {session_frame, *self.tree.ancestors(session_frame)} - {child or BASE_LINK}

    def is_given(self, frame_id: str) -> bool:
        """Whether the user gave the mounting of a frame."""
        return frame_name(frame_id) in self._given

    def is_fixed(self, frame_id: str) -> bool:
        """Whether the frame of a cloud is fixed in the world.

        Its points were moved by the poses before they were recorded.
        """
        base = self.base
        frame = frame_name(frame_id)
        if base is None or base.pose_frame is None or frame in (base.name, base.pose_frame):
            return False
        return frame in self._fixed_above(self.session_frame, self._child)

    def _base_T_fixed(self, frame_id: str, stamp_ns: int) -> F64 | None:
        session_T_base = self.track.at(stamp_ns)
        session_T_frame = self.tree.lookup(self.session_frame, frame_id, stamp_ns)
        if session_T_base is None or session_T_frame is None:
            return None
        return np.asarray(inverse(session_T_base) @ session_T_frame)

    def take_measurement(self, frame: Frame) -> None:
        """A frame of the log that a source may make poses from."""
        source = self.source or self._fallback
        if source is not None:
            source.take(frame)
            self._pull()

    def _pull(self) -> None:
        """Takes the new poses of the source, if there is one."""
        if self.source is not None and self.base is not None:
            new = list(self.source.poses(self.base_T))
            if new:
                self._raw.extend(new)
                self._move()

    def finish(self) -> None:
        """No more transforms will come: poses that wait for one are dropped."""
        if self.source is not None:
            self.source.finish()
            self._pull()
        self._move(is_end=True)

    def base_T(self, frame_id: str, stamp_ns: int) -> F64 | None:
        """``base_T_frame`` (4, 4) at a time; None when no transform leads to that frame."""
        if self.base is None:
            return None
        if self.base.assumed is not None and frame_name(frame_id) == self.base.assumed:
            return np.eye(4)
        if self.is_fixed(frame_id):
            return self._base_T_fixed(frame_id, stamp_ns)
        if frame_name(frame_id) == self.base.name:
            return self._base_T_base_axes
        return self.tree.lookup(self.base.name, frame_id, stamp_ns)

    def poses_have_passed(self, stamp_ns: int) -> bool:
        """Whether the poses reach beyond ``stamp_ns``, or there is nothing to wait for."""
        if self.base is None or self.base.pose_frame is None:
            return self.base is not None
        if self.source is not None and self.source.is_over and not self._raw:
            return True
        return self.track.end_ns is not None and self.track.end_ns >= stamp_ns

    def transforms_have_passed(self, frame_id: str, stamp_ns: int) -> bool:
        """Whether :meth:`base_T` has its final answer."""
        if self.base is None:
            return False
        if self.is_fixed(frame_id):
            return self.poses_have_passed(stamp_ns)
        return frame_name(frame_id) == self.base.assumed or self.tree.has_passed(
            self.base.name, frame_id, stamp_ns
        )

    def _pose_edge(self, sensors: Sequence[str]) -> Edge | None:
        frames = [*sensors, BASE_LINK, "base_footprint"]
        edge = self.tree.pose_edge(BASE_LINK)
        if edge is not None:  # clouds in a frame above it were moved by the poses already
            fixed = {edge[0], *self.tree.ancestors(edge[0])}
            frames = [frame for frame in frames if frame_name(frame) not in fixed]
        return next(
            (edge for frame in frames if (edge := self.tree.pose_edge(frame)) is not None), None
        )

    def _is_settled(self, sensors: Sequence[str], child: str | None) -> bool:
        if (child == "" and self._has_topic) or not (self._roles.tf or self._roles.tf_static):
            return True
        if all(self.tree.connected(BASE_LINK, f) for f in (*sensors, *([child] if child else []))):
            return True
        return not self._roles.tf and len(self._static_times) >= self._static_count

    def _move(self, is_end: bool = False) -> None:
        """Raw poses -> poses of the base frame, once the transform at their time is known."""
        base = self.base
        if base is None or base.pose_frame is None:
            return
        while self._raw:
            stamp_ns, pose = self._raw[0]
            is_late = is_end or self._raw[-1][0] - stamp_ns >= _LATE_TF_NS
            if not is_late and not self.tree.has_passed(base.pose_frame, base.name, stamp_ns):
                return
            child_T_base = self.tree.lookup(base.pose_frame, base.name, stamp_ns)
            self._raw.popleft()
            if child_T_base is not None:
                self.track.append(stamp_ns, pose @ child_T_base)
