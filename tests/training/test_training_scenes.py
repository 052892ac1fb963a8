"""What training gets: labelled clouds in the base frame with true poses, of one drive that maps and
a query drive.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from semloc_logs.numerics.transforms import apply
from semloc_logs.simulation.sensors.camera import CameraModel
from semloc_logs.simulation.sensors.lidar_models import MODELS
from semloc_logs.training.training_scenes import _rig, training_scene


@pytest.mark.parametrize("seed", [0, 2, 5, 8, 11])
def test_scenes_have_the_promised_form(seed: int) -> None:
    scene = training_scene(seed, frames=8)
    assert len(scene.mapped) == 8
    assert scene.queries is scene.mapped or len(scene.queries) in (5, 8)
    for frame in [*scene.mapped, *scene.queries]:
        points = frame.points
        origin = frame.origin
        labels = frame.labels
        pose = frame.world_T_base
        assert [str(a.dtype) for a in (points, origin, labels, pose)] == [
            "float32",
            "float32",
            "uint8",
            "float64",
        ]
        assert points.shape == (len(labels), 3)
        assert frame.sigma is None or frame.sigma.shape == labels.shape
        assert 1_000 < len(points) <= 60_000
        assert np.isfinite(points).all()
        assert np.linalg.norm(points - origin, axis=1).max() < (6 * 60 if seed == 11 else 62)
        assert set(np.unique(labels).tolist()) <= {*range(19), 255} - {10}
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)
    step = np.linalg.norm(np.diff([f.world_T_base[:3, 3] for f in scene.mapped], axis=0), axis=1)
    expected, tolerance = {5: (0.7, 0.2), 11: (6 * 0.12, 0.1)}.get(seed, (2.25, 0.8))
    assert np.median(step) == pytest.approx(expected, abs=tolerance)


def test_a_forest_has_trees_and_hardly_a_wall() -> None:
    labels = np.concatenate([f.labels for f in training_scene(8, frames=4).mapped])
    assert (labels == 8).mean() > 0.15
    assert np.isin(labels, [2, 3]).mean() < 0.02  # wrong labels only
    assert (labels <= 1).any()


def test_a_room_is_six_times_as_large_as_it_is() -> None:
    frames = training_scene(11, frames=6).mapped
    world = np.concatenate([apply(f.world_T_base, f.points) for f in frames])
    height = np.percentile(world[:, 2], 99) - np.percentile(world[:, 2], 1)
    assert 6 * 2.0 < height < 6 * 3.5
    assert np.ptp(world[:, :2], axis=0).max() < 6 * 16


def test_sensors_and_label_errors_vary() -> None:
    rng = np.random.default_rng(0)
    rigs = [_rig(rng, "street") for _ in range(300)]
    cameras = [r for r in rigs if isinstance(r.model, CameraModel)]
    assert 0.25 < len(cameras) / 300 < 0.45
    assert {round(r.model.yaw, 1) for r in rigs if isinstance(r.model, CameraModel)} == {
        0.0,
        1.6,
        -1.6,
        3.1,
    }
    assert {r.model.name for r in rigs} == {"stereo", *MODELS}
    assert {
        r.model.name
        for r in (_rig(rng, "hall") for _ in range(100))
        if isinstance(r.model, CameraModel)
    } == {"depth"}
    noise = [r.label_noise for r in rigs]
    assert min(noise) >= 0.02
    assert 0.15 < max(noise) <= 0.2


def test_the_same_seed_gives_the_same_frames() -> None:
    first, again, other = (training_scene(seed, frames=2) for seed in (3, 3, 5))
    for a, b in zip(first.mapped + first.queries, again.mapped + again.queries, strict=True):
        assert all(
            np.array_equal(getattr(a, k), getattr(b, k))
            for k in ("points", "origin", "labels", "world_T_base")
        )
    assert first.mapped[0].points.tobytes() != other.mapped[0].points.tobytes()


def test_frames_of_one_street_fit_together() -> None:
    """The road under the next pose, as this frame sees it, is where the next pose stands."""
    tried = 0
    for a, b in pairwise(training_scene(4, frames=6).mapped):
        world = apply(a.world_T_base, a.points[a.labels == 0])
        ahead = b.world_T_base[:3, 3] + 3 * b.world_T_base[:3, 0]
        is_beside = np.linalg.norm(world[:, :2] - ahead[:2], axis=1) < 1.0
        if is_beside.sum() > 5:
            tried += 1
            assert np.median(world[is_beside, 2]) == pytest.approx(ahead[2], abs=0.1)
    assert tried > 2
