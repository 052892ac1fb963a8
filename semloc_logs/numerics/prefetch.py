"""Prefetching: an iterator that runs in a thread of its own, a few items before their use."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from queue import Empty, Full, Queue
from threading import Event, Thread
from typing import Generic, TypeVar

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


class Lookahead(Generic[T]):
    """``make(0)``, ``make(1)``, ... in two threads, up to ``depth`` of them before they are taken.

    One thread is the caller's: where the other has not come far enough, the caller works as well
    instead of waiting. For work that releases the interpreter's lock. Exceptions of ``make`` are
    raised by :meth:`take`. Within :func:`in_callers_thread` each result is made when it is taken.
    """

    def __init__(self, make: Callable[[int], T], count: int, depth: int = 2) -> None:
        self._make = make
        self._count = count
        self._depth = depth
        self._next = 0  # the first that is not planned
        self._planned: dict[int, Future[T]] = {}
        self._pool: ThreadPoolExecutor | None = None
        if not _IN_CALLERS_THREAD.get():
            self._pool = ThreadPoolExecutor(1, thread_name_prefix=THREAD_NAME)

    def __enter__(self) -> Lookahead[T]:
        return self

    def __exit__(self, *_: object) -> None:
        """Waits for the other thread; what has not begun is not made any more."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def take(self, number: int) -> T:
        """``make(number)``, for numbers that only grow."""
        if self._pool is None:
            return self._make(number)
        last = min(number + self._depth, self._count - 1)
        for following in range(max(self._next, number + 1), last + 1):
            self._planned[following] = self._pool.submit(self._make, following)
        self._next = max(self._next, last + 1)

        planned = self._planned.pop(number, None)
        if planned is None or planned.cancel():  # nobody has begun it
            return self._make(number)
        while not planned.done() and self._help():
            pass
        return planned.result()

    def _help(self) -> bool:
        """Makes a later result that the other thread has not begun; False without any."""
        number = next((n for n, planned in self._planned.items() if planned.cancel()), None)
        if number is None:
            return False
        made: Future[T] = Future()
        try:
            made.set_result(self._make(number))
        except Exception as error:
            made.set_exception(error)
        self._planned[number] = made
        return True
