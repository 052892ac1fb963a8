"""Values that stay in memory between queries, as many as a number of bytes holds."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from dataclasses import fields, is_dataclass
from typing import Generic, TypeVar

import numpy as np
import pyarrow as pa

Cached = TypeVar("Cached")


class Recent(Generic[Cached]):
    """The most recently used values: their arrays take at most ``limit`` bytes, the last one apart.

    Values may grow, as their parts are made on first use: they are weighed when one is added.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._values: OrderedDict[Hashable, Cached] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], Cached]) -> Cached:
        """The value of ``key``, made if it is not there."""
        if key not in self._values:
            self._values[key] = make()
            self._forget_oldest()
        self._values.move_to_end(key)
        return self._values[key]

    def _forget_oldest(self) -> None:
        held = {key: size_of(value) for key, value in self._values.items()}
        total = sum(held.values())
        while total > self._limit and len(self._values) > 1:
            oldest, _ = self._values.popitem(last=False)
            total -= held[oldest]


def size_of(value: object) -> int:
    """Bytes of the arrays and tables in a value: in its fields, cached properties and items."""
    if isinstance(value, np.ndarray | pa.Table):
        return int(value.nbytes)
    if isinstance(value, Mapping):
        return sum(map(size_of, value.values()))
    if isinstance(value, tuple | list):
        return sum(map(size_of, value))
    if is_dataclass(value):
        parts = {f.name: getattr(value, f.name) for f in fields(value)}
        return sum(map(size_of, (parts | getattr(value, "__dict__", {})).values()))
    return 0
