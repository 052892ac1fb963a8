from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.numerics.hash_table import EMPTY
from semloc_logs.voxels.carve import (
    CLASSES,
    Grid,
    LogOddsUnits,
    Rays,
    VoteTable,
    add_votes,
    addresses,
    flush,
    mark_ends,
    rehash,
    to_rays,
    vote_table,
)

EDGE = 16
FREE, HIT = 1, 2
Walk = Callable[..., NDArray[np.uint8]]


def crossed(origin: F64, end: F64) -> tuple[set[tuple[int, ...]], set[tuple[int, ...]]]:
    """Cells that the segment certainly passes (their inside, by a margin) and cells that it may
    touch, from its crossings of all planes.
    """
    d = end - origin
    times = {0.0, 1.0}
    for k in range(3):
        if d[k]:
            times |= {
                float((plane - origin[k]) / d[k])
                for plane in range(EDGE + 1)
                if min(origin[k], end[k]) < plane < max(origin[k], end[k])
            }
    ordered = sorted(times)
    sure = set()
    maybe = set()
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


def check(walk: Walk, origin: F64, end: F64) -> None:
    grid = walk(origin, end[None], [True])
    last = tuple(np.floor(end).astype(int).tolist())
    assert grid[last] == HIT
    if last != tuple(np.floor(origin).astype(int).tolist()):
        assert grid[tuple(np.floor(origin).astype(int))] == FREE
    cells = {tuple(c) for c in np.argwhere(grid).tolist()}
    assert (grid == HIT).sum() == 1
    sure, maybe = crossed(origin, end)
    assert sure <= cells, "a crossed cell is missing"
    assert cells <= maybe | {last}, "a cell beside the ray is marked"
    # from the start to the end in steps of one face: as many cells as the Manhattan distance, plus
    # the first
    assert len(cells) == 1 + sum(abs(np.floor(end) - np.floor(origin)))


inside = st.floats(0, EDGE - 1e-6, allow_nan=False, allow_subnormal=False)
on_border = st.integers(0, EDGE - 1).map(float)
place = st.tuples(*[inside | on_border] * 3)


@given(origin=place, end=place)
@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_ray_marks_the_cells_that_it_crosses(
    walk: Walk, origin: tuple[float, ...], end: tuple[float, ...]
) -> None:
    check(walk, np.array(origin), np.array(end))


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("towards", [1, -1])
@pytest.mark.parametrize("offset", [0.5, 0.0])
def test_rays_along_an_axis_inside_cells_and_on_their_borders(
    walk: Walk, axis: int, towards: int, offset: float
) -> None:
    origin = np.full(3, 5.0 + offset)
    end = origin.copy()
    end[axis] += 4.0 * towards
    grid = walk(origin, end[None], [True])
    cells = np.argwhere(grid)
    low, high = sorted((5, 5 + 4 * towards))
    assert cells[:, axis].tolist() == list(range(low, high + 1))
    assert (np.delete(cells, axis, 1) == 5).all()


@pytest.mark.parametrize(
    ("x", "y", "last"),
    [(0.4045518398215282, 0.23064220899374743, 9), (0.5198330743342318, 0.3527434156964051, 8)],
)
def test_rounding_does_not_carry_a_ray_past_its_last_cell(
    walk: Walk, x: float, y: float, last: int
) -> None:
    """The end lies just before a border in x and on one in y, whose crossing times add up to a
    little more than one.
    """
    grid = walk(np.array([x, y, 0.5]), np.array([[np.nextafter(1, 0), float(last), 0.5]]), [True])
    assert np.argwhere(grid).tolist() == [[0, j, 0] for j in range(last + 1)]


def test_start_and_end_in_one_place(walk: Walk) -> None:
    grid = walk(np.array([3.0, 4.5, 5.25]), np.array([[3.0, 4.5, 5.25]]), [True])
    assert np.argwhere(grid).tolist() == [[3, 4, 5]]
    assert grid[3, 4, 5] == HIT


def test_hits_win_whatever_the_order(walk: Walk) -> None:
    rays = np.array([[9.5, 1.5, 1.5], [5.5, 1.5, 1.5]])
    for order in ([0, 1], [1, 0]):
        grid = walk(np.array([1.5, 1.5, 1.5]), rays[order], [True, True])
        assert grid[:, 1, 1].tolist() == [0, 1, 1, 1, 1, 2, 1, 1, 1, 2, 0, 0, 0, 0, 0, 0]


def test_a_ray_beyond_the_limit_passes_and_does_not_hit(walk: Walk) -> None:
    grid = walk(np.array([1.5, 1.5, 1.5]), np.array([[20.5, 1.5, 1.5]]), [False], blocks=(2, 1, 1))
    assert grid[:, 1, 1].tolist() == [0] + [1] * 20 + [0] * 11


