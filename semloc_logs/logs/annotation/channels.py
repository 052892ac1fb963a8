"""Loop closures as messages of a log: the types, and which closure gives which messages.

The messages are in the log's own encoding: one foreign channel would make the log unreadable for
some readers. :mod:`channels_ros` and :mod:`channels_foxglove` write the encodings.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from enum import Enum
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from semloc_logs.errors import ContractError
from semloc_logs.numerics.transforms import inverse, transform

F64 = NDArray[np.float64]
Colour = tuple[float, float, float, float]  # red, green, blue, opacity from 0 to 1
Encoding = Literal["ros2", "ros1", "protobuf", "json"]


class Kind(Enum):
    """What the messages of a topic are."""

    CLOSURE = "closure"
    POSE = "pose"
    MARKERS = "markers"
    TRANSFORMS = "transforms"
    CLOUD = "cloud"


CLOSURES, POSE, MARKERS, MAP = (
    "/semloc/loop_closures",
    "/semloc/pose",
    "/semloc/markers",
    "/semloc/map",
)
OVERVIEW = "/semloc/overview"
MOVING, FIXED = "/semloc/tf", "/semloc/tf_static"
TOPICS = {
    CLOSURES: Kind.CLOSURE,
    POSE: Kind.POSE,
    MARKERS: Kind.MARKERS,
    MOVING: Kind.TRANSFORMS,
    FIXED: Kind.TRANSFORMS,
    MAP: Kind.CLOUD,
    OVERVIEW: Kind.MARKERS,
}
LATCHED = (FIXED, MAP, OVERVIEW)  # a reader that starts later gets the last message
COMMON_FRAME = "semloc/common"
QOS_KEY = "offered_qos_profiles"
LATCHING_KEY = "latching"  # of a ROS 1 connection
# where a log has none; as rosbag2 writes it for reliable topics
DEFAULT_QOS = """- history: 1
  depth: 1
  reliability: 1
  durability: 2
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 9223372036
    nsec: 854775807
  liveliness: 1
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false
"""
RUN_KEY = "semloc.run_id"  # in the metadata of each of our channels


@dataclass(frozen=True, slots=True)
class NewChannel:
    """A channel to add, with its schema."""

    topic: str
    message_encoding: str
    schema_name: str
    schema_encoding: str
    schema_data: bytes
    metadata: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class NewMessage:
    """A message to add; its publish time is its log time.

    ``channel`` counts the channels that are added with it.
    """

    channel: int
    log_time_ns: int
    data: bytes


@dataclass(frozen=True, slots=True, eq=False)
class Transform:
    """Pose (4, 4) of the frame ``child`` in the frame ``parent`` at a time."""

    stamp_ns: int
    parent: str
    child: str
    parent_T_child: F64


@dataclass(frozen=True, slots=True, eq=False)
class StampedPose:
    """Pose (4, 4) of the base frame in ``frame_id``; covariance (6, 6), zeros where unknown."""

    stamp_ns: int
    frame_id: str
    frame_T_base: F64
    covariance: F64


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points (n, 3) in ``frame_id``, their colours (n, 3) and train ids (n,)."""

    frame_id: str
    points: NDArray[np.float32]
    colours: NDArray[np.uint8]
    label: NDArray[np.uint8]

    def rows(self, names: Sequence[str]) -> NDArray[Any]:
        """x y z as floats, then single bytes called ``names``: blue, green, red, 0, label."""
        kinds = [(axis, "<f4") for axis in "xyz"] + [(name, "u1") for name in names]
        out = np.zeros(len(self.points), np.dtype(kinds))
        out["x"], out["y"], out["z"] = self.points.T
        blue, green, red, _, label = names
        out[red], out[green], out[blue] = self.colours.T
        out[label] = self.label
        return out


