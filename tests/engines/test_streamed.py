from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from semloc_logs.engines.streamed import Growing


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


def test_no_more_is_taken_than_so_much_ahead_of_what_is_wanted() -> None:
    taken: list[int] = []

    def results() -> Iterator[int]:
        for i in range(2, 10):
            taken.append(i)
            yield i

    growing = Growing(results(), 10, first=2, ahead=3)
    assert growing[4] == 4
    assert growing[7] == 7  # wanted up to 7: taken up to 10
    assert growing[9] == 9
    with pytest.raises(IndexError, match="before the first"):
        growing[1]

    lazy = Growing(results(), 10, first=2, ahead=0)
    taken.clear()
    assert lazy[2] == 2
    assert lazy[3] == 3
    assert taken == [2, 3]


def test_who_waits_is_told_when_no_more_comes() -> None:
    stuck = threading.Event()

    def results() -> Iterator[int]:
        stuck.wait(20)
        yield 1

    growing = Growing(results(), 1)
    threading.Timer(0.1, growing.close).start()
    with pytest.raises(IndexError, match="not wanted"):
        growing[0]
    stuck.set()
