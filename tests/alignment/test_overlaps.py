"""The quick tau of many hypotheses against cases checked by hand, and against the slow one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from semloc_logs.alignment.cell_masks import (
    NOT_ALIGNED,
    OverlapMap,
    class_bit,
    look_up,
    overlap_map,
)
from semloc_logs.alignment.overlaps import (
    Shifts,
    aligned_pairs,
    best_overlaps,
    overlap,
    query_voxels,
)
from semloc_logs.alignment.tau import tau
from semloc_logs.numerics.transforms import yaw_transform
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE, BlockMap
from semloc_logs.voxels.keys import BLOCK, pack

ROAD, WALL = 0, 2


def mask_of_cell(target: OverlapMap, cell: tuple[int, int, int]) -> int:
    """The bits of all voxels that may be closest to a point in the cell."""
    return int(look_up(target.arrays, *cell, target.offsets))


def blocks_of(voxels: dict[tuple[int, int, int], int]) -> BlockMap:
    """A map of voxel states."""
    rows: dict[int, NDArray[np.uint8]] = {}
    for ijk, value in voxels.items():
        key = int(pack(np.array(ijk) // BLOCK))
        block = rows.setdefault(key, np.full(BLOCK**3, UNOBSERVED_STATE, np.uint8))
        x, y, z = (c % BLOCK for c in ijk)
        block[(x * BLOCK + y) * BLOCK + z] = value
    keys = np.array(sorted(rows), np.int64)
    state = np.array([rows[k] for k in keys.tolist()], np.uint8).reshape(-1, BLOCK**3)
    nothing = np.zeros(0, np.int64)
    return BlockMap(keys, np.zeros(state.shape, np.int8), state, nothing, nothing)


def query(*voxels: tuple[int, int, int, int]) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
    """Coordinates and classes of occupied voxels."""
    a = np.array(voxels)
    return a[:, :3].astype(np.int32), a[:, 3].astype(np.uint8)


def shifted(x: float, y: float = 0.0, z: float = 0.0) -> NDArray[np.float64]:
    return yaw_transform(0.0, (x, y, z))


def test_voxels_of_the_same_class_within_kappa_are_aligned() -> None:
    target = overlap_map(blocks_of({(0, 0, 0): ROAD, (9, 0, 0): WALL}), 3.0)
    four = query_voxels(query((0, 0, 0, ROAD), (1, 0, 0, WALL), (8, 0, 0, WALL), (5, 0, 0, ROAD)))
    # the road on itself; a wall beside the road; a wall beside the wall; a road 4 voxels from the
    # wall and 5 from the road
    assert overlap(target, four, np.eye(4)) == 2 / 4
    # all lie on the other side of both, 20 voxels away
    assert overlap(target, four, shifted(-30)) == 0.0
    # turned by half a turn about the corner of the first voxel: only the first two are within
    # kappa, at cells -1 and -2
    assert overlap(target, four, yaw_transform(np.pi, (0, 1, 0))) == 1 / 4


def test_free_space_that_is_closest_does_not_count() -> None:
    voxels = {(0, 0, 0): ROAD, (2, 0, 0): FREE_STATE}
    target = overlap_map(blocks_of(voxels), 5.0)
    assert overlap(target, query_voxels(query((0, 0, 0, ROAD))), shifted(0.6)) == 1.0
    assert overlap(target, query_voxels(query((2, 0, 0, ROAD))), np.eye(4)) == 0.0
    # 1.9 voxels from the road and 0.1 from free space; 0.9 and 1.1
    assert overlap(target, query_voxels(query((0, 0, 0, ROAD))), shifted(1.9)) == 0.0
    assert overlap(target, query_voxels(query((0, 0, 0, ROAD))), shifted(0.9)) == 1.0
    # without free space in the map the road is closest, 1.9 voxels away
    occupied = overlap_map(blocks_of(voxels), 5.0, free=False)
    assert overlap(occupied, query_voxels(query((0, 0, 0, ROAD))), shifted(1.9)) == 1.0


def test_kappa_ends_at_its_distance() -> None:
    target = overlap_map(blocks_of({(0, 0, 0): WALL}), 10.0)
    one = query_voxels(query((0, 0, 0, WALL)))
    assert overlap(target, one, shifted(9.99)) == 1.0
    assert overlap(target, one, shifted(10.01)) == 0.0
    assert overlap(target, one, shifted(6.0, 7.99, 0.0)) == 1.0
    assert overlap(target, one, shifted(6.0, 8.01, 0.0)) == 0.0


def test_pairs_are_the_centres_of_aligned_voxels() -> None:
    target = overlap_map(blocks_of({(0, 0, 0): ROAD, (9, 0, 0): WALL}), 3.0)
    three = query_voxels(query((0, 0, 0, ROAD), (1, 0, 0, WALL), (8, 0, 0, WALL)))
    ours, theirs = aligned_pairs(target, three, shifted(0.25))
    order = np.argsort(ours[:, 0])
    np.testing.assert_array_equal(ours[order], [[0.5, 0.5, 0.5], [8.5, 0.5, 0.5]])
    np.testing.assert_array_equal(theirs[order], [[0.5, 0.5, 0.5], [9.5, 0.5, 0.5]])


def random_map(seed: int) -> BlockMap:
    """Clusters of a few classes and free space on either side of a border of blocks."""
    rng = np.random.default_rng(seed)
    voxels = {}
    for _ in range(12):
        middle = rng.integers(-14, 14, 3)
        state = int(rng.choice([ROAD, WALL, 8, FREE_STATE, 255]))
        for offset in rng.integers(-3, 4, (30, 3)):
            voxels[tuple((middle + offset).tolist())] = state
    return blocks_of(voxels)


@settings(max_examples=25)
@given(
    seed=st.integers(0, 10_000),
    yaw=st.floats(0.1, 6.0),
    reach=st.sampled_from([0.5, 1.3, 4.0, 10.0]),
    shift=st.tuples(*[st.floats(-12, 12)] * 3),
)
def test_it_equals_the_slow_one(
    seed: int, yaw: float, reach: float, shift: tuple[float, float, float]
) -> None:
    blocks = random_map(seed)
    occupied = random_map(seed + 1).occupied()
    # no point lies as far from two voxels, which would leave open which of them is closest
    pose = yaw_transform(yaw, np.add(shift, 1e-3))
    slow, _ = tau(occupied, blocks, 1.0, pose, reach)
    assert overlap(overlap_map(blocks, reach), query_voxels(occupied), pose) == slow


@pytest.mark.parametrize("is_full", [False, True])
def test_a_voxel_within_others_is_closest_to_points_in_it(is_full: bool) -> None:
    """Road within a wall: it is not at the border of the observed voxels."""
    voxels = {(x, y, z): WALL for x in range(5) for y in range(5) for z in range(5)}
    target = overlap_map(blocks_of(voxels | {(2, 2, 2): ROAD}), 3.0)
    if is_full:  # the palette has no room for masks, so that every voxel is looked for
        target.palette[2:] = 1 << 30
    road = query_voxels(query((2, 2, 2, ROAD)))
    assert overlap(target, road, shifted(0.4, -0.4, 0.4)) == 1.0
    assert overlap(target, road, shifted(0.6)) == 0.0
    ours, theirs = aligned_pairs(target, road, shifted(0.4))
    np.testing.assert_array_equal(ours, [[2.5, 2.5, 2.5]])
    np.testing.assert_array_equal(theirs, [[2.5, 2.5, 2.5]])


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000), most=st.sampled_from([1, 7, 400]))
def test_the_best_of_many_are_the_best_by_the_slow_one(seed: int, most: int) -> None:
    rng = np.random.default_rng(seed)
    blocks = random_map(seed)
    occupied = random_map(seed + 1).occupied()
    reach = 3.0
    groups = [
        Shifts(
            yaw_transform(yaw, (0, 0, 0))[:3, :3],
            rng.uniform(0.01, 0.99, 3),
            rng.integers(-9, 9, (60, 3)),
        )
        for yaw in (0.3, 1.9, 4.4)
    ]
    slow = []
    for number, group in enumerate(groups):
        for row, whole in enumerate(group.whole):
            pose = np.eye(4)
            pose[:3, :3] = group.rotation
            pose[:3, 3] = group.part + whole
            share, _ = tau(occupied, blocks, 1.0, pose, reach)
            if share >= 0.05:
                slow.append((-share, number, row))
    best = best_overlaps(overlap_map(blocks, reach), query_voxels(occupied), groups, most, 0.05)
    assert [(-f.tau, f.group, f.row) for f in best] == sorted(slow)[:most]


def test_classes_beyond_the_masks_are_refused() -> None:
    with pytest.raises(ValueError, match="below 29"):
        query_voxels(query((0, 0, 0, 40)))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_voxels_that_leave_the_map_do_not_hide_the_others(axis: int) -> None:
    """One of two voxels lies on the road after a shift by 5, the other one 10,000 voxels off."""
    target = overlap_map(blocks_of({(0, 0, 0): ROAD}), 1.0)
    inside = np.zeros(4, int)
    inside[axis] = -5
    far = np.array([0, 0, 0, ROAD])
    far[axis] = 10_000
    shift = np.zeros((1, 3), np.int64)
    shift[0, axis] = 5
    best = best_overlaps(
        target,
        query_voxels(query(tuple(inside.tolist()), tuple(far.tolist()))),
        [Shifts(np.eye(3), np.zeros(3), shift)],
        1,
        0.4,
    )
    assert [ranked.tau for ranked in best] == [0.5]


@settings(max_examples=5)
@given(seed=st.integers(0, 10_000), reach=st.sampled_from([1.3, 4.0, 10.0]))
def test_masks_have_every_class_that_may_be_closest(seed: int, reach: float) -> None:
    blocks = random_map(seed)
    target = overlap_map(blocks, reach)
    low, high = blocks.bounds()
    dense = blocks.dense(low, tuple((high - low).tolist()))
    seen = dense != UNOBSERVED_STATE
    beside = np.pad(~seen, 1, constant_values=True)
    border = seen & np.logical_or.reduce(
        [np.roll(beside, step, axis)[1:-1, 1:-1, 1:-1] for axis in range(3) for step in (1, -1)]
    )
    place = np.argwhere(border) + low
    bits = bits_of(dense[border])
    corner = np.sqrt(0.75)  # a point of a cell is at most as far from its middle
    rng = np.random.default_rng(seed)
    for cell in rng.integers(low - 12, high + 12, (200, 3)):
        away = np.linalg.norm(place - cell, axis=1)
        may_be = (away <= away.min() + 2 * corner + 1e-6) & (away <= reach + corner)
        expected = np.bitwise_or.reduce(bits[may_be], initial=np.uint32(0))
        if away.min() + corner >= reach:
            expected |= NOT_ALIGNED
        inside = tuple((cell - low).tolist())
        if min(inside) >= 0 and (inside < high - low).all() and seen[inside]:
            expected = bits_of(dense[inside])
        assert mask_of_cell(target, tuple(cell.tolist())) == expected


def bits_of(state: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """The bits of voxel states."""
    is_free = state == FREE_STATE
    return np.where(is_free, NOT_ALIGNED, class_bit(np.where(is_free, ROAD, state)))