def _above(position: F64, size: float) -> F64:
    """Where a text of ``size`` m stands, or one beside a sphere of this size (3,)."""
    return np.asarray(position + np.array([0.0, 0.0, 1.5 * size]))


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """Positions (n, 3) of a session's vehicle in ``frame_id``, in the order of time."""

    session: str
    frame_id: str
    positions: F64
    color: Colour

    def name_position(self, size: float) -> F64:
        """Place (3,) of a text of ``size`` m: above the start."""
        return _above(self.positions[0], size)


@dataclass(frozen=True, slots=True)
class Scene:
    """What viewers show around the closures.

    ``moving`` transforms are of the vehicle, where the log has none, and of the common frame;
    ``fixed`` ones hold for the whole log. ``common`` are poses in the common frame, which /semloc/
    pose has instead of the ones in the frames of the targets. ``cloud`` is the map, ``drives`` are
    of the log and of the sessions that closures connect with it.
    """

    moving: Sequence[Transform] = ()
    fixed: Sequence[Transform] = ()
    common: Sequence[StampedPose] = ()
    cloud: Cloud | None = None
    drives: Sequence[Drive] = ()


NO_SCENE = Scene()


@dataclass(frozen=True, slots=True, eq=False)
class ClosureRecord:
    """A row of closures.parquet, and where it lies for those who look at the log.

    ``covariance`` has 36 numbers. ``session_T_query`` (4, 4) is the pose of the query's base frame
    in the *target's* session frame, None when the target has no poses. ``session_position`` (3,) is
    the place of this log's end in this log's session frame, None without poses; ``session_other``
    (3,) the place of the other end there, as the closure gives it.
    """

    query_session: str
    target_session: str
    query_stamp_ns: int
    target_stamp_ns: int
    t_x: float
    t_y: float
    t_z: float
    q_x: float
    q_y: float
    q_z: float
    q_w: float
    covariance: tuple[float, ...]
    overlap: float
    probability: float
    inliers: int
    words: int
    session_T_query: F64 | None = None
    session_position: F64 | None = None
    session_other: F64 | None = None

    @classmethod
    def from_row(
        cls,
        row: Mapping[str, object],
        *,
        session_T_query: F64 | None = None,
        session_position: F64 | None = None,
        session_other: F64 | None = None,
    ) -> ClosureRecord:
        """From a row of the table as plain Python values.

        ``ContractError`` when a column is missing or has another type.
        """
        try:
            values: dict[str, object] = {}
            for name in COLUMNS:
                value = row[name]
                kind = _TYPES[name]
                if kind is tuple:
                    value = tuple(float(x) for x in value)  # type: ignore[attr-defined]
                values[name] = kind(value)
        except (KeyError, TypeError, ValueError) as error:
            raise ContractError(
                f"A row of closures.parquet lacks a good value for {error}; "
                "write the table again with `semloc close`."
            ) from error
        if len(values["covariance"]) != 36:  # type: ignore[arg-type]
            raise ContractError(
                "The covariance of a row of closures.parquet has not 36 numbers; "
                "write the table again with `semloc close`."
            )
        values |= {
            "session_T_query": session_T_query,
            "session_position": session_position,
            "session_other": session_other,
        }
        return cls(**values)  # type: ignore[arg-type]

    def columns(self) -> dict[str, object]:
        """The columns of closures.parquet, in their order."""
        return {name: getattr(self, name) for name in COLUMNS}

    def target_T_query(self) -> F64:
        """Pose of the query's base frame in the target's base frame (4, 4)."""
        return transform(
            np.array([self.t_x, self.t_y, self.t_z]),
            np.array([self.q_x, self.q_y, self.q_z, self.q_w]),
        )

    def covariance_in_session(self) -> F64:
        """(6, 6) covariance of ``session_T_query`` due to the closure.

        The same errors, along the axes of the target's session frame.
        """
        session_T_query = np.eye(4) if self.session_T_query is None else self.session_T_query
        session_R_target = session_T_query[:3, :3] @ self.target_T_query()[:3, :3].T
        turn = np.kron(np.eye(2), session_R_target)
        return np.asarray(turn @ np.array(self.covariance).reshape(6, 6) @ turn.T)


