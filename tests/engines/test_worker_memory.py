"""Workers within the memory, and the end of a task that needs more than its share."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from semloc_logs.engines import make_engine, worker_memory
from semloc_logs.engines.worker_memory import (
    machine_memory,
    memory_limit,
    private_memory,
    workers_within,
)
from semloc_logs.errors import TemporaryError

TASKS = """
import signal, time

def hungry(n):
    held = []
    for _ in range(n):
        held.append(bytearray(b"x" * 50_000_000))
        time.sleep(0.02)
    return sum(len(h) for h in held)

def hungry_and_deaf(n):
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR1})  # as in a long call of a library
    held = bytearray(b"x" * n)
    time.sleep(1000)
"""


@pytest.fixture
def tasks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    (tmp_path / "tasks_of_memory_tests.py").write_text(TASKS)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield importlib.import_module("tasks_of_memory_tests")
    del sys.modules["tasks_of_memory_tests"]


def test_workers_have_the_memory_they_need(monkeypatch: pytest.MonkeyPatch) -> None:
    need = worker_memory.WORKER_BYTES
    assert workers_within(4 * need, None, lambda: 16) == 4
    assert workers_within(4 * need, 3, lambda: 16) == 3
    assert workers_within(4 * need, 8, lambda: 16) == 4
    assert workers_within(need // 2, 8, lambda: 16) == 1
    monkeypatch.setattr(worker_memory, "machine_memory", lambda: 2 * need + 1)
    assert workers_within(None, None, lambda: 16) == 2
    assert workers_within(None, 8, lambda: 16) == 8  # as it was given


def test_the_memory_of_a_container_is_its_cgroups(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    limit = tmp_path / "memory.max"
    monkeypatch.setattr(worker_memory, "CGROUP_LIMITS", (limit,))
    whole = machine_memory()
    limit.write_text("max\n")
    assert machine_memory() == whole
    limit.write_text("1000000000\n")
    assert machine_memory() == 1_000_000_000


def test_a_task_within_its_share_ends_as_usual(tasks: ModuleType) -> None:
    with memory_limit(private_memory() + 500_000_000):
        assert tasks.hungry(2) == 100_000_000
    with memory_limit(None):
        assert tasks.hungry(1) == 50_000_000


@pytest.mark.parametrize("name", ["serial", "processes"])
def test_a_task_that_needs_more_than_its_share_ends_with_a_sentence(
    name: str, tasks: ModuleType
) -> None:
    engine = make_engine(name, 1, max_memory=private_memory() + 400_000_000)
    try:
        with pytest.raises(TemporaryError, match=r"more than \d\.\d GB: .*--max-memory"):
            list(engine.map(tasks.hungry, [200]))
        assert list(engine.map(tasks.hungry, [1])) == [50_000_000]
    finally:
        engine.close()


def test_a_worker_that_cannot_be_interrupted_is_ended(
    tasks: ModuleType, capfd: pytest.CaptureFixture[str]
) -> None:
    engine = make_engine("processes", 1, max_memory=600_000_000)
    try:
        begun = time.monotonic()
        with pytest.raises(TemporaryError, match="ended abruptly"):
            list(engine.map(tasks.hungry_and_deaf, [700_000_000]))
        assert time.monotonic() - begun < 100
    finally:
        engine.stop()
    assert "needed more than 0.6 GB" in capfd.readouterr().err


def test_only_the_main_thread_has_a_limit(tasks: ModuleType) -> None:
    nbytes: list[int] = []

    def work() -> None:
        with memory_limit(1):
            nbytes.append(tasks.hungry(2))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert nbytes == [100_000_000]


_FREED = """
import sys
import numpy as np
from semloc_logs.engines.worker_memory import private_memory, return_freed_memory
if sys.argv[1] == "returned":
    return_freed_memory()
del [np.ones(1 << 20) for _ in range(2)][:]  # what makes glibc take such blocks from the heap
before = private_memory()
blocks, pins = [], []
for _ in range(40):
    blocks.append(np.ones(1 << 20))  # 8 MB
    pins.append(np.ones(2000))  # 16 kB, above it on the heap
held = private_memory() - before
blocks.clear()
print(held >> 20, (private_memory() - before) >> 20)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc alone has the setting")
def test_freed_arrays_go_back_to_the_system() -> None:
    """40 arrays of 8 MB, each below a small one that stays."""
    left = {}
    for how in ("returned", "kept"):
        environment = {k: v for k, v in os.environ.items() if not k.startswith("MALLOC_")}
        command = [sys.executable, "-c", _FREED, how]
        run = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        held, left[how] = map(int, run.stdout.split())
        assert held >= 300
    assert left["returned"] < 20
    assert left["kept"] > 200