@given(rays=st.lists(st.tuples(place, st.booleans()), min_size=1, max_size=20), origin=place)
@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_nothing_is_written_outside_the_grid(
    walk: Walk, rays: list[tuple[tuple[float, ...], bool]], origin: tuple[float, ...]
) -> None:
    assert walk(
        np.array(origin), np.array([r[0] for r in rays]), [r[1] for r in rays], guard=8192
    ).any()


def test_addresses_are_block_by_block() -> None:
    ax, ay, az = addresses((2, 3, 4))
    assert (len(ax), len(ay), len(az)) == (32, 48, 64)
    assert ax[0] + ay[0] + az[15] == 15
    assert ax[0] + ay[1] + az[0] == 16
    assert ax[1] + ay[0] + az[0] == 256
    assert ax[0] + ay[0] + az[16] == 4096
    assert ax[0] + ay[16] + az[0] == 4 * 4096
    assert ax[16] + ay[0] + az[0] == 12 * 4096
    every = (ax[:, None, None] + ay[None, :, None] + az[None, None, :]).reshape(-1)
    assert sorted(every.tolist()) == list(range(24 * 4096))


@pytest.mark.parametrize(
    ("sigma", "weight", "carved_to"),
    # voxels are 1 m: 2 sigma are 1, 2, 4, 200
    [(0.0, 16, 10.5), (0.5, 16, 10.5), (1.0, 8, 8.5), (2.0, 4, 6.5), (100.0, 1, 0.5)],
)
def test_an_uncertain_range_hits_less_and_carves_less(
    sigma: float, weight: int, carved_to: float
) -> None:
    marks = np.zeros(4096, np.uint8)
    touched = np.zeros(1, np.uint8)
    votes = np.zeros((1, CLASSES), np.uint32)
    start = np.full(3, 0.5)
    label = np.array([8], np.uint8)
    spread = np.array([sigma], np.float32)
    offset, length, _, _ = to_rays(np.array([[10.5, 0.5, 0.5]]), np.eye(4), start, 1.0, 50.0)
    rays = Rays(start, offset, length, 50.0, label, spread)
    ends, carved = mark_ends(Grid(marks, touched, *addresses((1, 1, 1))), rays, votes)
    assert ends.tolist() == [2 * 2560 + 1]  # voxel (10, 0, 0), a hit
    assert marks[2560] == weight << 1
    assert votes[0, 8] == weight
    np.testing.assert_allclose(carved, [[carved_to, 0.5, 0.5]], atol=1e-6)


def test_flush_by_hand() -> None:
    marks = np.zeros(6 * 4096, np.uint8)
    marks[0] = marks[5 * 4096 + 4094] = 1
    marks[5 * 4096 + 4095] = 16 << 1 | 1
    marks[7] = 4 << 1
    marks[8] = 1 << 1
    log_odds = np.full((3, 4096), -128, np.int8)
    log_odds[2, 0], log_odds[0, 4095] = -35, 60
    flush(marks, np.array([0, 5]), np.array([2, 0]), log_odds, LogOddsUnits(17, 8, -40, 70))
    expected = np.full((3, 4096), -128, np.int8)
    expected[2, 0] = -40  # -35 - 8, clamped
    expected[0, 4095] = 70  # 60 + 17, clamped; the hit wins over the pass
    expected[0, 4094] = -8
    expected[2, 7], expected[2, 8] = 4, 1  # 17 * 4 / 16 and 17 / 16
    np.testing.assert_array_equal(log_odds, expected)


@given(
    st.lists(
        st.tuples(st.integers(0, 40), st.integers(0, CLASSES - 1), st.integers(1, 70)),
        min_size=1,
        max_size=60,
    )
)
@settings(max_examples=50)
def test_votes_are_counted_as_in_a_dictionary(frames: list[tuple[int, int, int]]) -> None:
    table = vote_table(64)
    used = 0
    expected: dict[int, int] = {}
    for cell, label, weight in frames:
        votes = np.zeros((1, CLASSES), np.uint32)
        votes[0, label] = weight
        used += add_votes(table, np.array([2 * cell + 1]), votes, np.array([3]))
        key = (3 * 4096 + cell) * 32 + label
        expected[key] = expected.get(key, 0) + -(-weight // 16)
        if used > 32:  # what the fuser does when the table is half full
            smaller = table
            table = vote_table(4 * len(smaller.keys))
            rehash(smaller, table)
    assert contents(table) == expected
    assert used == len(expected)


def contents(table: VoteTable) -> dict[int, int]:
    filled = table.keys != EMPTY
    return dict(zip(table.keys[filled].tolist(), table.counts[filled].tolist(), strict=True))
