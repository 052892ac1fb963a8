"""The poses of one topic: of one frame in another, by one publisher."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from typing import NamedTuple

from semloc_logs.arrays import F64
from semloc_logs.frames import PoseSample, TransformSample
from semloc_logs.logs.poses.publishers import OnePublisher, publisher_of
from semloc_logs.logs.poses.tf_tree import frame_name
from semloc_logs.logs.problems import Problem, ProblemKind

FEWEST = 20  # poses after which the most frequent kind of them is known well enough


class PoseKind(NamedTuple):
    """Whose pose it is, in which frame, and by which publisher."""

    parent: str
    child: str
    publisher: str


class PoseStream:
    """Samples of the pose topic as they come; :meth:`choose` decides which kind of them counts.

    ``wanted``: the name of a frame or of a publisher that the user chose, "" without a choice.
    """

    def __init__(self, topic: str, wanted: str = "") -> None:
        self.topic = topic
        self.chosen: PoseKind | None = None
        self.count = 0
        self._wanted = frame_name(wanted)
        self._publisher = wanted
        self._counts: Counter[PoseKind] = Counter()
        self._waiting: dict[PoseKind, list[PoseSample | TransformSample]] = {}
        self._one: OnePublisher | None = None
        self._is_settled_by_log = True

    def take(self, sample: PoseSample | TransformSample) -> bool:
        """The next sample; whether it counts, which is not known before the choice."""
        self.count += 1
        parent = frame_name(sample.header.frame_id)
        child = frame_name(sample.child_frame_id)
        # the pose of a frame in itself: nobody filled in the name
        kind = PoseKind(parent, "" if child == parent else child, publisher_of(sample))
        self._counts[kind] += 1
        if self.chosen is None or self._one is None:
            self._waiting.setdefault(kind, []).append(sample)
            return False
        return kind[:2] == self.chosen[:2] and self._one.accepts(sample)

    def best(self, is_connected: Callable[[str], bool]) -> PoseKind | None:
        """The kind to use by what has come: its frame ``is_connected`` with the sensors.

        Else the one with the most samples. None before any that the user wants.
        """
        return min(self._able(), key=lambda kind: self._rank(kind, is_connected), default=None)

    def _able(self) -> list[PoseKind]:
        wanted = self._wanted
        return [
            kind
            for kind in self._counts
            if not wanted
            or wanted in (kind.parent, kind.child)
            or kind.publisher.endswith(f" by {self._publisher}")
        ]

    def _rank(self, kind: PoseKind, is_connected: Callable[[str], bool]) -> tuple[bool, int]:
        return not (kind.child and is_connected(kind.child)), -self._counts[kind]

    def choose(
        self, kind: PoseKind, is_connected: Callable[[str], bool]
    ) -> Iterator[tuple[int, F64]]:
        """Uses one kind from now on; gives the stamps and poses of it that have come."""
        self.chosen = kind
        is_known = not self._rank(kind, is_connected)[0]
        self._is_settled_by_log = is_known and not any(
            is_connected(other.child) for other in self._able() if other[:2] != kind[:2]
        )
        self._one = OnePublisher(kind.publisher)
        waiting = self._waiting
        self._waiting = {}
        samples = [s for k, several in waiting.items() if k[:2] == kind[:2] for s in several]
        samples.sort(key=lambda s: s.header.log_time_ns)
        for sample in samples:
            if self._one.accepts(sample):
                yield sample.header.stamp_ns, sample.frame_T_child

    def problems(self) -> list[Problem]:
        """Poses that are not used because they are of other frames, or of other publishers."""
        chosen = self.chosen
        problems = []
        if self._wanted and not self._able() and self._counts:
            seen = ", ".join(f"'{k.child}' in '{k.parent}'" for k in sorted(self._counts))
            text = (
                f"{self.topic} gives no pose of or in '{self._wanted}', but {seen}: name another "
                f"with --topic pose={self.topic}:FRAME."
            )
            problems.append(Problem(self.topic, ProblemKind.POSE, text, lost=True))
        if chosen is None or self._one is None:
            return problems
        others: Counter[tuple[str, str]] = Counter()
        for kind, count in self._counts.items():
            if kind[:2] != chosen[:2]:
                others[kind[:2]] += count
        if others:
            problems.append(self._other_frames(chosen, others))
        if self._one.is_contradicted:
            what = f"the pose of '{chosen.child}' in '{chosen.parent}'"
            remedy = f"--topic pose={self.topic}:PUBLISHER chooses another"
            is_assumed = not self._wanted
            problems.append(self._one.problem(self.topic, what, remedy, assumed=is_assumed))
        return problems

    def _other_frames(self, chosen: PoseKind, others: Counter[tuple[str, str]]) -> Problem:
        """Names the frames whose poses are left out."""
        listed = ", ".join(
            f"{count} of '{child}' in '{parent}'"
            for (parent, child), count in sorted(others.items())
        )
        parent, child = next(iter(sorted(others)))
        other = child if child != chosen.child else parent
        used = sum(n for kind, n in self._counts.items() if kind[:2] == chosen[:2])
        text = (
            f"{self.topic} gives poses of several frames: {used} of '{chosen.child}' in "
            f"'{chosen.parent}' are used, {listed} are not; --topic pose={self.topic}:{other} "
            f"chooses them."
        )
        is_assumed = not (self._wanted or self._is_settled_by_log)
        return Problem(self.topic, ProblemKind.POSE, text, lost=False, assumed=is_assumed)
