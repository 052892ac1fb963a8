"""Where words go: results to stdout, everything else to stderr, as text for people or as a line of
JSON each.
"""

from __future__ import annotations

import json
import logging
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Literal

import click

if TYPE_CHECKING:
    from rich.console import Console as Screen
    from rich.progress import TaskID

    from semloc_logs.progress import Progress

NARROW = 80  # columns of a terminal that bars fit into
Key = tuple[str, str, str]  # stage, session and unit of some work
PLAIN_SECONDS = 5.0  # between lines about one piece of work where nobody watches a bar


class Console:
    """One for the program; ``verbosity`` is -1 with -q, above 0 with -v."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """As at the start of the program."""
        self.verbosity = 0
        self.log_format = "text"
        self._bars: Bars | None = None
        self._shown: dict[Key, float] = {}
        self._paces: dict[Key, Pace] = {}
        self._begun = time.monotonic()

    # -- stdout

    def result(self, text: str) -> None:
        """A line of the answer."""
        click.echo(text)

    def result_json(self, content: object) -> None:
        """The answer as JSON; figures without a value become null."""
        click.echo(json.dumps(_finite(content), indent=1, default=str))

    def table(self, title: str, columns: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
        """A table for people; columns whose names end in a bracketed unit or '#' are aligned to the
        right.
        """
        from rich.box import SIMPLE_HEAD
        from rich.console import Console as RichConsole
        from rich.table import Table
        from rich.text import Text

        drawn = Table(title=title or None, box=SIMPLE_HEAD, title_justify="left", pad_edge=False)
        for name in columns:
            is_number = name.endswith((")", "#"))
            drawn.add_column(
                name.removesuffix("#"), justify="right" if is_number else "left", overflow="fold"
            )
        for row in rows:
            drawn.add_row(*(Text("-" if x is None else str(x)) for x in row))
        RichConsole(
            file=sys.stdout, width=None if sys.stdout.isatty() else 160, highlight=False
        ).print(drawn)

    # -- stderr

    def note(self, message: str) -> None:
        """A notice."""
        if self.verbosity >= 0:
            self._say("info", message)

    def warn(self, message: str) -> None:
        """About input that was skipped."""
        self._say("warning", message)

    def error(self, message: str) -> None:
        """Why the command failed."""
        self._say("error", message)

    def show_progress(self, event: Progress) -> None:
        """A bar on a terminal; elsewhere a line every few seconds, and one at the end."""
        is_alone = not event.session and event.total == 1
        if self.verbosity < 0 or is_alone:
            return
        key = event.stage, event.session, event.unit
        now = time.monotonic()
        pace = self._paces.setdefault(key, Pace(event.done, now))
        pace.move(event.done, event.total, now)
        if self._bars is not None:
            self._bars.show(event, pace)
            return
        is_due = now - self._shown.get(key, self._begun) >= PLAIN_SECONDS
        if is_due or event.finished or self.verbosity > 0:
            self._shown[key] = now
            figures = {"share": event.share, "rate": pace.rate, "left_s": pace.left_s}
            rounded = {k: None if v is None else round(v, 3) for k, v in figures.items()}
            self._say("info", sentence(event, pace), **asdict(event), **rounded)

    def _say(self, level: str, message: str, **fields: object) -> None:
        if self.log_format == "json":
            now = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
            content = {"time": now, "level": level, "message": message, **fields}
            click.echo(json.dumps(content), err=True)
            return
        text = message if level == "info" else f"{level.capitalize()}: {message}"
        if self._bars is not None:
            self._bars.print(text)
        else:
            click.echo(text, err=True)

    @contextmanager
    def progress(self) -> Iterator[None]:
        """Show the progress events and notices of the block."""
        from semloc_logs.progress import listening

        self._begun = time.monotonic()
        self._shown.clear()
        self._paces.clear()
        is_plain = self.verbosity < 0 or self.log_format == "json" or not sys.stderr.isatty()
        with self._notices(), listening(self.show_progress):
            if is_plain:
                yield
                return
            with Bars() as bars:
                self._bars = bars
                try:
                    yield
                finally:
                    self._bars = None

    @contextmanager
    def _notices(self) -> Iterator[None]:
        """Show what the package logs."""
        logger = logging.getLogger("semloc_logs")
        handler = _Notices(self)
        before = logger.level
        logger.setLevel(logging.INFO)
        logger.addHandler(handler)
        try:
            yield
        finally:
            logger.removeHandler(handler)
            logger.setLevel(before)


class _Notices(logging.Handler):
    """Log records as notices and warnings of the console."""

    def __init__(self, console: Console) -> None:
        super().__init__()
        self._console = console

    def emit(self, record: logging.LogRecord) -> None:
        message = record.getMessage()
        if record.levelno >= logging.WARNING:
            self._console.warn(message)
        else:
            self._console.note(message)


class Pace:
    """The rate of some work, from its first event on: a run that goes on where it was has done
    some of it before.
    """

    def __init__(self, done: int, now: float) -> None:
        self._first = done
        self._begun = now
        self.rate: float | None = None  # units a second
        self.left_s: float | None = None

    def move(self, done: int, total: int | None, now: float) -> None:
        """``done`` units of ``total`` are done now."""
        seconds = now - self._begun
        if done <= self._first or seconds <= 0:
            return
        self.rate = (done - self._first) / seconds
        self.left_s = None if total is None else max(0, total - done) / self.rate


class Bars:
    """A bar for each stage of each session that is being worked on, within 80 columns."""

    def __init__(self, screen: Screen | None = None) -> None:
        from rich.console import Console as RichConsole
        from rich.progress import BarColumn, SpinnerColumn, TextColumn
        from rich.progress import Progress as RichProgress
        from rich.table import Column

        def text(field: str, width: int, side: Literal["left", "right"] = "right") -> TextColumn:
            column = Column(width=width, no_wrap=True, overflow="ellipsis", justify=side)
            return TextColumn(f"{{task.{field}}}", justify=side, markup=False, table_column=column)

        screen = screen or RichConsole(stderr=True)
        spare = max(0, min(40, screen.width - NARROW))
        self._tasks: dict[Key, TaskID] = {}
        self._bar = RichProgress(
            SpinnerColumn(),
            text("description", 18 + spare // 2, "left"),
            BarColumn(bar_width=8 + spare - spare // 2),
            text("fields[share]", 5),
            text("fields[count]", 22),
            text("fields[rate]", 8),
            text("fields[left]", 11),
            console=screen,
            transient=True,
        )

    def __enter__(self) -> Bars:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def show(self, event: Progress, pace: Pace) -> None:
        """Move the bar of the event's work; a finished one disappears."""
        key = event.stage, event.session, event.unit
        if event.finished:
            if key in self._tasks:
                self._bar.remove_task(self._tasks.pop(key))
            return
        fields: dict[str, Any] = {
            "share": "" if event.share is None else f"{100 * event.share:.0f} %",
            "count": amount(event),
            "rate": "" if pace.rate is None else rate(pace.rate),
            "left": "" if pace.left_s is None else f"{duration(pace.left_s)} left",
        }
        if key not in self._tasks:
            name = f"{event.stage} {event.session or '(all)'}"
            self._tasks[key] = self._bar.add_task(name, total=None, **fields)
        self._bar.update(self._tasks[key], completed=event.done, total=event.total, **fields)

    def print(self, text: str) -> None:
        """A line above the bars."""
        self._bar.console.print(text, markup=False, highlight=False, soft_wrap=True)


