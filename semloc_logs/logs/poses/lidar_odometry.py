"""LIDAR odometry for logs without usable poses: KISS-ICP (Vizzo et al., RA-L 2023).

It is installed with the extra ``odometry``. Every sweep of one LIDAR is registered, in the pass
that reads the log. The trajectory begins at the identity of the base frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from semloc_logs.arrays import F64
from semloc_logs.errors import LogError
from semloc_logs.frames import Frame, LidarFrame
from semloc_logs.logs.messages.point_times import LONGEST_SWEEP_NS
from semloc_logs.logs.messages.stamps import utc
from semloc_logs.logs.poses.track import is_time
from semloc_logs.logs.problems import Problem, ProblemKind
from semloc_logs.numerics.transforms import apply, inverse, rotation_angle

MAX_SPEED = 100.0  # m/s; nothing on wheels is faster
# m/s from one sweep to the next beyond an acceleration of 30 m/s^2: no brake reaches that
MAX_SPEED_CHANGE = 12.0
_MAX_ACCELERATION = 30.0  # m/s^2
MAX_TURN = 10.0  # rad/s
_FEWEST = 100  # points of a sweep that can be registered
_VOXELS_PER_RANGE = 100.0  # KISS-ICP's own choice: the map's voxels are a hundredth of the range
_LONGEST_RANGE = 100.0  # m; its default
# A sweep lies on the one before it: in a hall 0.67 to 0.9 of its points, on a street 0.76 and more,
# 0.25 to 0.45 once track is lost
LEAST_OVERLAP = 0.6  # of the median overlap so far
_MOST_COMPARED = 20_000  # points of the sweep before


class LidarOdometry:
    """Poses of the LIDAR on ``topic`` from its sweeps; LogError when KISS-ICP is not installed.

    ``max_range`` and ``min_range`` (m): points that are used. After a jump that no vehicle can
    make, or once a sweep does not lie on the sweep before any more, poses end:
    ``problems`` names the time. Slow drift goes unnoticed.
    """

    name = "LIDAR odometry"
    session_frame = "lidar_odometry"

    def __init__(self, topic: str, *, min_range: float, max_range: float) -> None:
        self.topic = topic
        self.child: str | None = None  # the sensor's frame, once a sweep has come
        self.problems: list[Problem] = []
        self.is_over = False
        self._voxel = min(max_range, _LONGEST_RANGE) / _VOXELS_PER_RANGE
        self._engine, self._version = _kiss_icp(
            min_range, min(max_range, _LONGEST_RANGE), self._voxel
        )
        self._last_sweep: cKDTree | None = None
        self._overlaps: list[float] = []
        self._start: F64 | None = None  # base_T_sensor of the first sweep
        self._new: list[tuple[int, F64]] = []
        self._last: tuple[int, F64] | None = None
        self._speed: F64 | None = None  # (3,) of the last step, in the sensor frame
        self._count = 0
        self._refused = 0

    def take(self, frame: Frame) -> None:
        """Registers a sweep of the LIDAR; other frames are ignored."""
        if frame.header.topic != self.topic or not isinstance(frame, LidarFrame) or self.is_over:
            return
        if self.child is None:
            self.child = frame.header.frame_id
        stamp_ns, offsets = _pose_time(frame)
        is_late = self._last is not None and stamp_ns <= self._last[0]
        if len(frame.points) < _FEWEST or is_late or not is_time(stamp_ns):
            self._refused += 1
            return

        points, keypoints = self._engine.register_frame(frame.points.astype(np.float64), offsets)
        pose = np.array(self._engine.last_pose, float)
        if self._last is not None and (
            self._is_jump(stamp_ns, pose) or self._is_apart(pose, np.asarray(keypoints))
        ):
            self.is_over = True
            self._lose(
                f"LIDAR odometry lost track at {utc(stamp_ns)}: frames after that are left out; "
                f"give poses with --poses FILE, or cut the log there."
            )
            return

        if self._count == 1 and self._last is not None and len(offsets):
            # the first sweep was measured on the way to its pose: the same motion as in the next
            # step leads there
            first_ns, first = self._last
            self._new.insert(0, (2 * first_ns - stamp_ns, first @ inverse(pose) @ first))
        self._new.append((stamp_ns, pose))
        self._last = (stamp_ns, pose)
        self._last_sweep = cKDTree(np.asarray(points)[:: 1 + len(points) // _MOST_COMPARED])
        self._count += 1

    def _lose(self, text: str) -> None:
        self.problems.append(Problem(self.topic, ProblemKind.POSE, text, lost=True))

    def poses(self, base_T: Callable[[str, int], F64 | None]) -> Iterator[tuple[int, F64]]:
        """Stamps and ``session_T_sensor`` that are new since the last call.

        The first pose waits for the second.
        """
        if self._count < 2 and not self.is_over:
            return
        if self._start is None and self._new and self.child is not None:
            known = base_T(self.child, self._new[0][0])
            self._start = np.eye(4) if known is None else known
        ready = self._new
        self._new = []
        for stamp_ns, pose in ready:
            yield stamp_ns, (np.eye(4) if self._start is None else self._start) @ pose

    def finish(self) -> None:
        """No more sweeps will come: a single one has the identity as its pose."""
        self.is_over = True
        if self._refused:
            self._lose(
                f"{self.topic}: {self._refused} sweeps are too sparse or out of order for LIDAR "
                f"odometry and were left out."
            )

    def to_json(self) -> dict[str, object]:
        """For session.json."""
        return {
            "kind": "lidar_odometry",
            "topic": self.topic,
            "sweeps": self._count,
            "kiss_icp": self._version,
        }

    def _is_jump(self, stamp_ns: int, pose: F64) -> bool:
        """Whether no vehicle can make the step to ``pose``."""
        if self._last is None or not np.isfinite(pose).all():
            return True
        seconds = (stamp_ns - self._last[0]) * 1e-9
        step = inverse(self._last[1]) @ pose
        speed = step[:3, 3] / seconds
        before = self._speed
        self._speed = speed
        if np.linalg.norm(speed) > MAX_SPEED or rotation_angle(step[:3, :3]) / seconds > MAX_TURN:
            return True
        return before is not None and bool(
            np.linalg.norm(speed - before) > MAX_SPEED_CHANGE + _MAX_ACCELERATION * seconds
        )

    def _is_apart(self, pose: F64, points: F64) -> bool:
        """Whether fewer ``points`` (n, 3) at ``pose`` lie on the last sweep than usual."""
        if self._last is None or self._last_sweep is None or not len(points):
            return False
        distance, _ = self._last_sweep.query(
            apply(inverse(self._last[1]) @ pose, points), distance_upper_bound=self._voxel / 2
        )
        overlap = float(np.isfinite(distance).mean())
        usual = float(np.median(self._overlaps)) if self._overlaps else overlap
        self._overlaps.append(overlap)
        return overlap < LEAST_OVERLAP * usual


def _pose_time(frame: LidarFrame) -> tuple[int, F64]:
    """Stamp of the pose that KISS-ICP gives, and point times from 0 to 1.

    KISS-ICP moves the points of a sweep to the time of the last one.
    """
    offset_ns = frame.offset_ns
    if offset_ns is None or not len(offset_ns):
        return frame.header.stamp_ns, np.zeros(0)
    first = int(offset_ns.min())
    last = int(offset_ns.max())
    if not 0 < last - first <= LONGEST_SWEEP_NS or abs(last) > LONGEST_SWEEP_NS:
        return frame.header.stamp_ns, np.zeros(0)
    return frame.header.stamp_ns + last, (offset_ns - first) / (last - first)


def _kiss_icp(min_range: float, max_range: float, voxel_size: float) -> tuple[Any, str]:
    """An odometry and the version of the library.

    One thread, because more of them sum in another order each time.
    """
    try:
        version = str(import_module("kiss_icp").__version__)
        config = import_module("kiss_icp.config.config")
        parser = import_module("kiss_icp.config.parser")
        module = import_module("kiss_icp.kiss_icp")
    except ImportError as problem:
        raise LogError(
            f"LIDAR odometry needs KISS-ICP ({problem}): install it with "
            f"pip install 'semloc_logs[odometry]', or give poses with --poses FILE."
        ) from None
    settings = parser.KISSConfig(
        data=config.DataConfig(max_range=max_range, min_range=min_range, deskew=True),
        registration=config.RegistrationConfig(max_num_threads=1),
        mapping=config.MappingConfig(voxel_size=voxel_size),
        adaptive_threshold=config.AdaptiveThresholdConfig(),
    )
    return module.KissICP(config=settings), version
