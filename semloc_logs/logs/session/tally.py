"""Counts the used and the left out frames of each topic."""

from __future__ import annotations

from collections import Counter

from semloc_logs.frames import LidarFrame, PointTimeRemark
from semloc_logs.logs.messages.stamps import time_range
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
}


class Tally:
    """Frames seen, used and left out by topic and reason."""

    def __init__(self) -> None:
        self.seen: Counter[str] = Counter()
        self.used: Counter[str] = Counter()
        self._left_out: Counter[tuple[str, NoCloud]] = Counter()
        self._spans: dict[str, tuple[int, int]] = {}
        self._points: Counter[str] = Counter()
        self._lost_points: Counter[str] = Counter()
        self._remarks: Counter[tuple[str, PointTimeRemark]] = Counter()

    def saw(self, topic: str, stamp_ns: int) -> None:
        """Counts a frame."""
        self.seen[topic] += 1
        first, last = self._spans.get(topic, (stamp_ns, stamp_ns))
        self._spans[topic] = (min(first, stamp_ns), max(last, stamp_ns))

    def leave_out(self, topic: str, reason: NoCloud) -> None:
        """Counts a frame that gives no cloud."""
        self._left_out[topic, reason] += 1

    def measured(self, frame: LidarFrame) -> None:
        """Counts the points of a sweep, and the remark on it."""
        topic = frame.header.topic
        self._points[topic] += len(frame.points) + frame.lost
        self._lost_points[topic] += frame.lost
        if frame.remark is not None:
            self._remarks[topic, frame.remark] += 1

    def left_out(self, topic: str) -> dict[str, int]:
        """Key of each reason -> frames of ``topic``."""
        counts = {reason.key: n for (other, reason), n in self._left_out.items() if other == topic}
        return dict(sorted(counts.items()))

    def problems(self, poses: tuple[int | None, int | None]) -> list[Problem]:
        """One problem for each topic and reason: lost frames, lost points, unusual point times.

        ``poses``: the first and last stamp of the pose stream.
        """
        return [*self._lost_frames(poses), *self._not_finite(), *self._unusual_times()]

    def _lost_frames(self, poses: tuple[int | None, int | None]) -> list[Problem]:
        problems = []
        for (topic, reason), count in sorted(
            self._left_out.items(), key=lambda item: (item[0][0], item[0][1].key)
        ):
            if reason is NoCloud.DUPLICATE:
                continue
            because = reason.because.format(
                frames=time_range(*self._spans[topic]), poses=time_range(*poses)
            )
            text = f"{topic}: {count} of {self.seen[topic]} frames are left out: {because}."
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

    def _unusual_times(self) -> list[Problem]:
        return [
            Problem(
                topic,
                ProblemKind.POINT_TIME,
                f"{topic}: {count} of {self.seen[topic]} {_REMARKS[remark]}.",
                lost=False,
            )
            for (topic, remark), count in sorted(
                self._remarks.items(), key=lambda item: (item[0][0], item[0][1].value)
            )
        ]
