"""Prefetching: an iterator that runs in a thread of its own, a few items before their use."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from queue import Empty, Full, Queue
from threading import Event, Thread
from typing import TypeVar

T = TypeVar("T")
_END = object()
_IN_CALLERS_THREAD = ContextVar("in_callers_thread", default=False)


@contextmanager
def in_callers_thread() -> Iterator[None]:
    """Within it :func:`ahead` makes each item when the caller takes it, for profilers: these see one
    thread.
    """
    token = _IN_CALLERS_THREAD.set(True)
    try:
        yield
    finally:
        _IN_CALLERS_THREAD.reset(token)


def ahead(items: Iterable[T], depth: int = 2) -> Generator[T, None, None]:
    """``items`` in their order, made in another thread; at most ``depth`` of them wait.

    Reading, decompressing and the compiled loops release the interpreter's lock, so two cores are
    used. Exceptions of ``items`` are raised here; an iterator that is left early stops the other
    thread before it returns.
    """
    if _IN_CALLERS_THREAD.get():
        yield from items
        return
    queue: Queue[object] = Queue(depth)
    left = Event()
    failure: list[BaseException] = []

    def put(item: object) -> None:
        while not left.is_set():
            try:
                queue.put(item, timeout=0.1)
                return
            except Full:
                continue

    def work() -> None:
        try:
            iterator = iter(items)
            try:
                for item in iterator:
                    put(item)
                    if left.is_set():
                        return
            finally:
                close = getattr(iterator, "close", None)
                if close is not None:
                    close()
        except BaseException as problem:  # whatever it is, the caller has to see it
            failure.append(problem)
        finally:
            put(_END)

    thread = Thread(target=work, name="semloc-ahead", daemon=True)
    thread.start()
    try:
        while True:
            try:
                item = queue.get(timeout=1.0)
            except Empty:
                continue  # lets Ctrl-C through while the other thread is slow
            if item is _END:
                break
            yield item  # type: ignore[misc]
    finally:
        left.set()
        thread.join()
    if failure:
        raise failure[0]
