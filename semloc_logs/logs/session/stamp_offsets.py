"""Header stamps beside log times: a clock that differs shows in all messages of its topic."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.frames import Frame, Header, TransformSample
from semloc_logs.logs.poses.base_frame import BasePoses
from semloc_logs.logs.poses.tf_tree import Edge, frame_name
from semloc_logs.logs.problems import Problem, ProblemKind
from semloc_logs.logs.roles import Roles

_MOST_SAMPLES = 2048  # of a topic; beyond, every second one is forgotten
_MOST_TOPICS = 1000  # a broken log may have a new TF edge in each message
# s; a message is recorded after its measurement: a later stamp is of another clock, and computers
# in one network agree to some milliseconds
_LATEST = 0.02
# s; up to this it is a note: with simulated time, log times are as coarse as the clock topic
_CLEARLY_LATER = 0.1
_EARLIEST = 5.0  # s; poses that are computed slowly are recorded within a second or two
_FEWEST = 8  # messages in which a change of the clock can be seen
# s, with their usual causes: a difference so near to one of them is taken to be just that
_USUAL = ((37.0, "TAI beside UTC"), (18.0, "GPS time beside UTC"), (19.0, "TAI beside GPS time"))
_TIME_ZONE = 1800.0  # s; time zones differ by multiples of it, but for a few
_NEARLY = 0.5  # s
_AT_ONCE = 0.005  # s
_YEAR = 365.25 * 86400.0
# messages with one stamp that are recorded over so long a time (s) were not measured at once
_STUCK = 0.5
_SLOWEST = 0.01  # of the time of recording; a clock that advances by less stands still
_FEWEST_STUCK = 3
_STUCK_SHARE = 0.2  # of the messages of a topic
_PARTS = 4  # of a log, each of which shows what its stamps are like


@dataclass(frozen=True, slots=True)
class StampOffset:
    """Log time minus stamp (s) over the messages of a topic.

    ``without_stamp`` messages have no stamp, or 0, and take their log time instead; ``stuck`` ones
    have the stamp of the message before, or nearly, for half a second of recording or longer.
    """

    messages: int
    without_stamp: int
    median: float
    least: float
    greatest: float
    stuck: int = 0

    @property
    def is_stuck(self) -> bool:
        """Whether the clock of the stamps stands still, or counts coarsely."""
        return self.stuck > _STUCK_SHARE * self.messages


class StampOffsets:
    """Offsets of the topics of a pass, in bounded memory; a moving edge of TF counts as a topic.

    The stamps are the ones that are used: with ``logs.time_offset`` added, which is ``added_ns`` by
    topic.
    """

    def __init__(self, added_ns: Mapping[str, int] | None = None) -> None:
        self._added_ns = added_ns or {}
        self._topics: dict[str, _Samples] = {}

    def take(self, frame: Frame) -> None:
        """The next frame of a topic; a static transform holds at any time."""
        topic = frame.header.topic
        if isinstance(frame, TransformSample):
            if frame.static:
                return
            edge = (frame_name(frame.header.frame_id), frame_name(frame.child_frame_id))
            topic = edge_topic(topic, edge)
        if topic not in self._topics and len(self._topics) < _MOST_TOPICS:
            self._topics[topic] = _Samples()
        if topic in self._topics:
            self._topics[topic].add(frame.header)

    @property
    def topics(self) -> list[str]:
        """The topics that were seen, sorted; TF as :func:`edge_topic`."""
        return sorted(self._topics)

    def added(self, topic: str) -> float:
        """What the settings add to the stamps of a topic already (s); a new offset replaces it."""
        return self._added_ns.get(topic.partition(" ")[0], 0) * 1e-9

    def of(self, topic: str) -> StampOffset | None:
        """The offset of a topic; None without messages."""
        samples = self._topics.get(topic)
        return None if samples is None else samples.offset()

    def relative(self, topic: str, reference: str) -> F64:
        """Offsets (s) of a topic less the ones of ``reference`` at the same log times.

        What all topics have in common, such as the speed of a replay, is gone. Both must be known.
        """
        times, offsets = self._topics[topic].columns()
        other_times, others = self._topics[reference].columns()
        return np.asarray(offsets - np.interp(times, other_times, others))

    def latest(self, topic: str) -> float:
        """By how much (s) stamps are later than their recording, in the part where most."""
        _, offsets = self._topics[topic].columns()
        parts = np.array_split(offsets, _PARTS) if len(offsets) >= _FEWEST else [offsets]
        return -min(float(np.median(part)) for part in parts)

    def to_json(self) -> dict[str, object]:
        """For session.json: the figures by topic."""
        return {
            topic: {
                key: round(value, 6) if isinstance(value, float) else value
                for key, value in asdict(samples.offset()).items()
            }
            for topic, samples in sorted(self._topics.items())
        }


def edge_topic(topic: str, edge: Edge) -> str:
    """The name of a moving edge of TF among the topics: ``/tf odom -> base_link``."""
    return f"{topic} {edge[0]} -> {edge[1]}"


class _Samples:
    """Log times (s) and offsets of one topic, evenly thinned and in their order."""

    def __init__(self) -> None:
        self._values: list[tuple[float, float]] = []
        self._every = 1
        self._seen = 0
        self._without_stamp = 0
        self._least = np.inf
        self._greatest = -np.inf
        self._stuck = 0
        self._is_counted = False  # whether the run below counts as stuck
        self._run = (0, 0, 0)  # stamp and log time of the first message of a stamp, and their count

    def add(self, header: Header) -> None:
        self._count_stuck(header)
        offset = (header.log_time_ns - header.stamp_ns) * 1e-9
        self._without_stamp += header.lacks_stamp
        self._least = min(self._least, offset)
        self._greatest = max(self._greatest, offset)
        if self._seen % self._every == 0:
            self._values.append((header.log_time_ns * 1e-9, offset))
        self._seen += 1
        if len(self._values) >= _MOST_SAMPLES:
            del self._values[1::2]
            self._every *= 2

    def _count_stuck(self, header: Header) -> None:
        stamp_ns, log_time_ns, count = self._run
        elapsed_ns = _SLOWEST * abs(header.log_time_ns - log_time_ns)
        if not self._seen or abs(header.stamp_ns - stamp_ns) > elapsed_ns:
            self._run = (header.stamp_ns, header.log_time_ns, 1)
            self._is_counted = False
            return
        self._run = (stamp_ns, log_time_ns, count + 1)
        if (header.log_time_ns - log_time_ns) * 1e-9 >= _STUCK and count + 1 >= _FEWEST_STUCK:
            # the ones before, too, once it is known
            before = count - 1 if not self._is_counted else 0
            self._stuck += 1 + before
            self._is_counted = True

    def columns(self) -> tuple[F64, F64]:
        """Log times and offsets."""
        values = np.array(self._values)
        return values[:, 0], values[:, 1]

    def offset(self) -> StampOffset:
        median = float(np.median(self.columns()[1]))
        least = float(self._least)
        greatest = float(self._greatest)
        return StampOffset(self._seen, self._without_stamp, median, least, greatest, self._stuck)


def stamp_problems(
    offsets: StampOffsets, roles: Roles, poses: BasePoses, pictures: Sequence[str] = ()
) -> list[Problem]:
    """Stamps that are missing, or that come from different clocks.

    ``pictures``: topics of pictures that label points.
    """
    labels = roles.label_of.values()
    sensors = [*roles.ranging, *roles.topics("stereo_right"), *labels, *pictures]
    others = [*roles.topics("imu"), *roles.topics("gnss")]
    return _problems(offsets, pose_topic(offsets, roles, poses), sensors, others)


def pose_topic(offsets: StampOffsets, roles: Roles, poses: BasePoses) -> str | None:
    """The topic that the poses come from; None where another source has no messages."""
    if poses.source is not None:
        return poses.source.name
    if poses.edge is None:
        return roles.pose
    end = edge_topic("", poses.edge)
    return next((topic for topic in offsets.topics if topic.endswith(end)), None)


def _problems(
    offsets: StampOffsets, poses: str | None, sensors: Sequence[str], others: Sequence[str]
) -> list[Problem]:
    """As :func:`stamp_problems`: ``sensors`` need the poses of the topic ``poses``.

    The most important first. ``others`` are named too, but the map does not depend on their times.
    """
    named = dict.fromkeys([*([poses] if poses is not None else []), *sensors, *others])
    known = {topic: offset for topic in named if (offset := offsets.of(topic)) is not None}
    problems = [_unstamped(t, o) for t, o in sorted(known.items()) if o.without_stamp]
    needed = [t for t in (poses, *sensors) if t is not None]
    stuck = {t: o for t, o in known.items() if o.is_stuck and t in needed}
    problems += [_stuck(topic, offset) for topic, offset in stuck.items()]
    stamped = {t: o for t, o in known.items() if o.without_stamp < o.messages and t not in stuck}

    # the poses are what the others are compared with; without any, the first sensor
    reference = next(iter(stamped), None)
    if reference is None:
        return problems
    usual = stamped.pop(reference)
    different = []
    for topic, offset in stamped.items():
        relative = offsets.relative(topic, reference)
        shift = float(np.median(relative))
        is_clear = min(offset.median, usual.median) < -_CLEARLY_LATER or abs(shift) > _EARLIEST
        is_used = topic not in others
        if _is_other_clock(offset, usual, shift):
            is_assumed = is_used and is_clear
            different.append(_Difference(topic, offset, reference, usual, shift, is_assumed))
        elif abs(step := _step(relative)) > _EARLIEST:
            problems.append(_changed(topic, reference, step, assumed=is_used))
    if not different:
        return [*problems, *([_all_alike(reference, usual)] if _is_impossible(usual) else [])]

    # where only the reference is off, it is the one to name
    is_reference_off = _is_impossible(usual) and not any(map(_is_impossible, stamped.values()))
    if is_reference_off:
        different = [different[0].swapped()]
    return problems + [d.problem(offsets.added(d.topic)) for d in different]


def _is_impossible(offset: StampOffset) -> bool:
    """Whether the stamps and the times of recording cannot be of one clock."""
    return offset.median < -_LATEST or offset.median > _EARLIEST


def _is_other_clock(a: StampOffset, b: StampOffset, shift: float) -> bool:
    """Whether two topics cannot be stamped by one clock; ``shift`` lies between their offsets."""
    is_one_ahead = min(a.median, b.median) < -_LATEST < max(a.median, b.median)
    return abs(shift) > (_LATEST if is_one_ahead else _EARLIEST)


def _step(relative: F64) -> float:
    """The change of offsets from the first to the last quarter of the messages."""
    quarter = len(relative) // 4
    if len(relative) < _FEWEST:
        return 0.0
    return float(np.median(relative[-quarter:]) - np.median(relative[:quarter]))


@dataclass(frozen=True, slots=True)
class _Difference:
    """``topic`` is stamped by another clock than ``other``: ``shift`` (s) is between them.

    ``is_assumed``: the map rests on these stamps, and they are clearly wrong.
    """

    topic: str
    offset: StampOffset
    other: str
    its: StampOffset
    shift: float
    is_assumed: bool

    def swapped(self) -> _Difference:
        """The same difference, named at the other topic."""
        return _Difference(
            self.other, self.its, self.topic, self.offset, -self.shift, self.is_assumed
        )

    def problem(self, added: float) -> Problem:
        """The sentence, where the settings have ``added`` seconds to the stamps already."""
        shift, cause = _usual_shift(self.shift)
        topic = self.topic.partition(" ")[0]
        size = f"{_duration(shift)} ({cause})" if cause else f"about {_duration(shift)}"
        text = (
            f"{self.topic}: its header stamps are {_beside_log_time(self.offset.median)}, the ones "
            f"of {self.other} {_beside_log_time(self.its.median)}: their clocks differ by {size}; "
            f"give --set logs.time_offset.{topic}={shift + added:.2f}, or --stamps log."
        )
        return Problem(topic, ProblemKind.STAMP, text, lost=False, assumed=self.is_assumed)


def _usual_shift(shift: float) -> tuple[float, str]:
    """A shift near a usual one is taken to be that, less a latency; and its cause."""
    sign = float(np.sign(shift))
    for usual, cause in _USUAL:
        if abs(abs(shift) - usual) < _NEARLY:
            return sign * usual, cause
    zones = round(abs(shift) / _TIME_ZONE)
    if 0 < zones <= 48 and abs(abs(shift) - zones * _TIME_ZONE) < _NEARLY:
        return sign * zones * _TIME_ZONE, "a time zone"
    return shift, ""


def lead(offsets: StampOffsets, topic: str, poses: str) -> float:
    """By how much (s) the stamps of a topic are later than its recording, and the poses' are not.

    In a part of the log at least: a clock may have been set. No clock of the recording makes that.
    """
    if offsets.of(topic) is None or offsets.of(poses) is None:
        return 0.0
    own = offsets.latest(topic)
    relative = offsets.relative(topic, poses)
    parts = np.array_split(relative, _PARTS) if len(relative) >= _FEWEST else [relative]
    least = min(float(np.median(part)) for part in parts)
    later = -min(least, 0.0)
    return later if later > _CLEARLY_LATER and own > _LATEST else 0.0


def steady_shift(offsets: StampOffsets, topic: str, poses: str) -> float:
    """By how much (s) stamps of a topic are earlier beside their recording than the poses' are.

    0 where it differs from message to message, as where one of both is recorded when it can be.
    """
    if offsets.of(topic) is None or offsets.of(poses) is None:
        return 0.0
    relative = offsets.relative(topic, poses)
    spread = float(np.quantile(relative, 0.9) - np.quantile(relative, 0.1))
    return float(np.median(relative)) if spread < _NEARLY else 0.0


def _stuck(topic: str, offset: StampOffset) -> Problem:
    text = (
        f"{topic}: {offset.stuck} of {offset.messages} header stamps hardly differ from the one of"
        " the message before, although they were recorded at other times: their clock stands still"
        " or counts in other units; use the times of recording with --set logs.stamps=log."
    )
    name = topic.partition(" ")[0]
    return Problem(name, ProblemKind.STAMP, text, lost=False, assumed=True)


def _unstamped(topic: str, offset: StampOffset) -> Problem:
    count = offset.without_stamp
    every = f"all {count}" if count == offset.messages else f"{count} of {offset.messages}"
    text = (
        f"{topic}: {every} header stamps are 0 or missing: the times of recording are used instead."
    )
    return Problem(topic.partition(" ")[0], ProblemKind.STAMP, text, lost=False)


def _changed(topic: str, reference: str, step: float, *, assumed: bool) -> Problem:
    text = (
        f"{topic}: its header stamps change by {_duration(step)} against the ones of {reference} "
        f"while the log is recorded: a clock was set, or messages waited to be recorded; cut the "
        f"log there."
    )
    return Problem(topic.partition(" ")[0], ProblemKind.STAMP, text, lost=False, assumed=assumed)


def _all_alike(topic: str, offset: StampOffset) -> Problem:
    text = (
        f"{topic}: its header stamps are {_beside_log_time(offset.median)}, and the ones of the "
        f"other topics alike: they are used, because they agree with each other."
    )
    return Problem(topic.partition(" ")[0], ProblemKind.STAMP, text, lost=False)


def _beside_log_time(offset: float) -> str:
    """Where stamps lie beside log times: 37.00 s later than their recording."""
    if abs(offset) < _AT_ONCE:
        return "at the time of their recording"
    return f"{_duration(offset)} {'earlier' if offset >= 0 else 'later'} than their recording"


def _duration(seconds: float) -> str:
    """A length of time for people."""
    size = abs(seconds)
    if size >= _YEAR:
        return f"{size / _YEAR:.1f} years"
    return f"{size / 3600.0:.2f} hours" if size >= 7200.0 else f"{size:.2f} s"
