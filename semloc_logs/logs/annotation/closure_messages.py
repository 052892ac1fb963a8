"""Loop closures as messages of a log: which closure gives which messages, and when."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.errors import ContractError
from semloc_logs.logs.annotation.channels import (
    CLOSURES,
    FIXED,
    LATCHED,
    MAP,
    MARKERS,
    MOVING,
    OVERVIEW,
    POSE,
    TOPICS,
    Encoder,
    Kind,
    LogFacts,
    NewChannel,
    NewMessage,
    latched,
    topics_of_targets,
)
from semloc_logs.logs.annotation.closure_record import ClosureRecord
from semloc_logs.logs.annotation.markers import Mark, closure_markers, overview_markers
from semloc_logs.logs.annotation.scene import NO_SCENE, Scene, StampedPose
from semloc_logs.numerics.transforms import inverse


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
    of_session = [c for c in closures if session in (c.query_session, c.target_session)]
    placed = [c for c in of_session if c.query_session == session and c.session_T_query is not None]
    pose_topics = topics_of_targets({c.target_session for c in placed})
    topics = [*TOPICS.items(), *((topic, Kind.POSE) for topic in pose_topics.values())]
    number = {topic: k for k, (topic, _) in enumerate(topics)}
    messages: list[NewMessage] = []
    marks: list[Mark] = []
    for key, closure in enumerate(sorted(of_session, key=_order)):
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
            messages.append(
                NewMessage(number[MARKERS], log_time, encoder.markers([closure_markers(marks[-1])]))
            )
    if of_session:
        messages += _scene(context, encoder, number, marks)
    messages.sort(key=lambda m: m.log_time_ns)  # stable: closures of one frame stay in their order
    shared = {**context.facts.channel_metadata, **metadata}
    channels = [
        encoder.channel(topic, kind, latched(shared, context.facts) if topic in LATCHED else shared)
        for topic, kind in topics
    ]
    return _used(channels, messages)


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
        groups = overview_markers(
            scene.drives, marks, stamp_ns, context.frame_id, context.marker_size
        )
        messages.append(NewMessage(number[OVERVIEW], start_ns, encoder.markers(groups)))
    return messages


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
