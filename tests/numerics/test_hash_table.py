from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from semloc_logs.numerics.hash_table import EMPTY, empty_table, place_of, table_size


def test_half_of_the_places_stay_empty() -> None:
    assert [table_size(n) for n in (0, 512, 513, 1024, 1025)] == [1024, 1024, 2048, 2048, 4096]
    assert empty_table(600).tolist() == [EMPTY] * 2048


@given(st.lists(st.integers(-(2**63) + 1, 2**63 - 1) | st.integers(-4, 4), max_size=200))
@settings(max_examples=50)
def test_keys_are_found_where_they_were_put(keys: list[int]) -> None:
    table = empty_table(len(keys))
    for key in keys:
        table[place_of(table, key)] = key
    assert set(table[table != EMPTY].tolist()) == set(keys)
    assert [int(table[place_of(table, key)]) for key in keys] == keys


def test_a_crowded_table_wraps_around() -> None:
    """As many keys as half of the places, which all start at the last place."""
    table = np.full(8, EMPTY, np.int64)
    last = [k for k in range(10_000_000, 10_400_000, 7) if place_of(table, k) == 7][:4]
    for key in last:
        table[place_of(table, key)] = key
    assert table[[7, 0, 1, 2]].tolist() == last
    assert table[3:7].tolist() == [EMPTY] * 4
