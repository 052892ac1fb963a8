"""Static transforms that a session lacks and another log of the same command has.

A recording in several files has /tf_static only in the first. A few messages of each log are
read: the first of every sensor, and static transforms until the frames of the sensors connect.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from itertools import pairwise
from pathlib import Path

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.errors import LogError
from semloc_logs.frames import PoseSample, TransformSample
from semloc_logs.logs.containers.base import merged_streams
from semloc_logs.logs.containers.memory import DEFAULT
from semloc_logs.logs.containers.open import open_log
from semloc_logs.logs.log import Log
from semloc_logs.logs.poses.base_frame import BASE_LINK
from semloc_logs.logs.poses.mountings import Mountings, StaticTransform, matrix
from semloc_logs.logs.poses.tf_tree import Edge, TransformTree, frame_name
from semloc_logs.logs.problems import Problem, ProblemKind
from semloc_logs.logs.roles import Roles, guess_roles
from semloc_logs.numerics.transforms import translation_quaternion

# moving transforms are read so far (log time): a mounting that turns is published all the time
_MOVING_NS = 20_000_000_000
_SAME = 1e-3  # m, and of a quaternion: two logs give the same mounting


def lent_transforms(
    paths: Sequence[Path],
    others: Sequence[Path],
    topics: Mapping[str, str],
    child: str | None,
    *,
    memory: int = DEFAULT,
) -> Mountings:
    """The static transforms that the session of the logs ``paths`` holds from its start.

    These are its own, and the ones that it lacks between the frames of its sensors and its base
    frame and that one of the ``others`` has. ``topics`` overrules roles; ``child``: the frame of
    poses that are not in the log. At most ``memory`` bytes of a log are in memory at once. LogError
    for logs that cannot be read.
    """
    logs: list[Log] = []
    try:
        logs.extend(open_log(path, memory) for path in paths)
        logs.sort(key=lambda log: (log.start_ns is None, log.start_ns or 0))
        frames = _Frames(logs, topics, child)
        missing = frames.missing()
        lent = _Lent(frames.tree, frames.reference, missing, memory) if missing else None
    finally:
        for log in logs:
            log.close()
    own = tuple(_static(edge, pose) for edge, pose in frames.tree.static_poses.items())
    if lent is None:
        return Mountings(own=own)
    for path in others:
        lent.take(path)
    name = " + ".join(path.name for path in paths)
    return Mountings(own=own, lent=lent.transforms, problems=tuple(lent.problems(name)))


def _static(edge: Edge, pose: F64) -> StaticTransform:
    position, quaternion = translation_quaternion(pose)
    return StaticTransform(*edge, tuple(map(float, (*position, *quaternion))))


class _Frames:
    """The frames of a session's sensors, and the transforms between them.

    ``reference``: the frame that all of them have to be connected with.
    """

    def __init__(self, logs: Sequence[Log], topics: Mapping[str, str], child: str | None) -> None:
        self.tree = TransformTree()
        self._logs = logs
        self._roles: Roles = guess_roles(merged_streams(logs), topics)
        roles = self._roles
        infos = (roles.info_of[t] for t in (*roles.image, *roles.label_image) if t in roles.info_of)
        self._sensors = [
            frame_name(frame_id)
            for topic in (*roles.ranging, *infos, *roles.topics("imu"), *roles.topics("gnss"))
            if (frame_id := self._first_frame_id(topic)) is not None
        ]
        if child is None and roles.pose is not None:
            child = self._first_child(roles.pose)
        first = self._sensors[0] if self._sensors and child == "" else BASE_LINK
        self.reference = frame_name(child or "") or first

    def missing(self) -> list[str]:
        """The frames of sensors that the session's own transforms do not connect."""
        for sample in self._transforms():
            self.tree.add(sample)
            if not self._unconnected():
                break
        return self._unconnected()

    def _unconnected(self) -> list[str]:
        return [s for s in self._sensors if not self.tree.connected(self.reference, s)]

    def _transforms(self) -> Iterator[TransformSample]:
        """Static transforms, those that hang below moving ones after them."""
        yield from self._samples(self._roles.tf_static, None)
        yield from self._samples(self._roles.tf, _MOVING_NS)

    def _samples(self, topics: Sequence[str], span_ns: int | None) -> Iterator[TransformSample]:
        for log in self._logs:
            if not {s.topic for s in log.streams} & {*topics}:
                continue
            for frame in log.frames(topics):
                since_ns = frame.header.log_time_ns - (log.start_ns or 0)
                if span_ns is not None and since_ns > span_ns:
                    break
                if isinstance(frame, TransformSample):
                    yield frame

    def _first_frame_id(self, topic: str) -> str | None:
        for log in self._logs:
            for frame in log.frames({topic}) if topic in {s.topic for s in log.streams} else ():
                return frame.header.frame_id
        return None

    def _first_child(self, topic: str) -> str | None:
        for log in self._logs:
            for frame in log.frames({topic}) if topic in {s.topic for s in log.streams} else ():
                if isinstance(frame, PoseSample | TransformSample):
                    return frame.child_frame_id
        return None


class _Lent:
    """Static transforms of other logs that connect the ``missing`` frames with ``reference``."""

    def __init__(
        self, tree: TransformTree, reference: str, missing: Sequence[str], memory: int
    ) -> None:
        self._memory = memory
        self._own = tree
        self._reference = reference
        self._missing = missing
        self._of_edge: dict[Edge, dict[str, StaticTransform]] = {}

    def take(self, path: Path) -> None:
        """Reads the static transforms of a log."""
        try:
            with closing(open_log(path, self._memory)) as log:
                topics = guess_roles(log.streams).tf_static
                edges = [f for f in log.frames(topics) if isinstance(f, TransformSample)]
        except LogError:
            return  # its own session names the fault
        tree = TransformTree()
        for sample in edges:
            tree.add(sample)
        known = {(parent, child) for parent, child, _ in self._own.edges}
        for edge, pose in tree.static_poses.items():
            if edge not in known and edge[::-1] not in known and self._is_on_a_path(edge, tree):
                self._of_edge.setdefault(edge, {})[path.name] = _static(edge, pose)

    def _is_on_a_path(self, edge: Edge, tree: TransformTree) -> bool:
        """Whether an edge lies between a missing frame and the reference."""
        for frame in self._missing:
            steps = list(pairwise(tree.path(self._reference, frame) or ()))
            if edge in steps or edge[::-1] in steps:
                return True
        return False

    @property
    def transforms(self) -> tuple[StaticTransform, ...]:
        """The transforms that the other logs agree on."""
        return tuple(next(iter(by.values())) for by in self._of_edge.values() if _agree(by))

    def problems(self, name: str) -> Iterator[Problem]:
        """Where the transforms are from, and the ones that the logs do not agree on."""
        for (parent, child), by_log in self._of_edge.items():
            if _agree(by_log):
                text = (
                    f"{name} has no transform from '{parent}' to '{child}': the one of "
                    f"{next(iter(by_log))} is used."
                )
            else:
                text = (
                    f"{name} has no transform from '{parent}' to '{child}', and the other logs "
                    f"give different ones ({', '.join(by_log)}): none of them is used."
                )
            yield Problem("", ProblemKind.TRANSFORM, text, lost=False)


def _agree(by_log: Mapping[str, StaticTransform]) -> bool:
    first, *others = (matrix(transform.pose) for transform in by_log.values())
    return all(np.abs(first - other).max() <= _SAME for other in others)
