"""Which session is searched in which: by their recording, whatever the order of adding."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from semloc_logs.closures.pairs import Pair, pairs_of_sessions


def session(start_ns: int, *, posed: bool = True) -> Any:
    return SimpleNamespace(stamps_ns=np.array([start_ns, start_ns + 1]), posed=posed)


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
