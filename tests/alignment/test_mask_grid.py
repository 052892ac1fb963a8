"""The classes about each voxel, as bits, and their look-up."""

from __future__ import annotations

import numpy as np
import pytest

from semloc_logs.alignment.mask_grid import ANY_BIT, FREE_BIT, MaskGrid, class_bits, look_up
from semloc_logs.voxels.grid import FREE_STATE
from tests.alignment.voxel_maps import COARSE, V, block_map, mask_grid_of, occupied, random_cells


def test_class_bits_by_hand() -> None:
    states = np.array([0, 2, 5, 8, 13, 11, 255, 254, 253], np.uint8)
    assert class_bits(states, COARSE).tolist() == [
        64 + 1,
        64 + 2,
        64 + 4,
        64 + 8,
        64 + 16,
        64 + 32,
        64,
        0,
        0,
    ]


@pytest.mark.parametrize("seed", range(3))
def test_masks_are_those_of_slow_loops(seed: int) -> None:
    cells = random_cells(seed)
    grid = mask_grid_of(block_map(cells))
    corner = np.rint(grid.corner / V).astype(int)
    expected = np.zeros(grid.mask.shape, np.uint8)
    for ijk, state in cells.items():
        if occupied(state):
            for d in np.ndindex(3, 3, 3):
                expected[tuple(np.array(ijk) - corner + np.array(d) - 1)] |= ANY_BIT | (
                    1 << COARSE[state] if COARSE[state] < 6 else 0
                )
    for ijk, state in cells.items():
        cell = tuple(np.array(ijk) - corner)
        if state == FREE_STATE and expected[cell] == 0:
            expected[cell] = FREE_BIT
    np.testing.assert_array_equal(grid.mask, expected)


def test_look_ups_of_points() -> None:
    grid = mask_grid_of(block_map({(0, 0, 0): 2, (9, 9, 9): 254}))
    points = np.array(
        [
            [0.25, 0.25, 0.25],
            [-0.25, 0.7, 0.99],
            [1.01, 0.2, 0.2],
            [4.75, 4.75, 4.75],
            [1e6, 0, 0],
            [-1e6, 0, 0],
        ]
    )
    assert look_up(grid, points).tolist() == [ANY_BIT | 2, ANY_BIT | 2, 0, FREE_BIT, 0, 0]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_look_up_beside_the_grid_finds_nothing(axis: int) -> None:
    """A full grid of 3 x 3 x 3 cells of 0.5 m from (-1, 2, 4) on."""
    corner = np.array([-1.0, 2.0, 4.0])
    grid = MaskGrid(np.full((3, 3, 3), 9, np.uint8), corner, 0.5)
    along = [-0.6, -0.1, 0.1, 1.4, 1.6, 2.1]
    points = np.tile(corner + 0.75, (len(along), 1))
    points[:, axis] = corner[axis] + along
    assert look_up(grid, points).tolist() == [0, 0, 9, 9, 0, 0]
