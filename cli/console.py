"""Where words go: results to stdout, everything else to stderr, as text for people or as a line of
JSON each.
"""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

_COUNTED = re.compile(r"(\d+) of (\d+)|\bread \d+")
_PLAIN_SECONDS = 5.0  # between progress lines where nobody watches a bar


class Console:
    """One for the program; ``verbosity`` is -1 with -q, above 0 with -v."""

    def __init__(self) -> None:
        self.verbosity = 0
        self.log_format = "text"
        self._bar: Progress | None = None
        self._task: TaskID | None = None
        self._spoke = 0.0

    def reset(self) -> None:
        """As at the start of the program."""
        self.__init__()  # type: ignore[misc]

    # -- stdout

    def result(self, text: str) -> None:
        """A line of the answer."""
        click.echo(text)

    def result_json(self, content: object) -> None:
        """The answer as JSON; figures that are no numbers become null."""
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
        """What is going on; a message with 'N of M' or 'read N' in it is progress and may be left
        out.
        """
        if self.verbosity < 0:
            return
        counted = _COUNTED.search(message)
        if counted and self._bar is not None and self._task is not None:
            total = int(counted[2]) if counted[2] else None
            self._bar.update(
                self._task, description=message, completed=int(counted[1] or 0), total=total
            )
            return
        if (
            counted
            and self.verbosity == 0
            and (counted[1] is None or counted[1] != counted[2])
            and time.monotonic() - self._spoke < _PLAIN_SECONDS
        ):
            return
        if counted:
            self._spoke = time.monotonic()
        self._say("info", message)

    def warn(self, message: str) -> None:
        """About input that was skipped."""
        self._say("warning", message)

    def error(self, message: str) -> None:
        """Why the command failed."""
        self._say("error", message)

    def _say(self, level: str, message: str) -> None:
        if self.log_format == "json":
            click.echo(
                json.dumps(
                    {
                        "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
                        "level": level,
                        "message": message,
                    }
                ),
                err=True,
            )
            return
        text = message if level == "info" else f"{level.capitalize()}: {message}"
        if self._bar is not None:
            self._bar.console.print(text, markup=False, highlight=False, soft_wrap=True)
        else:
            click.echo(text, err=True)

    @contextmanager
    def progress(self) -> Iterator[None]:
        """A bar on a terminal, plain lines elsewhere, for the length of the block."""
        if self.verbosity < 0 or self.log_format == "json" or not sys.stderr.isatty():
            yield
            return
        from rich.console import Console as Screen
        from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

        with Progress(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TimeElapsedColumn(),
            console=Screen(stderr=True),
            transient=True,
        ) as bar:
            self._bar, self._task = bar, bar.add_task("", total=None)
            try:
                yield
            finally:
                self._bar = self._task = None


def _finite(content: Any) -> Any:
    if isinstance(content, float):
        return content if content - content == 0 else None
    if isinstance(content, dict):
        return {k: _finite(v) for k, v in content.items()}
    return [_finite(v) for v in content] if isinstance(content, list | tuple) else content


console = Console()
