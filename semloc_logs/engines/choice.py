"""Engines by name."""

from __future__ import annotations

from semloc_logs.engines.engine import Engine, Serial
from semloc_logs.errors import SettingsError

ENGINES = ("serial", "processes", "dask")


def make_engine(
    name: str,
    jobs: int | None = None,
    *,
    scheduler: str | None = None,
    max_memory: int | None = None,
) -> Engine:
    """The engine called ``name`` with ``jobs`` workers (default: the cores this process may use).

    ``scheduler`` is the address of a Dask scheduler, whose workers are used; ``max_memory`` (bytes)
    bounds the workers of this machine together. Raises SettingsError for an unknown name, an engine
    that is not installed, or a scheduler without Dask.
    """
    if scheduler is not None and name != "dask":
        raise SettingsError(f"The engine '{name}' has no scheduler: take the engine 'dask'.")
    if name not in ENGINES:
        raise SettingsError(f"Unknown engine '{name}': there are {', '.join(ENGINES)}.")
    if name == "serial":
        return Serial(max_memory)

    from semloc_logs.engines.processes import Processes, cores
    from semloc_logs.engines.worker_memory import workers_within

    workers = workers_within(max_memory, jobs, cores)
    limit = None if max_memory is None else max_memory // workers
    if name == "processes":
        return Processes(workers, limit)
    from semloc_logs.engines.dask_cluster import Dask

    return Dask(workers, scheduler, limit)
