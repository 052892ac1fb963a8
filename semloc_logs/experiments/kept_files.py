"""Files that systems keep, such as networks and words, and the CPU time of making each.

A file is made once, for all databases and for all systems that share it. Its time is therefore told
apart from the time of the database that needed it first, and stays known as long as the file.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path

from semloc_logs.tables.atomic_files import replacing_file


def cpu_seconds() -> float:
    """CPU time of this process and of the children that have ended."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


@dataclass(eq=False)
class Spent:
    """CPU time of a part of a run: ``cpu_s`` without the kept files; ``kept_s``, by folder and
    name, the seconds that each kept file took which was used, in this run or in an earlier one.
    """

    cpu_s: float = 0.0
    kept_s: dict[str, float] = field(default_factory=dict)
    apart_s: float = 0.0  # that are not in cpu_s


_current: ContextVar[Spent | None] = ContextVar("spent", default=None)


@contextmanager
def measured() -> Iterator[Spent]:
    """The CPU time of a block, filled in at its end."""
    spent = Spent()
    outer = _current.set(spent)
    started = cpu_seconds()
    try:
        yield spent
    finally:
        spent.cpu_s = cpu_seconds() - started - spent.apart_s
        _current.reset(outer)


@contextmanager
def not_counted() -> Iterator[None]:
    """A block that does not count to a system: the simulation of what it learns from."""
    with measured() as inner:
        yield
    _add_apart(inner.cpu_s + inner.apart_s)


def kept_file(path: Path, make: Callable[[Path], None]) -> Path:
    """``path``; where it is missing, ``make`` writes it under a temporary name. Beside it lies the
    CPU time that it took; 0 s are counted where that cannot be read.
    """
    seconds = path.with_name(f"{path.name}.cpu_s")
    if not path.exists():
        with replacing_file(path) as temporary:
            with measured() as inner:
                make(temporary)
            with replacing_file(seconds) as written:
                written.write_text(f"{inner.cpu_s:.3f}\n", encoding="utf-8")
        _add_apart(inner.cpu_s + inner.apart_s)
        _add_kept(inner.kept_s)
    name = f"{path.parent.name}/{path.name}"
    _add_kept({name: _read_seconds(seconds)})
    return path


def _read_seconds(path: Path) -> float:
    """The CPU time in a file, s; 0 where it is unknown."""
    try:
        cpu_s = float(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return 0.0
    return cpu_s if math.isfinite(cpu_s) else 0.0


def _add_apart(cpu_s: float) -> None:
    current = _current.get()
    if current is not None:
        current.apart_s += cpu_s


def _add_kept(kept_s: dict[str, float]) -> None:
    current = _current.get()
    if current is not None:
        current.kept_s |= kept_s
