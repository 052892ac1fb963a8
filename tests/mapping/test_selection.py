from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semloc_logs.mapping.selection import (
    UNPOSED_SPACING_NS,
    KeyframeSelector,
    road_distance,
    submap_ranges,
    thin,
)
from semloc_logs.numerics.transforms import yaw_transform
from semloc_logs.settings import Fusion, Settings

steps = st.lists(st.floats(0, 60, allow_subnormal=False), min_size=1, max_size=200)


@given(steps, st.floats(0.5, 120), st.sampled_from([0.0, 0.3, 0.5, 0.9]))
def test_submaps_cover_all_keyframes_and_keep_their_length(
    step: list[float], length: float, overlap: float
) -> None:
    distance = np.cumsum(step)
    distance = distance - distance[0]
    ranges = submap_ranges(distance, length, overlap)
    covered = np.zeros(len(distance), bool)
    for first, last in ranges:
        assert 0 <= first < last <= len(distance)
        assert distance[last - 1] - distance[first] <= length * (1 + 1e-6)
        covered[first:last] = True
    assert covered.all()
    assert len(set(ranges)) == len(ranges)
    assert [r[0] for r in ranges] == sorted(r[0] for r in ranges)


def test_submaps_of_a_road_by_hand() -> None:
    distance = np.arange(0.0, 241.0, 10)  # 0 .. 240 m
    # the last one pulled back to full length
    assert submap_ranges(distance, 100, 0.5) == [(0, 11), (5, 16), (10, 21), (14, 25)]
    assert submap_ranges(distance[:8], 100, 0.5) == [(0, 8)]
    assert submap_ranges(np.zeros(0), 100, 0.5) == []
    assert submap_ranges(np.zeros(3), 100, 0.5) == [(0, 3)]


@pytest.mark.parametrize("total", [123.456, 1e3 / 3, 7 * 100.1, 251.1])
def test_the_last_keyframe_is_in_a_submap_in_spite_of_rounding(total: float) -> None:
    for length in np.linspace(1, 99, 57):
        assert submap_ranges(np.array([0.0, total]), float(length), 0.5)[-1][1] == 2


def test_a_jump_in_the_road_leaves_no_empty_submaps() -> None:
    distance = np.r_[np.arange(0, 50.0, 5), 1000 + np.arange(0, 50.0, 5)]
    ranges = submap_ranges(distance, 100, 0.5)
    assert all(last > first for first, last in ranges)
    assert all(distance[last - 1] - distance[first] < 100 for first, last in ranges)


@given(steps, st.floats(0.5, 120), st.sampled_from([0.0, 0.3, 0.5, 0.9]))
def test_submaps_are_those_of_every_stretch_looked_at(
    step: list[float], length: float, overlap: float
) -> None:
    distance = np.cumsum(step) - step[0]
    total = float(distance[-1])
    starts = (
        [0.0]
        if total <= length
        else [*np.arange(0.0, total - length, length * (1 - overlap)), total - length]
    )
    slack = 1e-9 * max(total, 1.0)
    held = [
        (int((distance < s - slack).sum()), int((distance <= s + length + slack).sum()))
        for s in starts
    ]
    assert submap_ranges(distance, length, overlap) == [
        r for r in dict.fromkeys(held) if r[0] < r[1]
    ]


def test_a_road_of_many_submap_lengths_without_keyframes_takes_no_time() -> None:
    assert submap_ranges(np.array([0.0, 1e12, 2e12]), 100.0, 0.25) == [(0, 1), (1, 2), (2, 3)]
    assert submap_ranges(np.array([0.0, 50.0, 2e7]), 100.0, 0.9999999)[:2] == [(0, 2), (1, 2)]


def test_road_distance() -> None:
    poses = np.array([yaw_transform(1.0, (x, y, 0.0)) for x, y in ((0, 0), (3, 4), (3, 4), (3, 0))])
    assert road_distance(poses).tolist() == [0, 5, 5, 9]
    assert road_distance(np.zeros((0, 4, 4))).tolist() == []


def test_thinning_keeps_the_first_point_of_each_cell() -> None:
    points = np.array(
        [
            [0.1, 0.1, 0.1],
            [0.9, 0.9, 0.9],
            [1.1, 0, 0],
            [-0.1, 0, 0],
            [-0.9, 0.5, 0.5],
            [0.5, 0.5, 0.5],
        ],
        np.float32,
    )
    assert thin(points, 1.0).tolist() == [0, 2, 3]
    assert thin(points[::-1], 1.0).tolist() == [0, 1, 3]
    assert thin(points[:0], 1.0).tolist() == []


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_thinning_is_what_a_dictionary_says(seed: int) -> None:
    points = np.random.default_rng(seed).uniform(-3, 3, (200, 3)).astype(np.float32)
    first: dict[tuple[int, ...], int] = {}
    for i, cell in enumerate(np.floor(points / np.float32(0.7)).astype(int).tolist()):
        first.setdefault(tuple(cell), i)
    assert thin(points, 0.7).tolist() == sorted(first.values())


def test_keyframes_by_travel_by_turn_and_by_time() -> None:
    selector = KeyframeSelector(
        Settings(fusion=Fusion(keyframe_distance=1.0, keyframe_angle=0.2)).resolved().fusion
    )
    track = [
        (0.0, 0.0),
        (0.5, 0.0),
        (0.99, 0.0),
        (1.01, 0.0),
        (1.5, 0.1),
        (1.5, 0.21),
        (2.4, 0.3),
        (2.6, 0.3),
    ]
    chosen = [
        selector.wants("/a", i, yaw_transform(yaw, (x, 0.0, 0.0)))
        for i, (x, yaw) in enumerate(track)
    ]
    assert chosen == [True, False, False, True, False, True, False, True]
    # each stream has its own last keyframe
    assert selector.wants("/b", 100, yaw_transform(0.3, (2.6, 0.0, 0.0)))
    unposed = KeyframeSelector(Settings(fusion=Fusion(keyframe_distance=1.0)).resolved().fusion)
    times = [0, UNPOSED_SPACING_NS - 1, UNPOSED_SPACING_NS, UNPOSED_SPACING_NS + 5]
    assert [unposed.wants("/a", t, None) for t in times] == [True, False, True, False]
