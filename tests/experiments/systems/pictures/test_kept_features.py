"""Features of a picture are computed once for all databases."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from semloc_logs.experiments.systems.pictures.kept_features import kept_features
from semloc_logs.experiments.systems.pictures.local_features import Features, sift


def test_features_of_a_picture_are_computed_once(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    first, second = rng.integers(0, 256, (2, 80, 120, 3), np.uint8)
    computed: list[int] = []

    def counted(image: np.ndarray) -> Features:
        computed.append(1)
        return sift(image)

    for _ in range(2):  # as two systems do, one for each database
        features = kept_features(counted, tmp_path / "features")
        for image in (first, second):
            found = features(image)
            expected = sift(image)
            assert len(found.xy) > 10
            np.testing.assert_array_equal(found.xy, expected.xy)
            np.testing.assert_array_equal(found.descriptor, expected.descriptor)
    assert computed == [1, 1]
