"""Times for people: UTC, or seconds where a log does not count from 1970."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

DATED_NS = 100_000_000 * 1_000_000_000  # 1973: earlier stamps count from the start of something
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
TENTH_NS = 100_000_000


def time_text(stamp_ns: int) -> str:
    """As 2026-11-30 12:15:00.3, rounded to tenths."""
    if stamp_ns < DATED_NS:
        return f"{stamp_ns / 1e9:.1f} s"
    tenths = (stamp_ns + TENTH_NS // 2) // TENTH_NS
    moment = EPOCH + timedelta(seconds=tenths // 10)
    return f"{moment:%Y-%m-%d %H:%M:%S}.{tenths % 10}"


def period_text(first_ns: int, last_ns: int) -> str:
    """From when to when, as short as it can be."""
    if first_ns < DATED_NS:
        return f"{first_ns / 1e9:.0f} to {last_ns / 1e9:.0f} s"
    first = EPOCH + timedelta(seconds=first_ns // 1_000_000_000)
    last = EPOCH + timedelta(seconds=last_ns // 1_000_000_000)
    form = "%H:%M" if first.date() == last.date() else "%Y-%m-%d %H:%M"
    return f"{first:%Y-%m-%d %H:%M} to {last:{form}} UTC"
