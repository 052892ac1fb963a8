"""What training gets: labelled sweeps in the base frame with true poses."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from semloc_logs.geometry import apply
from semloc_logs.simulation.training_scenes import training_session


@pytest.mark.parametrize("seed", [0, 5, 7])
def test_sessions_have_the_promised_form(seed: int) -> None:
    frames = list(training_session(seed, frames=12))
    assert len(frames) == 12
    for points, origin, labels, pose in frames:
        assert [str(a.dtype) for a in (points, origin, labels, pose)] == ["float32", "float32", "uint8", "float64"]
        assert points.shape == (len(labels), 3)
        assert 2_000 < len(points) <= 60_000
        assert np.isfinite(points).all()
        assert np.linalg.norm(points - origin, axis=1).max() < 60.5
        assert set(np.unique(labels).tolist()) <= {*range(19), 255} - {10}
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)
    step = np.linalg.norm(np.diff([pose[:3, 3] for *_, pose in frames], axis=0), axis=1)
    assert np.median(step) == pytest.approx(0.7 if seed == 5 else 2.25, abs=0.2 if seed == 5 else 0.8)


def test_the_same_seed_gives_the_same_frames() -> None:
    first, again, other = (list(training_session(seed, frames=2)) for seed in (3, 3, 5))
    for a, b in zip(first, again, strict=True):
        assert all(np.array_equal(a[k], b[k]) for k in range(4))
    assert first[0][0].tobytes() != other[0][0].tobytes()


def test_sweeps_of_one_street_fit_together() -> None:
    """The road under the next pose, as this sweep sees it, is where the next pose stands."""
    frames = list(training_session(1, frames=6))
    for (points, _, labels, pose), (_, _, _, following) in pairwise(frames):
        world = apply(pose, points[labels == 0])
        near = np.linalg.norm(world[:, :2] - (following[:3, 3] + 3 * following[:3, 0])[:2], axis=1) < 1.0
        assert near.sum() > 5
        expected = (following[:3, 3] + 3 * following[:3, 0])[2]
        assert np.median(world[near, 2]) == pytest.approx(expected, abs=0.08)
