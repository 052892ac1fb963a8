"""What became of the frames of each topic: counted, and told in sentences."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from datetime import UTC, datetime

from semloc_logs.frames import LidarFrame
from semloc_logs.logs.poses.track import PoseTrack

# a vehicle may well stand so long, but a log of nothing else is worth a sentence
_STANDSTILL_NS = 10_000_000_000
COPY = "copy"  # nothing is lost with the frames of a topic that repeats another's
BACK_IN_TIME = "back in time"
_WHY = {
    "no pose": "no pose is known at their time ({spans}): the pose stream has a gap there, or its clock differs from the sensor's",
    "no transform": "no transform leads from their frame to the base frame: record /tf_static, or leave the topic out with --topic",
    "no calibration": "no CameraInfo belongs to them: record it, or name it with --topic camera_info=TOPIC",
    "unusable calibration": "their CameraInfo cannot be used",
    "no depth": "they are colour or 8-bit pictures, not depth: choose another topic with --topic depth=TOPIC",
    "no calibration of the right": "no CameraInfo belongs to the right camera: record it, or name both by --topic camera_info=TOPIC,TOPIC",
    "no picture": "they are depth images, not pictures: choose another topic with --topic stereo_left=TOPIC",
    "no partner": "the right camera has no picture within half a frame period of theirs",
    "other size": "the picture of the right camera has another size",
    "same picture": "the right camera has the very same picture: choose two cameras with --topic stereo_left=TOPIC stereo_right=TOPIC",
    "unusable pair": "the calibrations of the pair cannot be used",
    "no points": "they have no points within the range limits",
    BACK_IN_TIME: "their stamps fall back behind those of earlier frames: the clock was set back; cut the log there",
    "empty": "they hold no points, or none whose position is a number",
}
_REMARKS = {
    "times": "sweeps are used as measured, with the motion of the vehicle in them: their point times are no times within a sweep",
    "clock": "sweeps have point times of another clock than their header: the first point is taken to be measured at the header's time",
}


class Tally:
    """Frames seen, used and left out by topic and reason."""

    def __init__(self) -> None:
        self.seen: Counter[str] = Counter()
        self.used: Counter[str] = Counter()
        self._left_out: Counter[tuple[str, str]] = Counter()
        self._spans: dict[str, tuple[int, int]] = {}
        self._points: Counter[str] = Counter()
        self._lost_points: Counter[str] = Counter()
        self._remarks: Counter[tuple[str, str]] = Counter()

    def saw(self, topic: str, stamp_ns: int) -> None:
        """Counts a frame."""
        self.seen[topic] += 1
        first, last = self._spans.get(topic, (stamp_ns, stamp_ns))
        self._spans[topic] = (min(first, stamp_ns), max(last, stamp_ns))

    def leave_out(self, topic: str, reason: str) -> None:
        """Counts a frame that gives no cloud; ``reason`` is one of the keys that have a sentence."""
        self._left_out[topic, reason] += 1

    def measured(self, frame: LidarFrame) -> None:
        """Counts the points of a sweep and what was remarked on it."""
        topic = frame.header.topic
        self._points[topic] += len(frame.points) + frame.lost
        self._lost_points[topic] += frame.lost
        if frame.remark:
            self._remarks[topic, frame.remark] += 1

    def remarks(self) -> list[str]:
        """One sentence for each topic and remark on its sweeps: what was assumed, nothing was lost."""
        return [
            f"{topic}: {count} of {self.seen[topic]} {_REMARKS[key]}."
            for (topic, key), count in sorted(self._remarks.items())
        ]

    def left_out(self, topic: str) -> dict[str, int]:
        """Reason -> frames of ``topic``."""
        return {
            reason: count for (t, reason), count in sorted(self._left_out.items()) if t == topic
        }

    def sentences(self, poses: tuple[int | None, int | None]) -> list[str]:
        """One sentence for each topic and reason; ``poses``: the first and last stamp of the pose
        stream.
        """
        told = []
        for (topic, reason), count in sorted(self._left_out.items()):
            if reason == COPY:
                continue
            spans = f"frames {span(*self._spans[topic])}, poses {span(*poses)}"
            told.append(
                f"{topic}: {count} of {self.seen[topic]} frames are left out: {_WHY[reason].format(spans=spans)}."
            )
        for topic, count in sorted((+self._lost_points).items()):
            of = f"{count} of {self._points[topic]} points"
            told.append(
                f"{topic}: {of} are left out: they are not finite, although their clouds call themselves dense."
            )
        return told


def no_poses(name: str) -> str:
    """What follows from a log without any pose."""
    return (
        f"{name} has no pose stream: its frames can be searched one by one, but no map is built; "
        f"for a map use --odometry lidar, give a trajectory with --poses FILE, or name a topic with --topic pose=TOPIC."
    )


def refused(topic: str, track: PoseTrack) -> list[str]:
    """A sentence about poses whose stamps make no sense. Empty when all is well."""
    kinds = (
        (track.duplicates, "repeated"),
        (track.backwards, "back in time"),
        (track.ahead, "far ahead in time"),
    )
    counts = [f"{count} {what}" for count, what in kinds if count]
    return [f"{topic}: poses that are {' and '.join(counts)} were left out."] if counts else []


def smeared(topic: str, shift: float) -> str:
    """What follows from poses that stand still while the surroundings move by ``shift`` metres or
    more.
    """
    return (
        f"{topic} gives the same position all the time, but the surroundings move by {shift:.1f} m or more: its poses, and what is mapped "
        f"with them, are wrong; use --odometry lidar, give poses with --poses FILE, or name a topic with --topic pose=TOPIC."
    )


def never_moves(topic: str, track: PoseTrack) -> list[str]:
    """A sentence about a pose stream whose position is constant: odometry that was never filled in.
    Empty when all is well.
    """
    start_ns = track.start_ns
    end_ns = track.end_ns
    if (
        start_ns is None
        or end_ns is None
        or end_ns - start_ns < _STANDSTILL_NS
        or track.length() > 0.0
    ):
        return []
    seconds = (end_ns - start_ns) * 1e-9
    return [
        f"{topic} gives the same position for {seconds:.0f} s: name another with --topic pose=TOPIC if the vehicle moved."
    ]


def without_unused(problems: Sequence[str], unused: Collection[str]) -> list[str]:
    """The problems of a log apart from those of topics that nobody asks for: they begin with the
    topic's name.
    """
    return [p for p in problems if p.partition(": ")[0] not in unused]


def span(start_ns: int | None, end_ns: int | None) -> str:
    """A time range for people."""
    return "none" if start_ns is None or end_ns is None else f"{_time(start_ns)} to {_time(end_ns)}"


def _time(stamp_ns: int) -> str:
    try:
        return (
            datetime.fromtimestamp(stamp_ns / 1e9, UTC).strftime("%Y-%m-%dT%H:%M:%S.%f")[:-3] + "Z"
        )
    except (OverflowError, ValueError, OSError):
        return f"{stamp_ns} ns"
