"""Engines call a plain function on picklable tasks; results come in the order of the tasks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Protocol, TypeVar

from semloc_logs.engines.worker_memory import memory_limit, return_freed_memory

Task = TypeVar("Task")
Result = TypeVar("Result")


class Engine(Protocol):
    """Runs independent tasks; results come in the order of the tasks, errors as they are raised.

    Progress events and log records of the tasks arrive in the process that called ``map``.
    """

    jobs: int

    def map(
        self, function: Callable[[Task], Result], tasks: Iterable[Task]
    ) -> Iterator[Result]: ...

    def close(self) -> None:
        """Release the workers once their tasks are done."""

    def stop(self) -> None:
        """End the workers now; they clean up what they were writing."""


class Serial:
    """Everything in this process, one task after the other; each ends where it needs more than
    ``max_memory`` bytes.
    """

    jobs = 1

    def __init__(self, max_memory: int | None = None) -> None:
        self._max_memory = max_memory

    def map(self, function: Callable[[Task], Result], tasks: Iterable[Task]) -> Iterator[Result]:
        return_freed_memory()
        for task in tasks:
            with memory_limit(self._max_memory):
                result = function(task)
            yield result

    def close(self) -> None:
        """Nothing to release."""

    def stop(self) -> None:
        """Nothing to end."""
