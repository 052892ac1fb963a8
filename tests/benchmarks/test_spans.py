"""Spans of a profile: time within functions, less the time of what belongs to other spans."""

from __future__ import annotations

import cProfile
import functools
from collections.abc import Callable, Iterator
from types import ModuleType

import pytest

from semloc_logs.benchmarks.spans import FunctionTimes, Span, span_seconds

CLOCK = [0]  # s; only work() lets it run


def work(seconds: int) -> None:
    CLOCK[0] += seconds


def module(name: str, text: str) -> ModuleType:
    """A module of its own, with ``work``."""
    made = ModuleType(name)
    made.__file__ = f"{name}.py"
    made.__dict__["work"] = work
    exec(compile(text, made.__file__, "exec"), made.__dict__)
    return made


ELSEWHERE = module(
    "elsewhere", "def source():\n    for i in range(2):\n        work(4)\n        yield i\n"
)


def twice(function: Callable[[], None]) -> Callable[[], None]:
    @functools.wraps(function)
    def wrapper() -> None:
        function()
        function()

    return wrapper


@twice
def decorated() -> None:
    work(1)


def outer() -> None:
    work(2)
    decorated()
    for _ in writer():
        pass
    work(3)


def writer() -> Iterator[int]:
    for item in ELSEWHERE.source():
        work(1)
        yield item


def unused() -> None:
    pass


@pytest.fixture(scope="module")
def times() -> FunctionTimes:
    profiler = cProfile.Profile(lambda: CLOCK[0], 1.0)
    profiler.runcall(outer)
    return FunctionTimes(profiler)


def test_spans_are_the_time_of_their_functions(times: FunctionTimes) -> None:
    spans = (
        Span("decorated", (decorated,)),
        Span("outer alone", (outer,), without=(decorated, writer)),
        Span("written", (writer,), pulled=ELSEWHERE),
        Span("unused", (unused,)),
    )
    assert times.within(outer) == 17
    assert times.within(writer) == 10
    assert span_seconds(spans, times, outer) == {
        "decorated": 2,
        "outer alone": 5,
        "written": 2,
        "unused": 0,
        "rest": 8,  # the items from elsewhere
    }
    assert Span("outer", (outer,), pulled=cProfile).seconds(times) == 17  # it calls nothing there


def test_the_busiest_functions_come_first(times: FunctionTimes) -> None:
    (own, calls, place), *others = times.busiest(3)
    assert (own, calls) == (17, 8)
    assert place.startswith("benchmarks/test_spans.py:")
    assert place.endswith(" work")
    assert [seconds for seconds, _, _ in others] == [0, 0]
