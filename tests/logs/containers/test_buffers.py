from __future__ import annotations

import numpy as np

from semloc_logs.logs.containers.buffers import Buffers


def test_an_array_that_nobody_looks_at_is_used_again() -> None:
    buffers = Buffers()
    first = buffers.take(100)
    buffers.give(first)
    again = buffers.take(90)
    assert again is first
    assert len(again) >= 90


def test_an_array_with_a_view_is_not_touched() -> None:
    buffers = Buffers()
    first = buffers.take(8)
    view = np.frombuffer(memoryview(first)[:8].toreadonly(), np.uint8)
    buffers.give(first)
    other = buffers.take(8)
    assert other is not first
    other[:8] = b"\xff" * 8
    assert view.tolist() == [0] * 8
    # the last view is gone: the array is free
    del view
    assert buffers.take(8) is first


def test_larger_needs_get_a_larger_array() -> None:
    buffers = Buffers()
    small = buffers.take(10)
    buffers.give(small)
    large = buffers.take(10_000)
    assert large is not small
    assert len(large) >= 10_000


def test_few_arrays_are_kept() -> None:
    buffers = Buffers(most=2)
    given = [buffers.take(10) for _ in range(5)]
    for buffer in given:
        buffers.give(buffer)
    taken = [buffers.take(10) for _ in range(3)]
    assert [any(a is b for b in given) for a in taken] == [True, True, False]
