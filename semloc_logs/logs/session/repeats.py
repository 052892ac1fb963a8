"""Frames that repeat the one before: a driver that hangs publishes its last measurement again."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from semloc_logs.frames import DepthFrame, LidarFrame
from semloc_logs.logs.messages.stamps import time_range
from semloc_logs.logs.poses.track import PoseTrack
from semloc_logs.logs.session.frame_queue import RangeFrame

_FEWEST = 3000  # values of a frame; so many are never measured twice alike
_MOST_RUNS = 1000  # of a topic; a driver that hangs more often is broken for sure
_MOVED = 0.3  # m; the surroundings look another way from there


@dataclass(slots=True)
class _Run:
    """Frames after the first one that are the same as it."""

    start_ns: int
    end_ns: int
    count: int = 1


@dataclass(slots=True)
class _Topic:
    """The measurement of the last frame, its stamp, and the runs of repeated ones."""

    last: NDArray[np.float32]
    stamp_ns: int
    is_repeating: bool = False
    runs: list[_Run] = field(default_factory=list)


class Repeats:
    """Finds frames whose measurements are exactly the ones of the frame before."""

    def __init__(self) -> None:
        self._topics: dict[str, _Topic] = {}

    def take(self, frame: RangeFrame) -> bool:
        """The next frame; whether it repeats the one before. Pictures are not compared."""
        values = _values(frame)
        if values is None or values.size < _FEWEST:
            return False
        header = frame.header
        topic = self._topics.get(header.topic)
        if topic is None or not _are_same(topic.last, values):
            runs = [] if topic is None else topic.runs
            self._topics[header.topic] = _Topic(values, header.stamp_ns, runs=runs)
            return False
        if topic.is_repeating:
            topic.runs[-1].end_ns = header.stamp_ns
            topic.runs[-1].count += 1
        elif len(topic.runs) < _MOST_RUNS:
            topic.runs.append(_Run(topic.stamp_ns, header.stamp_ns))
            topic.is_repeating = True
        return True

    def text(self, topic: str, track: PoseTrack) -> str:
        """What is wrong where a topic repeated frames while the vehicle moved; else empty.

        A simulated one that stands still measures the same again and again.
        """
        known = self._topics.get(topic)
        runs = [] if known is None else [run for run in known.runs if _has_moved(track, run)]
        if not runs:
            return ""
        longest = max(runs, key=lambda run: run.count)
        return (
            f"{sum(run.count for run in runs)} of its measurements are exactly the one before,"
            " although the vehicle moves"
            f" ({time_range(longest.start_ns, longest.end_ns)} at the longest): the driver hung, or"
            " messages were recorded again with other stamps; cut the log there"
        )


def _values(frame: RangeFrame) -> NDArray[np.float32] | None:
    if isinstance(frame, LidarFrame):
        return frame.points
    return frame.depth if isinstance(frame, DepthFrame) else None


def _are_same(a: NDArray[np.float32], b: NDArray[np.float32]) -> bool:
    return a.shape == b.shape and bool(np.array_equal(a[:8], b[:8])) and np.array_equal(a, b)


def _has_moved(track: PoseTrack, run: _Run) -> bool:
    poses, known = track.at_many(np.array([run.start_ns, run.end_ns], np.int64))
    return bool(known.all()) and bool(np.linalg.norm(poses[1, :3, 3] - poses[0, :3, 3]) > _MOVED)
