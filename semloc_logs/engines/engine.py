"""Engines run picklable tasks with a plain function and give the results in the order of the tasks."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import NoReturn, Protocol, TypeVar

from semloc_logs.errors import SemlocError, SettingsError

Task = TypeVar("Task")
Result = TypeVar("Result")


class Engine(Protocol):
    """Runs independent tasks; results come in the order of the tasks, errors as they are raised."""

    jobs: int

    def map(
        self, function: Callable[[Task], Result], tasks: Iterable[Task]
    ) -> Iterator[Result]: ...

    def close(self) -> None:
        """Release the workers once their tasks are done."""

    def stop(self) -> None:
        """End the workers now; what they were writing is cleaned up."""


class Serial:
    """Everything in this process, one task after the other."""

    jobs = 1

    def map(self, function: Callable[[Task], Result], tasks: Iterable[Task]) -> Iterator[Result]:
        return map(function, tasks)

    def close(self) -> None:
        """Nothing to release."""

    def stop(self) -> None:
        """Nothing to end."""


class Processes:
    """``jobs`` worker processes (spawned, so that threads of the parent cannot hurt them), one
    thread each.
    """

    def __init__(self, jobs: int) -> None:
        self.jobs = jobs
        self._pool: ProcessPoolExecutor | None = None

    def map(self, function: Callable[[Task], Result], tasks: Iterable[Task]) -> Iterator[Result]:
        if self._pool is None:
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(self.jobs, context, initializer=_prepare_worker)
        waiting: deque[Future[Result]] = deque()
        try:
            for task in tasks:  # a bounded number of tasks in flight: their results may be large
                waiting.append(self._pool.submit(_run, function, task))
                if len(waiting) >= 2 * self.jobs:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        except BrokenProcessPool:
            self._pool = None
            raise SemlocError(
                "A worker process ended abruptly, most likely for lack of memory: run again with fewer --jobs; finished work is kept."
            ) from None

    def close(self) -> None:
        """Stop the workers."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def stop(self) -> None:
        """End the workers now: they unwind, so that temporary files go, and leave."""
        if self._pool is not None:
            # public as terminate_workers() from 3.14 on
            for worker in list((getattr(self._pool, "_processes", None) or {}).values()):
                worker.terminate()
            self._pool.shutdown(cancel_futures=True)
            self._pool = None


ENGINES = ("serial", "processes")


def make_engine(name: str, jobs: int | None = None) -> Engine:
    """The engine called ``name`` with ``jobs`` workers (default: the cores that this process may
    use).
    """
    if name == "serial":
        return Serial()
    if name == "processes":
        return Processes(jobs or cores())
    raise SettingsError(f"Unknown engine '{name}': there are {', '.join(ENGINES)}.")


def cores() -> int:
    """Cores that this process may use, as SLURM or the affinity mask say."""
    slurm = os.environ.get("SLURM_CPUS_PER_TASK", "")
    return int(slurm) if slurm.isdigit() and int(slurm) else len(os.sched_getaffinity(0))


def single_threaded() -> None:
    """One thread for each numerical library, unless the environment says otherwise; to be called
    before any of them is loaded.

    Cores are used by processes: many small matrix products lose time by waking threads, and sums
    keep their order.
    """
    for variable in (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "NUMBA_NUM_THREADS",
    ):
        os.environ.setdefault(variable, "1")


def _prepare_worker() -> None:
    """A worker leaves when told to (SIGTERM) or when its parent is gone, and leaves Ctrl-C to the
    parent.
    """
    single_threaded()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _leave)
    threading.Thread(target=_leave_with_parent, daemon=True).start()


def _leave(number: int, _: object) -> NoReturn:
    signal.signal(number, signal.SIG_IGN)  # once is enough; the unwinding must not be interrupted
    raise SystemExit(128 + number)


def _leave_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)


def _run(function: Callable[[Task], Result], task: Task) -> Result:
    """In a worker: the pool would hand SystemExit to the parent as a result and live on."""
    try:
        return function(task)
    except SystemExit as leaving:
        os._exit(leaving.code if isinstance(leaving.code, int) else 1)
