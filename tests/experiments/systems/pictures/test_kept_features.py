"""Features of a picture and their points are computed once for all databases."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semloc_logs.experiments.system import Picture
from semloc_logs.experiments.systems.catalogue import SystemOptions
from semloc_logs.experiments.systems.pictures.kept_features import kept_features
from semloc_logs.experiments.systems.pictures.local_features import Features, sift
from semloc_logs.experiments.systems.pictures.picture_matching import features_folder
from semloc_logs.settings import Settings


def test_features_of_a_picture_are_computed_once(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    depth = np.full((80, 120), 5.0, np.float32)
    intrinsics = np.array([[100.0, 0.0, 60.0], [0.0, 100.0, 40.0], [0.0, 0.0, 1.0]])
    first, second = (
        Picture(image, depth, intrinsics, np.eye(4))
        for image in rng.integers(0, 256, (2, 80, 120, 3), np.uint8)
    )
    farther = first._replace(depth=2 * depth)
    computed: list[int] = []

    def counted(image: NDArray[np.uint8]) -> Features:
        computed.append(1)
        return sift(image)

    for _ in range(2):  # as two systems do, one for each database
        file = kept_features(counted, tmp_path / "features")
        for picture in (first, second, farther):
            with np.load(file(picture)) as arrays:
                xy, descriptor, points = (arrays[name] for name in arrays.files)
            expected = sift(picture.image)
            assert len(xy) > 10
            np.testing.assert_array_equal(xy, expected.xy)
            np.testing.assert_array_equal(descriptor, expected.descriptor)
            away = picture.depth[0, 0]
            np.testing.assert_allclose(points[:, 2], away)
            np.testing.assert_allclose(points[:, 0], (xy[:, 0] - 60) / 100 * away, atol=1e-5)
    assert computed == [1, 1, 1]
    assert len([*(tmp_path / "features").glob("*.npz")]) == 3


def test_systems_share_their_features(tmp_path: Path) -> None:
    settings = Settings().resolved()
    one, other = (SystemOptions(settings, tmp_path / name) for name in ("dsp-sift", "dense-vlad"))
    assert features_folder(one) == features_folder(other) == tmp_path / "features"
