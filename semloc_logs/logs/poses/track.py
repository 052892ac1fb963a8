"""A pose stream: where a frame was at any time, and None where that is unknown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.frames import PoseSample, TransformSample
from semloc_logs.numerics import transforms

EDGE_NS = 100_000_000  # a stamp may lie this far outside of the stream: it goes on as it was
# a motion goes on where it has changed by less than this share, or so little, since the step before
_CHANGED_SHARE = 0.25
_CHANGED_SPEED, _CHANGED_TURN = 1.0, 0.2  # m/s, rad/s
# a stream slower than max_gap / 3 may skip two poses before its hole counts as a gap
PERIODS_PER_GAP = 3.0
# s; nothing that drives is interpolated over more than this, however slow its stream
LONGEST_GAP = 5.0
_DETERMINANT = 1e-3  # of a rotation, off 1: floats of a message are more exact
_FARTHEST = 1e8  # m; positions in Earth-centred frames are below 1e7
# the years 1933 to 2116: sums and differences still fit 64 bits
_FIRST_NS = -(1 << 60)
_LAST_NS = 1 << 62
_AHEAD_NS = 10_000_000_000  # clocks that are adjusted while recording jump less
_GLITCH = 3  # poses that a glitch of the clock may stamp in a row
_MOST_SET_BACK = 1000  # runs of poses that go back in time; a broken log has one at every pose
_PERIOD_WINDOW = 256  # poses that the period is estimated from: the newest ones


def is_time(stamp_ns: int) -> bool:
    """Whether a stamp can be calculated with in 64 bits; damaged messages hold others."""
    return _FIRST_NS < stamp_ns < _LAST_NS


def _is_rigid(pose: F64) -> bool:
    """Whether a pose (4, 4) is finite, on Earth, and its rotation keeps volumes."""
    is_on_earth = bool(np.isfinite(pose).all()) and np.abs(pose[:3, 3]).max() < _FARTHEST
    return is_on_earth and abs(np.linalg.det(pose[:3, :3]) - 1.0) <= _DETERMINANT


@dataclass(slots=True)
class SetBack:
    """A run of ``count`` poses before the newest one, by ``longest_ns`` at most."""

    count: int = 0
    longest_ns: int = 0


class PoseTrack:
    """Poses at strictly increasing stamps, which may still grow.

    ``max_gap`` (s) is the longest hole that is interpolated, or three median periods of a slow
    stream. With ``keep_seconds`` only the newest stretch is remembered (at least that long), so
    memory is bounded. ``duplicates``, ``backwards`` and ``invalid`` count refused poses: equal
    stamps, stamps before the newest one, and matrices that are not rigid transforms; ``ahead``
    counts poses that were taken back. ``set_back``: the refused poses by the newest stamp before
    them.
    """

    def __init__(self, max_gap: float = 1.0, keep_seconds: float | None = None) -> None:
        self.max_gap = max_gap
        self.duplicates = 0
        self.backwards = 0
        self.invalid = 0
        self.ahead = 0
        self.set_back: dict[int, SetBack] = {}
        self.first_ns: int | None = None  # the oldest stamp, also where it is forgotten
        self.moves = False  # whether any position differs from the first
        self._keep_ns = None if keep_seconds is None else round(keep_seconds * 1e9)
        self._stamps = np.empty(16, np.int64)
        self._rows = np.empty((16, 3, 4))
        self._n = 0
        self._limit: tuple[int, int] | None = None  # (count it was computed at, ns)

    def __len__(self) -> int:
        return self._n

    def add(self, sample: PoseSample | TransformSample) -> bool:
        """Appends ``frame_T_child`` at the header stamp; False when it was refused and counted."""
        return self.append(sample.header.stamp_ns, sample.frame_T_child)

    def append(self, stamp_ns: int, pose: F64) -> bool:
        """Appends a pose (4, 4); False when it was refused and counted."""
        if self._is_late(stamp_ns):
            self._drop_ahead(stamp_ns)
        if self._is_late(stamp_ns):
            if stamp_ns == self._stamps[self._n - 1]:
                self.duplicates += 1
            else:
                self.backwards += 1
                self._count_set_back(stamp_ns)
            return False
        if not is_time(stamp_ns) or not _is_rigid(pose):
            self.invalid += 1
            return False

        if self._n == 0:
            self.first_ns = stamp_ns
        if self._n == len(self._stamps):
            self._make_room()
        self._stamps[self._n] = stamp_ns
        self._rows[self._n] = pose[:3]
        self._n += 1
        self.moves = self.moves or bool((pose[:3, 3] != self._rows[0, :, 3]).any())
        return True

    def _count_set_back(self, stamp_ns: int) -> None:
        newest_ns = int(self._stamps[self._n - 1])
        if newest_ns in self.set_back or len(self.set_back) < _MOST_SET_BACK:
            run = self.set_back.setdefault(newest_ns, SetBack())
            run.count += 1
            run.longest_ns = max(run.longest_ns, newest_ns - stamp_ns)

    def _is_late(self, stamp_ns: int) -> bool:
        """Whether a stamp is not after the newest one."""
        return self._n > 0 and is_time(stamp_ns) and stamp_ns <= int(self._stamps[self._n - 1])

    def _drop_ahead(self, stamp_ns: int) -> None:
        """Takes back the newest poses, a few at most, that a glitch of the clock stamped far ahead.

        One pose from the next century would otherwise make all that follow it too old.
        """
        for count in range(1, min(_GLITCH, self._n) + 1):
            is_ahead = self._stamps[self._n - count] - stamp_ns > _AHEAD_NS
            if is_ahead and (count == self._n or self._stamps[self._n - count - 1] < stamp_ns):
                self._n -= count
                self.ahead += count
                self._limit = None
                return

    def _make_room(self) -> None:
        first = 0
        if self._keep_ns is not None:
            first = int(np.searchsorted(self._stamps, self._stamps[self._n - 1] - self._keep_ns))
        kept = self._n - first
        size = max(16, 2 * kept)
        stamps = np.empty(size, np.int64)
        rows = np.empty((size, 3, 4))
        stamps[:kept] = self._stamps[first : self._n]
        rows[:kept] = self._rows[first : self._n]
        self._stamps = stamps
        self._rows = rows
        self._n = kept

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Stamps (n,), strictly increasing. A view: not to be written to."""
        return self._stamps[: self._n]

    @property
    def poses(self) -> F64:
        """Poses (n, 4, 4)."""
        return self._matrices(slice(0, self._n))

    @property
    def start_ns(self) -> int | None:
        """The oldest stamp that is remembered."""
        return int(self._stamps[0]) if self._n else None

    @property
    def end_ns(self) -> int | None:
        """The newest stamp."""
        return int(self._stamps[self._n - 1]) if self._n else None

    def gap_limit_ns(self) -> int:
        """The longest hole between two poses that is interpolated.

        ``max_gap`` or three median periods, at most 5 s.
        """
        # the estimate is renewed now and then: a median for every frame would cost more than the
        # interpolation
        if self._limit is None or not self._limit[0] <= self._n < self._limit[0] + max(
            1, self._limit[0] // 4
        ):
            limit = self.max_gap
            if self._n > 2:
                period = float(np.median(np.diff(self.stamps_ns[-_PERIOD_WINDOW:]))) * 1e-9
                limit = max(limit, min(PERIODS_PER_GAP * period, LONGEST_GAP))
            self._limit = (self._n, round(limit * 1e9))
        return self._limit[1]

    def at(self, stamp_ns: int) -> F64 | None:
        """The pose (4, 4) at ``stamp_ns``; None in a gap and over 0.1 s outside of the stream.

        Outside it a steady motion goes on as it was: at 10 m/s the nearest pose is off by up to a
        metre. Where the last step is unlike the one before it, as a jump is, that pose stays.
        """
        if not is_time(stamp_ns):
            return None
        poses, known = self.at_many(np.array([stamp_ns], np.int64))
        return poses[0] if known[0] else None

    def at_many(self, stamps_ns: NDArray[np.int64]) -> tuple[F64, NDArray[np.bool_]]:
        """Poses (m, 4, 4) at ``stamps_ns`` (m,), and which are known (m,); else identity."""
        wanted = np.asarray(stamps_ns, np.int64)
        poses = np.tile(np.eye(4), (len(wanted), 1, 1))
        if self._n == 0:
            return poses, np.zeros(len(wanted), bool)
        stamps = self.stamps_ns
        known = (wanted >= stamps[0] - EDGE_NS) & (wanted <= stamps[-1] + EDGE_NS)
        poses, is_within = self._within(np.clip(wanted, stamps[0], stamps[-1]))
        known &= is_within
        for end, is_beyond in ((0, wanted < stamps[0]), (-1, wanted > stamps[-1])):
            rows = np.flatnonzero(known & is_beyond)
            if not len(rows) or not self._is_steady(end):
                continue
            mirrored = 2 * stamps[end] - wanted[rows]
            before, is_near = self._within(mirrored)
            rows = rows[is_near]
            # as far beyond the end as the motion was before it
            poses[rows] = poses[rows] @ transforms.inverse(before[is_near]) @ poses[rows]
        return poses, known

    def _is_steady(self, end: int) -> bool:
        """Whether the step at an end of the stream, the first or last (-1), is like the next to it.

        Steps of poses in quick succession are taken together: noise is large beside one of them.
        """
        stamps = self.stamps_ns
        if len(stamps) <= 2:
            return False
        step_ns = max(EDGE_NS, int(stamps[1] - stamps[0] if end == 0 else stamps[-1] - stamps[-2]))
        towards = step_ns if end == 0 else -step_ns
        poses, known = self._within(stamps[end] + towards * np.arange(3))
        if not known.all():
            return False
        last, before = transforms.inverse(poses[1:]) @ poses[:-1]
        seconds = step_ns * 1e-9
        speed = float(np.linalg.norm(before[:3, 3])) / seconds
        turn = transforms.rotation_angle(before[:3, :3]) / seconds
        changed_speed = float(np.linalg.norm(last[:3, 3] - before[:3, 3])) / seconds
        changed_turn = transforms.rotation_angle(before[:3, :3].T @ last[:3, :3]) / seconds
        return changed_speed <= max(_CHANGED_SPEED, _CHANGED_SHARE * speed) and (
            changed_turn <= max(_CHANGED_TURN, _CHANGED_SHARE * turn)
        )

    def _within(self, wanted: NDArray[np.int64]) -> tuple[F64, NDArray[np.bool_]]:
        """Poses (m, 4, 4) at stamps (m,) between the ends, and which are not in gaps or outside."""
        poses = np.tile(np.eye(4), (len(wanted), 1, 1))
        stamps = self.stamps_ns
        newest = self._n - 1
        right = np.searchsorted(stamps, wanted, side="left")
        is_exact = stamps[np.minimum(right, newest)] == wanted
        left = np.clip(np.where(is_exact, right, right - 1), 0, newest)
        right = np.clip(right, 0, newest)
        known = (wanted >= stamps[0]) & (wanted <= stamps[-1])
        known &= stamps[right] - stamps[left] <= self.gap_limit_ns()
        if known.any():
            # only the poses on both sides: a drive may have a million
            rows = np.unique(np.concatenate([left[known], right[known]]))
            poses[known] = transforms.interpolate(stamps[rows], self._matrices(rows), wanted[known])
        return poses, known

    def gaps(self) -> list[tuple[int, int]]:
        """Holes that are not interpolated: (stamp before, stamp after)."""
        stamps = self.stamps_ns
        holes = np.flatnonzero(np.diff(stamps) > self.gap_limit_ns())
        return [(int(stamps[i]), int(stamps[i + 1])) for i in holes]

    def extents(self) -> F64:
        """Edges (3,) of the box along the axes that holds all positions, m; 0 without poses."""
        positions = self._rows[: self._n, :, 3]
        return np.asarray(np.ptp(positions, axis=0)) if self._n else np.zeros(3)

    def length(self) -> float:
        """Metres travelled, gaps left out."""
        rows = self._rows[: self._n]
        stamps = self.stamps_ns
        steps = np.linalg.norm(np.diff(rows[:, :, 3], axis=0), axis=1)
        return float(steps[np.diff(stamps) <= self.gap_limit_ns()].sum())

    def to_json(self) -> dict[str, object]:
        """The stream in numbers, for session.json."""
        gaps = [[before, after] for before, after in self.gaps()]
        return {
            "count": self._n,
            "start_ns": self.start_ns,
            "end_ns": self.end_ns,
            "gaps": gaps,
            "length_m": round(self.length(), 3),
            "duplicates": self.duplicates,
            "backwards": self.backwards,
            "invalid": self.invalid,
            "ahead": self.ahead,
        }

    def _matrices(self, rows: NDArray[np.int64] | slice) -> F64:
        part = self._rows[rows]
        out = np.zeros((len(part), 4, 4))
        out[:, :3] = part
        out[:, 3, 3] = 1.0
        return out
