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
THREAD_NAME = "semloc-prefetch"
_IN_CALLERS_THREAD = ContextVar("in_callers_thread", default=False)
PUT_SECONDS = 0.1  # after which a waiting producer looks whether the consumer has left
GET_SECONDS = 1.0  # after which a waiting consumer lets Ctrl-C through


@contextmanager
def in_callers_thread() -> Iterator[None]:
    """Within it :func:`prefetched` makes each item when the caller takes it.

    For profilers, which see one thread.
    """
    token = _IN_CALLERS_THREAD.set(True)
    try:
        yield
    finally:
        _IN_CALLERS_THREAD.reset(token)


def prefetched(items: Iterable[T], depth: int = 2) -> Generator[T, None, None]:
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
    thread = Thread(
        target=_produce, args=(items, queue, left, failure), name=THREAD_NAME, daemon=True
    )
    thread.start()
    try:
        while True:
            try:
                item = queue.get(timeout=GET_SECONDS)
            except Empty:
                continue
            if item is _END:
                break
            yield item  # type: ignore[misc]
    finally:
        left.set()
        thread.join()
    if failure:
        raise failure[0]


def _produce(
    items: Iterable[T], queue: Queue[object], left: Event, failure: list[BaseException]
) -> None:
    """Put ``items`` into ``queue``, and its end, until they are all there or ``left`` is set."""
    try:
        iterator = iter(items)
        try:
            for item in iterator:
                _put(item, queue, left)
                if left.is_set():
                    return
        finally:
            close = getattr(iterator, "close", None)
            if close is not None:
                close()
    except BaseException as problem:  # whatever it is, the caller has to see it
        failure.append(problem)
    finally:
        _put(_END, queue, left)


def _put(item: object, queue: Queue[object], left: Event) -> None:
    """Put ``item`` into ``queue``, unless the consumer has left."""
    while not left.is_set():
        try:
            queue.put(item, timeout=PUT_SECONDS)
            return
        except Full:
            continue
