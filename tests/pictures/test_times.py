"""Times as people read them."""

from __future__ import annotations

from datetime import UTC, datetime

from semloc_logs.pictures.times import period_text, time_text

NOON_NS = int(datetime(2026, 11, 30, 12, 0, tzinfo=UTC).timestamp()) * 1_000_000_000


def test_a_time_is_rounded_to_tenths() -> None:
    assert time_text(NOON_NS) == "2026-11-30 12:00:00.0"
    assert time_text(NOON_NS + 949_999_999) == "2026-11-30 12:00:00.9"
    assert time_text(NOON_NS - 50_000_000) == "2026-11-30 12:00:00.0"


def test_small_stamps_are_seconds() -> None:
    assert time_text(12_340_000_000) == "12.3 s"
    assert period_text(0, 95_600_000_000) == "0 to 96 s"


def test_a_period_names_its_day_once() -> None:
    hour_ns = 3600 * 1_000_000_000
    assert period_text(NOON_NS, NOON_NS + hour_ns) == "2026-11-30 12:00 to 13:00 UTC"
    later = period_text(NOON_NS, NOON_NS + 24 * hour_ns)
    assert later == "2026-11-30 12:00 to 2026-12-01 12:00 UTC"
