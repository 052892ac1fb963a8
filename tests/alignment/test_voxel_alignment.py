from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from semloc_logs.alignment import refine as refine_module
from semloc_logs.alignment import search as search_module
from semloc_logs.alignment.hypotheses import Hypothesis, pose_matrix, same_place, yaw_between
from semloc_logs.alignment.icp import Fit, Step, Weighting, align
from semloc_logs.alignment.mask_grid import (
    ANY_BIT,
    FREE_BIT,
    MaskGrid,
    build_mask_grid,
    class_bits,
    look_up,
)
from semloc_logs.alignment.query_map import Evidence, Query, structure_mask
from semloc_logs.alignment.refine import coarse_fit, escaped, fine_fit, measured
from semloc_logs.alignment.scores import (
    MutualScores,
    Scores,
    alignment_score,
    mutual_shares,
    reverse_scores,
    structure_scores,
)
from semloc_logs.alignment.search import Candidate, search, search_hypotheses
from semloc_logs.alignment.surface import thin_points
from semloc_logs.alignment.target_map import PLANE_NOISE, UNCERTAIN_RADII, Target
from semloc_logs.alignment.tau import tau
from semloc_logs.labels.space import UNLABELLED, cityscapes
from semloc_logs.numerics.transforms import apply, exp_se3, inverse, yaw_transform
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE, BlockMap, empty_map
from semloc_logs.voxels.keys import BLOCK, pack

V = 0.5
U8 = NDArray[np.uint8]
F64 = NDArray[np.float64]
Cell = tuple[int, ...]
COARSE = cityscapes().coarse


