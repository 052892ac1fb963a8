from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from semloc_logs.engines.growing import Growing


def test_the_first_result_is_there_before_the_last() -> None:
    last = threading.Event()

    def results() -> Iterator[str]:
        yield "a"
        yield "b"
        assert last.wait(10)
        yield "c"

    counted: list[int] = []
    growing = Growing(results(), 3, counted.append)
    assert len(growing) == 3
    assert growing[0] == "a"
    assert growing[1] == "b"
    assert not last.is_set()
    last.set()
    assert growing[-1] == "c"
    assert list(growing) == ["a", "b", "c"]
    assert growing[1:] == ["b", "c"]
    with pytest.raises(IndexError):
        growing[3]


def test_what_went_wrong_is_raised_where_it_is_missed() -> None:
    def results() -> Iterator[int]:
        yield 1
        raise ValueError("no scene")

    growing = Growing(results(), 2)
    with pytest.raises(ValueError, match="no scene"):
        growing[1]
    assert growing[0] == 1
    with pytest.raises(IndexError, match="1 results came, not 2"):
        Growing([5], 2)[1]
