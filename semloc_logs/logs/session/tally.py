"""Counts the used and the left out frames of each topic."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from semloc_logs.frames import Header, LidarFrame, PointTimeRemark
from semloc_logs.logs.messages.point_times import off_stamp_ns
from semloc_logs.logs.messages.stamps import duration, time_range, utc
from semloc_logs.logs.poses.tf_tree import frame_name
from semloc_logs.logs.poses.track import PoseTrack
from semloc_logs.logs.problems import NoCloud, Problem, ProblemKind

_REMARKS = {
    PointTimeRemark.OTHER_CLOCK: (
        "sweeps have point times of another clock than their header: the first point is taken to "
        "be measured at the header's time"
    ),
    PointTimeRemark.UNUSABLE: (
        "sweeps are used as measured, with the motion of the vehicle in them: their point times "
        "are not times within a sweep"
    ),
    PointTimeRemark.OTHER_UNIT: (
        "sweeps have point times in microseconds or milliseconds, it seems: in nanoseconds, as "
        "their message defines them, more points would be measured than any sensor can"
    ),
    PointTimeRemark.OFF_STAMP: (
        "sweeps have points that were all measured {gap:.2f} s or more before or after the time of "
        "their header: the times of the points are used, but one of both is wrong"
    ),
}


@dataclass(slots=True)
class _LeftOut:
    """Frames of a topic that one reason leaves out: frame id of the first, range of stamps."""

    frame_id: str
    first_ns: int
    last_ns: int
    count: int = 0

    def add(self, stamp_ns: int) -> None:
        """Counts one more."""
        self.count += 1
        self.first_ns = min(self.first_ns, stamp_ns)
        self.last_ns = max(self.last_ns, stamp_ns)

    def sentence(self, topic: str, reason: NoCloud, track: PoseTrack, base: str) -> str:
        """The end of a sentence, with the facts about these frames."""
        start_ns = self.first_ns if track.start_ns is None else track.start_ns
        end_ns = self.last_ns if track.end_ns is None else track.end_ns
        return reason.because.format(
            topic=topic,
            frame=frame_name(self.frame_id),
            base=base,
            frames=time_range(self.first_ns, self.last_ns),
            start=utc(start_ns),
            end=utc(end_ns),
            before=duration(start_ns - self.first_ns),
            after=duration(self.last_ns - end_ns),
            gaps=self._gaps(track),
        )

    def _gaps(self, track: PoseTrack) -> str:
        """The gaps of the poses between the first and the last of these frames."""
        gaps = [
            end_ns - start_ns
            for start_ns, end_ns in track.gaps()
            if start_ns <= self.last_ns and self.first_ns <= end_ns
        ]
        longest = duration(max(gaps, default=0))
        return f"a gap of {longest}" if len(gaps) == 1 else f"{len(gaps)} gaps of up to {longest}"


def _why_no_pose(stamp_ns: int, track: PoseTrack) -> NoCloud:
    """Why no pose was known at a time; ``track`` is complete by now."""
    if track.start_ns is None or track.end_ns is None:
        return NoCloud.NO_POSES
    if track.at(stamp_ns) is not None:
        return NoCloud.LATE_POSE
    if stamp_ns < track.start_ns:
        return NoCloud.BEFORE_POSES
    return NoCloud.AFTER_POSES if stamp_ns > track.end_ns else NoCloud.POSE_GAP


class Tally:
    """Frames seen, used and left out by topic and reason."""

    def __init__(self) -> None:
        self.seen: Counter[str] = Counter()
        self.used: Counter[str] = Counter()
        self._left_out: dict[tuple[str, NoCloud], _LeftOut] = {}
        self._without_pose: list[Header] = []
        self._points: Counter[str] = Counter()
        self._lost_points: Counter[str] = Counter()
        self._without_return: Counter[str] = Counter()
        self._unclaimed: Counter[str] = Counter()
        self._off_stamp_ns: dict[str, int] = {}
        self._span_ns: dict[str, int] = {}
        self._remarks: Counter[tuple[str, PointTimeRemark]] = Counter()

    def saw(self, topic: str) -> None:
        """Counts a frame."""
        self.seen[topic] += 1

    def leave_out(self, header: Header, reason: NoCloud) -> None:
        """Counts a frame that gives no cloud."""
        left_out = self._left_out.setdefault(
            (header.topic, reason), _LeftOut(header.frame_id, header.stamp_ns, header.stamp_ns)
        )
        left_out.add(header.stamp_ns)
        if reason is NoCloud.NO_POSE:
            self._without_pose.append(header)

    def explain(self, track: PoseTrack) -> None:
        """Tells why poses are missing, once all poses of the ``track`` have come."""
        for topic, reason in list(self._left_out):
            if reason is NoCloud.NO_POSE:
                del self._left_out[topic, reason]
        waiting = self._without_pose
        self._without_pose = []
        for header in waiting:
            self.leave_out(header, _why_no_pose(header.stamp_ns, track))

    def measured(self, frame: LidarFrame) -> None:
        """Counts the points of a sweep, and the remark on it."""
        topic = frame.header.topic
        self._points[topic] += len(frame.points) + frame.lost
        self._points[topic] += frame.without_return
        self._lost_points[topic] += frame.lost
        self._without_return[topic] += frame.without_return
        self._unclaimed[topic] += frame.unclaimed
        if frame.remark is not None:
            self._remarks[topic, frame.remark] += 1
        if frame.offset_ns is not None and len(frame.offset_ns):
            span_ns = int(frame.offset_ns.max()) - int(frame.offset_ns.min())
            self._span_ns[topic] = max(span_ns, self._span_ns.get(topic, 0))
        if frame.remark is PointTimeRemark.OFF_STAMP and frame.offset_ns is not None:
            gap_ns = off_stamp_ns(frame.offset_ns)
            self._off_stamp_ns[topic] = min(gap_ns, self._off_stamp_ns.get(topic, gap_ns))

    def off_stamp(self, topic: str) -> float:
        """From the header of most sweeps to their nearest point, s; 0 where it is as usual."""
        count = self._remarks[topic, PointTimeRemark.OFF_STAMP]
        is_usual = 2 * count <= self.seen[topic]
        return 0.0 if is_usual else self._off_stamp_ns[topic] * 1e-9

    def sweep_span(self, topic: str) -> float:
        """From the first to the last point of the longest sweep, s; 0 without times of points."""
        return self._span_ns.get(topic, 0) * 1e-9

    def left_out(self, topic: str) -> dict[str, int]:
        """Key of each reason -> frames of ``topic``."""
        counts = {
            reason.key: left_out.count
            for (other, reason), left_out in self._left_out.items()
            if other == topic
        }
        return dict(sorted(counts.items()))

    def problems(self, track: PoseTrack, base: str) -> list[Problem]:
        """One problem for each topic and reason: lost frames, lost points, unusual point times.

        ``track``: the poses; ``base``: name of the base frame.
        """
        return [
            *self._lost_frames(track, base),
            *self._not_finite(),
            *self._not_returned(),
            *self._not_claimed(),
            *self._unusual_times(),
        ]

    def _lost_frames(self, track: PoseTrack, base: str) -> list[Problem]:
        problems = []
        for (topic, reason), left_out in sorted(
            self._left_out.items(), key=lambda item: (item[0][0], item[0][1].key)
        ):
            if reason is NoCloud.DUPLICATE:
                continue
            because = left_out.sentence(topic, reason, track, base)
            text = (
                f"{topic}: {left_out.count} of {self.seen[topic]} frames are left out: {because}."
            )
            problems.append(Problem(topic, ProblemKind.FRAME, text, lost=True))
        return problems

    def _not_finite(self) -> list[Problem]:
        return [
            Problem(
                topic,
                ProblemKind.FRAME,
                f"{topic}: {count} of {self._points[topic]} points are left out: they are not "
                f"finite, although their clouds call themselves dense.",
                lost=True,
            )
            for topic, count in sorted((+self._lost_points).items())
        ]

    def _not_returned(self) -> list[Problem]:
        return [
            Problem(
                topic,
                ProblemKind.FRAME,
                f"{topic}: {count} of {self._points[topic]} points are left out: they all have one "
                f"range, the greatest or in many directions: rays of which nothing came back.",
                lost=False,
            )
            for topic, count in sorted((+self._without_return).items())
        ]

    def _not_claimed(self) -> list[Problem]:
        return [
            Problem(
                topic,
                ProblemKind.FRAME,
                f"{topic}: its clouds hold {count} points beside the {self._points[topic]} that "
                f"their width and height claim, and these are left out: record clouds whose width, "
                f"height and row_step fit their data.",
                lost=True,
            )
            for topic, count in sorted((+self._unclaimed).items())
        ]

    def _unusual_times(self) -> list[Problem]:
        return [
            Problem(
                topic,
                ProblemKind.POINT_TIME,
                f"{topic}: {count} of {self.seen[topic]} "
                f"{_REMARKS[remark].format(gap=self._off_stamp_ns.get(topic, 0) * 1e-9)}.",
                lost=False,
                assumed=remark is PointTimeRemark.OFF_STAMP,
            )
            for (topic, remark), count in sorted(
                self._remarks.items(), key=lambda item: (item[0][0], item[0][1].value)
            )
        ]
