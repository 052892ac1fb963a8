"""Results of an engine as a sequence that grows while it is read: work on the first ones begins before the last ones are there."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Sequence
from typing import Generic, TypeVar, overload

Result = TypeVar("Result")


class Growing(Sequence[Result], Generic[Result]):
    """``total`` results that a thread takes from ``results``; ``[i]`` waits for the i-th and raises what has gone wrong before it."""

    def __init__(self, results: Iterable[Result], total: int, on_result: Callable[[int], None] = lambda _: None) -> None:
        self._there: list[Result] = []
        self._failure: BaseException | None = None
        self._total = total
        self._change = threading.Condition()
        threading.Thread(target=self._take, args=(results, on_result), daemon=True).start()

    def _take(self, results: Iterable[Result], on_result: Callable[[int], None]) -> None:
        try:
            for result in results:
                with self._change:
                    self._there.append(result)
                    self._change.notify_all()
                on_result(len(self._there))
            if len(self._there) < self._total:
                raise IndexError(f"{len(self._there)} results came, not {self._total}")
        except BaseException as failure:  # whatever it is, it belongs to the one who waits
            with self._change:
                self._failure = failure
                self._change.notify_all()

    def __len__(self) -> int:
        return self._total

    @overload
    def __getitem__(self, index: int) -> Result: ...
    @overload
    def __getitem__(self, index: slice) -> list[Result]: ...
    def __getitem__(self, index: int | slice) -> Result | list[Result]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(self._total))]
        index = range(self._total)[index]
        with self._change:
            self._change.wait_for(lambda: len(self._there) > index or self._failure is not None)
            if len(self._there) <= index and self._failure is not None:
                raise self._failure
            return self._there[index]
