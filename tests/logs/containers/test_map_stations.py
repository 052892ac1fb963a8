"""Stations in a map of points, and the points that are seen there."""

from __future__ import annotations

import numpy as np
import pytest

from semloc_logs.arrays import F64
from semloc_logs.errors import LogError
from semloc_logs.logs.containers.map_stations import (
    FIRST_NS,
    HEIGHT,
    POSE_STEP,
    SPACING,
    SPEED,
    Stations,
    Views,
    tour,
)


def plane(x: F64, y: F64, z: F64) -> F64:
    """Points of a grid of lines x, y, z; a single value is a plane."""
    return np.stack([g.ravel() for g in np.meshgrid(x, y, z, indexing="ij")], 1)


def street() -> F64:
    """40 m x 16 m of ground, a roof of 6 m x 6 m at 5 m beside it, and a box on the ground."""
    ground = plane(np.arange(0, 40, 0.25), np.arange(0, 16, 0.25), np.zeros(1))
    roof = plane(np.arange(10, 14, 0.25), np.arange(20, 22, 0.25), np.array([5.0]))
    box = plane(np.arange(16, 24, 0.25), np.arange(0, 8, 0.25), np.arange(0, 1.5, 0.25))
    return np.concatenate([ground, roof, box])


def test_stations_stand_on_the_ground() -> None:
    stations = tour(street())
    place = stations.poses[:, :3, 3]
    assert (place[:, 2] == HEIGHT).all()
    # one in each square of 8 m, but for the one that the box fills
    squares = {tuple(cell) for cell in np.floor(place[:, :2] / SPACING).astype(int).tolist()}
    assert squares == {(i, j) for i in range(5) for j in range(2)} - {(2, 0)}
    assert len(place) == 9


def test_a_tour_is_driven_at_a_constant_speed_along_its_heading() -> None:
    stations = tour(street())
    place = stations.poses[:, :3, 3]
    way = np.linalg.norm(np.diff(place, axis=0), axis=1)
    seconds = np.diff(stations.stamps_ns) / 1e9
    assert stations.is_tour
    assert stations.stamps_ns[0] == FIRST_NS
    np.testing.assert_allclose(way / seconds, SPEED, rtol=1e-6)
    first = place[1, :2] - place[0, :2]
    heading = stations.poses[0, :2, 0]
    assert heading @ first / np.linalg.norm(first) == pytest.approx(1.0)


def test_poses_between_stations_leave_no_gap() -> None:
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 10.0
    stations = Stations(np.array([0, 2_000_000_000]), poses)
    between = list(stations.between(0))
    assert [stamp for stamp, _ in between] == [0, 666_666_666, 1_333_333_333]
    assert [pose[0, 3] for _, pose in between] == pytest.approx([0.0, 10 / 3, 20 / 3])
    assert max(np.diff([pose[0, 3] for _, pose in between])) <= POSE_STEP
    assert [stamp for stamp, _ in stations.between(1)] == [2_000_000_000]


def test_a_map_without_ground_asks_for_a_trajectory() -> None:
    wall = plane(np.zeros(1), np.arange(0, 9, 0.5), np.arange(0, 3, 0.5))
    with pytest.raises(LogError, match="--poses"):
        tour(wall)


@pytest.mark.parametrize("spacing", [0.1, 0.3])
def test_a_wall_hides_what_is_behind_it(spacing: float) -> None:
    side = np.arange(-3.0, 3.0, spacing)
    wall = plane(np.array([5.0]), side, side)
    behind = plane(np.array([9.0]), side, side)
    beside = plane(np.array([9.0]), side + 12, side)
    xyz = np.concatenate([wall, behind, beside])
    seen = np.zeros(len(xyz), bool)
    seen[Views(xyz).seen(np.zeros(3))] = True
    assert seen[: len(wall)].all()
    assert seen[2 * len(wall) :].all()
    assert seen[len(wall) : 2 * len(wall)].mean() < 0.02


def test_what_is_far_is_not_seen() -> None:
    xyz = np.array([[10.0, 0.0, 0.0], [0.0, 39.0, 0.0], [-41.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
    assert sorted(Views(xyz).seen(np.zeros(3)).tolist()) == [0, 1]