def amount(event: Progress) -> str:
    """Such as ``120 of 300 keyframes``."""
    of = "" if event.total is None else f" of {event.total}"
    return f"{event.done}{of} {event.unit}"


def rate(units_a_second: float, unit: str = "") -> str:
    """Such as ``12/s``, ``2.1 queries/s``, or ``0.5/min`` where little is done a second."""
    name = f" {unit}" if unit else ""
    if units_a_second < 0.1:
        return f"{60 * units_a_second:.2g}{name}/min"
    return f"{units_a_second:.3g}{name}/s"


def duration(seconds: float) -> str:
    """Such as ``44 s``, ``12 min`` or ``3.5 h``."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    if seconds < 100 * 60:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.{0 if seconds > 100 * 3600 else 1}f} h"


def sentence(event: Progress, pace: Pace | None = None) -> str:
    """Such as ``fuse monday: 120 of 300 keyframes (40 %), 12 keyframes/s, 15 s left``."""
    text = f"{event.stage} {event.session}".strip() + f": {amount(event)}"
    if event.finished or pace is None or pace.rate is None:
        return text
    share = "" if event.share is None else f" ({100 * event.share:.0f} %)"
    left = "" if pace.left_s is None else f", {duration(pace.left_s)} left"
    return f"{text}{share}, {rate(pace.rate, event.unit.split()[0])}{left}"


def _finite(content: Any) -> Any:
    if isinstance(content, float):
        return content if content - content == 0 else None
    if isinstance(content, dict):
        return {k: _finite(v) for k, v in content.items()}
    return [_finite(v) for v in content] if isinstance(content, list | tuple) else content


console = Console()