COLUMNS = tuple(f.name for f in fields(ClosureRecord) if not f.name.startswith("session_"))
_TYPES: dict[str, type] = {
    name: str
    if name.endswith("_session")
    else int
    if name.endswith("_ns") or name in ("inliers", "words")
    else float
    for name in COLUMNS
} | {"covariance": tuple}


@dataclass(frozen=True, slots=True, eq=False)
class Mark:
    """Drawing at this log's end of a closure, in the frame ``frame_id``.

    A sphere, a text and a line to the other end.
    """

    stamp_ns: int
    frame_id: str
    key: int  # number of the closure in this log
    position: F64
    other: F64 | None  # position of the other end
    size: float  # diameter of the sphere, m
    text: str
    color: Colour

    def text_position(self) -> F64:
        """Above the sphere (3,)."""
        return _above(self.position, self.size)


@dataclass(frozen=True, slots=True, eq=False)
class Overview:
    """All drives and closures in one message.

    Viewers that jump to a time show the last message of each topic only, so that messages of single
    closures do not show them all. ``size`` (m) is the diameter of the ``marks`` in ``frame_id``.
    """

    stamp_ns: int
    frame_id: str
    size: float
    drives: Sequence[Drive]
    marks: Sequence[Mark]

    def lines(self) -> list[tuple[F64, Colour]]:
        """The ends of the lines, and their colours: two for each mark with another end."""
        return [
            (end, mark.color)
            for mark in self.marks
            if mark.other is not None
            for end in (mark.position, mark.other)
        ]


class Encoder(Protocol):
    """The messages in one encoding: a channel for each topic, and the bytes of messages."""

    def channel(self, topic: str, kind: Kind, metadata: Mapping[str, str]) -> NewChannel: ...
    def loop_closure(self, closure: ClosureRecord, stamp_ns: int) -> bytes: ...
    def pose(self, pose: StampedPose) -> bytes: ...
    def mark(self, mark: Mark) -> bytes: ...
    def overview(self, overview: Overview) -> bytes: ...
    def transforms(self, transforms: Sequence[Transform]) -> bytes: ...
    def cloud(self, cloud: Cloud, stamp_ns: int) -> bytes: ...


@dataclass(frozen=True, slots=True)
class LogFacts:
    """Facts that a writer needs of a log: encoding, profile, metadata for new channels, times.

    ``start_ns`` and ``end_ns`` are the first and last receive time. ``old_markers``: the log
    defines visualization_msgs/Marker as ROS 2 did before Humble; readers know one definition of a
    type.
    """

    encoding: Encoding
    profile: str
    channel_metadata: Mapping[str, str]
    start_ns: int
    end_ns: int
    messages: int
    old_markers: bool = False


@dataclass(frozen=True, slots=True)
class LogContext:
    """What the messages of one log share.

    ``log_times`` maps the stamp (ns) of an end to the receive time (ns) of the log at that frame.
    ``frame_id`` is the frame of the markers, ``marker_size`` their diameter in metres. ``scene`` is
    published if the log takes part in a closure.
    """

    session: str
    facts: LogFacts
    log_times: Mapping[int, int]
    frame_id: str
    marker_size: float
    scene: Scene = NO_SCENE

    def log_time(self, stamp_ns: int) -> int:
        """The receive time at a stamp; without one, the stamp within the log's time range."""
        facts = self.facts
        time = self.log_times.get(stamp_ns)
        if time is None and facts.messages:
            time = min(max(stamp_ns, facts.start_ns), facts.end_ns)
        return min(max(stamp_ns if time is None else time, 0), (1 << 64) - 1)


