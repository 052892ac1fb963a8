"""How many workers the memory is enough for; a task that needs more than its share ends."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import FrameType

from semloc_logs.errors import TemporaryError

WORKER_BYTES = 2_000_000_000  # a worker of the search, with maps of a few kilometres: measured
LOOK_SECONDS = 0.2  # between two looks at the memory
LEAVE_SECONDS = 3.0  # that a task has to unwind: it may be in a long call of a library
# glibc keeps freed blocks of up to 32 MB; arrays of a search have 1 to 36 MB
LARGE_BLOCK = 4 << 20
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of mallopt(3)
CGROUP_LIMITS = (
    Path("/sys/fs/cgroup/memory.max"),
    Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"),
)


def workers_within(max_memory: int | None, jobs: int | None, cores: Callable[[], int]) -> int:
    """Workers for ``jobs`` or else the cores, as many as have the memory they need.

    It is ``max_memory`` (bytes), else the machine's; ``jobs`` without ``max_memory`` are as given.
    """
    if max_memory is None and jobs is not None:
        return jobs
    memory = machine_memory() if max_memory is None else max_memory
    return max(1, min(jobs or cores(), memory // WORKER_BYTES))


def machine_memory() -> int:
    """Bytes that this process may use, by the machine and by the limit of its cgroup."""
    available = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    for path in CGROUP_LIMITS:
        try:
            available = min(available, int(path.read_text()))
        except (OSError, ValueError):  # not there, or "max"
            continue
    return available


def private_memory() -> int:
    """Bytes of this process that belong to it alone; files that are mapped do not count."""
    try:
        _, resident, shared, *_ = map(int, Path("/proc/self/statm").read_text().split())
    except (OSError, ValueError):  # another system than Linux: the most so far
        import resource

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if os.uname().sysname == "Darwin" else peak * 1024
    return (resident - shared) * os.sysconf("SC_PAGE_SIZE")


@cache
def return_freed_memory() -> None:
    """Large arrays of this process go back to the system when they are freed, from now on.

    Without it a worker that had searched in ten kilometres held 0.3 GB more, for 3 % less time.
    Nothing is done with another library than glibc, or where the environment has the limits.
    """
    if sys.platform != "linux" or "MALLOC_MMAP_THRESHOLD_" in os.environ:
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(M_MMAP_THRESHOLD, LARGE_BLOCK)
        mallopt(M_TRIM_THRESHOLD, LARGE_BLOCK)


@contextmanager
def memory_limit(limit: int | None) -> Iterator[None]:
    """TemporaryError in the block once this process needs more than ``limit`` bytes.

    The process ends if the block does not soon. Only the main thread can be interrupted:
    elsewhere the block has no limit.
    """
    if limit is None or threading.current_thread() is not threading.main_thread():
        yield
        return

    over = threading.Event()  # the block is over
    sentence = (
        f"A worker needed more than {limit / 1e9:.1f} GB: give more with --max-memory, or take"
        " fewer --jobs; finished work is kept."
    )

    def interrupt(_: int, __: FrameType | None) -> None:
        if not over.is_set():
            raise TemporaryError(sentence)

    before = signal.signal(signal.SIGUSR1, interrupt)
    watch = threading.Thread(target=_watch, args=(limit, over, sentence), daemon=True)
    watch.start()
    try:
        yield
    finally:
        over.set()
        watch.join()
        signal.signal(signal.SIGUSR1, before)


def _watch(limit: int, over: threading.Event, sentence: str) -> None:
    main = threading.main_thread().ident
    while not over.wait(LOOK_SECONDS):
        if private_memory() <= limit or main is None:
            continue
        signal.pthread_kill(main, signal.SIGUSR1)
        deadline = time.monotonic() + LEAVE_SECONDS
        while not over.wait(LOOK_SECONDS):
            if private_memory() > limit and time.monotonic() > deadline:
                os.write(2, f"Error: {sentence}\n".encode())
                os._exit(1)
