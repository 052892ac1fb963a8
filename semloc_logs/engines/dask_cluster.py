"""The engine of Dask workers: a scheduler has them, or a cluster on this machine.

Tasks and results are small, tables go to the workspace: workers have to see it under the same path,
and need the same version of this package.
"""

from __future__ import annotations

import contextlib
import logging
import os
import tempfile
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from dataclasses import astuple, dataclass
from importlib import import_module
from logging import LogRecord
from pathlib import Path
from typing import Any, Generic

import semloc_logs
from semloc_logs import progress
from semloc_logs.engines.engine import Result, Task
from semloc_logs.engines.worker_memory import return_freed_memory
from semloc_logs.errors import SemlocError, SettingsError, TemporaryError
from semloc_logs.progress import Progress

LOGGER = logging.getLogger(__name__)
PACKAGE_LOGGER = "semloc_logs"
CONNECT_SECONDS = 20  # to reach the scheduler
WORKER_SECONDS = 120  # until the first worker is there
LEAVE_SECONDS = 2  # that a local cluster has to end
EVENT_SECONDS = 0.5  # between two events of the same work: they go through the scheduler
# a worker that dies again and again does not end the night: the scheduler gives a task up after
# some deaths (by default 4), and then it is given to it again so many times
RESUBMISSIONS = 8
LOCAL_FAILURES = 3  # the scheduler's own number, of a local cluster


