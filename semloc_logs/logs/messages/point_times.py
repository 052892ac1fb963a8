"""Times of the points of a sweep: unit, origin, and whether they are plausible."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F32
from semloc_logs.frames import LidarFrame, PointTimeRemark

# the points of a sweep are within a second, and within a second of their header
LONGEST_SWEEP_NS = 1_000_000_000
# a sweep takes longer than this, so milliseconds and microseconds are not confused
_LEAST_SPAN_NS = 5_000_000
# sweeps with times of another clock, less others, that count: those at the start of a log do not
# decide for the rest
_REMEMBERED = 2
# of counters that begin again: 4.3 s of nanoseconds, 72 minutes of microseconds
_WRAPPING_BYTES = 4
_PERIODS_PER_SWEEP = 1.5  # a sweep is over when the next one begins, give or take
_PERIODS_KEPT = 16
# the share of neighbours measured nearly together: above 0.9 in sweeps, 0.1 where times are noise
_ORDERED = 0.5
_NEARLY = 0.05  # of the sweep's span
_OFF_STAMP_NS = 100_000_000  # from the header to the nearest point: publishing takes less
_FEWEST = 100  # points of a sweep whose order can be judged
_MOST_PER_SECOND = 1e7  # points; the fastest LIDARs measure a few millions
_LOOKED_AT = 20_000  # points that are compared
_CELLS = 180  # cells of azimuth of 2 degrees


def offsets_ns(time: NDArray[np.generic], stamp_ns: int) -> tuple[NDArray[np.int64] | None, bool]:
    """Times (n,) of points relative to ``stamp_ns``; and whether they are of another clock.

    None when nothing makes sense of them. The unit (s, ms, us, ns) and origin (the stamp, or the
    epoch) are those with which the points span more than 5 ms and stay within a second of the
    stamp; failing that the unit with which they span as much on a clock of their own (such as
    seconds since power-on), whose first point is taken to be measured at the stamp; failing that (a
    flash sensor) those that keep them within a second at all.
    """
    if time.size == 0:
        return np.zeros(0, np.int64), False
    time = _unwrapped(time)
    low = time.min().item()
    high = time.max().item()
    if not (np.isfinite(low) and np.isfinite(high)):
        return None, False
    # in integers, because nanoseconds since 1970 do not fit a float64; the parts of a second are
    # exact enough as float
    ranges = [(unit, _to_ns(low, unit), _to_ns(high, unit)) for unit in _units(time)]
    # units and origins that put all points within a second of the stamp
    plausible = [
        (unit, origin)
        for unit, first, last in ranges
        for origin in (0, stamp_ns)
        if max(abs(first - origin), abs(last - origin)) < LONGEST_SWEEP_NS
    ]
    # first point, by the units with which the points span as long as a sweep
    sweeps = {
        unit: first
        for unit, first, last in ranges
        if _LEAST_SPAN_NS <= last - first < 2 * LONGEST_SWEEP_NS
    }
    for unit, origin in plausible:
        if unit in sweeps:
            return _shift(time, unit, origin), False
    for unit, first in sweeps.items():
        return _shift(time, unit, first), True
    return (_shift(time, *plausible[0]), False) if plausible else (None, False)


def _unwrapped(time: NDArray[np.generic]) -> NDArray[np.generic]:
    """Times (n,) of a counter of at most 32 bits that began again at zero within the sweep.

    Those before are negative then, as a difference to the stamp is that was kept without its sign.
    """
    if time.dtype.kind != "u" or time.dtype.itemsize > _WRAPPING_BYTES:
        return time
    turn = 1 << (8 * time.dtype.itemsize)
    signed = time.astype(np.int64)
    is_before = signed >= turn // 2
    if is_before.all() or not is_before.any():
        return time
    signed = np.where(is_before, signed - turn, signed)
    span = int(signed.max()) - int(signed.min())
    # a wild value is far from all others
    gap = int(signed[~is_before].min()) - int(signed[is_before].max())
    return signed if gap <= _NEARLY * span < _NEARLY * turn // 2 else time


def _units(time: NDArray[np.generic]) -> tuple[int, ...]:
    """Nanoseconds of the units to try, the usual ones of the type first."""
    return (
        (1, 1_000, 1_000_000, 1_000_000_000)
        if time.dtype.kind in "iu"
        else (1_000_000_000, 1_000_000, 1_000, 1)
    )


def sweep_unit(time: NDArray[np.int64]) -> int:
    """Nanoseconds of the unit of times (n,) that are defined to be nanoseconds; mostly 1.

    Some writers fill in microseconds or milliseconds: then no sensor would be so fast.
    """
    if len(time) < _FEWEST:
        return 1
    span = int(time.max()) - int(time.min())
    if not span or len(time) <= span * 1e-9 * _MOST_PER_SECOND:
        return 1
    units = (1_000, 1_000_000)
    return next((u for u in units if _LEAST_SPAN_NS <= span * u < LONGEST_SWEEP_NS // 2), 1)


def _to_ns(value: float, unit: int) -> int:
    return int(value) * unit + int((value - int(value)) * unit)


def _shift(time: NDArray[np.generic], unit: int, origin: int) -> NDArray[np.int64]:
    """``time * unit - origin`` as int64; only called where every result is below a second."""
    if time.dtype.kind in "iu":
        whole, rest = divmod(origin, unit)
        # unsigned 64-bit arithmetic wraps, so the small difference is right even where the times
        # are not
        difference = time.astype(np.uint64) - np.uint64(whole % (1 << 64))
        return difference.view(np.int64) * np.int64(unit) - np.int64(rest)
    seconds = time.astype(np.float64)
    base = np.floor(seconds.min())
    fraction = np.rint((seconds - base) * unit).astype(np.int64)
    return np.asarray(fraction + np.int64(int(base) * unit - origin), np.int64)


class PointTimes:
    """Checks the point times of the sweeps of a log, topic by topic."""

    def __init__(self) -> None:
        self._newest: dict[tuple[str, str], int] = {}
        self._periods: dict[tuple[str, str], deque[int]] = {}
        # sweeps with times of another clock, less the ones with times that follow the stamp
        self._other_clock: Counter[tuple[str, str]] = Counter()

    def checked(self, frame: LidarFrame) -> LidarFrame:
        """The sweep as it is, or with a remark: without times when they are not plausible.

        A sweep does not take much longer than the time to the next one; clouds gathered from
        several sweeps do. And points recorded one after the other, or seen in the same direction,
        were measured nearly together; where they were not, the values are not times. Where most
        sweeps have times of another clock, others only look as if theirs followed the stamp.
        """
        key = (frame.header.topic, frame.header.frame_id)
        stamp_ns = frame.header.stamp_ns
        periods = self._periods.setdefault(key, deque(maxlen=_PERIODS_KEPT))
        step = stamp_ns - self._newest.get(key, stamp_ns)
        if step > 0:
            periods.append(step)
        self._newest[key] = stamp_ns
        offset = frame.offset_ns
        if offset is None or not len(offset):
            return frame
        is_other = frame.remark is PointTimeRemark.OTHER_CLOCK
        are_others = self._other_clock[key] > 0
        counted = self._other_clock[key] + (1 if is_other else -1)
        self._other_clock[key] = min(max(counted, -_REMEMBERED), _REMEMBERED)
        if are_others and not is_other:
            offset = offset - offset.min()
            frame = replace(frame, offset_ns=offset, remark=PointTimeRemark.OTHER_CLOCK)
        # the longest of some: several sensors on one topic come in bursts
        longest = _PERIODS_PER_SWEEP * max(periods) if len(periods) > 1 else LONGEST_SWEEP_NS
        if int(offset.max()) - int(offset.min()) <= longest and in_order(offset, frame.points):
            is_near = off_stamp_ns(offset) <= _OFF_STAMP_NS
            return frame if is_near else replace(frame, remark=PointTimeRemark.OFF_STAMP)
        return replace(frame, offset_ns=None, remark=PointTimeRemark.UNUSABLE)


def off_stamp_ns(offset_ns: NDArray[np.int64]) -> int:
    """From the header's time to the nearest of ``offset_ns`` (n,); 0 within them."""
    return max(0, int(offset_ns.min()), -int(offset_ns.max())) if len(offset_ns) else 0


def in_order(offset_ns: NDArray[np.int64], points: F32) -> bool:
    """Whether neighbours among ``points`` (n, 3) have nearly the same time.

    Neighbours in the recorded order, or by their direction.
    """
    span = int(offset_ns.max()) - int(offset_ns.min())
    if span == 0 or len(offset_ns) < _FEWEST:
        return True
    together = max(1.0, _NEARLY * span)  # ns
    some = slice(0, _LOOKED_AT)
    if float(np.mean(np.abs(np.diff(offset_ns[some])) < together)) > _ORDERED:
        return True
    every = max(1, len(offset_ns) // _LOOKED_AT)
    cell = (
        (np.arctan2(points[::every, 1], points[::every, 0]) + np.pi) * (_CELLS / (2 * np.pi))
    ).astype(np.int64)
    time = offset_ns[::every]
    order = np.lexsort((time, cell))
    starts = np.flatnonzero(np.diff(cell[order], prepend=-1))
    middle = starts + np.diff(starts, append=len(order)) // 2
    median = np.zeros(int(cell.max()) + 1, np.int64)
    median[cell[order[starts]]] = time[order[middle]]
    return float(np.mean(np.abs(time - median[cell]) < together)) > _ORDERED
