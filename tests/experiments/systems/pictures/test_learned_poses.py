"""PoseNet and DSAC: both learn a database of a few pictures, and know them again."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from semloc_logs.experiments.systems.pictures.pose_regression import (
    PoseNetSystem,
    _has_settled,
    make_posenet,
)
from semloc_logs.experiments.systems.pictures.scene_coordinates import (
    SceneCoordinateSystem,
    _grid,
    chosen_loss,
    hypotheses,
    make_dsac,
    pose_loss,
    soft_inliers,
)
from semloc_logs.numerics.transforms import apply, inverse, yaw_transform


@pytest.mark.parametrize(
    "make",
    [
        lambda options: PoseNetSystem(options.folder, 150),
        lambda options: SceneCoordinateSystem(options.folder, (300, 5)),
    ],
    ids=["posenet", "dsac"],
)
def test_pictures_of_the_database_are_localised(
    make: Any, picture_drive: Any, options: Any, errors: Any
) -> None:
    system = make(options)
    database = picture_drive.database[1:4:2]
    system.fit(database)
    for view in database:
        (pose,) = system.localise(picture_drive.query_at(view.world_T_base))
        metres, degrees = errors(pose, view.world_T_base)
        assert metres < 2.0, view.world_T_base
        assert degrees < 5.0
    again = make(options)
    again.fit(database)
    query = picture_drive.query_at(database[0].world_T_base)
    np.testing.assert_array_equal(
        again.localise(query)[0].world_T_base, system.localise(query)[0].world_T_base
    )


@pytest.mark.parametrize("make", [make_posenet, make_dsac])
def test_without_pictures_nothing_is_found(
    make: Any, point_drive: Any, picture_drive: Any, options: Any
) -> None:
    system = make(options)
    system.fit(point_drive.database[:2])
    assert system.localise(picture_drive.query_at(np.eye(4))) == []
    system.fit(picture_drive.database[:2])
    assert system.localise(point_drive.query_at(np.eye(4))) == []


def test_training_ends_when_the_loss_stays() -> None:
    falling = [0.99**n for n in range(2000)]
    assert not any(_has_settled(falling[:n]) for n in range(800))
    assert _has_settled([1.0] * 400)
    assert not _has_settled([1.0] * 300)


def test_exact_coordinates_give_the_pose(town: Any) -> None:
    world_T_base = yaw_transform(0.3, (20.0, 1.0, 0.0))
    picture = town.picture(world_T_base)
    grid = _grid(picture)
    camera_T_world = inverse(world_T_base @ picture.base_T_camera)
    known = np.isfinite(grid.points).all(1)
    points = apply(world_T_base, grid.points[known]).astype(np.float32)
    coordinates = torch.from_numpy(points)
    pixel = grid.pixel[known]
    # all cells are inliers of the truth, and few of a pose that is half a metre off
    right = float(soft_inliers(coordinates, pixel, grid.intrinsics, camera_T_world))
    off = camera_T_world.copy()
    off[0, 3] += 0.5
    assert right > 0.97 * known.sum()
    assert float(soft_inliers(coordinates, pixel, grid.intrinsics, off)) < 0.7 * right
    poses = hypotheses(points, pixel, grid.intrinsics, np.random.default_rng(0))
    assert len(poses) > 8
    assert np.median([pose_loss(p, camera_T_world) for p in poses]) < 1.0
    loss = chosen_loss(coordinates, pixel, grid.intrinsics, camera_T_world, poses)
    assert float(loss) < 0.5


def test_the_loss_of_a_pose_by_hand() -> None:
    assert pose_loss(np.eye(4), yaw_transform(0.0, (0.03, 0.04, 0.0))) == pytest.approx(0.5)
    assert pose_loss(np.eye(4), yaw_transform(np.radians(3), (0.1, 0, 0))) == pytest.approx(3.0)
    assert pose_loss(np.eye(4), yaw_transform(0.0, (90.0, 0, 0))) == 20.0


def test_the_gradient_is_that_of_small_changes() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([-3, -2, 4], [3, 2, 9], (30, 3))
    intrinsics = np.array([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]])
    pixel = points @ intrinsics.T
    pixel = (pixel[:, :2] / pixel[:, 2:]).astype(np.float32)
    poses = [np.eye(4), yaw_transform(0.02), yaw_transform(0.0, (0.2, 0.1, 0.0))]

    def loss(coordinates: torch.Tensor) -> torch.Tensor:
        return chosen_loss(coordinates, pixel, intrinsics, np.eye(4), poses)

    noisy = torch.from_numpy(points + rng.normal(0, 0.1, points.shape)).requires_grad_()
    assert torch.autograd.gradcheck(loss, (noisy,), eps=1e-5, atol=1e-4)
