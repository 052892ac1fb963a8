"""The engine of worker processes, and how many of them this machine can run."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from logging import LogRecord
from logging.handlers import QueueHandler
from multiprocessing.context import SpawnContext
from multiprocessing.queues import SimpleQueue
from typing import NoReturn

from semloc_logs import progress
from semloc_logs.engines.engine import Result, Task
from semloc_logs.engines.worker_memory import memory_limit, return_freed_memory
from semloc_logs.errors import TemporaryError
from semloc_logs.progress import Progress

PACKAGE_LOGGER = "semloc_logs"
LEAVE_SECONDS = 2.5  # that workers have to leave: a cluster kills soon after it terminates
EVENT_SECONDS = 0.05  # between two looks for events of the workers
EVENTS_END_SECONDS = 0.5  # for the last events

Event = Progress | LogRecord


def cores() -> int:
    """Cores that this process may use: by SLURM, the affinity mask and the limits of its cgroup."""
    from loky import cpu_count  # a quarter of a second, which --help need not wait for

    slurm = os.environ.get("SLURM_CPUS_PER_TASK", "")
    available = int(cpu_count())
    return min(int(slurm), available) if slurm.isdigit() and int(slurm) else available


def single_threaded() -> None:
    """One thread for each numerical library, unless the environment names another number.

    To be called before any of them is loaded. Cores are used by processes: many small matrix
    products lose time by waking threads, and sums keep their order.
    """
    libraries = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
    for variable in libraries:
        os.environ.setdefault(variable, "1")


class Processes:
    """``jobs`` worker processes, one thread each; a task ends that needs more than
    ``worker_memory`` bytes.

    They are spawned, so that threads of the parent cannot hurt them.
    """

    def __init__(self, jobs: int, worker_memory: int | None = None) -> None:
        self.jobs = jobs
        self._worker_memory = worker_memory
        self._context: SpawnContext = multiprocessing.get_context("spawn")
        self._pool: ProcessPoolExecutor | None = None
        self._events: _Events | None = None

    def map(self, function: Callable[[Task], Result], tasks: Iterable[Task]) -> Iterator[Result]:
        pool = self._started()
        waiting: deque[Future[Result]] = deque()
        try:
            # a bounded number of tasks in flight: their results may be large
            for task in tasks:
                waiting.append(pool.submit(_run, function, task, self._worker_memory))
                if len(waiting) >= 2 * self.jobs:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        except BrokenProcessPool:
            self._end_events()
            self._pool = None
            raise TemporaryError(
                "A worker process ended abruptly: for lack of memory, in which case fewer --jobs"
                " help, or in a script whose calls are not under 'if __name__ == \"__main__\":'."
                " Finished work is kept."
            ) from None

    def close(self) -> None:
        """Stop the workers."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
            self._end_events()

    def stop(self) -> None:
        """End the workers now: they unwind, so that temporary files go, and leave.

        One that is in a long call of a library is killed after a while.
        """
        if self._pool is None:
            return
        # a public method, terminate_workers, from Python 3.14 on
        workers = list((getattr(self._pool, "_processes", None) or {}).values())
        for worker in workers:
            worker.terminate()
        deadline = time.monotonic() + LEAVE_SECONDS
        for worker in workers:
            worker.join(max(0.0, deadline - time.monotonic()))
            if worker.is_alive():
                worker.kill()
        self._pool.shutdown(cancel_futures=True)
        self._pool = None
        self._end_events()

    def _started(self) -> ProcessPoolExecutor:
        if self._pool is None:
            self._events = _Events(self._context)
            level = logging.getLogger(PACKAGE_LOGGER).getEffectiveLevel()
            self._pool = ProcessPoolExecutor(
                self.jobs,
                self._context,
                initializer=_prepare_worker,
                initargs=(self._events.queue, level),
            )
        return self._pool

    def _end_events(self) -> None:
        if self._events is not None:
            self._events.end()
            self._events = None


class _Events:
    """Events of the workers, handed on by a thread of this process.

    Nothing is ever put into the queue here: a worker that was killed may have its lock.
    """

    def __init__(self, context: SpawnContext) -> None:
        self.queue: SimpleQueue[Event] = context.SimpleQueue()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._hand_on, daemon=True)
        self._thread.start()

    def _hand_on(self) -> None:
        while True:
            is_over = self._over.is_set()  # before the look: what came until then is handed on
            if self.queue.empty():
                if is_over:
                    return
                time.sleep(EVENT_SECONDS)
                continue
            event = self.queue.get()
            if isinstance(event, Progress):
                progress.emit(event)
            else:
                logging.getLogger(event.name).handle(event)

    def end(self) -> None:
        """Hand on what has come, then stop; half of an event that a killed worker left is lost."""
        self._over.set()
        self._thread.join(timeout=EVENTS_END_SECONDS)


class _QueueHandler(QueueHandler):
    """Puts log records, formatted, into the queue of the parent."""

    def __init__(self, queue: SimpleQueue[Event]) -> None:
        super().__init__(queue)  # type: ignore[arg-type]
        self._events = queue

    def enqueue(self, record: LogRecord) -> None:
        self._events.put(record)


def _prepare_worker(queue: SimpleQueue[Event], level: int) -> None:
    """A worker leaves when told to (SIGTERM) or when its parent is gone, and leaves Ctrl-C to the
    parent; its events go to the parent.
    """
    single_threaded()
    return_freed_memory()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _leave)
    threading.Thread(target=_leave_with_parent, daemon=True).start()

    progress.listen(queue.put)
    logger = logging.getLogger(PACKAGE_LOGGER)
    logger.setLevel(level)
    logger.addHandler(_QueueHandler(queue))
    logger.propagate = False


def _leave(number: int, _: object) -> NoReturn:
    signal.signal(number, signal.SIG_IGN)  # once is enough; the unwinding must not be interrupted
    raise SystemExit(128 + number)


def _leave_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)


def _run(function: Callable[[Task], Result], task: Task, max_memory: int | None) -> Result:
    """In a worker: the pool would hand SystemExit to the parent as a result and live on."""
    try:
        with memory_limit(max_memory):
            return function(task)
    except SystemExit as leaving:
        os._exit(leaving.code if isinstance(leaving.code, int) else 1)
