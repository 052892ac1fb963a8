"""SIFT, DSP-SIFT, MSER and DenseVLAD: features, retrieval, and poses where they must succeed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from semloc_logs.experiments.systems.pictures.dense_vlad import make_dense_vlad, principal_axes_of
from semloc_logs.experiments.systems.pictures.local_features import (
    Features,
    dense_sift,
    dsp_sift,
    keypoint,
    mser_dsp_sift,
    root_sift,
    sift,
    sift_points,
)
from semloc_logs.experiments.systems.pictures.picture_pose import (
    mutual_matches,
    points_of,
    pose_of_points,
    two_view_inliers,
)
from semloc_logs.experiments.systems.pictures.sift import make_dsp_sift, make_mser, make_sift
from semloc_logs.experiments.systems.pictures.visual_index import VisualIndex
from semloc_logs.numerics.transforms import yaw_transform
from semloc_logs.words.vocabulary import train_vocabulary

Extract = Callable[[NDArray[np.uint8]], Features]


@pytest.fixture(scope="module")
def spots() -> NDArray[np.uint8]:
    """A picture of bright and dark spots of different size."""
    rng = np.random.default_rng(0)
    image = np.full((200, 300), 128.0)
    y, x = np.mgrid[:200, :300]
    for _ in range(150):
        centre = rng.uniform([10, 10], [290, 190])
        inside = np.hypot((x - centre[0]) / rng.uniform(0.6, 1), y - centre[1]) < rng.uniform(3, 9)
        image[inside] = rng.uniform(0, 255)
    return np.repeat(gaussian_filter(image, 1.0).astype(np.uint8)[:, :, None], 3, axis=2)


@pytest.mark.parametrize(("extract", "least"), [(sift, 60), (dsp_sift, 60), (mser_dsp_sift, 25)])
def test_a_shifted_picture_has_the_same_features(
    extract: Extract, least: int, spots: NDArray[np.uint8]
) -> None:
    here = extract(spots[:180, :280])
    there = extract(spots[8:188, 12:292])
    matches = mutual_matches(here.vectors(), there.vectors(), there.xy)
    shift = here.xy[matches[:, 0]] - there.xy[matches[:, 1]]
    right = (np.abs(shift - [12, 8]) < 0.5).all(1)
    assert right.mean() > 0.95
    assert right.sum() > least
    inliers = two_view_inliers(here.xy[matches[:, 0]], there.xy[matches[:, 1]])
    assert inliers[right].mean() > 0.95
    assert not inliers[np.linalg.norm(shift - [12, 8], axis=1) > 12].any()


def test_the_points_have_the_levels_that_the_library_gives(spots: NDArray[np.uint8]) -> None:
    points = sift_points(spots[:, :, 0])
    assert len(points) > 100
    for p in points:
        octave = p.octave & 255
        layer = (p.octave >> 8) & 255
        again = keypoint(p.pt[0], p.pt[1], p.size)
        # the library's size has a part of a layer more or less
        level = 3 * (octave - 256 * (octave > 127)) + layer
        octave_again = again.octave & 255
        assert (
            abs(
                3 * (octave_again - 256 * (octave_again > 127))
                + ((again.octave >> 8) & 255)
                - level
            )
            <= 1
        )


def test_root_sift_has_the_hellinger_distance() -> None:
    raw = np.zeros((2, 128))
    raw[0, :4] = 1
    raw[1, :1] = 5
    a, b = Features(np.zeros((2, 2), np.float32), root_sift(raw)).vectors()
    assert a @ b == pytest.approx(0.5, abs=0.01)  # sqrt(1/4 * 1)


def test_dense_features_lie_on_a_grid_at_four_scales() -> None:
    image = np.random.default_rng(0).integers(0, 255, (100, 140, 3)).astype(np.uint8)
    features = dense_sift(image, 20)
    assert len(features.xy) == 4 * len(np.unique(features.xy, axis=0)) == 4 * 3 * 5
    assert set(np.diff(np.unique(features.xy[:, 0])).tolist()) == {20.0}


def test_matches_are_mutual_and_pass_the_ratio() -> None:
    a = np.eye(4, dtype=np.float32)
    # the last two are equally near to row 1, and nothing is near to row 3
    b = np.array([a[2], a[0], a[1] + a[3] / 9, a[1] - a[3] / 9]) / [[1], [1], [1.006], [1.006]]
    far = np.arange(8, dtype=np.float32).reshape(4, 2) * 10
    assert mutual_matches(a, b.astype(np.float32), far).tolist() == [[0, 1], [2, 0]]
    # the same place at another scale is not a second place
    beside = far[[0, 1, 2, 2]]
    assert mutual_matches(a, b.astype(np.float32), beside).tolist() == [[0, 1], [1, 2], [2, 0]]
    assert not len(mutual_matches(a[:1], b.astype(np.float32), far))


def test_the_index_finds_the_picture_with_the_same_words() -> None:
    rng = np.random.default_rng(1)
    pictures = rng.normal(size=(30, 80, 128)).astype(np.float32)
    pictures /= np.linalg.norm(pictures, axis=2, keepdims=True)
    index = VisualIndex(train_vocabulary(pictures.reshape(-1, 128)))
    for picture in pictures:
        index.add(picture)
    index.finish()
    noisy = pictures[17] + 0.02 * rng.normal(size=(80, 128)).astype(np.float32)
    scores = index.scores(noisy / np.linalg.norm(noisy, axis=1, keepdims=True))
    assert scores.argmax() == 17
    assert scores[17] > 3 * np.sort(scores)[-2]


def test_a_burst_of_one_feature_counts_less() -> None:
    rng = np.random.default_rng(1)
    features = rng.normal(size=(600, 128)).astype(np.float32)
    features /= np.linalg.norm(features, axis=1, keepdims=True)
    index = VisualIndex(train_vocabulary(features))
    index.add(np.repeat(features[:1], 50, axis=0))  # one feature 50 times
    index.add(np.concatenate([features[:10], features[100:140]]))  # ten of the query's once
    index.add(features[200:250])
    index.finish()
    scores = index.scores(features[:10])
    assert scores[1] > scores[0] > 0


def test_the_axes_are_those_of_the_covariance() -> None:
    rows = np.random.default_rng(0).normal(size=(6, 40)).astype(np.float32)
    rows -= rows.mean(0)
    axes = principal_axes_of(rows, 3)
    wanted = np.linalg.svd(rows, full_matrices=False)[2][:3]
    np.testing.assert_allclose(np.abs((axes * wanted).sum(1)), 1.0, atol=1e-4)
    assert len(principal_axes_of(rows, 4096)) == 5


def test_a_pose_from_points_by_hand() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([-3, -2, 4], [3, 2, 9], (60, 3)).astype(np.float32)
    intrinsics = np.array([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]])
    shifted = points + np.array([0.5, 0, 0])
    pixels = shifted @ intrinsics.T
    xy = (pixels[:, :2] / pixels[:, 2:]).astype(np.float32)
    xy[:20] += rng.uniform(20, 60, (20, 2))
    pose = pose_of_points(xy, points, intrinsics)
    assert pose is not None
    assert pose.inliers == 40
    wanted = np.eye(4)
    wanted[0, 3] = 0.5
    np.testing.assert_allclose(pose.camera_T_points, wanted, atol=1e-3)
    assert pose_of_points(xy[:30], points[:30], intrinsics) is None  # 10 inliers


def test_points_have_the_depth_beside_a_hole(picture_drive: Any) -> None:
    picture = picture_drive.database[0].picture
    depth = np.full_like(picture.depth, np.nan)
    depth[80, 160] = 4.0
    xy = np.array([[160, 80], [161, 81], [165, 80]], np.float32)
    points = points_of(picture._replace(depth=depth), xy)
    # the camera looks along x from (0.3, 0, 1.5); pixel (160, 80) is its middle
    np.testing.assert_allclose(points[0], [4.3, 0.0, 1.5], atol=1e-5)
    np.testing.assert_allclose(points[1], [4.3, -4 / 180, 1.5 - 4 / 180], atol=1e-5)
    assert np.isnan(points[2]).all()


@pytest.fixture(scope="module", params=[make_sift, make_dsp_sift, make_mser, make_dense_vlad])
def system(request: Any, picture_drive: Any, options: Any) -> Any:
    out = request.param(options)
    out.fit(picture_drive.database)
    return out


def test_a_query_beside_the_database_is_localised(
    system: Any, picture_drive: Any, errors: Any
) -> None:
    truth = yaw_transform(0.0, (20.4, 0.2, 0.0))
    poses = system.localise(picture_drive.query_at(truth))
    assert poses
    assert poses[0].score >= 15
    metres, degrees = errors(poses[0], truth)
    assert metres < 0.15
    assert degrees < 1.0


def test_nothing_is_found_from_the_other_side(system: Any, picture_drive: Any) -> None:
    assert not system.localise(picture_drive.query_at(yaw_transform(np.pi, (20.4, 0.2, 0.0))))


def test_views_without_pictures_are_passed_over(point_drive: Any, options: Any) -> None:
    for make in (make_sift, make_dense_vlad):
        system = make(options)
        system.fit(point_drive.database)
        assert system.localise(point_drive.query_at(np.eye(4))) == []
