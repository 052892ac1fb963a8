from __future__ import annotations

import contextlib
import importlib
import logging
import multiprocessing
import os
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from semloc_logs.engines import ENGINES, Engine, make_engine, processes
from semloc_logs.engines.processes import cores
from semloc_logs.errors import LogError, SemlocError, SettingsError
from semloc_logs.progress import Progress, listening

TASKS = """
import logging, os, signal, time
from semloc_logs import progress
from semloc_logs.errors import LogError

def slow_square(n):
    time.sleep(0.05 if n % 3 == 0 else 0)  # later tasks overtake
    return n * n, os.getpid()

def picky(n):
    if n == 3:
        raise LogError("drive.mcap: task 3 is damaged, remove it")
    return n

def dies(n):
    if n == 2:
        os._exit(9)
    return n

def talks(n):
    progress.report("fuse", "monday", n, 10, "keyframes")
    logging.getLogger("semloc_logs.tasks").info("task %d", n)
    logging.getLogger("semloc_logs.tasks").debug("not wanted")
    return n

def is_deaf(path):
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})  # as in a long call of a library
    open(path, "w").close()
    time.sleep(1000)

def threads(_):
    return {k: os.environ.get(k) for k in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
"""


@pytest.fixture
def tasks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """Functions in a module that spawned workers can import too."""
    (tmp_path / "tasks_of_engine_tests.py").write_text(TASKS)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield importlib.import_module("tasks_of_engine_tests")
    del sys.modules["tasks_of_engine_tests"]


@pytest.fixture(params=ENGINES)
def engine(request: pytest.FixtureRequest, tasks: ModuleType) -> Iterator[Engine]:
    """Closed before its tasks' module is forgotten: what waits is pickled by its name."""
    del tasks
    made = make_engine(request.param, 2)
    yield made
    made.close()


def test_results_come_in_the_order_of_the_tasks(engine: Engine, tasks: ModuleType) -> None:
    results = list(engine.map(tasks.slow_square, (n for n in range(13))))
    assert [value for value, _ in results] == [n * n for n in range(13)]
    elsewhere = {pid for _, pid in results} != {os.getpid()}
    assert elsewhere == (engine.jobs > 1)
    assert list(engine.map(tasks.slow_square, [])) == []
    # the engine can be used again
    assert [value for value, _ in engine.map(tasks.slow_square, [5])] == [25]


def test_an_exception_arrives_as_raised_after_what_came_before(
    engine: Engine, tasks: ModuleType
) -> None:
    results = engine.map(tasks.picky, range(8))
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(LogError, match=r"^drive\.mcap: task 3 is damaged, remove it$"):
        next(results)
    assert list(engine.map(tasks.picky, [1, 2])) == [1, 2]


def test_tasks_are_taken_as_they_are_needed(engine: Engine, tasks: ModuleType) -> None:
    """Results may be large: not all tasks are in flight at once."""
    taken = []

    def source() -> Iterator[int]:
        for n in range(100):
            taken.append(n)
            yield n

    results = engine.map(tasks.picky, source())
    assert next(results) == 0
    assert len(taken) <= 2 * engine.jobs + 1


def test_a_worker_that_dies_is_an_error_with_advice(tasks: ModuleType) -> None:
    engine = make_engine("processes", 2)
    try:
        with pytest.raises(SemlocError, match="--jobs"):
            list(engine.map(tasks.dies, range(5)))
        assert list(engine.map(tasks.dies, [0, 1])) == [0, 1]  # a new pool serves what comes next
    finally:
        engine.close()


def test_a_worker_that_does_not_leave_is_killed(
    tasks: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, "LEAVE_SECONDS", 0.2)
    engine = make_engine("processes", 1)
    begun = tmp_path / "begun"

    def wait() -> None:
        with contextlib.suppress(Exception):  # the pool is broken, as it should be
            list(engine.map(tasks.is_deaf, [begun]))

    threading.Thread(target=wait, daemon=True).start()
    while not begun.exists():
        time.sleep(0.02)
    workers = multiprocessing.active_children()
    assert workers
    engine.stop()
    assert not any(worker.is_alive() for worker in workers)


def test_a_worker_that_died_over_an_event_holds_nobody_up(tasks: ModuleType) -> None:
    """It has the lock of the queue of events for ever."""
    engine = processes.Processes(1)
    assert list(engine.map(tasks.picky, [1])) == [1]
    assert engine._events is not None
    engine._events.queue._wlock.acquire()  # type: ignore[attr-defined]
    thread = threading.Thread(target=engine.stop, daemon=True)
    thread.start()
    thread.join(timeout=60)
    assert not thread.is_alive()


def test_workers_share_the_cores(tasks: ModuleType) -> None:
    engine = make_engine("processes", cores() + 1)
    try:
        assert next(engine.map(tasks.threads, [0]))["OMP_NUM_THREADS"] == "1"
    finally:
        engine.close()


def test_unknown_engines_are_refused_by_name() -> None:
    with pytest.raises(SettingsError, match="'slurm'"):
        make_engine("slurm")


def test_cores_that_the_scheduler_grants(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("loky.cpu_count", lambda: 64)
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "7")
    assert cores() == 7
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "70")
    assert cores() == 64
    for odd in ("", "0", "many"):
        monkeypatch.setenv("SLURM_CPUS_PER_TASK", odd)
        assert cores() == 64


def test_cores_of_a_pod_are_those_of_its_cgroup(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The limit of a container, in microseconds of processor time a period."""
    limits = {"/sys/fs/cgroup/cpu.max": "200000 100000"}
    real_open = open

    def fake_open(path: Any, *args: Any, **options: Any) -> Any:
        if str(path) in limits:
            (tmp_path / "limit").write_text(limits[str(path)])
            return real_open(tmp_path / "limit", *args, **options)
        return real_open(path, *args, **options)

    monkeypatch.delenv("SLURM_CPUS_PER_TASK", raising=False)
    monkeypatch.setattr("os.cpu_count", lambda: 64)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(64)), raising=False)
    exists = os.path.exists
    monkeypatch.setattr("os.path.exists", lambda p: str(p) in limits or exists(p))
    monkeypatch.setattr("builtins.open", fake_open)
    assert cores() == 2


def test_what_workers_report_and_log_arrives(
    engine: Engine, tasks: ModuleType, caplog: pytest.LogCaptureFixture
) -> None:
    events: list[Progress] = []
    with caplog.at_level(logging.INFO, "semloc_logs"), listening(events.append):
        assert list(engine.map(tasks.talks, [3, 4])) == [3, 4]
        engine.close()  # events are handed on before
    assert sorted(events, key=lambda e: e.done) == [
        Progress("fuse", "monday", 3, 10, "keyframes"),
        Progress("fuse", "monday", 4, 10, "keyframes"),
    ]
    assert sorted(r.getMessage() for r in caplog.records) == ["task 3", "task 4"]
    assert {r.name for r in caplog.records} == {"semloc_logs.tasks"}
