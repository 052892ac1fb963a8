"""Whether the time of a stream goes on: stamps that leap and come back are outliers, stamps that
fall back for good are another clock.
"""

from __future__ import annotations

LEAP_NS = 10_000_000_000  # a stamp so far ahead counts once the next one confirms it
_REORDERED_NS = 1_000_000_000  # messages may overtake each other by this


class StampOrder:
    """Follows the stamps of one stream in the order of recording."""

    def __init__(self) -> None:
        self._newest: int | None = None
        self._ahead: int | None = None
        self._run = 0  # stamps that have led to the newest one

    def accepts(self, stamp_ns: int) -> bool:
        """False for a stamp that lies more than a second before what the stream had reached."""
        newest = self._newest
        ahead = self._ahead
        self._ahead = None
        # the first stamp itself leapt
        is_lone = self._run == 1 and newest is not None and stamp_ns < newest - LEAP_NS
        if newest is None or is_lone:
            self._newest, self._run = stamp_ns, 1
            return True
        if stamp_ns > newest + LEAP_NS and (
            ahead is None or not ahead <= stamp_ns <= ahead + LEAP_NS
        ):
            self._ahead = stamp_ns
            return True
        if stamp_ns >= newest:
            self._newest = stamp_ns
            self._run = self._run + 1
        return stamp_ns >= newest - _REORDERED_NS
