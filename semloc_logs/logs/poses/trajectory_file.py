"""Trajectories in a file beside the log: TUM (stamp and pose a line) or KITTI (twelve numbers).

TUM: ``stamp t_x t_y t_z q_x q_y q_z q_w``, seconds and metres, lines that start with ``#`` are
comments (TUM RGB-D benchmark, file formats). KITTI: the upper 3 x 4 of the pose, row-major (KITTI
odometry development kit); line i belongs to the i-th frame of the main range sensor, unless a file
of times, one number of seconds a line, gives the time of each pose.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.errors import LogError
from semloc_logs.frames import DepthFrame, Frame, ImageFrame, LidarFrame
from semloc_logs.logs.poses.track import is_time
from semloc_logs.logs.problems import Problem
from semloc_logs.numerics import transforms

if TYPE_CHECKING:
    from semloc_logs.logs.containers.map_stations import Stations

TUM = 8  # numbers a line
KITTI = 12
_LONGEST_LINE = 4096  # characters; a line of either format has about 150
_MOST_POSES = 50_000_000  # a kilohertz over half a day; a trajectory has fewer
# a quaternion's length may be off by so much, a rotation matrix' R R^T from the identity
_UNIT = 0.05
STATION_STEP = 1.0  # m between the places that a map is looked at from
POSE_NS = 100_000_000  # between poses without stamps, as sweeps are


@dataclass(frozen=True, slots=True)
class TrajectoryFile:
    """The files of a trajectory: ``path``, and for KITTI poses perhaps ``times``.

    ``frame`` is the frame whose poses they are ("": the base frame).
    """

    path: Path
    times: Path | None = None
    frame: str = ""

    def fingerprint(self) -> str:
        """sha256 over the content of the files and the frame; LogError when one cannot be read."""
        digest = hashlib.sha256(self.frame.encode())
        for path in (self.path, *([self.times] if self.times else [])):
            if path.exists() and not path.is_file():
                # a pipe can be read only once
                raise LogError(f"{path} is not a regular file: give the path of a file of poses.")
            try:
                with path.open("rb") as file:
                    digest.update(hashlib.file_digest(file, "sha256").digest())
            except OSError as problem:
                raise _unreadable(path, problem) from None
        return digest.hexdigest()


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """``poses`` (n, 4, 4) at ``stamps_ns`` (n,), in the order of the file.

    Without stamps there is one pose for each frame of the main sensor. ``is_relative``: the stamps
    count from the stamp of the first frame, as in KITTI's ``times.txt``, whose first number is
    zero.
    """

    poses: F64
    stamps_ns: NDArray[np.int64] | None
    is_relative: bool = False


def read_trajectory(source: TrajectoryFile) -> Trajectory:
    """Reads TUM or KITTI poses, distinguished by the numbers a line.

    LogError names the file and line that cannot be read.
    """
    rows = _read_rows(source.path)
    if not rows.values:
        raise LogError(f"{source.path} has no poses: give a file in TUM or KITTI format.")
    values = np.array(rows.values)
    if rows.stamps:
        if source.times is not None:
            raise LogError(
                f"{source.path} has stamps of its own (TUM format): "
                f"leave --pose-times {source.times} out."
            )
        poses = _from_quaternions(values, source.path, rows.lines)
        return Trajectory(poses, np.array(rows.stamps, np.int64))

    poses = _from_matrices(values, source.path, rows.lines)
    if source.times is None:
        return Trajectory(poses, None)
    times = _read_times(source.times)
    if len(times) != len(poses):
        raise LogError(
            f"{source.times} has {len(times)} times but {source.path} has {len(poses)} poses: "
            f"give one time for each pose."
        )
    return Trajectory(poses, times, is_relative=bool(times[0] == 0))


def stations_along(source: TrajectoryFile) -> Stations:
    """Places along a trajectory from which a map of points is looked at.

    With stamps they are ``STATION_STEP`` apart, else one a pose, at ``POSE_NS`` from each other.
    LogError as in :func:`read_trajectory`.
    """
    # compiled code, which other logs need not wait for
    from semloc_logs.logs.containers.map_stations import FIRST_NS, Stations

    trajectory = read_trajectory(source)
    poses = trajectory.poses
    if trajectory.stamps_ns is None:
        return Stations(FIRST_NS + POSE_NS * np.arange(len(poses), dtype=np.int64), poses)
    order = np.argsort(trajectory.stamps_ns, kind="stable")
    poses = poses[order]
    stamps_ns = trajectory.stamps_ns[order] + (FIRST_NS if trajectory.is_relative else 0)
    way = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0, prepend=poses[:1, :3, 3]), axis=1)
    step = np.floor(np.cumsum(way) / STATION_STEP)
    chosen = np.flatnonzero(np.diff(step, prepend=-1.0))
    return Stations(stamps_ns[chosen], poses[chosen])


@dataclass(slots=True)
class _Rows:
    """Numbers of each pose, its line in the file, and for TUM its stamp (ns)."""

    values: list[list[float]] = field(default_factory=list)
    lines: list[int] = field(default_factory=list)
    stamps: list[int] = field(default_factory=list)


def _read_rows(path: Path) -> _Rows:
    rows = _Rows()
    width = 0
    for number, words in _lines(path):
        width = width or len(words)
        if width not in (TUM, KITTI) or len(words) != width:
            wanted = (
                f"{width} numbers like the lines before"
                if rows.values
                else f"{TUM} (TUM) or {KITTI} (KITTI) numbers"
            )
            raise LogError(
                f"{path}, line {number} has {len(words)} numbers: "
                f"give a file with {wanted} in each line."
            )
        if width == TUM:
            rows.stamps.append(seconds_to_ns(words[0], path, number))
        rows.values.append(_floats(words[1:] if width == TUM else words, path, number))
        rows.lines.append(number)
        if len(rows.values) > _MOST_POSES:
            raise LogError(f"{path} has more than {_MOST_POSES} poses: it is not a trajectory.")
    return rows


def seconds_to_ns(text: str, path: Path, line: int) -> int:
    """Integer nanoseconds of a decimal number of seconds, exactly.

    A float64 of seconds since 1970 would be off by 0.2 us.
    """
    try:
        seconds = Decimal(text)
        # a number that is far too large is refused by its exponent, before it is written out
        stamp_ns = (
            int((seconds * 1_000_000_000).to_integral_value())
            if seconds.is_finite() and seconds.adjusted() < 12
            else None
        )
    except InvalidOperation:
        stamp_ns = None
    if stamp_ns is None or not is_time(stamp_ns):
        raise LogError(f"{path}, line {line}: {text[:40]!r} is not a time in seconds.")
    return stamp_ns


class FilePoses:
    """The poses of a file as a source of poses for a session.

    ``topic`` is the main range sensor, of which ``count`` frames are to come. LogError when it is
    unknown which frames KITTI poses belong to.
    """

    def __init__(self, source: TrajectoryFile, topic: str, count: int) -> None:
        self.name = str(source.path)
        self.session_frame = "trajectory"
        self.child: str | None = source.frame
        self.problems: list[Problem] = []  # none: a file with a mistake is an error
        self._source = source
        self._topic = topic
        self._count = count
        self._trajectory = read_trajectory(source)
        self._frames = 0
        self._given = 0
        self._start_ns = 0
        self._stamps: list[int] = []
        n = len(self._trajectory.poses)
        if self._trajectory.stamps_ns is None and n != count:
            raise LogError(
                f"{source.path} has {n} poses without stamps but {topic} has {count} frames: "
                f"give one pose for each frame, a TUM file, or the times of the poses with "
                f"--pose-times FILE."
            )

    @property
    def is_over(self) -> bool:
        """Whether no more poses will come."""
        return self._given == len(self._trajectory.poses)

    def take(self, frame: Frame) -> None:
        """A frame of the log: frames of the main sensor date poses that have no stamps."""
        if frame.header.topic == self._topic and isinstance(
            frame, LidarFrame | DepthFrame | ImageFrame
        ):
            if not self._frames:
                self._start_ns = frame.header.stamp_ns
            self._frames += 1
            if self._trajectory.stamps_ns is None:
                self._stamps.append(frame.header.stamp_ns)

    def poses(self, base_T: Callable[[str, int], F64 | None]) -> Iterator[tuple[int, F64]]:
        """Stamps and poses that are new since the last call."""
        trajectory = self._trajectory
        if trajectory.stamps_ns is None:
            ready = self._stamps
        elif trajectory.is_relative and not self._frames:
            return
        else:
            ready = (
                (trajectory.stamps_ns + (self._start_ns if trajectory.is_relative else 0)).tolist()
                if not self.is_over
                else []
            )
        while self._given < min(len(ready), len(trajectory.poses)):
            self._given += 1
            yield ready[self._given - 1], trajectory.poses[self._given - 1]

    def finish(self) -> None:
        """All frames of the log have been seen."""
        if self._trajectory.stamps_ns is None and self._frames != self._count:
            raise LogError(
                f"Only {self._frames} of {self._count} frames of {self._topic} can be read, so it "
                f"is unknown which frames the poses of {self._source.path} belong to: give a TUM "
                f"file, or the times of the poses with --pose-times FILE."
            )

    def to_json(self) -> dict[str, object]:
        """For session.json."""
        return {
            "kind": "file",
            "path": str(self._source.path),
            "times": str(self._source.times) if self._source.times else None,
            "frame": self._source.frame,
            "fingerprint": self._source.fingerprint(),
        }


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Line number and words of every line, without comments and empty lines."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            number = 0
            while line := file.readline(_LONGEST_LINE):
                number += 1
                if len(line) >= _LONGEST_LINE:
                    raise LogError(
                        f"{path}, line {number} is longer than {_LONGEST_LINE} characters: "
                        f"it is not a file of poses."
                    )
                words = line.split("#", 1)[0].split()
                if words:
                    yield number, words
    except UnicodeDecodeError:
        raise LogError(f"{path} is not text: give a file in TUM or KITTI format.") from None
    except OSError as problem:
        raise _unreadable(path, problem) from None


def _unreadable(path: Path, problem: OSError) -> LogError:
    return LogError(
        f"{path} cannot be read ({problem.strerror}): give the path of a file of poses."
    )


def _floats(words: list[str], path: Path, line: int) -> list[float]:
    try:
        values = [float(w) for w in words]
    except ValueError:
        values = [np.nan]
    if not np.isfinite(values).all():
        raise LogError(
            f"{path}, line {line} has a word that is not a number: "
            f"give a file in TUM or KITTI format."
        )
    return values


def _from_quaternions(values: F64, path: Path, lines: list[int]) -> F64:
    length = np.linalg.norm(values[:, 3:], axis=1)
    bad = np.flatnonzero(np.abs(length - 1.0) > _UNIT)
    if len(bad):
        raise LogError(
            f"{path}, line {lines[bad[0]]}: the quaternion (x y z w) has the length "
            f"{length[bad[0]]:.3g}, not 1."
        )
    return transforms.transform(values[:, :3], values[:, 3:])


def _from_matrices(values: F64, path: Path, lines: list[int]) -> F64:
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    poses[:, :3] = values.reshape(-1, 3, 4)
    rotation = poses[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        bad = np.flatnonzero(~((off <= _UNIT) & (np.linalg.det(rotation) > 0)))
    if len(bad):
        raise LogError(f"{path}, line {lines[bad[0]]}: the 3 x 3 part is not a rotation.")
    # as written with six digits it is nearly one
    return transforms.transform(*transforms.translation_quaternion(poses))


def _read_times(path: Path) -> NDArray[np.int64]:
    times = []
    for number, words in _lines(path):
        if len(words) != 1:
            raise LogError(
                f"{path}, line {number} has {len(words)} numbers: give one time in seconds a line."
            )
        times.append(seconds_to_ns(words[0], path, number))
    return np.array(times, np.int64)