class Dask:
    """Workers of a Dask scheduler, or ``jobs`` local ones; each has one thread.

    ``worker_memory`` (bytes) is the limit of a local worker.
    """

    def __init__(
        self, jobs: int, scheduler: str | None = None, worker_memory: int | None = None
    ) -> None:
        _distributed()
        self.jobs = jobs
        self._scheduler = scheduler
        self._worker_memory = worker_memory
        # a worker of a cluster of our own dies of the limit that it was given
        self._resubmissions = RESUBMISSIONS if worker_memory is None else 0
        self._cluster: Any = None
        self._scratch: tempfile.TemporaryDirectory[str] | None = None
        self._client: Any = None
        self._topic = ""

    def map(self, function: Callable[[Task], Result], tasks: Iterable[Task]) -> Iterator[Result]:
        client = self._started()
        waiting: deque[_Running[Task, Result]] = deque()
        try:
            for task in tasks:
                call = self._call(function)
                waiting.append(_Running(client, call, task, self._resubmissions))
                if len(waiting) >= 2 * self._workers():
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for running in waiting:
                running.cancel()

    def close(self) -> None:
        """Leave the scheduler, or end the local workers."""
        self._end(gently=True)

    def stop(self) -> None:
        """Cancel what waits and leave; local workers are killed, since a thread cannot be ended.

        The temporary files of killed workers are removed by whoever writes the same files next.
        """
        self._end(gently=False)

    def _started(self) -> Any:
        if self._client is not None:
            return self._client
        distributed = _distributed()
        for name in ("distributed", "tornado", "bokeh"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
        if self._scheduler is None:
            config = import_module("dask").config
            self._scratch = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
            with config.set({"distributed.scheduler.allowed-failures": LOCAL_FAILURES}):
                self._cluster = distributed.LocalCluster(
                    n_workers=self.jobs,
                    threads_per_worker=1,
                    processes=True,
                    host="127.0.0.1",
                    dashboard_address="127.0.0.1:0",
                    memory_limit=self._worker_memory or 0,
                    silence_logs=logging.CRITICAL,
                    local_directory=self._scratch.name,
                )
        address = self._cluster or self._scheduler
        try:
            self._client = distributed.Client(
                address, timeout=CONNECT_SECONDS, set_as_default=False
            )
        except (OSError, ValueError):
            raise TemporaryError(
                f"No Dask scheduler answers at {self._scheduler}: start one with 'dask scheduler',"
                " or leave --scheduler out for workers on this machine."
            ) from None
        try:
            self._client.wait_for_workers(1, timeout=WORKER_SECONDS)
        except TimeoutError:
            raise TemporaryError(
                f"The Dask scheduler at {self._scheduler or 'this machine'} has no workers: start"
                " some with 'dask worker ADDRESS --nthreads 1'."
            ) from None
        self._topic = f"semloc-{uuid.uuid4().hex}"
        self._client.subscribe_topic(self._topic, _hand_on)
        return self._client

    def _workers(self) -> int:
        """Workers of now: they may come and go."""
        if self._client is not None and self._scheduler is not None:
            self.jobs = max(1, len(self._client.nthreads()))
        return self.jobs

    def _call(self, function: Callable[[Task], Result]) -> _Call[Task, Result]:
        level = logging.getLogger(PACKAGE_LOGGER).getEffectiveLevel()
        return _Call(function, semloc_logs.__version__, str(Path.cwd()), self._topic, level)

    def _end(self, *, gently: bool) -> None:
        client, self._client = self._client, None
        cluster, self._cluster = self._cluster, None
        # what goes wrong at the end is about connections that are gone already
        with contextlib.suppress(Exception):
            if client is not None:
                client.close(timeout=LEAVE_SECONDS)
        with contextlib.suppress(Exception):
            if cluster is not None:
                if not gently:
                    _kill(cluster)
                cluster.close(timeout=LEAVE_SECONDS)
        if self._scratch is not None:
            self._scratch.cleanup()
            self._scratch = None


def _distributed() -> Any:
    """The module; SettingsError where Dask is not installed."""
    try:
        return import_module("distributed")
    except ImportError:
        raise SettingsError(
            "The engine 'dask' needs the extra 'dask': pip install 'semloc_logs[dask]'."
        ) from None


def _kill(cluster: Any) -> None:
    for nanny in list(cluster.workers.values()):
        nanny.auto_restart = False
        if nanny.pid is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(nanny.pid, 9)


class _Running(Generic[Task, Result]):
    """A task at the scheduler. Its result comes here as soon as it is there, so that it is not lost
    with the worker while earlier tasks go on.
    """

    def __init__(
        self, client: Any, call: _Call[Task, Result], task: Task, resubmissions: int
    ) -> None:
        self._client = client
        self._resubmissions = resubmissions
        self._call = call
        self._task = task
        self._submissions = 0
        self._submit()

    def _submit(self) -> None:
        self._submissions += 1
        self._outcome: Future[Result] = Future()
        key = f"semloc-{uuid.uuid4().hex}"
        self._future = self._client.submit(self._call, self._task, key=key, pure=False)
        self._future.add_done_callback(self._take)

    def _take(self, future: Any) -> None:
        try:
            self._outcome.set_result(future.result())
        except BaseException as problem:  # whatever it is, it belongs to the one who waits
            self._outcome.set_exception(problem)

    def result(self) -> Result:
        """Wait for it. Raises what the task raises; TemporaryError where workers or the scheduler
        are gone for good.
        """
        distributed = _distributed()
        while True:
            try:
                return self._outcome.result()
            except distributed.KilledWorker as death:
                if self._submissions > self._resubmissions:
                    deaths = self._submissions * (death.allowed_failures + 1)
                    raise TemporaryError(
                        f"{deaths} Dask workers died over one task, most likely for lack of memory:"
                        " run again with fewer or larger workers; finished work is kept."
                    ) from None
                LOGGER.warning("Dask workers died over one task; it is submitted again.")
                self._submit()
            except distributed.client.FutureCancelledError:
                raise TemporaryError(
                    "The connection to the Dask scheduler is lost: run again; finished work is"
                    " kept."
                ) from None

    def cancel(self) -> None:
        with contextlib.suppress(Exception):  # the connection may be gone
            self._future.cancel()


@dataclass(frozen=True, slots=True)
class _Call(Generic[Task, Result]):
    """``function`` as a worker calls it; picklable.

    Relative paths are meant from ``folder``. Events and log records go to ``topic``.
    """

    function: Callable[[Task], Result]
    version: str
    folder: str
    topic: str
    level: int

    def __call__(self, task: Task) -> Result:
        worker = _distributed().get_worker()
        if self.version != semloc_logs.__version__:
            raise SemlocError(
                f"Dask worker {worker.address} has semloc {semloc_logs.__version__}, not"
                f" {self.version}: install the same version everywhere."
            )
        if worker.state.nthreads != 1:
            raise SettingsError(
                f"Dask worker {worker.address} has {worker.state.nthreads} threads: start workers"
                " with --nthreads 1, and as many as there are cores."
            )
        if Path(self.folder).is_dir():
            os.chdir(self.folder)
        return_freed_memory()
        sender = _Sender(worker, self.topic)
        logger = logging.getLogger(PACKAGE_LOGGER)
        before = logger.level
        logger.setLevel(self.level)
        logger.addHandler(sender)
        try:
            with progress.listening(sender.send_progress):
                return self.function(task)
        finally:
            logger.removeHandler(sender)
            logger.setLevel(before)


class _Sender(logging.Handler):
    """Sends the events and log records of a task, by way of the scheduler."""

    def __init__(self, worker: Any, topic: str) -> None:
        super().__init__()
        self._worker = worker
        self._topic = topic
        self._sent: dict[tuple[str, str, str], float] = {}

    def emit(self, record: LogRecord) -> None:
        self._send(["log", record.name, record.levelno, record.getMessage()])

    def send_progress(self, event: Progress) -> None:
        now = time.monotonic()
        key = event.stage, event.session, event.unit
        if event.finished or now - self._sent.get(key, -EVENT_SECONDS) >= EVENT_SECONDS:
            self._sent[key] = now
            self._send(["progress", *astuple(event)])

    def _send(self, message: list[Any]) -> None:
        with contextlib.suppress(Exception):  # the task matters more than the word about it
            self._worker.log_event(self._topic, message)


def _hand_on(event: tuple[float, Any]) -> None:
    """In the process that started the engine."""
    kind, *content = event[1]
    if kind == "progress":
        progress.emit(Progress(*content))
        return
    name, level, message = content
    logger = logging.getLogger(name)
    if logger.isEnabledFor(level):
        logger.handle(logger.makeRecord(name, level, "", 0, message, (), None))
