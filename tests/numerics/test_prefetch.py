from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest

from semloc_logs.numerics.prefetch import THREAD_NAME, in_callers_thread, prefetched


def test_items_come_in_their_order() -> None:
    assert list(prefetched(range(100), depth=3)) == list(range(100))
    assert list(prefetched([])) == []


def test_at_most_the_depth_and_one_are_made_ahead() -> None:
    made = []

    def items() -> Iterator[int]:
        for i in range(10):
            made.append(i)
            yield i

    coming = prefetched(items(), depth=2)
    assert next(coming) == 0
    time.sleep(0.3)
    assert made == [0, 1, 2, 3]  # one taken, two waiting, one in hand
    assert list(coming) == list(range(1, 10))


def test_an_exception_of_the_source_is_raised_after_the_items_before_it() -> None:
    def items() -> Iterator[int]:
        yield 1
        raise KeyError("lost")

    coming = prefetched(items())
    assert next(coming) == 1
    with pytest.raises(KeyError, match="lost"):
        next(coming)


def test_leaving_early_closes_the_source_and_ends_the_thread() -> None:
    closed = threading.Event()

    def items() -> Iterator[int]:
        try:
            yield from range(10**9)
        finally:
            closed.set()

    coming = prefetched(items())
    next(coming)
    coming.close()
    assert closed.is_set()
    assert not [t for t in threading.enumerate() if t.name == THREAD_NAME]


def test_items_are_made_as_they_are_taken_where_one_thread_is_wanted() -> None:
    threads = []

    def items() -> Iterator[int]:
        for i in range(3):
            threads.append(threading.current_thread())
            yield i

    with in_callers_thread():
        coming = prefetched(items())
        assert next(coming) == 0
        assert threads == [threading.current_thread()]
        assert list(coming) == [1, 2]
    assert set(threads) == {threading.current_thread()}
    list(prefetched(items()))
    assert threads[-1] is not threading.current_thread()
