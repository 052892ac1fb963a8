"""The TF tree of a log: where a frame is in another frame, at any time.

Frame names are compared without leading slash. Edges form an undirected graph, so that a log whose
publishers contradict the rule "one parent each" (loops, two parents) still gives a result, and
disconnected frames give None.
"""

from __future__ import annotations

from collections import deque
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.frames import TransformSample
from semloc_logs.logs.poses.track import PoseTrack
from semloc_logs.numerics import transforms

# how far back a moving edge remembers: frames wait for their transforms by far less
HISTORY_SECONDS = 60.0
MAX_EDGES = 10_000  # a log with more frames than this is broken; the rest is ignored and counted

Edge = tuple[str, str]  # (parent, child)


class Change(NamedTuple):
    """How far a static transform moved (m) and turned (rad)."""

    distance: float
    angle: float


_NO_CHANGE = Change(1e-3, 1e-3)  # rounding


def frame_name(frame_id: str) -> str:
    """The frame's name without leading slash and blanks."""
    return frame_id.strip().lstrip("/")


class TransformTree:
    """Static and dynamic transforms as they come; ``ignored`` counts samples that made no sense.

    ``changes``: static transforms that were sent with different values, by edge.
    """

    def __init__(self) -> None:
        self.ignored = 0
        self._static: dict[Edge, F64] = {}
        self._moving: dict[Edge, PoseTrack] = {}
        self._neighbours: dict[str, list[str]] = {}
        self._parents: dict[str, list[str]] = {}
        self._paths: dict[Edge, list[str] | None] = {}
        self._fixed: set[Edge] = set()
        self._sent: set[Edge] = set()  # static edges that the log has sent
        self.changes: dict[Edge, Change] = {}

    def fix(self, parent: str, child: str, pose: F64) -> None:
        """Sets ``parent_T_child`` (4, 4) for good: samples of this edge are ignored from now on."""
        edge = (frame_name(parent), frame_name(child))
        self._moving.pop(edge, None)
        if edge not in self._static:
            self._connect(*edge)
        self._static[edge] = pose
        self._fixed.add(edge)

    def add(self, sample: TransformSample) -> None:
        """Takes one edge; dynamic samples of an edge overrule static ones."""
        parent = frame_name(sample.header.frame_id)
        child = frame_name(sample.child_frame_id)
        edge = (parent, child)
        if edge in self._fixed:
            return
        is_new = edge not in self._static and edge not in self._moving
        usable = parent and child and parent != child and np.isfinite(sample.frame_T_child).all()
        if not usable or (is_new and len(self._static) + len(self._moving) >= MAX_EDGES):
            self.ignored += 1
            return
        if sample.static and edge not in self._moving:
            self._note_change(edge, sample)
            self._static[edge] = sample.frame_T_child
        elif not sample.static:
            self._moving.setdefault(edge, PoseTrack(keep_seconds=HISTORY_SECONDS)).add(sample)
            self._static.pop(edge, None)
        if is_new:
            self._connect(parent, child)

    def _note_change(self, edge: Edge, sample: TransformSample) -> None:
        """Keeps the largest change of a static transform that the log sends with other values."""
        if not sample.header.topic or edge not in self._sent:
            if sample.header.topic:
                self._sent.add(edge)
            return
        step = transforms.inverse(self._static[edge]) @ sample.frame_T_child
        change = Change(float(np.linalg.norm(step[:3, 3])), transforms.rotation_angle(step[:3, :3]))
        if max(change) > max(self.changes.get(edge, _NO_CHANGE)):
            self.changes[edge] = change

    def _connect(self, parent: str, child: str) -> None:
        self._neighbours.setdefault(parent, []).append(child)
        self._neighbours.setdefault(child, []).append(parent)
        self._parents.setdefault(child, []).append(parent)
        self._paths.clear()

    @property
    def frames(self) -> list[str]:
        """All frame names, sorted."""
        return sorted(self._neighbours)

    @property
    def edges(self) -> list[tuple[str, str, bool]]:
        """(parent, child, static) of every edge, sorted."""
        return sorted(
            [(*edge, True) for edge in self._static] + [(*edge, False) for edge in self._moving]
        )

    @property
    def static_poses(self) -> dict[Edge, F64]:
        """``parent_T_child`` (4, 4) of the static edges."""
        return dict(self._static)

    def ancestors(self, frame: str) -> set[str]:
        """The frames above a frame, along all of its parents."""
        above: set[str] = set()
        coming = [frame_name(frame)]
        while coming:
            parents = [p for p in self._parents.get(coming.pop(), []) if p not in above]
            above.update(parents)
            coming += parents
        return above

    def root_above(self, frame: str) -> tuple[str, F64] | None:
        """The topmost frame above ``frame`` and ``frame_T_root`` (4, 4).

        None where an edge between them moves, a frame has several parents, or edges are a loop.
        """
        root = frame_name(frame)
        frame_T_root = np.eye(4)
        seen = {root}
        while parents := self._parents.get(root, []):
            pose = self._static.get((parents[0], root))
            if len(parents) > 1 or pose is None or parents[0] in seen:
                return None
            frame_T_root = frame_T_root @ transforms.inverse(pose)
            root = parents[0]
            seen.add(root)
        return root, frame_T_root

    def connected(self, target: str, source: str) -> bool:
        """Whether edges lead from one frame to the other; a frame is connected with itself."""
        return self._path(frame_name(target), frame_name(source)) is not None

    def lookup(self, target: str, source: str, stamp_ns: int) -> F64 | None:
        """``target_T_source`` (4, 4), dynamic edges interpolated at ``stamp_ns``.

        None when unconnected or unknown at that time.
        """
        path = self._path(frame_name(target), frame_name(source))
        if path is None:
            return None
        result = np.eye(4)
        for frame, following in pairwise(path):
            step = self._step(frame, following, stamp_ns)
            if step is None:
                return None
            result = result @ step
        return result

    def has_passed(self, target: str, source: str, stamp_ns: int) -> bool:
        """Whether a lookup at ``stamp_ns`` will not change any more.

        The frames are connected and all dynamic edges between them have reached that time.
        """
        path = self._path(frame_name(target), frame_name(source))
        edges = (
            [] if path is None else [edge for a, b in pairwise(path) for edge in ((a, b), (b, a))]
        )
        ends = [self._moving[edge].end_ns for edge in edges if edge in self._moving]
        return path is not None and all(end is not None and end >= stamp_ns for end in ends)

    def track(self, parent: str, child: str) -> PoseTrack | None:
        """The remembered history of a dynamic edge."""
        return self._moving.get((frame_name(parent), frame_name(child)))

    def end_ns(self, parent: str, child: str) -> int | None:
        """The newest stamp of a dynamic edge; None without any."""
        track = self.track(parent, child)
        return None if track is None else track.end_ns

    def pose_edge(self, frame: str) -> Edge | None:
        """The dynamic edge of a moving ``frame``: below ``odom`` if there is one, else the topmost.

        ``odom`` first, because odometry is continuous, whereas ``map`` -> ``odom`` jumps with every
        correction.
        """
        chain: list[Edge] = []
        child = frame_name(frame)
        seen = {child}
        while parents := [p for p in self._parents.get(child, []) if p not in seen]:
            parent = next((p for p in parents if p.endswith("odom")), parents[0])
            if (parent, child) in self._moving:
                chain.append((parent, child))
            seen.add(parent)
            child = parent
        return next(
            (edge for edge in chain if edge[0].endswith("odom")), chain[-1] if chain else None
        )

    def _step(self, target: str, source: str, stamp_ns: int) -> F64 | None:
        """``target_T_source`` (4, 4) of two neighbours."""
        for edge, is_forward in (((target, source), True), ((source, target), False)):
            pose = self._static.get(edge)
            if edge in self._moving:
                pose = self._moving[edge].at(stamp_ns)
            if pose is not None:
                return pose if is_forward else transforms.inverse(pose)
        return None

    def path(self, target: str, source: str) -> list[str] | None:
        """Frame names from target to source along the fewest edges; None when unconnected."""
        return self._path(frame_name(target), frame_name(source))

    def _path(self, target: str, source: str) -> list[str] | None:
        if target == source:
            return [target]
        if target not in self._neighbours or source not in self._neighbours:
            return None
        if (target, source) not in self._paths:
            came_from = {target: target}
            queue = deque([target])
            while queue and source not in came_from:
                frame = queue.popleft()
                for neighbour in self._neighbours[frame]:
                    if neighbour not in came_from:
                        came_from[neighbour] = frame
                        queue.append(neighbour)
            self._paths[target, source] = (
                _walk_back(came_from, target, source) if source in came_from else None
            )
        return self._paths[target, source]


def _walk_back(came_from: dict[str, str], target: str, source: str) -> list[str]:
    path = [source]
    while path[-1] != target:
        path.append(came_from[path[-1]])
    return path[::-1]
