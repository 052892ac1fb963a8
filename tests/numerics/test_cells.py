from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from semloc_logs.numerics.cells import by_cell, cell_starts


def test_by_hand() -> None:
    order, start = by_cell(np.array([2, 0, 2, 4, 0]), 6)
    assert order.tolist() == [1, 4, 0, 2, 3]
    assert start.tolist() == [0, 2, 2, 4, 4, 5, 5]


@given(st.lists(st.integers(0, 9), max_size=50))
@settings(max_examples=50)
def test_as_a_stable_sort(cells: list[int]) -> None:
    cell = np.array(cells, np.int32)
    order, start = by_cell(cell, 10)
    np.testing.assert_array_equal(order, np.argsort(cell, kind="stable"))
    np.testing.assert_array_equal(start, np.searchsorted(np.sort(cell), np.arange(11)))
    np.testing.assert_array_equal(start, cell_starts(cell, 10))
