from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semloc_logs.subvolumes.cut import code_table, turn


def test_codes_of_the_states() -> None:
    semantic = code_table("semantic")
    geometric = code_table("geometric")
    assert semantic[:19].tolist() == list(range(19))
    assert [int(semantic[s]) for s in (254, 253, 255)] == [19, 20, 21]
    assert [int(geometric[s]) for s in (254, 253, 255)] == [1, 2, 0]
    assert set(geometric[:19].tolist()) == {0}
    assert {int(c) for c in semantic} <= set(range(22))
    with pytest.raises(KeyError):
        code_table("other")


@given(
    st.integers(0, 2**32 - 1),
    st.floats(-7, 7),
    st.tuples(st.floats(-12, 12), st.floats(-12, 12), st.floats(-6, 6)),
    st.tuples(st.integers(1, 9), st.integers(1, 9), st.integers(1, 9)),
)
@settings(max_examples=60)
def test_turning_is_what_the_slow_loop_says(
    seed: int, yaw: float, centre: tuple[float, ...], size: tuple[int, ...]
) -> None:
    state = np.random.default_rng(seed).integers(0, 19, (11, 7, 5)).astype(np.uint8)
    low = np.array([-4, -9, -2])
    out = np.zeros(size, np.uint8)
    turn(state, low, yaw, np.array(centre), out)
    R = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    for ijk in np.ndindex(*size):
        position = np.array(centre) + R @ (np.array(ijk) + 0.5 - np.array(size) / 2)
        if np.abs(position - np.round(position)).min() < 1e-6:  # on a border rounding decides
            continue
        cell = np.floor(position).astype(int) - low
        inside = (cell >= 0).all() and (cell < state.shape).all()
        assert out[ijk] == (state[tuple(cell)] if inside else 253)


def test_quarter_turns_are_those_of_numpy() -> None:
    state = np.random.default_rng(0).integers(0, 19, (8, 8, 4)).astype(np.uint8)
    out = np.zeros_like(state)
    for quarter in range(4):
        turn(
            state,
            np.zeros(3, np.int64),
            quarter * np.pi / 2 + 1e-12,
            np.array([4.0, 4.0, 2.0]),
            out,
        )
        np.testing.assert_array_equal(out, np.rot90(state, -quarter, (0, 1)))