def block_map(cells: dict[Cell, int]) -> BlockMap:
    """A map with these voxel states."""
    blocks: dict[Cell, U8] = {}
    for ijk, value in cells.items():
        block = tuple(c // BLOCK for c in ijk)
        blocks.setdefault(block, np.full((BLOCK,) * 3, UNOBSERVED_STATE, np.uint8))[
            tuple(c % BLOCK for c in ijk)
        ] = value
    if not blocks:
        return empty_map()
    keys = pack(np.array(list(blocks)))
    state = np.stack(list(blocks.values())).reshape(-1, BLOCK**3)[np.argsort(keys)]
    occupied = (state != FREE_STATE) & (state != UNOBSERVED_STATE)
    nothing = np.zeros(0, np.int64)
    return BlockMap(
        np.sort(keys), np.where(occupied, 20, -20).astype(np.int8), state, nothing, nothing
    )


def mask_grid_of(blocks: BlockMap) -> MaskGrid:
    return build_mask_grid(blocks, blocks.occupied(), V, COARSE)


def random_cells(seed: int, n: int = 120, low: int = -9, high: int = 11) -> dict[Cell, int]:
    rng = np.random.default_rng(seed)
    states = np.array([0, 2, 2, 5, 8, 13, 255, 254, 254, 254])
    return {tuple(c): int(rng.choice(states)) for c in rng.integers(low, high, (n, 3)).tolist()}


def occupied(state: int) -> bool:
    return state not in (FREE_STATE, UNOBSERVED_STATE)


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


def slow_tau(
    query: dict[Cell, int],
    target: dict[Cell, int],
    T: NDArray[np.float64],
    kappa: float,
    coarse: bool,
) -> tuple[float, int]:
    """Each occupied query voxel against all observed target voxels."""
    observed = np.array([c for c, s in target.items() if s != UNOBSERVED_STATE], float).reshape(
        -1, 3
    )
    states = [s for s in target.values() if s != UNOBSERVED_STATE]
    aligned = total = 0
    for ijk, state in query.items():
        if not occupied(state):
            continue
        total += 1
        p = T[:3, :3] @ ((np.array(ijk) + 0.5) * V) + T[:3, 3]
        if not len(observed):
            continue
        distance = np.linalg.norm((observed + 0.5) * V - p, axis=1)
        n = int(np.argmin(distance))
        same = COARSE[states[n]] == COARSE[state] if coarse else states[n] == state
        aligned += distance[n] < kappa and occupied(states[n]) and bool(same)
    return aligned / total, aligned


@given(
    st.integers(0, 10_000),
    st.floats(-3.2, 3.2),
    st.tuples(*[st.floats(-4, 4)] * 3),
    st.booleans(),
    st.sampled_from([0.7, 1.5, 5.0]),
)
@settings(max_examples=40, deadline=None)
def test_tau_is_that_of_brute_force(
    seed: int, yaw: float, t: tuple[float, float, float], coarse: bool, kappa: float
) -> None:
    query = random_cells(seed, 40)
    target = random_cells(seed + 1, 300)
    T = yaw_transform(yaw, (t[0] + 1e-7, t[1] + 1e-7, t[2] + 1e-7)) @ exp_se3(
        np.zeros(3), np.array([0.03, -0.02, 0.0])
    )
    ratio = tau(
        block_map(query).occupied(), block_map(target), V, T, kappa, COARSE if coarse else None
    )
    assert ratio == pytest.approx(slow_tau(query, target, T, kappa, coarse))


def test_tau_of_a_map_with_itself_and_with_nothing() -> None:
    cells = random_cells(3)
    blocks = block_map(cells)
    n = sum(occupied(s) for s in cells.values())
    assert tau(blocks.occupied(), blocks, V, np.eye(4), 3.0) == (1.0, n)
    shifted = block_map(
        {tuple((np.array(c) + np.array([3, -40, 7])).tolist()): s for c, s in cells.items()}
    )
    assert tau(blocks.occupied(), shifted, V, yaw_transform(0.0, (3 * V, -40 * V, 7 * V)), 3.0) == (
        1.0,
        n,
    )
    for query, target in (
        (empty_map(), blocks),
        (blocks, empty_map()),
        (block_map({(0, 0, 0): 254}), blocks),
    ):
        assert tau(query.occupied(), target, V, np.eye(4), 3.0) == (0.0, 0)
    assert tau(blocks.occupied(), blocks, V, yaw_transform(0.0, (1e5, 0.0, 0.0)), 3.0) == (0.0, 0)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(("first", "step"), [(BLOCK, -1), (BLOCK - 1, 1)])
def test_tau_looks_into_a_map_whose_blocks_begin_within_kappa(
    axis: int, first: int, step: int
) -> None:
    """Five cells of 0.5 m away is within 3 m, six are not; the query lies beside the block."""
    target = np.zeros(3, int)
    target[axis] = first
    for cells, share in ((5, 1.0), (6, 0.0)):
        query = target.copy()
        query[axis] += cells * step
        maps = [block_map({tuple(ijk.tolist()): 2}) for ijk in (query, target)]
        assert tau(maps[0].occupied(), maps[1], V, np.eye(4), 3.0)[0] == share


def test_free_space_counts_against_an_alignment_in_tau() -> None:
    """The closest observed voxel decides, not some occupied one within kappa."""
    query = block_map({(0, 0, 0): 2})
    assert tau(query.occupied(), block_map({(2, 0, 0): 2}), V, np.eye(4), 3.0)[0] == 1
    assert (
        tau(query.occupied(), block_map({(2, 0, 0): 2, (0, 0, 1): 254}), V, np.eye(4), 3.0)[0] == 0
    )
    assert tau(query.occupied(), block_map({(2, 0, 0): 3}), V, np.eye(4), 3.0)[0] == 0
    # building and wall are construction
    assert tau(query.occupied(), block_map({(2, 0, 0): 3}), V, np.eye(4), 3.0, COARSE)[0] == 1
    # at kappa, not below it
    assert tau(query.occupied(), block_map({(6, 0, 0): 2}), V, np.eye(4), 3.0)[0] == 0


def town(seed: int = 0) -> dict[Cell, int]:
    """Ground, fronts, a pole, a bush: no symmetry."""
    cells: dict[Cell, int] = {}
    for x in range(-30, 31):
        for y in range(-30, 31):
            cells[(x, y, -4)] = 0 if abs(y) < 8 else 1
    for z in range(-3, 9):
        for x in range(-28, 12):
            cells[(x, 12, z)] = 2
        for y in range(-25, -10):
            cells[(17, y, z)] = 2
        cells[(6, -9, z)] = 5
        cells[(-14, -11, z)] = 5
        for x in range(-9, -1):
            cells[(x, -16 + x, z)] = 8
    return cells


def points_of(cells: dict[Cell, int]) -> NDArray[np.float64]:
    return (np.array([c for c, s in cells.items() if occupied(s)]) + 0.5) * V


def moved(cells: dict[Cell, int], T: NDArray[np.float64]) -> dict[Cell, int]:
    """The map seen from the query's frame: voxel centres by inverse(T), dense enough by two samples
    an axis.
    """
    out: dict[Cell, int] = {}
    back = inverse(T)
    for d in np.ndindex(2, 2, 2):
        centres = (np.array(list(cells)) + 0.25 + 0.5 * np.array(d)) * V
        for p, s in zip(apply(back, centres), cells.values(), strict=True):
            out[tuple(np.floor(p / V).astype(int).tolist())] = s
    return out


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.4])
def test_a_search_finds_the_transform_that_was_put_in(yaw: float) -> None:
    truth = yaw_transform(yaw, (3.3, -2.1, 0.4))
    target = Target(block_map(town()), V)
    query_cells = moved(town(), truth)
    query = Query(block_map(query_cells), points_of(query_cells), V)
    start = np.array([yaw + 0.12, 3.3 + 1.1, -2.1 - 0.9, 0.4 + 0.4])
    score, pose = search(target.mask_grid, query.evidence, start, (-0.12, 0.0, 0.12), 2)
    score, pose = search(
        target.mask_grid, query.evidence, pose, np.linspace(-0.1, 0.1, 9).tolist(), 1
    )
    assert score > 0.9
    target_T_query = pose_matrix(pose)
    assert np.linalg.norm(target_T_query[:3, 3] - truth[:3, 3]) < 2.5 * V
    assert yaw_between(target_T_query, truth) < np.radians(5)
    beside, _ = search(
        target.mask_grid, query.evidence, start + np.array([0.5, 6, 6, 2]), (0.0,), 1
    )
    assert beside < 0.7 * score

    wrong = [Hypothesis(0, (yaw + 1.2 * k, 9.0 - k, 6.0 * k, 0.0), 3, 1.0) for k in (1, 2, 3)]
    right = Hypothesis(0, (yaw + 0.15, 4.2, -3.0, 0.5), 2, 0.5)
    candidates = search_hypotheses([*wrong, right], {0: target}, query, 18, 24)
    best = candidates[0]
    assert same_place(best.target_T_query, truth, V)
    assert best.votes == 2
    assert candidates[0].score == max(c.score for c in candidates)
    assert len(candidates) <= 24
    twice = search_hypotheses([right, right], {0: target}, query, 18, 24)
    assert len(twice) == 1  # hypotheses at the same pose are merged
    away = Hypothesis(0, (yaw, 60.0, 0.0, 0.0), 3, 1.0)
    assert search_hypotheses([away], {0: target}, query, 18, 24) == []  # too bad to be fitted


