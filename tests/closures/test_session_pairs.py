"""Which session is searched in which: by their recording, whatever the order of adding."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from semloc_logs.closures.session_pairs import Pair, pairs_of_sessions

SECOND = 1_000_000_000


def session(start_ns: int, *, posed: bool = True, is_map: bool = False) -> Any:
    stamps_ns = np.array([start_ns, start_ns + 1])
    return SimpleNamespace(stamps_ns=stamps_ns, posed=posed, fixes=None, is_map=is_map)


def located(start_s: int, longitude: float, sigma: float = 1.0, fixes: int = 20) -> Any:
    """Ten seconds to the north from 47 degrees, two fixes a second, one keyframe a second."""
    columns = {
        "stamp_ns": start_s * SECOND + np.arange(fixes) * SECOND // 2,
        "latitude_deg": 47.0 + 1e-5 * np.arange(fixes),
        "longitude_deg": np.full(fixes, longitude),
        "sigma_east": np.full(fixes, sigma),
        "sigma_north": np.full(fixes, sigma),
    }
    stamps_ns = (start_s + np.arange(10)) * SECOND
    fixes_table = pa.table(columns)
    return SimpleNamespace(stamps_ns=stamps_ns, posed=True, fixes=fixes_table, is_map=False)


SESSIONS = {"b": session(5), "a": session(7), "c": session(5), "frames": session(1, posed=False)}


@pytest.mark.parametrize("names", ["b a c frames", "frames c a b", "c frames b a"])
def test_the_later_one_is_searched_in_the_earlier_one(names: str) -> None:
    pairs = pairs_of_sessions({name: SESSIONS[name] for name in names.split()})
    assert pairs == [
        Pair("a", "a"),
        Pair("a", "b"),
        Pair("a", "c"),
        Pair("b", "b"),
        Pair("c", "b"),  # as late: by name
        Pair("c", "c"),
        Pair("frames", "a"),  # without poses a session has no map to search
        Pair("frames", "b"),
        Pair("frames", "c"),
        Pair("frames", "frames"),
    ]


def test_a_new_session_leaves_the_pairs_of_the_others() -> None:
    before = pairs_of_sessions({name: SESSIONS[name] for name in "ab"})
    assert set(before) < set(pairs_of_sessions(SESSIONS))


@pytest.mark.parametrize(
    ("other", "is_searched"),
    [
        (located(100, 8.0), True),  # the same road
        (located(100, 8.006), True),  # 456 m to the east
        (located(100, 8.008), False),  # 607 m
        (located(100, 8.008, sigma=6.0), True),  # too uncertain
        (located(100, 8.008, sigma=float("nan")), True),  # it does not tell
        (located(100, 8.008, fixes=10), True),  # none at the end
        (located(100, 8.008, fixes=16), False),  # 1.5 s before the last keyframe
        (session(100 * SECOND), True),  # without fixes
    ],
)
def test_sessions_that_satellites_tell_apart_are_no_pair(other: Any, is_searched: bool) -> None:
    pairs = pairs_of_sessions({"a": located(0, 8.0), "b": other})
    assert (Pair("b", "a") in pairs) == is_searched
    assert Pair("a", "a") in pairs


def test_a_map_is_not_searched_in_itself() -> None:
    maps = {"hdmap": session(1, is_map=True), "drive": session(5)}
    assert pairs_of_sessions(maps) == [Pair("drive", "drive"), Pair("drive", "hdmap")]
