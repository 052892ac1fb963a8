"""A real Dask scheduler with worker processes that are killed: the tables stay the same."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from semloc_logs.engines import make_engine
from semloc_logs.errors import SettingsError, TemporaryError
from semloc_logs.progress import Progress, listening
from semloc_logs.workspace import Workspace

pytest.importorskip("distributed", reason="the extra 'dask' is not installed")
MOST_KILLS = 6
KILL_SECONDS = 3.0  # from the first task on, one worker each


class Cluster:
    """A scheduler and its workers, each a process without a nanny."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._file = folder / "scheduler.json"
        self.processes: list[subprocess.Popen[bytes]] = []
        self._start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
        deadline = time.monotonic() + 60
        while not self._file.exists() and time.monotonic() < deadline:
            time.sleep(0.1)

    @property
    def address(self) -> str:
        return str(json.loads(self._file.read_text())["address"])

    def _start(self, *words: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "dask", *words, "--scheduler-file", str(self._file)]
        quiet = subprocess.DEVNULL
        process = subprocess.Popen(command, cwd=self._folder, stdout=quiet, stderr=quiet)
        self.processes.append(process)
        return process

    def worker(self, threads: int = 1) -> subprocess.Popen[bytes]:
        return self._start(
            "worker", "--nthreads", str(threads), "--no-nanny", "--no-dashboard",
            "--host", "127.0.0.1",
        )  # fmt: skip

    def stop(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    folder = tmp_path / "dask"
    folder.mkdir()
    started = Cluster(folder)
    yield started
    started.stop()


@contextmanager
def killing(cluster: Cluster, begun: threading.Event) -> Iterator[list[int]]:
    """One of two workers is killed every few seconds, and another one is started."""
    workers = [cluster.worker(), cluster.worker()]
    killed: list[int] = []
    over = threading.Event()

    def work() -> None:
        begun.wait()
        while len(killed) < MOST_KILLS and not over.wait(KILL_SECONDS):
            victim = workers.pop(0)
            victim.send_signal(signal.SIGKILL)
            victim.wait()
            killed.append(victim.pid)
            workers.append(cluster.worker())

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    try:
        yield killed
    finally:
        over.set()
        begun.set()
        thread.join()


@pytest.mark.timeout(600)  # workers import much, again and again
def test_workers_that_die_change_no_byte(
    cluster: Cluster, tools: SimpleNamespace, drives: Any, coarse: Workspace, tmp_path: Path
) -> None:
    two = {name: drives[name] for name in ("monday", "tuesday")}
    begun = threading.Event()
    events: list[Progress] = []

    def listen(event: Progress) -> None:
        events.append(event)
        begun.set()

    engine = make_engine("dask", scheduler=cluster.address)
    with killing(cluster, begun) as killed, listening(listen):
        work = tools.whole(tmp_path / "again", two, tools.coarse_settings(), engine)
    engine.close()
    assert killed
    # a worker that was killed leaves its scratch folder, which the next command removes
    made = {name: d for name, d in tools.files(work.path).items() if "/." not in name}
    assert made == tools.files(coarse.path)
    assert {event.stage for event in events} == {"fuse", "describe", "close"}


@pytest.mark.timeout(240)
def test_workers_need_one_thread(cluster: Cluster) -> None:
    cluster.worker(threads=2)
    engine = make_engine("dask", scheduler=cluster.address)
    try:
        with pytest.raises(SettingsError, match=r"has 2 threads: .* --nthreads 1"):
            list(engine.map(abs, [1]))
    finally:
        engine.stop()


@pytest.mark.timeout(240)
def test_a_scheduler_that_is_gone_is_one_sentence(
    cluster: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    from semloc_logs.engines import dask_cluster

    address = cluster.address
    cluster.stop()
    monkeypatch.setattr(dask_cluster, "CONNECT_SECONDS", 1)
    with pytest.raises(TemporaryError, match=f"No Dask scheduler answers at {address}"):
        list(make_engine("dask", scheduler=address).map(abs, [1]))


def test_without_the_extra_the_engine_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(SettingsError, match=r"pip install 'semloc_logs\[dask\]'"):
        make_engine("dask")


def test_only_dask_has_a_scheduler() -> None:
    with pytest.raises(SettingsError, match="'processes' has no scheduler"):
        make_engine("processes", scheduler="tcp://head:8786")
