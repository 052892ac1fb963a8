from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from semloc_logs.voxels.carve import FREE, HIT, carve, flush, touched_blocks

EDGE = 12
F64 = NDArray[np.float64]


def crossed(origin: F64, end: F64) -> tuple[set[tuple[int, ...]], set[tuple[int, ...]]]:
    """Cells that the segment certainly passes (their inside, by a margin) and cells that it may touch, from its crossings of all planes."""
    d = end - origin
    times = {0.0, 1.0}
    for k in range(3):
        if d[k]:
            times |= {
                float((plane - origin[k]) / d[k]) for plane in range(EDGE + 1) if min(origin[k], end[k]) < plane < max(origin[k], end[k])
            }
    ordered = sorted(times)
    sure, maybe = set(), set()
    for a, b in itertools.pairwise(ordered):
        middle = origin + d * (a + b) / 2
        cell = tuple(np.floor(middle).astype(int).tolist())
        maybe.add(cell)
        if (b - a) * np.abs(d).max() > 1e-6:
            sure.add(cell)
    for t in ordered:  # where two cells meet rounding decides which one is taken
        p = origin + d * t
        for dx, dy, dz in np.ndindex(3, 3, 3):
            maybe.add(tuple(np.floor(p + 1e-9 * (np.array([dx, dy, dz]) - 1)).astype(int).tolist()))
    return sure, maybe


def marked(origin: F64, end: F64, hit: bool) -> NDArray[np.uint8]:
    grid = np.zeros((EDGE, EDGE, EDGE), np.uint8)
    carve(grid, origin, end[None], np.array([hit]))
    return grid


def check(origin: F64, end: F64, hit: bool) -> None:
    grid = marked(origin, end, hit)
    last = tuple(np.floor(end).astype(int).tolist())
    assert grid[last] == (HIT if hit else FREE)
    if not hit or last != tuple(np.floor(origin).astype(int).tolist()):
        assert grid[tuple(np.floor(origin).astype(int))] == FREE
    cells = {tuple(c) for c in np.argwhere(grid).tolist()}
    assert (grid == HIT).sum() == hit
    sure, maybe = crossed(origin, end)
    assert sure <= cells, "a crossed cell is missing"
    assert cells <= maybe | {last}, "a cell beside the ray is marked"
    # from the start to the end in steps of one face: as many cells as the Manhattan distance, plus the first
    assert len(cells) == 1 + sum(abs(np.floor(end) - np.floor(origin)))


inside = st.floats(0, EDGE - 1e-6, allow_nan=False, allow_subnormal=False)
on_border = st.integers(0, EDGE - 1).map(float)
place = st.tuples(*[inside | on_border] * 3)


@given(place, place, st.booleans())
@settings(max_examples=300, deadline=None)
def test_a_ray_marks_the_cells_that_it_crosses(origin: tuple[float, ...], end: tuple[float, ...], hit: bool) -> None:
    check(np.array(origin), np.array(end), hit)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("towards", [1, -1])
@pytest.mark.parametrize("offset", [0.5, 0.0])
def test_rays_along_an_axis_inside_cells_and_on_their_borders(axis: int, towards: int, offset: float) -> None:
    origin = np.full(3, 5.0 + offset)
    end = origin.copy()
    end[axis] += 4.0 * towards
    grid = marked(origin, end, True)
    cells = np.argwhere(grid)
    low, high = sorted((5, 5 + 4 * towards))
    assert cells[:, axis].tolist() == list(range(low, high + 1))
    assert (np.delete(cells, axis, 1) == 5).all()


@pytest.mark.parametrize(("x", "y", "last"), [(0.4045518398215282, 0.23064220899374743, 9), (0.5198330743342318, 0.3527434156964051, 8)])
def test_rounding_does_not_carry_a_ray_past_its_last_cell(x: float, y: float, last: int) -> None:
    """The end lies just before a border in x and on one in y, whose crossing times add up to a little more than one."""
    grid = marked(np.array([x, y, 0.5]), np.array([np.nextafter(1, 0), float(last), 0.5]), True)
    assert np.argwhere(grid).tolist() == [[0, j, 0] for j in range(last + 1)]


def test_start_and_end_in_one_place() -> None:
    grid = marked(np.array([3.0, 4.5, 5.25]), np.array([3.0, 4.5, 5.25]), True)
    assert np.argwhere(grid).tolist() == [[3, 4, 5]]
    assert grid[3, 4, 5] == HIT


def test_hits_win_whatever_the_order() -> None:
    rays = np.array([[9.5, 1.5, 1.5], [5.5, 1.5, 1.5]])
    for order in ([0, 1], [1, 0]):
        grid = np.zeros((EDGE, EDGE, EDGE), np.uint8)
        carve(grid, np.array([1.5, 1.5, 1.5]), rays[order], np.array([True, True]))
        assert grid[:, 1, 1].tolist() == [0, 1, 1, 1, 1, 2, 1, 1, 1, 2, 0, 0]


@given(st.lists(st.tuples(place, st.booleans()), min_size=1, max_size=20), place)
@settings(max_examples=100, deadline=None)
def test_nothing_is_written_outside_the_grid(rays: list[tuple[tuple[float, ...], bool]], origin: tuple[float, ...]) -> None:
    room = np.zeros((EDGE + 32, EDGE + 32, EDGE + 32), np.uint8)  # a view inside guard cells: a stray write lands in them
    carve(room[16:-16, 16:-16, 16:-16], np.array(origin), np.array([r[0] for r in rays]), np.array([r[1] for r in rays]))
    assert room[16:-16, 16:-16, 16:-16].any()
    room[16:-16, 16:-16, 16:-16] = 0
    assert not room.any()


def test_touched_blocks_and_flush() -> None:
    grid = np.zeros((32, 16, 48), np.uint8)
    grid[0, 0, 0], grid[31, 15, 47], grid[31, 15, 46] = FREE, HIT, FREE
    offsets = touched_blocks(grid)
    assert offsets.tolist() == [[0, 0, 0], [1, 0, 2]]
    log_odds = np.full((3, 4096), -128, np.int8)
    flush(grid, offsets, np.array([2, 0]), log_odds, 17, 8, -40, 70)
    expected = np.full((3, 4096), -128, np.int8)
    expected[2, 0], expected[0, 4095], expected[0, 4094] = -8, 17, -8
    np.testing.assert_array_equal(log_odds, expected)
    assert not grid.any()
