"""Progress of long work, as events that a listener may show.

A stage reports from the process it runs in. Engines carry the events and log records of their
workers to the process that started them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Progress:
    """``done`` of ``total`` units of a stage's work on a session; ``total`` is None if unknown.

    Without a session it is about all sessions of the stage.
    """

    stage: str
    session: str
    done: int
    total: int | None
    unit: str

    @property
    def finished(self) -> bool:
        return self.total is not None and self.done >= self.total

    @property
    def share(self) -> float | None:
        """Of the work that is done, in [0, 1]; None if unknown."""
        return self.done / self.total if self.total else None


Listener = Callable[[Progress], None]


def _ignore(_: Progress) -> None:
    """The listener until another one is set."""


_listener: Listener = _ignore


def report(stage: str, session: str, done: int, total: int | None, unit: str) -> None:
    """Tell the listener of this process."""
    _listener(Progress(stage, session, done, total, unit))


def report_start(stage: str, total: int, unit: str) -> None:
    """Tell it how much work a stage begins on all sessions, if there is any."""
    if total:
        report(stage, "", 0, total, unit)


def emit(event: Progress) -> None:
    """Tell the listener of this process of an event that another process reported."""
    _listener(event)


def listen(listener: Listener) -> None:
    """Send every further event of this process to ``listener``."""
    global _listener
    _listener = listener


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Send the events of the block to ``listener``."""
    before = _listener
    listen(listener)
    try:
        yield
    finally:
        listen(before)
