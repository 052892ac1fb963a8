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
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from rich.progress import TaskID

    from semloc_logs.progress import Progress

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
        self._shown: dict[tuple[str, str, str], float] = {}
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
        from rich.console import Console as Screen
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
        Screen(file=sys.stdout, width=None if sys.stdout.isatty() else 160, highlight=False).print(
            drawn
        )

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
        if self.verbosity < 0:
            return
        if self._bars is not None:
            self._bars.show(event)
            return
        now = time.monotonic()
        key = event.stage, event.session, event.unit
        is_due = now - self._shown.get(key, self._begun) >= PLAIN_SECONDS
        if is_due or event.finished or self.verbosity > 0:
            self._shown[key] = now
            self._say("info", sentence(event), **asdict(event))

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


class Bars:
    """A bar for each stage of each session that is being worked on."""

    def __init__(self) -> None:
        from rich.console import Console as Screen
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            SpinnerColumn,
            TextColumn,
            TimeRemainingColumn,
        )
        from rich.progress import Progress as RichProgress

        self._tasks: dict[tuple[str, str, str], TaskID] = {}
        self._bar = RichProgress(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=20),
            MofNCompleteColumn(),
            TextColumn("{task.fields[unit]}", markup=False),
            TimeRemainingColumn(),
            console=Screen(stderr=True),
            transient=True,
        )

    def __enter__(self) -> Bars:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def show(self, event: Progress) -> None:
        """Move the bar of the event's work; a finished one disappears."""
        key = event.stage, event.session, event.unit
        if event.finished:
            if key in self._tasks:
                self._bar.remove_task(self._tasks.pop(key))
            return
        if key not in self._tasks:
            description = f"{event.stage} {event.session}".strip()
            self._tasks[key] = self._bar.add_task(description, total=None, unit=event.unit)
        task = self._tasks[key]
        self._bar.update(task, completed=event.done, total=event.total, unit=event.unit)

    def print(self, text: str) -> None:
        """A line above the bars."""
        self._bar.console.print(text, markup=False, highlight=False, soft_wrap=True)


def sentence(event: Progress) -> str:
    """Such as ``fuse monday: 120 of 300 keyframes``."""
    of = "" if event.total is None else f" of {event.total}"
    name = f"{event.stage} {event.session}".strip()
    return f"{name}: {event.done}{of} {event.unit}"


def _finite(content: Any) -> Any:
    if isinstance(content, float):
        return content if content - content == 0 else None
    if isinstance(content, dict):
        return {k: _finite(v) for k, v in content.items()}
    return [_finite(v) for v in content] if isinstance(content, list | tuple) else content


console = Console()
