"""Several publishers of one stream of poses: one of them counts, and the others are named."""

from __future__ import annotations

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.frames import PoseSample, TransformSample
from semloc_logs.logs.poses.tf_tree import MAX_EDGES, Edge, frame_name
from semloc_logs.logs.problems import Problem, ProblemKind
from semloc_logs.numerics.transforms import rotation_angle

# a publisher that is silent for so long has ended: another one may go on, as after a restart, or
# where the parts of a recording were put into one file
_SILENCE_NS = 500_000_000
_FEWEST_TURNS = 2  # publishers that take turns give poses at the same time
# poses that differ by more cannot be of one vehicle: this, and so much for each second between them
_SAME_POSITION = (0.1, 40.0)  # m, m/s
_SAME_ROTATION = (0.05, 3.0)  # rad, rad/s


class OnePublisher:
    """Lets the poses of one publisher through; another one follows only after a silence."""

    def __init__(self, publisher: str | None = None) -> None:
        self.publisher = publisher
        self.refused: dict[str, int] = {}
        self._turns = 0
        self._newest_ns = 0
        self._pose: tuple[int, F64] | None = None
        self._has_refused = False
        self._ended: set[str] = set()

    def accepts(self, sample: PoseSample | TransformSample) -> bool:
        """Whether a sample counts."""
        header = sample.header
        name = publisher_of(sample)
        if self.publisher is None:
            self.publisher = name
        if name != self.publisher:
            is_silent = header.log_time_ns - self._newest_ns > _SILENCE_NS
            if not is_silent or name in self._ended or self._pose is None:
                self._refuse(name, sample)
                return False
            self._ended.add(self.publisher)
            self.publisher = name
        self._turns += self._has_refused
        self._has_refused = False
        self._newest_ns = header.log_time_ns
        self._pose = (header.stamp_ns, sample.frame_T_child)
        return True

    def _refuse(self, name: str, sample: PoseSample | TransformSample) -> None:
        self.refused[name] = self.refused.get(name, 0) + 1
        if self._pose is None or _differ(*self._pose, sample.header.stamp_ns, sample.frame_T_child):
            self._has_refused = True

    @property
    def is_contradicted(self) -> bool:
        """Whether others publish other poses at the same time."""
        return self._turns >= _FEWEST_TURNS

    def problem(self, topic: str, what: str, remedy: str, *, assumed: bool) -> Problem:
        """Names the publishers of ``what``, which contradict each other."""
        others = ", ".join(f"{name} ({count})" for name, count in sorted(self.refused.items()))
        text = (
            f"{topic}: {len(self.refused) + 1} publishers give {what} in turns, and not the same: "
            f"{self.publisher} is used, {others} not; {remedy}."
        )
        return Problem(topic, ProblemKind.POSE, text, lost=False, assumed=assumed)


class EdgePublishers:
    """Lets the transforms of one publisher through for each moving edge of TF."""

    def __init__(self) -> None:
        self._edges: dict[Edge, OnePublisher] = {}

    def accepts(self, sample: TransformSample) -> bool:
        """Whether a sample counts; a static one always does."""
        if sample.static:
            return True
        edge = (frame_name(sample.header.frame_id), frame_name(sample.child_frame_id))
        if edge not in self._edges:
            if len(self._edges) >= MAX_EDGES:
                return True
            self._edges[edge] = OnePublisher()
        return self._edges[edge].accepts(sample)

    def problems(self, pose_edge: Edge | None) -> list[Problem]:
        """The edges with several publishers; the map depends on ``pose_edge``."""
        return [
            one.problem(
                (one.publisher or "").partition(" ")[0],
                f"'{child}' in '{parent}'",
                "--topic tf=TOPIC leaves out other topics, --topic pose=TOPIC takes other poses",
                assumed=(parent, child) == pose_edge,
            )
            for (parent, child), one in sorted(self._edges.items())
            if one.is_contradicted
        ]


def publisher_of(sample: PoseSample | TransformSample) -> str:
    """Topic and publisher of a sample."""
    header = sample.header
    return f"{header.topic} by {header.publisher}" if header.publisher else header.topic


def _differ(stamp_ns: int, pose: F64, other_ns: int, other: F64) -> bool:
    """Whether two poses (4, 4) at their times cannot be of one vehicle."""
    seconds = abs(stamp_ns - other_ns) * 1e-9
    distance = float(np.linalg.norm(pose[:3, 3] - other[:3, 3]))
    angle = float(rotation_angle(pose[:3, :3].T @ other[:3, :3]))
    return (
        distance > _SAME_POSITION[0] + _SAME_POSITION[1] * seconds
        or angle > _SAME_ROTATION[0] + _SAME_ROTATION[1] * seconds
    )
