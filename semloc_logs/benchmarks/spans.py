"""Named spans of a run: the time within functions of the package, as a profiler measures it.

Spans hold the functions themselves, so that a renamed one is an error and not a missing figure.
"""

from __future__ import annotations

import cProfile
import inspect
import pstats
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

Rows = list[tuple[float, int, str]]
Function = Callable[..., Any]
Code = tuple[str, int, str]  # file, first line and name, as the profiler names a function
Callers = dict[Code, tuple[int, int, float, float]]
PLACE_FOLDERS = 2  # parts of a path that tell where a function is


@dataclass(frozen=True, slots=True)
class Span:
    """A part of a run: the time within ``functions`` and all that they call.

    The time within the functions ``without``, and within functions of the module ``pulled`` that
    ``functions`` call directly, belongs to other spans. ``pulled`` is for generators that take
    their items from another module's generators.
    """

    name: str
    functions: tuple[Function, ...]
    without: tuple[Function, ...] = ()
    pulled: ModuleType | None = None

    def seconds(self, times: FunctionTimes) -> float:
        """Seconds of this span."""
        total = sum(times.within(function) for function in self.functions)
        total -= sum(times.within(function) for function in self.without)
        if self.pulled is not None:
            total -= sum(times.pulled(function, self.pulled) for function in self.functions)
        return total


class FunctionTimes:
    """Seconds within functions, from a profiler that has run."""

    def __init__(self, profiler: cProfile.Profile) -> None:
        self._stats: dict[Code, tuple[int, int, float, float, Callers]] = pstats.Stats(
            profiler
        ).stats  # type: ignore[attr-defined]

    def within(self, function: Function) -> float:
        """Seconds within ``function`` and all that it calls; 0 when it was not called."""
        code = _code(function)
        return self._stats[code][3] if code in self._stats else 0.0

    def pulled(self, function: Function, module: ModuleType) -> float:
        """Seconds within functions of ``module`` that ``function`` calls directly."""
        caller = _code(function)
        return sum(
            callers[caller][3]
            for (path, _, _), (_, _, _, _, callers) in self._stats.items()
            if path == module.__file__ and caller in callers
        )

    def busiest(self, count: int) -> Rows:
        """Own seconds, calls and place of the ``count`` functions with most own seconds."""
        rows = [(own, calls, _place(code)) for code, (_, calls, own, _, _) in self._stats.items()]
        return sorted(rows, reverse=True)[:count]


def span_seconds(spans: Sequence[Span], times: FunctionTimes, whole: Function) -> dict[str, float]:
    """Seconds of each of ``spans`` by name, and the ``rest`` of the time of ``whole``."""
    seconds = {span.name: span.seconds(times) for span in spans}
    return seconds | {"rest": max(0.0, times.within(whole) - sum(seconds.values()))}


def _code(function: Function) -> Code:
    """How a profiler names ``function``, decorators taken off."""
    code = inspect.unwrap(function).__code__
    return code.co_filename, code.co_firstlineno, code.co_name


def _place(code: Code) -> str:
    path, line, name = code
    if line == 0:  # built in
        return name
    return f"{'/'.join(Path(path).parts[-PLACE_FOLDERS:])}:{line} {name}"
