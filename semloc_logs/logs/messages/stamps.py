"""Order of the stamps of a stream: outliers, and clocks that were set back."""

from __future__ import annotations

from datetime import UTC, datetime

LEAP_NS = 10_000_000_000  # a stamp so far ahead counts once the next one confirms it
_REORDERED_NS = 1_000_000_000  # messages may overtake each other by this


class StampOrder:
    """Follows the stamps of one stream in the order of recording."""

    def __init__(self) -> None:
        self._newest: int | None = None
        self._leapt: int | None = None  # a stamp far ahead that no other has confirmed yet
        self._run = 0  # stamps that have led to the newest one

    def accepts(self, stamp_ns: int) -> bool:
        """False for a stamp more than a second before the newest stamp of the stream."""
        newest = self._newest
        leapt = self._leapt
        self._leapt = None

        # the first stamp itself leapt
        is_lone = self._run == 1 and newest is not None and stamp_ns < newest - LEAP_NS
        if newest is None or is_lone:
            self._newest = stamp_ns
            self._run = 1
            return True

        is_confirmed = leapt is not None and leapt <= stamp_ns <= leapt + LEAP_NS
        if stamp_ns > newest + LEAP_NS and not is_confirmed:
            self._leapt = stamp_ns
            return True
        if stamp_ns >= newest:
            self._newest = stamp_ns
            self._run += 1
        return stamp_ns >= newest - _REORDERED_NS


def time_range(start_ns: int | None, end_ns: int | None) -> str:
    """A time range for people, in UTC."""
    if start_ns is None or end_ns is None:
        return "none"
    return f"{utc(start_ns)} to {utc(end_ns)}"


def duration(span_ns: int) -> str:
    """A span of time for people, in the largest unit that it fills."""
    seconds = span_ns * 1e-9
    for unit, length in (("years", 31_557_600), ("days", 86_400), ("hours", 3600), ("min", 60)):
        if abs(seconds) >= 2 * length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.2f} s"


def utc(stamp_ns: int) -> str:
    """A time for people: UTC to the millisecond, or nanoseconds where no calendar has it."""
    try:
        time = datetime.fromtimestamp(stamp_ns / 1e9, UTC)
    except (OverflowError, ValueError, OSError):
        return f"{stamp_ns} ns"
    return time.strftime("%Y-%m-%dT%H:%M:%S.%f")[:-3] + "Z"
