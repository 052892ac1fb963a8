"""Sweeps in rooms whose walls one knows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semloc_logs.numerics.transforms import apply, interpolate, yaw_transform
from semloc_logs.simulation.meshes.world import CAR, POLE, SIDEWALK, WALL, MeshBuilder, Scene, box
from semloc_logs.simulation.sensors.label_errors import CONFUSIONS, corrupt_labels
from semloc_logs.simulation.sensors.lidar import SweepOptions, full_sweep
from semloc_logs.simulation.sensors.lidar_models import MODELS, beam_directions

QUIET = replace(MODELS["hdl32"], noise=0.0, beam_bias=0.0, pointing_deg=0.0, divergence=0.0)


def room() -> Scene:
    """20 x 10 m inside, floor at 0, walls of 6 m: the long ones WALL, the short ones POLE, the
    floor SIDEWALK.
    """
    builder = MeshBuilder(lambda x, y: np.zeros_like(x))
    for x in (-10.5, 10.5):
        builder.add(box(1.0, 12.0, 6.0, x=x), POLE, ground="none")
    for y in (-5.5, 5.5):
        builder.add(box(22.0, 1.0, 6.0, y=y), WALL, ground="none")
    builder.add(box(22.0, 12.0, 1.0, z=-1.0), SIDEWALK, ground="none")
    return Scene(builder.build())


def misplaced(points: np.ndarray, labels: np.ndarray) -> float:
    """The largest distance of a point from the surface of its label."""
    off = {
        POLE: np.abs(np.abs(points[:, 0]) - 10),
        WALL: np.abs(np.abs(points[:, 1]) - 5),
        SIDEWALK: np.abs(points[:, 2]),
    }
    return float(max(off[int(label)][labels == label].max() for label in np.unique(labels)))


def test_points_lie_on_the_walls_of_their_label() -> None:
    pose = yaw_transform(0.7, (1.0, -2.0, 1.9))
    turn = full_sweep(room(), pose, np.random.default_rng(0), QUIET)
    points, labels = turn.points, turn.labels
    assert points.dtype == np.float32
    assert set(np.unique(labels)) == {SIDEWALK, WALL, POLE}
    assert len(points) > 0.8 * 32 * 1500
    assert misplaced(apply(pose, points), labels) < 1e-3


def test_noise_has_its_size() -> None:
    noisy = replace(QUIET, noise=0.05)
    pose = yaw_transform(0.0, (0.0, 0.0, 1.9))
    turn = full_sweep(room(), pose, np.random.default_rng(0), noisy)
    points, labels = turn.points, turn.labels
    straight = (labels == WALL) & (np.abs(points[:, 0]) < 0.5) & (np.abs(points[:, 2]) < 0.5)
    assert np.std(np.abs(points[straight, 1])) == pytest.approx(0.05, rel=0.2)


def test_the_same_generator_gives_the_same_sweep() -> None:
    pose = yaw_transform(0.0, (0.0, 0.0, 1.9))
    scene = room()
    first, again = (
        full_sweep(scene, pose, np.random.default_rng(5), MODELS["vlp16"]).points for _ in range(2)
    )
    np.testing.assert_array_equal(first, again)


def test_range_and_sector_are_kept() -> None:
    turn = full_sweep(
        room(),
        yaw_transform(0.0, (0.0, 0.0, 1.9)),
        np.random.default_rng(0),
        QUIET,
        SweepOptions(max_range=7.0, sector=(-0.8, 0.8)),
    )
    distance = np.linalg.norm(turn.points, axis=1)
    assert distance.max() < 7.0
    assert np.abs(np.arctan2(turn.points[:, 1], turn.points[:, 0])).max() <= 0.8
    assert len(turn.points) > 100


def test_rings_count_from_the_top_and_time_runs_clockwise() -> None:
    directions, ring, turn = beam_directions(MODELS["vlp16"], 8)
    assert directions.shape == (128, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-6)
    assert np.degrees(np.arcsin(directions[ring == 0, 2])) == pytest.approx(15.0, abs=1e-4)
    assert np.degrees(np.arcsin(directions[ring == 15, 2])) == pytest.approx(-15.0, abs=1e-4)
    azimuth = np.arctan2(directions[ring == 0, 1], directions[ring == 0, 0])
    assert (np.diff(azimuth) < 0).all()
    assert (np.diff(turn[ring == 0]) > 0).all()


def test_traffic_hides_what_is_behind_it() -> None:
    builder = MeshBuilder(lambda x, y: np.zeros_like(x))
    builder.add(box(1.0, 2.0, 4.0, x=5.0), CAR, ground="none")
    pose = yaw_transform(0.0, (0.0, 0.0, 1.9))
    turn = full_sweep(
        room(), pose, np.random.default_rng(0), QUIET, SweepOptions(traffic=Scene(builder.build()))
    )
    cars = turn.points[turn.labels == CAR]
    front = cars[np.abs(cars[:, 1]) < 0.9]
    assert front[:, 0] == pytest.approx(4.5, abs=1e-3)
    behind = (np.abs(turn.points[:, 1]) < 0.1 * turn.points[:, 0]) & (turn.points[:, 0] > 6)
    assert not behind.any()


@pytest.mark.parametrize("middle_yaw", [0.05, 0.02], ids=["evenly", "at changing rates"])
def test_a_moving_sensor_measures_in_the_frame_of_each_moment(middle_yaw: float) -> None:
    path = np.stack(
        [
            yaw_transform(0.0, (0.0, 0.0, 1.9)),
            yaw_transform(middle_yaw, (0.4, 0.05, 1.9)),
            yaw_transform(0.1, (0.8, 0.1, 1.9)),
        ]
    )
    turn = full_sweep(room(), path[0], np.random.default_rng(0), QUIET, SweepOptions(path=path))
    still = apply(path[0], turn.points)
    stamps = np.array([0, 5 * 10**8, 10**9])
    poses = interpolate(stamps, path, (turn.turn * 1e9).astype(np.int64))
    moved = np.einsum("nij,nj->ni", poses[:, :3, :3], turn.points) + poses[:, :3, 3]
    assert misplaced(moved, turn.labels) < 2e-3
    assert misplaced(still, turn.labels) > 0.3


def test_label_errors_have_their_share_and_stay_in_place() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(-40, 40, (60_000, 3))
    labels = rng.choice(np.array(sorted(CONFUSIONS), np.uint8), 60_000)
    assert (corrupt_labels(points, labels, 0, 0.0) == labels).all()
    wrong = corrupt_labels(points, labels, 7, 0.13) != labels
    assert wrong.mean() == pytest.approx(0.12, abs=0.02)
    np.testing.assert_array_equal(corrupt_labels(points, labels, 7, 0.13) != labels, wrong)
    assert ((corrupt_labels(points, labels, 8, 0.13) != labels) != wrong).mean() > 0.1


def test_label_errors_come_in_patches() -> None:
    grid = np.stack(
        np.meshgrid(np.arange(0, 20, 0.1), np.arange(0, 20, 0.1), [0.2], indexing="ij"), -1
    ).reshape(-1, 3)
    labels = np.full(len(grid), 2, np.uint8)
    wrong = (corrupt_labels(grid, labels, 3, 0.15) != labels).reshape(200, 200)
    neighbour = wrong[1:][wrong[:-1]].mean()
    assert neighbour > 3 * wrong.mean()


def test_no_class_is_confused_with_itself() -> None:
    assert set(CONFUSIONS) == {*range(19), 255} - {10}
    assert all(label not in wrong for label, wrong in CONFUSIONS.items())
