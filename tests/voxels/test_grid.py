from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from semloc_logs.labels.space import UNLABELLED
from semloc_logs.settings import Fusion, ResolvedFusion, Settings
from semloc_logs.voxels.carve import Carver
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE, BlockMap, Fuser
from semloc_logs.voxels.keys import BLOCK, pack

Cell = tuple[int, ...]
Walk = Callable[..., NDArray[np.uint8]]
Frame = tuple[NDArray[np.float64], NDArray[np.uint8], NDArray[np.float64]]


def fusion(voxel: float = 0.5, reach: float = 6.0, **more: Any) -> ResolvedFusion:
    return Settings(fusion=Fusion(voxel_size=voxel, max_range=reach, **more)).resolved().fusion


def fused(frames: list[Frame], f: ResolvedFusion) -> BlockMap:
    fuser = Fuser(f)
    for points, label, origin in frames:
        fuser.add(points, label, origin)
    return fuser.finish()


def as_dictionary(blocks: BlockMap) -> dict[Cell, tuple[int, int, int]]:
    """Observed voxel -> (log-odds in 1/20, state, hits)."""
    low, high = blocks.bounds()
    out: dict[Cell, tuple[int, int, int]] = {}
    shape = (BLOCK, BLOCK, BLOCK)
    votes: dict[int, int] = defaultdict(int)
    for ballot, count in zip(blocks.ballots.tolist(), blocks.votes.tolist(), strict=True):
        votes[ballot // 256] += count
    for n in range(len(blocks.keys)):
        nothing = np.zeros(0, np.int64)
        one = BlockMap(
            blocks.keys[n : n + 1],
            blocks.log_odds[n : n + 1],
            blocks.state[n : n + 1],
            nothing,
            nothing,
        )
        corner = one.bounds()[0]
        for cell in np.argwhere(one.log_odds.reshape(shape) != -128):
            index = tuple(cell)
            odds, state = (int(a.reshape(shape)[index]) for a in (one.log_odds, one.state))
            hits = votes[n * 4096 + int(np.ravel_multi_index(index, shape))] if odds > 0 else 0
            out[tuple((cell + corner).tolist())] = odds, state, hits
        assert (one.state[one.log_odds == -128] == UNOBSERVED_STATE).all()
    assert len(low) == len(high)
    return out


def slow_reference(
    walk: Walk, frames: list[Frame], f: ResolvedFusion
) -> dict[Cell, tuple[int, int, int]]:
    """A dictionary of voxels; each frame changes a voxel once, hits win over passes, votes are
    counted by point.
    """
    assert f.max_range is not None
    odds: dict[Cell, int] = {}
    votes: dict[Cell, dict[int, int]] = defaultdict(lambda: defaultdict(int))
    for points, label, origin in frames:
        marks: dict[Cell, int] = {}
        carved = set()
        for p, c in zip(points, label, strict=True):
            if not np.isfinite(p).all():
                continue
            ray = p - origin
            distance = float(np.linalg.norm(ray))
            is_in_range = distance <= f.max_range
            if is_in_range:
                votes[tuple(np.floor(p / f.voxel_size).astype(int).tolist())][int(c)] += 1
            end = p if is_in_range else origin + ray * (f.max_range / distance)
            ends_in = (is_in_range, *np.floor(end / f.voxel_size).astype(int).tolist())
            if ends_in in carved:  # one ray for each end voxel
                continue
            carved.add(ends_in)
            base = np.floor(np.minimum(end, origin) / f.voxel_size).astype(int) - 2
            grid = walk(
                origin / f.voxel_size - base,
                (end / f.voxel_size - base)[None],
                [is_in_range],
                (5, 5, 5),
            )
            for cell in np.argwhere(grid):
                key = tuple((cell + base).tolist())
                marks[key] = max(marks.get(key, 0), int(grid[tuple(cell)]))
        for key, mark in marks.items():
            change = round(20 * f.hit) if mark == 2 else -round(20 * f.miss)
            odds[key] = int(
                np.clip(odds.get(key, 0) + change, round(20 * f.clamp[0]), round(20 * f.clamp[1]))
            )
            assert mark in (1, 2)
    out: dict[Cell, tuple[int, int, int]] = {}
    for key, value in odds.items():
        if value <= 0:
            out[key] = (value, FREE_STATE, 0)
            continue
        known = {c: n for c, n in votes[key].items() if c != UNLABELLED}
        label_ = min(known, key=lambda c: (-known[c], c)) if known else UNLABELLED
        out[key] = (value, label_, sum(votes[key].values()))
    return out


def random_frames(seed: int, count: int = 6, points: int = 60) -> list[Frame]:
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(count):
        origin = rng.uniform(-1, 1, 3)
        # few directions and distances, so that voxels are hit by several points and frames, and are
        # passed too
        p = rng.uniform(-5, 5, (points, 3)) * rng.choice([0.3, 1.0, 2.0], (points, 1))
        p[: points // 2] = np.array([4.0, 1.0, 0.2]) + rng.uniform(-0.6, 0.6, (points // 2, 3))
        out.append((p, rng.choice(np.array([4, 2, 8, 255], np.uint8), points), origin))
    return out


@pytest.mark.parametrize("seed", range(4))
def test_fusion_is_what_the_dictionary_says(walk: Walk, seed: int) -> None:
    frames = random_frames(seed)
    f = fusion()
    voxels = as_dictionary(fused(frames, f))
    assert voxels == slow_reference(walk, frames, f)
    # the example has something of everything
    assert {s for _, s, _ in voxels.values()} >= {2, 4, 8, FREE_STATE}


def one_point(
    label: int, count: int = 1, position: tuple[float, float, float] = (3.25, 0.25, 0.25)
) -> Frame:
    return (
        np.tile(np.array(position), (count, 1)),
        np.full(count, label, np.uint8),
        np.array([0.25, 0.25, 0.25]),
    )


def state_at(blocks: BlockMap, cell: Cell) -> int:
    return int(blocks.dense(np.array(cell), (1, 1, 1))[0, 0, 0])


@pytest.mark.parametrize(
    ("labels", "winner"),
    [
        ([2, 8], 2),  # a tie goes to the lower id
        ([8, 2], 2),
        ([2, 8, 8], 8),
        ([255, 255, 255, 8], 8),  # a known class beats any number of unknown ones
        ([255, 255], UNLABELLED),
    ],
)
def test_votes(labels: list[int], winner: int) -> None:
    blocks = fused([one_point(c) for c in labels], fusion())
    assert state_at(blocks, (6, 0, 0)) == winner
    ijk, label = blocks.occupied()
    assert ijk.tolist() == [[6, 0, 0]]
    assert label.tolist() == [winner]
    assert {
        int(b % 256): int(n) for b, n in zip(blocks.ballots, blocks.votes, strict=True)
    } == Counter(labels)
    # 0.85 each, clamped at 3.5
    assert blocks.log_odds[blocks.log_odds > 0].tolist() == [min(70, 17 * len(labels))]


@pytest.mark.parametrize("seed", range(4))
def test_occupied_voxels_are_those_neither_free_nor_unobserved(seed: int) -> None:
    rng = np.random.default_rng(seed)
    usual = rng.choice([UNOBSERVED_STATE, FREE_STATE], (3, BLOCK**3)).astype(np.uint8)
    any_state = rng.integers(0, 256, usual.shape).astype(np.uint8)  # unlabelled among them
    state = np.where(rng.random(usual.shape) < [[0.01], [0.5], [1.0]], any_state, usual)
    coordinates = np.array([[0, 0, 0], [0, 0, 1], [0, 2, -1]])
    nothing = np.zeros(0, np.int64)
    blocks = BlockMap(pack(coordinates), np.zeros(state.shape, np.int8), state, nothing, nothing)

    ijk, label = blocks.occupied()
    expected = [
        (*(BLOCK * coordinates[n] + np.unravel_index(m, (BLOCK,) * 3)), value)
        for n, values in enumerate(state)
        for m, value in enumerate(values)
        if value not in (FREE_STATE, UNOBSERVED_STATE)
    ]
    assert np.c_[ijk, label].tolist() == np.array(expected).tolist()


def test_votes_do_not_overflow() -> None:
    blocks = fused([one_point(2, 70_000)], fusion())
    assert blocks.votes.tolist() == [70_000]


@given(st.permutations(range(6)))
@settings(max_examples=10)
def test_votes_do_not_depend_on_the_order_of_frames(order: list[int]) -> None:
    f = fusion(clamp=(-6.0, 6.0))  # nothing is clamped, so the log-odds add up in any order too
    frames = random_frames(7)
    a = fused(frames, f)
    b = fused([frames[i] for i in order], f)
    for name in ("keys", "log_odds", "state", "ballots", "votes"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_what_drives_away_is_carved_free() -> None:
    car = one_point(13, 5)
    behind = one_point(2, 1, (5.25, 0.25, 0.25))
    assert state_at(fused([car], fusion()), (6, 0, 0)) == 13
    # 2 * 0.85 - 5 * 0.4 < 0
    carved = fused([car, car, behind, behind, behind, behind, behind], fusion())
    assert state_at(carved, (6, 0, 0)) == FREE_STATE
    assert state_at(carved, (10, 0, 0)) == 2
    assert carved.occupied()[0].tolist() == [[10, 0, 0]]


def test_points_beyond_the_range_carve_and_do_not_hit() -> None:
    blocks = fused([one_point(2, 1, (50.0, 0.25, 0.25))], fusion(reach=3.0))
    assert not len(blocks.occupied()[0])
    seen = as_dictionary(blocks)
    assert set(seen) == {(i, 0, 0) for i in range(7)}  # from 0.25 m to 3.25 m
    assert {s for _, s, _ in seen.values()} == {FREE_STATE}


def test_no_frames_and_empty_frames() -> None:
    empty = np.zeros((0, 3)), np.zeros(0, np.uint8), np.zeros(3)
    for frames in ([], [empty]):
        blocks = fused(frames, fusion())
        assert len(blocks.keys) == 0
        assert [len(a) for a in blocks.occupied()] == [0, 0]
        assert (
            blocks.dense(np.zeros(3, int), (2, 2, 2)).tolist()
            == np.full((2, 2, 2), UNOBSERVED_STATE).tolist()
        )
        assert [b.tolist() for b in blocks.bounds()] == [[0, 0, 0], [0, 0, 0]]


def test_points_that_are_not_finite_are_left_out() -> None:
    points, label, origin = random_frames(3)[0]
    bad = np.array([[np.nan, 0, 0], [np.inf, 1, 1], [0, -np.inf, np.nan]])
    f = fusion()
    a = fused([(points, label, origin)], f)
    b = fused(
        [(np.concatenate([bad, points]), np.concatenate([np.full(3, 5, np.uint8), label]), origin)],
        f,
    )
    assert as_dictionary(a) == as_dictionary(b)
    assert not len(fused([(bad, np.full(3, 5, np.uint8), origin)], f).keys)
    assert not len(fused([(points, label, np.array([0, np.nan, 0]))], f).keys)


def test_an_origin_a_rounding_error_below_a_block_border() -> None:
    """-1e-17 lies in block -1 and, taken from that block's corner, on its upper border: no write
    may leave the grid.
    """
    origin = np.array([0.0, 0.0, -1e-17])
    blocks = fused([(np.array([[1.2, 0.2, -0.7]]), np.zeros(1, np.uint8), origin)], fusion())
    seen = as_dictionary(blocks)
    assert seen[(2, 0, -2)][1] == 0
    assert len(seen) <= 6
    ends = fused(
        [(np.array([[1.2, 0.2, -1e-17]]), np.zeros(1, np.uint8), np.array([0.2, 0.2, -0.7]))],
        fusion(),
    )
    assert ends.votes.tolist() == [1]  # the vote lies where the hit does


@pytest.mark.parametrize("far", [(500_000.0, 3_400_000.0, 300.0), (-2_000_000.0, 0.0, 0.0)])
def test_a_map_far_from_the_origin_is_the_same_map(far: tuple[float, float, float]) -> None:
    """Hundreds of kilometres away; whole voxels of shift, so that rounding does not enter."""
    f = fusion(voxel=0.25)
    shift = np.array(far)
    frames = [
        (np.round(p * 64) / 64 + 1 / 128, label, np.round(o * 64) / 64)
        for p, label, o in random_frames(5)
    ]
    voxels = as_dictionary(fused(frames, f))
    moved = as_dictionary(fused([(p + shift, label, o + shift) for p, label, o in frames], f))
    offset = (shift / 0.25).astype(int)
    assert moved == {tuple((np.array(k) + offset).tolist()): v for k, v in voxels.items()}


def test_dense_boxes_overlap_the_map_in_part() -> None:
    blocks = fused(random_frames(1), fusion())
    low, high = blocks.bounds()
    whole = blocks.dense(low, tuple((high - low).tolist()))
    wider = blocks.dense(low - 5, tuple((high - low + 9).tolist()))
    np.testing.assert_array_equal(wider[5:-4, 5:-4, 5:-4], whole)
    wider[5:-4, 5:-4, 5:-4] = UNOBSERVED_STATE
    assert (wider == UNOBSERVED_STATE).all()
    np.testing.assert_array_equal(blocks.dense(low + 7, (3, 20, 4)), whole[7:10, 7:27, 7:11])
    ijk, label = blocks.occupied()
    np.testing.assert_array_equal(whole[tuple((ijk - low).T)], label)
    assert len(ijk) == (whole < FREE_STATE - 1).sum() + (whole == UNLABELLED).sum()


def test_uncertain_ranges_count_less_and_leave_room_before_them() -> None:
    """A point at 5 m known to 1 m, in voxels of 0.5 m: a quarter of a hit, and free up to 3 m only;
    one more certain wins.
    """
    f = fusion(reach=10.0)
    points = np.array([[5.25, 0.25, 0.25]])
    origin = np.array([0.25, 0.25, 0.25])
    fuser = Fuser(f)
    fuser.add(points, np.array([2], np.uint8), origin, np.array([1.0], np.float32))
    blocks = fuser.finish()
    assert blocks.dense(np.array([0, 0, 0]), (11, 1, 1))[:, 0, 0].tolist() == [FREE_STATE] * 6 + [
        UNOBSERVED_STATE
    ] * 4 + [2]
    assert blocks.log_odds.max() == round(20 * f.hit / 4)
    fuser.add(points + np.array([0, 0, 0.1]), np.array([8], np.uint8), origin)
    blocks = fuser.finish()
    assert blocks.log_odds.max() == round(20 * f.hit / 4) + 17
    assert (blocks.dense(np.array([0, 0, 0]), (10, 1, 1)) == FREE_STATE).all()


def test_a_pose_takes_the_points_into_the_map() -> None:
    points, label, origin = random_frames(3, count=1)[0]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], [7.125, -3.5, 0.25]
    moved = Fuser(fusion())
    there = points @ pose[:3, :3].T + pose[:3, 3]
    moved.add(points, label, origin, map_T_points=pose)
    origin_in_map = pose[:3, :3] @ origin + pose[:3, 3]
    assert as_dictionary(moved.finish()) == as_dictionary(
        fused([(there, label, origin_in_map)], fusion())
    )


def test_rays_that_graze_the_ground_do_not_carve_it() -> None:
    """A sensor 1.8 m above a road drives 20 m; rings of rays end on the road up to 40 m away."""
    f = fusion(voxel=0.3, reach=50.0)
    angle, ring = np.meshgrid(np.radians(np.arange(0, 360, 0.5)), np.geomspace(3, 40, 24))

    def frames(label: int) -> list[Frame]:
        out = []
        for x in np.arange(0, 20, 1.0):
            points = np.stack(
                [x + ring * np.cos(angle), ring * np.sin(angle), np.full(ring.shape, 0.1)], -1
            ).reshape(-1, 3)
            out.append((points, np.full(len(points), label, np.uint8), np.array([x, 0.0, 1.9])))
        return out

    def lost(label: int) -> float:
        """Share of the voxels that were hit at the road's level and are not occupied."""
        blocks = fused(frames(label), f)
        hit = np.unique(blocks.ballots // 256)
        return float((blocks.log_odds.reshape(-1)[hit] <= 0).mean())

    assert lost(0) == 0.0
    assert lost(2) > 0.1  # a building's surface need not be level


def test_maps_that_share_a_carved_frame_are_those_that_carve_it_themselves() -> None:
    frames = random_frames(5, count=4)
    f = fusion()
    carver = Carver(f)
    shared = Fuser(f)
    late = Fuser(f)
    for i, frame in enumerate(frames):
        marks = carver.marks(*frame)
        shared.take(marks)
        if i >= 2:
            late.take(marks)
    assert as_dictionary(shared.finish()) == as_dictionary(fused(frames, f))
    assert as_dictionary(late.finish()) == as_dictionary(fused(frames[2:], f))
