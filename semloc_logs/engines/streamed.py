"""Results of an engine as a sequence that grows while it is read: work on the first ones begins
before the last ones are there.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Sequence
from typing import Generic, TypeVar, overload

Result = TypeVar("Result")


class Growing(Sequence[Result], Generic[Result]):
    """``total`` results, of which a thread takes those from number ``first`` on from ``results``.

    ``[i]`` waits for the i-th and raises what has gone wrong before it. With ``ahead`` no more than
    so many results are taken beyond the last one that was wanted so far. Raises IndexError for a
    result before ``first``.
    """

    def __init__(
        self,
        results: Iterable[Result],
        total: int,
        on_result: Callable[[int], None] = lambda _: None,
        *,
        first: int = 0,
        ahead: int | None = None,
    ) -> None:
        self._there: list[Result] = []
        self._failure: BaseException | None = None
        self._total, self._first, self._ahead = total, first, ahead
        self._wanted = first  # results that were wanted so far
        self._change = threading.Condition()
        threading.Thread(target=self._take, args=(results, on_result), daemon=True).start()

    def _may_take(self) -> bool:
        count = self._first + len(self._there)
        return (
            self._ahead is None or count < self._wanted + self._ahead or self._failure is not None
        )

    def _take(self, results: Iterable[Result], on_result: Callable[[int], None]) -> None:
        try:
            source = iter(results)
            for count in range(self._first + 1, self._total + 1):
                with self._change:
                    self._change.wait_for(self._may_take)
                    if self._failure is not None:
                        return
                result = next(source, None)
                if result is None:
                    raise IndexError(f"{count - 1} results came, not {self._total}")
                with self._change:
                    self._there.append(result)
                    self._change.notify_all()
                on_result(count)
        except BaseException as failure:  # whatever it is, it belongs to the one who waits
            self._fail(failure)

    def _fail(self, failure: BaseException) -> None:
        with self._change:
            self._failure = self._failure or failure
            self._change.notify_all()

    def close(self) -> None:
        """Take no further results; whoever waits for one gets an IndexError."""
        self._fail(IndexError("the results are not wanted any more"))

    def __len__(self) -> int:
        return self._total

    @overload
    def __getitem__(self, index: int) -> Result: ...
    @overload
    def __getitem__(self, index: slice) -> list[Result]: ...
    def __getitem__(self, index: int | slice) -> Result | list[Result]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(self._total))]
        place = range(self._total)[index] - self._first
        if place < 0:
            raise IndexError(f"result {index} lies before the first, {self._first}")
        with self._change:
            self._wanted = max(self._wanted, self._first + place + 1)
            self._change.notify_all()
            self._change.wait_for(lambda: len(self._there) > place or self._failure is not None)
            if len(self._there) <= place and self._failure is not None:
                raise self._failure
            return self._there[place]
