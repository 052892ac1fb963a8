"""Bits and bytes of words, against Python's own integers."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from semloc_logs.numerics.bits import EACH_BYTE, bytes_set


@given(st.lists(st.sampled_from([0, 1, 0x7F, 0x80, 0xFF]), min_size=8, max_size=8))
def test_the_highest_bit_of_each_byte_tells_whether_the_byte_is_set(values: list[int]) -> None:
    word = np.uint64(int.from_bytes(bytes(values), "little"))
    expected = bytes(0x80 if value else 0 for value in values)
    assert int(bytes_set(word)).to_bytes(8, "little") == expected


def test_a_byte_eight_times() -> None:
    assert (0xAB * EACH_BYTE).to_bytes(8, "little") == b"\xab" * 8