def test_a_candidate_that_both_sides_hold_for_right_is_kept_though_few_voxels_overlap(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Poses at 0 to 5 m, best first by the search. At 4 m a tenth of the voxels is in observed
    space, and none of them contradicts; elsewhere a third of many does.
    """
    far = Scores(5000, 500, 450, 0)
    contradicted = Scores(5000, 4000, 2000, 1300)

    def scores(query: object, target: object, pose: np.ndarray) -> MutualScores:
        return (
            MutualScores(far, far)
            if pose[0, 3] == 4.0
            else MutualScores(contradicted, contradicted)
        )

    monkeypatch.setattr(search_module, "mutual_scores", scores)
    rows = [Candidate(0, yaw_transform(0.0, (x, 0, 0)), 0.9 - 0.1 * x, 3) for x in np.arange(6.0)]
    target = Target(block_map(town()), V)
    query = Query(block_map(town()), points_of(town()), V)
    chosen = search_module._chosen(rows, {0: target}, query, 4)
    assert [c.target_T_query[0, 3] for c in chosen] == [0.0, 1.0, 4.0, 2.0]
    assert search_module._chosen(rows[:1], {0: target}, query, 4) == rows[:1]
    assert search_module._chosen(rows, {0: target}, query, 1) == rows[:1]

    poor = [replace(c, score=0.1) for c in rows]
    chosen = search_module._chosen(poor, {0: target}, query, 4)
    assert chosen[2] == poor[4], "the search hardly saw it, but nothing contradicts it"
    assert search_module._chosen(poor[:4], {0: target}, query, 4) == []


def evidence_of(cells: dict[Cell, int], structure: int) -> Evidence:
    """The first ``structure`` of these voxels are structure, the rest ground."""
    states = np.array(list(cells.values()), np.uint8)
    return Evidence(
        (np.array(list(cells)) + 0.5) * V,
        class_bits(states, COARSE) & np.uint8(ANY_BIT - 1),
        structure,
    )


def test_what_lies_in_free_space_is_subtracted_from_a_search_score() -> None:
    """Of four voxels of a wall two lie on one, one in free space and one where nothing was
    observed: a quarter of the structure's share, which is three quarters; of two voxels of ground
    one lies on ground and one in free space.
    """
    target: dict[Cell, int] = {
        (0, 0, 0): 2,
        (12, 0, 0): 2,
        (20, 0, 0): 254,
        (40, 0, 0): 0,
        (60, 0, 0): 254,
    }
    grid = mask_grid_of(block_map(target))
    cells: dict[Cell, int] = {
        (0, 0, 0): 2,
        (12, 0, 0): 2,
        (20, 0, 0): 2,
        (30, 0, 0): 2,
        (40, 0, 0): 0,
        (60, 0, 0): 0,
    }
    value, pose = search(grid, evidence_of(cells, 4), np.zeros(4), (0.0,), 1)
    # one cell aside: free cells are left, walls are not
    assert value == pytest.approx(0.75 * (2 - 0) / 4 + 0.25 * 1 / 2, abs=1e-5)
    assert abs(pose[1:]).max() == V
    free = {(20 + x, y, z): 254 for x in range(-3, 4) for y in range(-3, 4) for z in range(-3, 4)}
    free |= {(60 + x, y, z): 254 for x in range(-3, 4) for y in range(-3, 4) for z in range(-3, 4)}
    value, pose = search(
        mask_grid_of(block_map(target | free)),
        evidence_of(cells, 4),
        np.zeros(4),
        (0.0,),
        1,
    )
    assert value == pytest.approx(0.75 * (2 - 1) / 4 + 0.25 * (1 - 1) / 2, abs=1e-5)
    assert not pose.any()


@given(st.integers(0, 10_000), st.sampled_from([1, 2]))
@settings(max_examples=8, deadline=None)
def test_a_search_finds_the_best_of_all_its_poses(seed: int, step: int) -> None:
    """Every turn and shift that is tried, one by one, by look-ups of turned and moved voxels."""
    rng = np.random.default_rng(seed)
    grid = mask_grid_of(block_map(random_cells(seed, 500)))
    e = evidence_of({c: s for c, s in random_cells(seed + 1, 30, -6, 7).items() if occupied(s)}, 8)
    start = np.r_[rng.uniform(-3, 3), rng.uniform(-0.5, 0.5, 3)]
    yaws = (-0.2, 0.0, 0.3)

    def value(pose: NDArray[np.float64]) -> float:
        mask = look_up(grid, apply(pose_matrix(pose), e.centres))
        hit = ((mask & e.bits) != 0).astype(int) - (mask == FREE_BIT)
        return float(0.75 * hit[:8].mean() + 0.25 * hit[8:].mean())

    sides = [step * V * np.arange(-n, n + 1) for n in (2, 2, 1)]
    poses = [
        start + np.array([yaw, x, y, z])
        for yaw in yaws
        for x in sides[0]
        for y in sides[1]
        for z in sides[2]
    ]
    best, pose = search(grid, e, start, yaws, step)
    # of equals the nearest: 1e-6 a cell
    assert best == pytest.approx(max(map(value, poses)), abs=2e-5)
    assert value(pose) == pytest.approx(best, abs=2e-5)
    assert np.abs(np.array(poses) - pose).max(1).min() < 1e-9


def test_of_equally_good_poses_the_one_nearest_the_start_is_taken() -> None:
    """A wall along x holds nothing along it: the search stays where it began, and takes the least
    turn.
    """
    grid = mask_grid_of(block_map({(x, 0, z): 2 for x in range(-40, 40) for z in range(10)}))
    cells: dict[Cell, int] = {(x, 0, z): 2 for x in range(-3, 4) for z in range(3, 6)}
    start = np.array([0.0, 0.3, 0.1, 0.2])
    _, pose = search(grid, evidence_of(cells, len(cells)), start, (0.02, -0.01, 0.0, 0.01), 2)
    np.testing.assert_array_equal(pose, start)


def test_structure_scores_by_hand() -> None:
    target = Target(block_map({(0, 0, 0): 2, (0, 0, 1): 254, (4, 0, 0): 254, (8, 0, 0): 8}), V)
    query_cells: dict[Cell, int] = {
        (0, 0, 0): 2,  # on its class
        (1, 0, 0): 2,  # beside it
        (4, 0, 0): 5,  # in free space
        (8, 0, 0): 2,  # on another class
        (12, 0, 0): 2,  # where nothing was observed
        (0, 0, 1): 2,  # in free space, but beside its class
        (0, 1, 0): 0,  # ground and cars do not count as structure
        (0, 1, 1): 13,
    }
    query = Query(block_map(query_cells), points_of(query_cells), V)
    assert structure_scores(query, target, np.eye(4)) == (6, 5, 3, 1)
    bare = Query(block_map({(0, 0, 0): 0}), np.zeros((1, 3)), V)
    assert structure_scores(bare, target, np.eye(4)) == (0, 0, 0, 0)
    assert structure_mask(np.array([0, 1, 9, 2, 5, 8, 13, 255], np.uint8)).tolist() == [
        False,
        False,
        False,
        True,
        True,
        True,
        False,
        True,
    ]


def test_reverse_scores_are_of_the_targets_structure_on_the_querys_map() -> None:
    """The query lies three voxels along the target's x: roles are exchanged, the pose inverted."""
    query = Query(block_map({(0, 0, 0): 2, (0, 0, 1): 254, (4, 0, 0): 254}), np.zeros((1, 3)), V)
    target = Target(block_map({(3, 0, 0): 2, (7, 0, 0): 5, (20, 0, 0): 8}), V)
    moved = np.eye(4)
    moved[0, 3] = 3 * V
    assert reverse_scores(query, target, moved) == (3, 2, 1, 1)
    assert reverse_scores(query, target, np.eye(4)) != (3, 2, 1, 1)


def test_shares_of_both_sides_by_hand() -> None:
    """150 voxels are added to each, half of them aligned and a fifth in free space."""
    good = Scores(2000, 850, 725, 20)  # 800 and 50 of 1000
    bad = Scores(3000, 850, 425, 370)  # 500 and 400 of 1000
    aligned, free = mutual_shares(good, bad)
    assert aligned == pytest.approx((0.5**2 * 0.8) ** (1 / 3))
    assert free == pytest.approx((0.4**2 * 0.05) ** (1 / 3))
    assert mutual_shares(bad, good) == (aligned, free)
    assert MutualScores(good, bad).score == pytest.approx(aligned - free)
    nothing = Scores(0, 0, 0, 0)
    assert mutual_shares(nothing, nothing) == pytest.approx((0.5, 0.2))


def test_scores_of_alignments_by_hand() -> None:
    """Below a coverage of a half the structure counts less in proportion; what contradicts free
    space is taken off in full.
    """
    assert float(alignment_score(0.8, 0.25, 0.1)) == pytest.approx(0.8 * 0.5 - 0.1)
    assert float(alignment_score(0.8, 0.5, 0.1)) == pytest.approx(0.7)
    assert float(alignment_score(0.8, 0.9, 0.1)) == pytest.approx(0.7)
    scores = Scores(100, 25, 20, 10)
    assert (scores.structure, scores.coverage, scores.contradiction) == (0.8, 0.25, 0.1)
    assert scores.score == pytest.approx(0.3)
    np.testing.assert_allclose(
        alignment_score(np.array([1.0, 0.5]), np.array([0.1, 1.0]), np.array([0.0, 0.25])),
        [0.2, 0.25],
    )


def test_some_of_the_evidence_is_three_quarters_structure() -> None:
    cells: dict[Cell, int] = {(x, 0, 0): 2 for x in range(40)}
    cells.update({(x, 5, 0): 0 for x in range(20)})
    e = evidence_of(cells, 40)
    some = e.first(16)
    assert (some.structure, len(some.bits)) == (12, 16)
    np.testing.assert_array_equal(some.centres[:, 1] == 0.5 * V, [True] * 12 + [False] * 4)
    every = e.first(1000)
    assert (every.structure, len(every.bits)) == (40, 60)


def test_of_a_cell_the_most_certain_point_stays() -> None:
    points = np.array(
        [[0.1, 0.1, 0.1], [0.2, 0.1, 0.1], [0.3, 0.1, 0.1], [1.1, 0.1, 0.1], [1.2, 0.1, 0.1]]
    )
    assert sorted(thin_points(points, 0.5, np.zeros((5, 3))).tolist()) == [0, 3]
    spread = np.array(
        [[0.3, 0.0, 0.0], [0.0, 0.1, 0.1], [0.0, 0.0, 0.2], [0.2, 0.0, 0.0], [0.0, 0.2, 0.0]]
    )
    assert sorted(thin_points(points, 0.5, spread).tolist()) == [1, 3]


@pytest.mark.parametrize("degrees", [0, 90, 180, 270])
def test_an_alignment_is_measured_as_it_is(degrees: int) -> None:
    """Planes of the town under the true transform: nearly all points lie on them, and every third
    point stands for three.
    """
    truth = yaw_transform(np.radians(degrees), (3.0, -2.0, 0.5))
    target = Target(block_map(town()), V)
    points = points_of(town())
    query = Query(block_map(moved(town(), truth)), apply(inverse(truth), points), V)
    fit = measured(truth, target.surface, query)
    np.testing.assert_array_equal(fit.target_T_query, truth)
    assert fit.inliers > 0.99
    assert fit.rmse < 0.1 * V
    assert fit.count == pytest.approx(len(points[::3]), rel=0.01)
    whole = align(query.points, target.surface, truth, (Step(0.4 * V, 0, 1),))
    np.testing.assert_allclose(
        fit.information[:3, :3],
        whole.information[:3, :3],
        rtol=0.05,
        atol=0.02 * whole.information[:3, :3].max(),
    )
    beside = measured(
        yaw_transform(np.radians(degrees), (3.0, -2.0, 0.5 + 0.3)), target.surface, query
    )
    assert beside.inliers < 0.9


@pytest.mark.parametrize("degrees", [0, 90, 180, 270])
def test_a_coarse_fit_leaves_a_place_that_looks_alike(degrees: int) -> None:
    """A fit two voxels beside the truth gets away, one at the truth stays; a fine fit of a coarse
    one is at the truth to a tenth of a voxel.
    """
    truth = yaw_transform(np.radians(degrees), (3.0, -2.0, 0.5))
    target = Target(block_map(town()), V)
    query = Query(block_map(moved(town(), truth)), apply(inverse(truth), points_of(town())), V)
    candidate = Candidate(0, yaw_transform(0.02, (0.8 * V, -0.6 * V, 0.3 * V)) @ truth, 1.0, 10)
    right = coarse_fit(candidate, target, query)
    assert np.linalg.norm(right.target_T_query[:3, 3] - truth[:3, 3]) < 0.2 * V
    assert escaped(right, candidate, target, query, 20) is right

    beside = yaw_transform(0.0, (2 * V, -2 * V, 0.0)) @ truth
    wrong = measured(beside, target.surface, query)
    escaped_fit = escaped(wrong, candidate, target, query, 20)
    assert np.linalg.norm(escaped_fit.target_T_query[:3, 3] - truth[:3, 3]) < 0.2 * V
    fine = fine_fit(right.target_T_query, target.surface, query)
    assert np.linalg.norm(fine.target_T_query[:3, 3] - truth[:3, 3]) < 0.1 * V
    assert fine.count == len(query.points)  # the last step takes all of them


def fit_at(x: float) -> Fit:
    T = yaw_transform(0.0, (x, 0.0, 0.0))
    return Fit(T, 1.0, 100, 0.1, np.eye(6), np.zeros(3), np.zeros((2, 6)))


@pytest.mark.parametrize(
    ("of_target", "of_query", "uncertain"),
    [(0.2, 0.2, False), (0.3, 0.2, True), (0.2, 0.3, True)],
)
def test_a_fine_fit_looks_farther_and_is_held_where_either_side_is_uncertain(
    of_target: float, of_query: float, uncertain: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By more than a quarter of a voxel. Of 12 000 points every second one is taken, at last."""
    asked: list[object] = []

    def align(points: object, surface: object, start: object, *how: object) -> Fit:
        asked.extend([how[0], how[2]])
        return fit_at(0.0)

    monkeypatch.setattr(refine_module, "align", align)
    monkeypatch.setattr(refine_module, "ground_bias", lambda *_: np.ones((3, 6)))
    surface = SimpleNamespace(sigma=of_target * V)
    query = SimpleNamespace(
        points=np.zeros((12_000, 3)), spread=None, sigma=of_query * V, voxel_size=V
    )
    fit = fine_fit(np.eye(4), cast(Any, surface), cast(Any, query))
    if uncertain:
        steps = (Step(3.0 * V, 10, 6), Step(2.0 * V, 20, 4), Step(2.0 * V, 1, 2))
        assert asked == [steps, Weighting(PLANE_NOISE * V, 10.0)]
        assert not fit.ground_bias.any()
    else:
        steps = (Step(0.7 * V, 6, 6), Step(0.4 * V, 10, 4), Step(0.4 * V, 1, 2))
        assert asked == [steps, Weighting(PLANE_NOISE * V, 0.0)]
        assert fit.ground_bias.all()


@pytest.mark.parametrize(
    ("voxels", "score", "leaves"),
    [(1.1, 0.6, True), (0.9, 0.6, False), (1.1, 0.5, False)],
)
def test_a_coarse_fit_is_left_for_a_start_a_voxel_away_that_scores_higher(
    voxels: float, score: float, leaves: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of 0.5. Of 18 headings, 0.6 of half of 20 degrees to either side are tried."""
    turns = []

    def search(
        grid: object, evidence: object, pose: F64, yaws: F64, step: int
    ) -> tuple[float, F64]:
        turns.append(np.degrees(yaws))
        return 1.0, pose + np.array([0.0, voxels * V, 0.0, 0.0])

    monkeypatch.setattr(refine_module, "search", search)
    monkeypatch.setattr(
        refine_module, "coarse_fit", lambda candidate, *_: fit_at(candidate.target_T_query[0, 3])
    )
    monkeypatch.setattr(
        refine_module,
        "structure_scores",
        lambda query, target, T: SimpleNamespace(score=score if T[0, 3] > 2.0 else 0.5),
    )
    query = cast(Any, SimpleNamespace(voxel_size=V, evidence=None))
    fit = fit_at(2.0)
    candidate = Candidate(0, np.eye(4), 1.0, 10)
    escaped_fit = escaped(fit, candidate, cast(Any, SimpleNamespace(mask_grid=None)), query, 18)
    np.testing.assert_allclose(turns, [[-6.0, -3.0, 0.0, 3.0, 6.0]], atol=1e-12)
    assert escaped_fit.target_T_query[0, 3] == pytest.approx(2.0 + voxels * V if leaves else 2.0)
    assert (escaped_fit is fit) != leaves


def test_an_alignment_of_uncertain_points_is_measured_by_their_radius() -> None:
    """Every third point, out to two voxels, stands for three: also where ranges may all be off."""
    target = Target(block_map(town()), V)
    points = points_of(town())
    spread = 0.8 * V * points / np.linalg.norm(points, axis=1, keepdims=True)
    query = Query(block_map(town()), points, V, spread)
    beside = yaw_transform(0.0, (0.0, 0.0, 1.5 * V))
    fit = measured(beside, target.surface, query)
    step = Step(UNCERTAIN_RADII[1] * V, 0, 1)
    whole = align(points, target.surface, beside, (step,), spread, Weighting(PLANE_NOISE * V))
    assert fit.inliers == pytest.approx(whole.inliers, abs=0.02)
    assert np.abs(whole.range_bias).max() > 0
    np.testing.assert_allclose(
        fit.range_bias, whole.range_bias, atol=0.1 * np.abs(whole.range_bias).max()
    )


def test_evidence_of_unlabelled_voxels_asks_for_anything_occupied() -> None:
    query = Query(block_map({(0, 0, 0): UNLABELLED, (3, 0, 0): 2}), np.zeros((1, 3)), V)
    bits = dict(
        zip(map(tuple, query.evidence.centres.tolist()), query.evidence.bits.tolist(), strict=True)
    )
    assert bits == {(0.25, 0.25, 0.25): ANY_BIT, (1.75, 0.25, 0.25): 2}


def test_the_same_place() -> None:
    a = yaw_transform(1.0, (2.0, 3.0, 0.0))
    assert same_place(a, yaw_transform(1.0 + np.radians(4), (2.0 + 3 * V, 3.0, 0.0)), V)
    assert not same_place(a, yaw_transform(1.0, (2.0 + 3.5 * V, 3.0, 0.0)), V)
    assert not same_place(a, yaw_transform(1.0 - np.radians(6), (2.0, 3.0, 0.0)), V)
    # 100 m of road between them: 1 m and 2 degrees more
    driven = yaw_transform(1.0 + np.radians(6), (2.0 + 3.5 * V, 3.0, 0.0))
    assert not same_place(a, driven, V)
    assert same_place(a, driven, V, 100.0)
    assert not same_place(a, yaw_transform(1.0, (2.0 + 3.5 * V + 1.0, 3.0, 0.0)), V, 100.0)
    assert yaw_between(yaw_transform(3.1), yaw_transform(-3.1)) == pytest.approx(2 * np.pi - 6.2)