def is_old_marker(name: str, definition: bytes) -> bool:
    """Whether a ROS 2 definition contains visualization_msgs/Marker as it was before Humble."""
    own = name.startswith("visualization_msgs/msg/Marker")
    return (
        own or b"MSG: visualization_msgs/Marker\n" in definition
    ) and b"mesh_file" not in definition


def run_id(
    closures: Sequence[ClosureRecord], session: str, settings: Mapping[str, str], version: str
) -> str:
    """Sixteen hexadecimal digits that name this result.

    The same closures, settings and version give the same.
    """
    rows = [list(c.columns().values()) for c in closures]
    content = json.dumps([version, session, sorted(settings.items()), rows], allow_nan=True)
    return hashlib.sha256(content.encode()).hexdigest()[:16]


def encode(
    closures: Sequence[ClosureRecord],
    context: LogContext,
    encoder: Encoder,
    metadata: Mapping[str, str],
) -> tuple[list[NewChannel], list[NewMessage]]:
    """Channels and messages for the closures of the session, in log-time order.

    ``metadata`` goes to the channels. Channels without messages are left out.
    """
    session = context.session
    mine = [c for c in closures if session in (c.query_session, c.target_session)]
    placed = [c for c in mine if c.query_session == session and c.session_T_query is not None]
    pose_topics = topics_of_targets({c.target_session for c in placed})
    topics = [*TOPICS.items(), *((topic, Kind.POSE) for topic in pose_topics.values())]
    number = {topic: k for k, (topic, _) in enumerate(topics)}
    messages: list[NewMessage] = []
    marks: list[Mark] = []
    for key, closure in enumerate(sorted(mine, key=_order)):
        _refuse_infinite(closure)
        is_query = closure.query_session == session
        stamp = closure.query_stamp_ns if is_query else closure.target_stamp_ns
        log_time = context.log_time(stamp)
        data = encoder.loop_closure(closure, stamp)
        messages.append(NewMessage(number[CLOSURES], log_time, data))
        if is_query and closure.session_T_query is not None:
            data = encoder.pose(_pose_in_target(closure, closure.session_T_query))
            if not context.scene.common:
                messages.append(NewMessage(number[POSE], log_time, data))
            topic = pose_topics[closure.target_session]
            messages.append(NewMessage(number[topic], log_time, data))
        if closure.session_position is not None:
            marks.append(_mark(closure, stamp, key, context))
            messages.append(NewMessage(number[MARKERS], log_time, encoder.mark(marks[-1])))
    if mine:
        messages += _scene(context, encoder, number, marks)
    messages.sort(key=lambda m: m.log_time_ns)  # stable: closures of one frame stay in their order
    shared = {**context.facts.channel_metadata, **metadata}
    channels = [
        encoder.channel(topic, kind, latched(shared, context.facts) if topic in LATCHED else shared)
        for topic, kind in topics
    ]
    return _used(channels, messages)


def topics_of_targets(targets: Collection[str]) -> dict[str, str]:
    """A topic for the poses in the frame of each target session, as ROS allows names."""
    topics: dict[str, str] = {}
    for target in sorted(targets):
        name = re.sub("[^A-Za-z0-9_]", "_", target)
        if not name[:1].isalpha():
            name = f"session_{name}"
        topic = f"{POSE}/{name}"
        while topic in topics.values():
            topic += "_"
        topics[target] = topic
    return topics


def latched(metadata: Mapping[str, str], facts: LogFacts) -> dict[str, str]:
    """Metadata of a topic whose last message a late reader gets."""
    if facts.encoding == "ros1":
        return {**metadata, LATCHING_KEY: "1"}
    if facts.encoding != "ros2":
        return dict(metadata)
    profile = metadata.get(QOS_KEY) or DEFAULT_QOS
    for volatile, local in (("volatile", "transient_local"), ("2", "1")):
        profile = re.sub(rf"durability: {volatile}\b", f"durability: {local}", profile)
    return {**metadata, QOS_KEY: profile}


