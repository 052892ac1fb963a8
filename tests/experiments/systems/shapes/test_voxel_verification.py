from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from semloc_logs.alignment.tau import tau
from semloc_logs.experiments.system import Query
from semloc_logs.experiments.systems.level_maps import (
    database_map,
    query_map,
    query_poses,
    view_map,
)
from semloc_logs.experiments.systems.shapes.shape_matching import keypoints_of, unit_vectors
from semloc_logs.experiments.systems.shapes.voxel_verification import Verifier
from semloc_logs.numerics.transforms import yaw_transform
from semloc_logs.settings import Settings

SETTINGS = Settings().resolved()


@pytest.fixture(scope="module")
def database(point_drive: Any) -> Any:
    return database_map(point_drive.database[:5], SETTINGS)


def test_the_share_is_the_papers_ratio(database: Any, point_drive: Any) -> None:
    query = view_map(point_drive.database[2], SETTINGS)
    verifier = Verifier(database, 3.0)
    ijk, label = query.blocks.occupied()
    centres = (ijk + 0.5).astype(np.float64)
    # whole voxels and no turn: the middles of voxels fall on the middles of others
    for shift in ((0, 0, 0), (3, 1, 0), (-7, 4, 2), (40, 0, 1)):
        pose = np.eye(4)
        pose[:3, 3] = 0.3 * np.array(shift)
        verifier._complete_tiles(np.array([[0.0, *pose[:3, 3]]]), 100.0)
        (share,) = verifier._tau(centres, label, np.array([[0.0, *pose[:3, 3]]]))
        wanted, _ = tau((ijk, label), database.blocks, 0.3, pose, 3.0)
        # two observed voxels may be equally close
        assert share == pytest.approx(wanted, abs=0.03)
    assert verifier._tau(centres, label, np.zeros((1, 4)))[0] > 0.9


def test_the_true_pose_is_ranked_first(database: Any, point_drive: Any) -> None:
    query = view_map(point_drive.database[2], SETTINGS)
    rng = np.random.default_rng(0)
    poses = np.c_[rng.uniform(0, 6.28, 400), rng.uniform(-15, 15, (400, 2)), np.zeros(400)]
    poses[123] = (0.05, 0.4, -0.5, 0.2)
    best, *others = Verifier(database, 3.0).ranked(query, poses)
    assert best.tau > others[-1].tau
    np.testing.assert_allclose(best.world_T_query, np.eye(4), atol=0.1)
    assert Verifier(database, 3.0).ranked(query, poses[:0]) == []


def test_views_of_a_query_are_joined_by_odometry(point_drive: Any) -> None:
    views = [replace(v, odom_T_base=v.world_T_base) for v in point_drive.database[1:4]]
    level_map, query_T_base = query_map(Query("five", tuple(views)), SETTINGS)
    np.testing.assert_allclose(query_T_base, np.eye(4))
    np.testing.assert_allclose(query_poses(views)[0][:3, 3], [-4.0, 0.0, 0.0])
    whole = {tuple(p) for p in np.round(level_map.points, 3).tolist()}
    alone, _ = query_map(Query("one", (views[-1],)), SETTINGS)
    assert len(whole) > len(alone.points)
    # the origins of the rays of one view may differ
    split = replace(views[-1], origin=np.tile(views[-1].origin, (len(views[-1].points), 1)))
    again, _ = query_map(Query("one", (split,)), SETTINGS)
    np.testing.assert_array_equal(again.points, alone.points)


def test_normals_look_to_the_sensor(point_drive: Any) -> None:
    level_map = view_map(point_drive.database[0], SETTINGS)
    ground = level_map.points[:, 2] < 0.3
    assert np.median(level_map.normals[ground, 2]) > 0.95
    towards = level_map.seen_from[0] - level_map.points
    assert (np.einsum("ij,ij->i", towards, level_map.normals) >= 0).all()


def test_a_keypoint_is_nearest_to_the_middle_of_its_cell() -> None:
    points = np.array([[0.1, 0.1, 0.1], [0.6, 0.5, 0.5], [1.2, 0.5, 0.5], [-0.4, 0.5, 0.5]])
    assert keypoints_of(points, 1.0).tolist() == [3, 1, 2]
    assert not len(keypoints_of(points[:0], 1.0))


def test_short_descriptors_are_filled_up() -> None:
    out = unit_vectors(np.array([[3.0, 4.0], [0.0, 0.0]]))
    assert out.shape == (2, 64)
    np.testing.assert_allclose(out[0, :2], [0.6, 0.8])
    assert not out[1].any()


def test_a_pose_in_the_world_moves_with_the_last_view(point_drive: Any) -> None:
    view = point_drive.database[2]
    odom_T_base = yaw_transform(1.0, (5.0, 6.0, 7.0))
    (first,) = query_poses([replace(view, odom_T_base=odom_T_base)])
    np.testing.assert_allclose(first, yaw_transform(1.0))
