"""The overlap ratio of the paper: against slow loops, and at borders."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from semloc_logs.alignment.tau import tau
from semloc_logs.numerics.transforms import exp_se3, yaw_transform
from semloc_logs.voxels.grid import UNOBSERVED_STATE, empty_map
from semloc_logs.voxels.keys import BLOCK
from tests.alignment.voxel_maps import COARSE, Cell, V, block_map, occupied, random_cells


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
@settings(max_examples=40)
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