def _pose_in_target(closure: ClosureRecord, session_T_query: F64) -> StampedPose:
    frame_id = f"semloc/{closure.target_session}"
    covariance = closure.covariance_in_session()
    return StampedPose(closure.query_stamp_ns, frame_id, session_T_query, covariance)


def _scene(
    context: LogContext, encoder: Encoder, number: Mapping[str, int], marks: Sequence[Mark]
) -> list[NewMessage]:
    """A message for each moving transform and pose.

    At the start one for all fixed transforms, one for the map, and one for drives and closures.
    """
    scene = context.scene
    moving = [(t.stamp_ns, MOVING, encoder.transforms([t])) for t in scene.moving]
    moving += [(pose.stamp_ns, POSE, encoder.pose(pose)) for pose in scene.common]
    facts = context.facts
    messages = []
    for stamp_ns, topic, data in moving:
        time = context.log_time(stamp_ns)
        if facts.start_ns <= time <= facts.end_ns:  # a session may have other logs, too
            messages.append(NewMessage(number[topic], time, data))
    start_ns = max(0, facts.start_ns)
    if scene.fixed:
        messages.append(NewMessage(number[FIXED], start_ns, encoder.transforms(scene.fixed)))
    stamp_ns = scene.fixed[0].stamp_ns if scene.fixed else start_ns
    if scene.cloud is not None:
        messages.append(NewMessage(number[MAP], start_ns, encoder.cloud(scene.cloud, stamp_ns)))
    if scene.drives:
        shown = Overview(stamp_ns, context.frame_id, context.marker_size, scene.drives, marks)
        messages.append(NewMessage(number[OVERVIEW], start_ns, encoder.overview(shown)))
    return messages


def channel_metadata(run: str, version: str) -> dict[str, str]:
    """Metadata by which our channels are known."""
    return {RUN_KEY: run, "semloc.version": version}


def _refuse_infinite(c: ClosureRecord) -> None:
    pose = (c.t_x, c.t_y, c.t_z, c.q_x, c.q_y, c.q_z, c.q_w)
    if not np.isfinite([*c.covariance, *pose, c.overlap, c.probability]).all():
        raise ContractError(
            f"The closure of {c.query_session} at {c.query_stamp_ns} ns has a number that is not "
            "finite; run `semloc close`."
        )


def _order(closure: ClosureRecord) -> tuple[str, int, str, int]:
    query = closure.query_session, closure.query_stamp_ns
    return *query, closure.target_session, closure.target_stamp_ns


def _mark(closure: ClosureRecord, stamp_ns: int, key: int, context: LogContext) -> Mark:
    position = np.asarray(closure.session_position, float)
    other = closure.session_other
    name = closure.target_session
    if closure.query_session == closure.target_session:
        earlier = closure.target_stamp_ns <= closure.query_stamp_ns
        name = "an earlier place" if earlier else "a later place"
        if closure.session_T_query is not None:
            other = (closure.session_T_query @ inverse(closure.target_T_query()))[:3, 3]
    elif closure.query_session != context.session:
        name = closure.query_session
    good = min(1.0, max(0.0, 2 * closure.probability - 1))  # red at 0.5 and below, green at 1
    return Mark(
        stamp_ns,
        context.frame_id,
        key,
        position,
        other,
        context.marker_size,
        f"{name} {closure.probability:.2f}",
        (1 - good, good, 0.1, 0.9),
    )


def _used(
    channels: list[NewChannel], messages: list[NewMessage]
) -> tuple[list[NewChannel], list[NewMessage]]:
    """Without channels that have no message."""
    used = sorted({m.channel for m in messages})
    number = {old: new for new, old in enumerate(used)}
    kept = [NewMessage(number[m.channel], m.log_time_ns, m.data) for m in messages]
    return [channels[k] for k in used], kept
