from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from semloc_logs.experiments.systems.level_maps import oriented_normals
from semloc_logs.experiments.systems.shapes.feature_histograms import feature_histograms
from semloc_logs.experiments.systems.shapes.fpfh import fpfh_system
from semloc_logs.numerics.transforms import yaw_transform


def test_histograms_of_two_points_by_hand() -> None:
    # the line lies in both tangent planes, one normal is turned by 90 degrees about the line
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    (first, second) = feature_histograms(points, normals, np.array([0, 1]), 2.0)
    # u = z, v = x * z = -y, w = u * v = x: theta = atan2(0, 0) = 0, alpha = -1, phi = 0
    wanted = np.zeros(33)
    wanted[[5, 11, 22 + 5]] = 100.0
    np.testing.assert_allclose(first, wanted)
    # from the other point: v = -x * y = -z, so alpha = -1 again
    np.testing.assert_allclose(second, wanted)


def test_a_plane_has_one_bin_an_angle() -> None:
    x, y = np.meshgrid(np.arange(8.0), np.arange(8.0))
    points = np.c_[x.ravel(), y.ravel(), np.zeros(64)]
    normals = oriented_normals(points, np.array([[3.0, 3.0, 5.0]]))
    np.testing.assert_allclose(normals, np.tile([0.0, 0.0, 1.0], (64, 1)), atol=1e-6)
    histograms = feature_histograms(points, normals, np.arange(64), 2.5)
    assert (np.sort(histograms.reshape(64, 3, 11), axis=2)[:, :, -1] == 100).all()


def test_a_turned_cloud_has_the_same_histograms() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-3, 3, (400, 3))
    normals = rng.normal(size=(400, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    rows = np.arange(50)
    turn = yaw_transform(1.1, (4.0, -2.0, 1.0))
    here = feature_histograms(points, normals, rows, 1.5)
    there = feature_histograms(
        points @ turn[:3, :3].T + turn[:3, 3], normals @ turn[:3, :3].T, rows, 1.5
    )
    # an angle on the border of two bins may fall into either
    assert np.abs(here - there).max() < 2.0
    assert here.std(0).max() > 1.0
    np.testing.assert_allclose(here.reshape(50, 3, 11).sum(2), 100.0, rtol=1e-5)


def test_a_keypoint_alone_has_no_histogram() -> None:
    points = np.array([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]])
    normals = np.tile([0.0, 0.0, 1.0], (2, 1))
    assert not feature_histograms(points, normals, np.array([0]), 1.0).any()
    assert feature_histograms(points, normals, np.zeros(0, np.int64), 1.0).shape == (0, 33)


@pytest.fixture(scope="module")
def system(point_drive: Any, options: Any, training: Any) -> Any:
    out = fpfh_system(options, training)
    out.fit(point_drive.database)
    return out


@pytest.mark.parametrize("yaw", [0.0, 1.5, 3.0])
def test_a_turned_query_is_localised(
    yaw: float, system: Any, point_drive: Any, errors: Any
) -> None:
    truth = yaw_transform(yaw, (21.0, 0.6, 0.0))
    poses = system.localise(point_drive.query_at(truth))
    assert 1 < len(poses) <= 100
    assert [p.score for p in poses] == sorted((p.score for p in poses), reverse=True)
    metres, degrees = errors(poses[0], truth)
    assert metres < 0.3
    assert degrees < 2.0
