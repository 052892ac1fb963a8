from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from semloc_logs.voxels.keys import morton, pack, unpack

LIMIT = 1 << 20
coordinate = st.integers(-LIMIT, LIMIT - 1)
cell = st.tuples(coordinate, coordinate, coordinate)


@given(st.lists(cell, min_size=1, max_size=20))
def test_packing_is_undone_and_keeps_the_order(cells: list[tuple[int, int, int]]) -> None:
    keys = pack(np.array(cells))
    np.testing.assert_array_equal(unpack(keys), cells)
    assert [cells[i] for i in np.argsort(keys, kind="stable")] == sorted(cells)
    assert (keys >= 0).all()


def interleaved(ijk: tuple[int, int, int]) -> int:
    code = 0
    for bit in range(21):
        for axis in range(3):
            code |= ((ijk[axis] + LIMIT) >> bit & 1) << (3 * bit + axis)
    return code


@given(cell)
def test_morton_code_is_the_interleaved_bits(ijk: tuple[int, int, int]) -> None:
    assert int(morton(np.array([ijk]))[0]) == interleaved(ijk)


def test_morton_order_of_a_small_cube_by_hand() -> None:
    # even coordinates: a cube of two lies in one cell of the next level
    corner = np.array([[-8, 16, 0]])
    cube = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)]) + corner
    codes = morton(cube)
    assert np.diff(codes.astype(np.int64)).tolist() == [1] * 7
