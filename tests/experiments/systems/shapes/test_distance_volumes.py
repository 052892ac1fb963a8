from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from semloc_logs.experiments.systems.shapes.distance_volumes import (
    Volumes,
    describe_points,
    distance_volume,
    training_volumes,
    volume_system,
)
from semloc_logs.numerics.transforms import yaw_transform


def test_distances_are_those_of_the_slow_loop() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-3, 15, (12, 3))
    low = np.array([-1.0, 2.0, 0.0])
    volume = distance_volume(points, low, (10, 8, 6))
    for ijk in np.ndindex(10, 8, 6):
        middle = low + np.array(ijk) + 0.5
        nearest = np.linalg.norm(points - middle, axis=1).min()
        assert volume[ijk] == pytest.approx(max(0.0, 1 - nearest / 5), abs=1e-6)


def test_a_subvolume_has_the_same_descriptor_in_a_map_and_alone() -> None:
    torch.manual_seed(0)
    network = Volumes().eval()
    points = np.random.default_rng(0).uniform([-140, -30, 0], [140, 30, 20], (3000, 3))
    cells, descriptor = describe_points(points, network)
    assert len(cells) == len(np.unique(np.floor(points / 8), axis=0))
    for row in range(0, len(cells), len(cells) // 7):
        alone = distance_volume(points, cells[row] * 8.0 - 11, (30, 30, 30))
        with torch.inference_mode():
            wanted = network(torch.from_numpy(alone[None, None])).flatten().numpy()
        np.testing.assert_allclose(descriptor[row], wanted, atol=1e-5)
    assert describe_points(np.zeros((0, 3)), network)[1].shape == (0, 512)


@pytest.fixture(scope="module")
def system(point_drive: Any, options: Any, training: Any) -> Any:
    out = volume_system(options, training)
    out.fit(point_drive.database)
    return out


def test_pairs_are_nearer_than_others(system: Any, point_drive: Any, options: Any) -> None:
    incomplete, complete = training_volumes(point_drive.database[::9], options.settings)
    assert len(incomplete) == len(complete) == 48
    with torch.inference_mode():
        a, b = (
            system._descriptor._network(torch.from_numpy(x[:, None])).flatten(1).numpy()
            for x in (incomplete, complete)
        )
    pair = np.linalg.norm(a - b, axis=1)
    other = np.linalg.norm(a - np.roll(b, 5, axis=0), axis=1)
    assert np.median(pair) < 0.6 * np.median(other)


def test_a_turned_query_is_localised(system: Any, point_drive: Any, errors: Any) -> None:
    truth = yaw_transform(2.0, (21.0, 0.6, 0.0))
    poses = system.localise(point_drive.query_at(truth))
    metres, degrees = errors(poses[0], truth)
    assert metres < 0.3
    assert degrees < 2.0
