from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from semloc_logs.experiments.systems.shapes.spherical_histograms import (
    cgf_system,
    spherical_histograms,
    training_pairs,
)
from semloc_logs.numerics.transforms import yaw_transform


def test_the_bins_of_points_by_hand() -> None:
    # x goes to the side of the far point; one point straight up
    points = np.array([[0.0, 0, 0], [0.9, 0, 0], [0, 0, 0.5], [-0.05, 0, 0]])
    normals = np.tile([0.0, 0.0, 1.0], (4, 1))
    histogram = spherical_histograms(points, normals, np.array([0]), 1.0)[0].reshape(17, 11, 12)
    assert histogram.sum() == pytest.approx(1.0)
    # along +x the azimuth is 0: sector 6 of 12; the equator is level 5 of 11
    # borders of rings are 0.1 * 10^(k / 16): 0.9 lies below border 16, 0.5 below border 12
    assert histogram[16, 5, 6] == pytest.approx(1 / 3)
    assert histogram[12, 10].sum() == pytest.approx(1 / 3)
    assert histogram[0, 5, [0, 11]].sum() == pytest.approx(1 / 3)


def test_a_turned_cloud_has_the_same_histograms() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-3, 3, (400, 3))
    normals = rng.normal(size=(400, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    rows = np.arange(50)
    turn = yaw_transform(1.1, (4.0, -2.0, 1.0))
    here = spherical_histograms(points, normals, rows, 1.5)
    there = spherical_histograms(
        points @ turn[:3, :3].T + turn[:3, 3], normals @ turn[:3, :3].T, rows, 1.5
    )
    np.testing.assert_allclose(here, there, atol=1e-6)
    assert not spherical_histograms(points[:1], normals[:1], rows[:1], 1.5).any()


@pytest.fixture(scope="module")
def system(point_drive: Any, options: Any, training: Any) -> Any:
    out = cgf_system(options, training)
    out.fit(point_drive.database)
    return out


def test_pairs_are_nearer_than_others(system: Any, point_drive: Any, options: Any) -> None:
    anchor, positive, place = training_pairs(point_drive.database[::7], options.settings)
    assert len(anchor) == len(positive) == len(place) > 100
    described = system._descriptor._network
    with torch.inference_mode():
        a, p = (described(torch.from_numpy(x)).numpy() for x in (anchor, positive))
    pair = np.linalg.norm(a - p, axis=1)
    other = np.linalg.norm(a - np.roll(p, len(p) // 2, axis=0), axis=1)
    assert np.median(pair) < 0.6 * np.median(other)


@pytest.mark.parametrize(("yaw", "most_m", "most_deg"), [(0.0, 0.3, 2.0), (2.0, 1.5, 5.0)])
def test_a_turned_query_is_localised(
    yaw: float, most_m: float, most_deg: float, system: Any, point_drive: Any, errors: Any
) -> None:
    """2.0 rad lie between two of the 18 headings, 5 degrees from either. The refinement of the
    plain method, by closest voxels, hardly turns a pose, and ends a metre away.
    """
    truth = yaw_transform(yaw, (21.0, 0.6, 0.0))
    poses = system.localise(point_drive.query_at(truth))
    metres, degrees = errors(poses[0], truth)
    assert metres < most_m
    assert degrees < most_deg


def test_weights_are_kept(system: Any, options: Any, training: Any) -> None:
    files = sorted(options.folder.glob("cgf-*.safetensors"))
    assert len(files) == 2  # network and words
    before = [f.stat().st_mtime_ns for f in files]
    cgf_system(options, training).fit(())
    assert [f.stat().st_mtime_ns for f in files] == before
