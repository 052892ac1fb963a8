"""Engines by name."""

from __future__ import annotations

from semloc_logs.engines.base import Engine, Serial
from semloc_logs.errors import SettingsError

ENGINES = ("serial", "processes")


def make_engine(name: str, jobs: int | None = None) -> Engine:
    """The engine called ``name`` with ``jobs`` workers (default: the cores this process may use).

    Raises SettingsError for an unknown name.
    """
    if name == "serial":
        return Serial()
    if name == "processes":
        from semloc_logs.engines.processes import Processes, cores

        return Processes(jobs or cores())
    raise SettingsError(f"Unknown engine '{name}': there are {', '.join(ENGINES)}.")
