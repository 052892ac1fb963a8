"""Sessions of one recording are known by their measurements."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from semloc_logs.closures.same_recording import same_recordings

S = 1_000_000_000


def session(first: int, last: int, seed: int = 0) -> Any:
    """Keyframes each second; ``seed`` decides the points of each."""
    means = np.random.default_rng(seed).normal(size=(100, 3))[first:last]
    stamps_ns = np.arange(first, last) * S
    return cast(
        Any,
        SimpleNamespace(
            stamps_ns=stamps_ns, view_means=lambda: [tuple(mean) for mean in means.tolist()]
        ),
    )


@pytest.mark.parametrize(
    ("a", "b", "count"),
    [
        (session(0, 20), session(0, 20), 20),  # one log under two names
        (session(0, 20), session(15, 40), 5),  # a part that both have
        (session(0, 1), session(0, 1), 1),  # single sweeps
        (session(0, 20), session(17, 40), 3),  # three keyframes of many
        (session(0, 20), session(18, 40), 0),  # two
        (session(0, 20), session(0, 20, seed=1), 0),  # simulated time starts at 0 in both
        (session(0, 20), session(20, 40), 0),
    ],
)
def test_sessions_of_one_recording_are_named(a: Any, b: Any, count: int) -> None:
    sentences = same_recordings({"b": b, "a": a, "other": session(60, 80)})
    if not count:
        assert sentences == []
        return
    [sentence] = sentences
    assert sentence.startswith(
        f"Sessions a and b are of one recording: {count} of their keyframes are the same"
    )


def test_many_copies_are_one_sentence() -> None:
    """Five copies and a part of one of them; two and three copies of other recordings."""
    maps = {name: session(0, 20) for name in "fecba"} | {"d": session(15, 40)}
    maps |= {name: session(0, 9, seed=1) for name in "yx"}
    maps |= {name: session(0, 8, seed=2) for name in "rqp"}
    first, third, second = same_recordings(maps)
    assert third.startswith("Sessions p, q and r are of one recording: 8 of their keyframes are")
    assert first.startswith(
        "Sessions a, b, c, d and 2 others are of one recording: 20 of their keyframes are"
    )
    assert second.startswith("Sessions x and y are of one recording: 9 of their keyframes are")


def test_a_sweep_between_the_keyframes_of_a_drive_is_not_of_it() -> None:
    sweep = session(5, 6)
    sweep.stamps_ns = sweep.stamps_ns + S // 2
    assert same_recordings({"drive": session(0, 20), "sweep": sweep}) == []


def test_sessions_of_earlier_versions_are_not_compared() -> None:
    old = SimpleNamespace(stamps_ns=np.arange(20) * S, view_means=list)
    assert same_recordings({"a": cast(Any, old), "b": cast(Any, old)}) == []
