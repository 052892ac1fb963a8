from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from semloc_logs.experiments.systems.pictures.ground_patches import (
    Patches,
    ground_fit,
    ground_plane,
    make_vip,
    view_from_above,
)
from semloc_logs.numerics.transforms import exp_se3, yaw_transform


def test_the_plane_lies_below_a_tilted_base(town: Any) -> None:
    tilted = exp_se3(np.array([20.0, 0.0, 0.4]), np.array([0.03, -0.05, 0.0]))
    base_T_plane = ground_plane(town.picture(tilted))
    assert base_T_plane is not None
    world_T_plane = tilted @ base_T_plane
    np.testing.assert_allclose(world_T_plane[:3, 2], [0, 0, 1], atol=2e-3)
    assert world_T_plane[2, 3] == pytest.approx(0.0, abs=0.02)
    assert np.linalg.det(base_T_plane[:3, :3]) == pytest.approx(1.0)


def test_the_view_from_above_shows_the_ground(town: Any) -> None:
    picture = town.picture(yaw_transform(0.0, (20.0, 0.0, 0.0)))
    view = view_from_above(picture)
    assert view is not None
    # the ground 5 to 8 m ahead and up to 1 m to either side, drawn without a camera
    rows = np.arange(75, 150)
    columns = np.arange(225, 275)
    assert view.seen[np.ix_(rows, columns)].all()
    x, y = np.meshgrid(22.0 + 0.04 * rows, -10.0 + 0.04 * columns, indexing="ij")
    wanted = town.brightness(np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1))
    shown = view.grey[np.ix_(rows, columns)].ravel()
    assert np.corrcoef(wanted, shown)[0, 1] > 0.8
    # ground behind the corner of a building is hidden
    assert 0.2 < (view.seen > 0).mean() < 0.9


def test_no_ground_without_depth(town: Any) -> None:
    picture = town.picture(np.eye(4))
    assert view_from_above(picture._replace(depth=np.full_like(picture.depth, np.nan))) is None


def test_places_are_fitted_by_a_turn_and_a_shift() -> None:
    rng = np.random.default_rng(0)
    descriptor = rng.integers(0, 255, (40, 128)).astype(np.uint8)
    places = rng.uniform(-8, 8, (40, 2))
    moved = yaw_transform(2.0, (1.0, -3.0, 0.0))
    target = places @ moved[:2, :2].T + moved[:2, 3]
    target[:10] += 3.0
    fit = ground_fit(
        Patches(target.astype(np.float32), descriptor, np.eye(4)),
        Patches(places.astype(np.float32), descriptor, np.eye(4)),
    )
    assert fit is not None
    np.testing.assert_allclose(fit[0], moved, atol=1e-4)
    assert fit[1] == 30


@pytest.mark.parametrize(
    ("yaw", "position"), [(0.1, (20.5, 0.2, 0.0)), (np.pi / 2, (29.5, -4.5, 0.0))]
)
def test_ground_is_matched_from_another_side(
    yaw: float, position: Any, picture_drive: Any, options: Any, errors: Any
) -> None:
    system = make_vip(options)
    system.fit(picture_drive.database[4:7])
    truth = yaw_transform(yaw, position)
    poses = system.localise(picture_drive.query_at(truth))
    assert poses
    metres, degrees = errors(poses[0], truth)
    assert metres < 0.3
    assert degrees < 2.0
