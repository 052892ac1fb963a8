"""Values in memory, by the bytes of their arrays."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pyarrow as pa
import pytest

from semloc_logs.closures.recent import Recent, size_of


@dataclass(frozen=True, slots=True, eq=False)
class Slotted:
    numbers: np.ndarray
    name: str = "a"


@dataclass(frozen=True, slots=True, eq=False)
class Named:
    name: str
    numbers: np.ndarray


@dataclass(eq=False)
class Growing:
    numbers: np.ndarray

    @cached_property
    def twice(self) -> Slotted:
        return Slotted(np.concatenate([self.numbers, self.numbers]))


def eight(count: int) -> np.ndarray:
    """An array of ``count`` times eight bytes."""
    return np.zeros(count)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (eight(3), 24),
        (eight(4)[:2], 16),
        (pa.table({"x": eight(5)}), 40),
        ((eight(1), [eight(2), 7], None), 24),
        ({"a": eight(1), "b": "text"}, 8),
        (Slotted(eight(6)), 48),
        (Named("a", eight(6)), 48),
        (Growing(eight(2)), 16),
    ],
)
def test_arrays_are_weighed_wherever_they_are(value: object, expected: int) -> None:
    assert size_of(value) == expected


def test_what_a_value_made_for_itself_counts_once() -> None:
    value = Growing(eight(2))
    assert len(value.twice.numbers) == 4
    assert size_of(value) == 16 + 32


class Counted:
    """A cache that tells which values it made."""

    def __init__(self, limit: int) -> None:
        self.made: list[str] = []
        self._recent: Recent[np.ndarray] = Recent(limit)

    def get(self, key: str, count: int) -> np.ndarray:
        def make() -> np.ndarray:
            self.made.append(key)
            return eight(count)

        return self._recent.get(key, make)


def test_the_values_used_longest_ago_are_forgotten_when_the_bytes_are_spent() -> None:
    cache = Counted(32)
    for key in "aababa":
        cache.get(key, 2)
    assert cache.made == ["a", "b"]  # 32 bytes
    cache.get("c", 2)  # 48 bytes: b was used longest ago, though it was made last
    cache.get("a", 2)
    assert cache.made == ["a", "b", "c"]
    cache.get("b", 2)
    assert cache.made == ["a", "b", "c", "b"]


def test_a_large_value_pushes_out_several_and_stays_alone() -> None:
    cache = Counted(40)
    cache.get("a", 1)
    cache.get("b", 1)
    assert len(cache.get("large", 100)) == 100
    assert len(cache.get("large", 100)) == 100
    assert cache.made == ["a", "b", "large"]
    cache.get("b", 1)
    cache.get("a", 1)
    assert cache.made == ["a", "b", "large", "b", "a"]


def test_a_value_that_grew_is_weighed_when_the_next_one_comes() -> None:
    recent: Recent[Growing] = Recent(64)
    first = recent.get("a", lambda: Growing(eight(2)))
    recent.get("b", lambda: Growing(eight(2)))
    assert recent.get("a", lambda: Growing(eight(9))) is first
    recent.get("b", lambda: Growing(eight(9)))
    assert len(first.twice.numbers) == 4  # 16 + 32 bytes now
    recent.get("c", lambda: Growing(eight(2)))  # 48 + 16 + 16 bytes: without a 32
    assert recent.get("a", lambda: Growing(eight(2))) is not first
