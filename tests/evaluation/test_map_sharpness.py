"""How sharp maps are: planes that are put in, apart by a known distance."""

from __future__ import annotations

import numpy as np
import pytest

from semloc_logs.arrays import F64
from semloc_logs.evaluation.map_sharpness import plane_figures, rigidly_at
from semloc_logs.numerics.transforms import exp_se3


def wall(x: float, seed: int) -> F64:
    """Points (n, 3) of a wall of 4 x 4 m across x."""
    rng = np.random.default_rng(seed)
    return np.column_stack([np.full(4000, x), rng.uniform(0, 4, (4000, 2))])


@pytest.mark.parametrize("apart", [0.0, 0.1])
def test_two_walls_are_as_thick_as_they_are_apart(apart: float) -> None:
    """Half of the points on either side of the middle: a standard deviation of half of it."""
    cells, thickness = plane_figures([wall(0.4, 1), wall(0.4 + apart, 2)], 1.0)
    assert cells == 16
    assert len(thickness) == 16
    np.testing.assert_allclose(thickness, apart / 2, atol=2e-3)


def test_walls_far_apart_are_not_a_plane() -> None:
    """0.4 m apart within a cell of 1 m: thicker than a third of the width."""
    cells, thickness = plane_figures([wall(0.3, 1), wall(0.7, 2)], 1.0)
    assert (cells, len(thickness)) == (16, 0)


def test_cells_of_one_map_alone_and_of_few_points_tell_nothing() -> None:
    far = wall(0.4, 1) + np.array([0.0, 10.0, 0.0])
    few = wall(0.4, 2)[::400]
    assert plane_figures([wall(0.4, 1), far], 1.0)[0] == 0
    assert plane_figures([few, few], 1.0)[0] == 0
    assert plane_figures([few[:0], few[:0]], 1.0)[0] == 0


def test_a_session_is_laid_as_a_whole_where_its_optimised_poses_are() -> None:
    """Exactly, where these are the same drive elsewhere; else in the mean."""
    rng = np.random.default_rng(3)
    poses = [np.eye(4)]
    for _ in range(20):
        poses.append(poses[-1] @ exp_se3(rng.normal(0, 1, 3), rng.normal(0, 0.2, 3)))
    drive = np.array(poses)
    move = exp_se3(np.array([30.0, -4.0, 2.0]), np.array([0.1, -0.2, 2.5]))
    np.testing.assert_allclose(rigidly_at(drive, move @ drive), move @ drive, atol=1e-9)

    bent = move @ drive
    bent[:, 2, 3] += np.linspace(-1.0, 1.0, len(drive))
    laid = rigidly_at(drive, bent)
    np.testing.assert_allclose((laid - bent)[:, :3, 3].mean(0), np.zeros(3), atol=1e-9)
    assert abs(laid[0, 2, 3] - bent[0, 2, 3]) > 0.5


def test_a_straight_drive_is_not_turned_about_itself() -> None:
    """Positions alone would leave its roll open."""
    drive = np.tile(np.eye(4), (5, 1, 1))
    drive[:, 0, 3] = np.arange(5.0)
    np.testing.assert_allclose(rigidly_at(drive, drive), drive, atol=1e-12)
