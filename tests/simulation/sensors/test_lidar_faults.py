"""What a lidar does wrong, each fault on surfaces where its size is known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from semloc_logs.numerics.transforms import yaw_transform
from semloc_logs.simulation.meshes.world import (
    BUILDING,
    CAR,
    ROAD,
    VEGETATION,
    WALL,
    MeshBuilder,
    Scene,
    box,
)
from semloc_logs.simulation.sensors.echoes import (
    beyond_edges,
    is_heard,
    is_pane,
    mixed_ranges,
    reflectance,
)
from semloc_logs.simulation.sensors.label_errors import CONFUSIONS, corrupt_labels
from semloc_logs.simulation.sensors.lidar import SweepOptions, full_sweep
from semloc_logs.simulation.sensors.lidar_models import MODELS, beam_directions, is_blocked

PERFECT = replace(
    MODELS["hdl64"], noise=0.0, beam_bias=0.0, pointing_deg=0.0, divergence=0.0, lift=(), blocked=()
)


def wall(x: float = 10.0) -> MeshBuilder:
    """A wall 60 m wide and 40 m high whose face is at ``x``."""
    builder = MeshBuilder(lambda a, b: np.zeros_like(a))
    builder.add(box(1.0, 60.0, 40.0, x=x + 0.5, z=-20.0), WALL, ground="none")
    return builder


def ahead(scene: Scene, model: str = "hdl64", **changes: Any) -> np.ndarray:
    sensor = replace(PERFECT, **changes)
    options = SweepOptions(sector=(-0.5, 0.5))
    return full_sweep(scene, np.eye(4), np.random.default_rng(3), sensor, options).points


def test_noise_is_along_the_beam() -> None:
    points = ahead(Scene(wall().build()), noise=0.05)
    cosine = points[:, 0] / np.linalg.norm(points, axis=1)
    error = (points[:, 0] - 10.0) / cosine
    assert error.mean() == pytest.approx(0.0, abs=0.002)
    assert error[cosine > 0.98].std() == pytest.approx(0.05, rel=0.03)


def test_every_beam_has_a_bias_of_its_own() -> None:
    scene = Scene(wall().build())
    turn = full_sweep(
        scene,
        np.eye(4),
        np.random.default_rng(0),
        replace(PERFECT, beam_bias=0.02),
        SweepOptions(sector=(-0.3, 0.3)),
    )
    error = np.linalg.norm(turn.points, axis=1) * (1 - 10.0 / turn.points[:, 0])
    per_beam = np.array([error[turn.ring == k].mean() for k in range(64)])
    assert per_beam.std() == pytest.approx(0.02, rel=0.35)
    assert all(error[turn.ring == k].std() < 1e-3 for k in range(64))


def test_azimuths_are_off_by_the_pointing_error() -> None:
    points = ahead(Scene(wall().build()), pointing_deg=0.05)
    # a wall at 30 degrees: an azimuth that is off by e shifts the range by r e tan 30
    slanted = points[np.abs(np.arctan2(points[:, 1], points[:, 0]) - 0.45) < 0.03]
    off = (slanted[:, 0] - 10.0) / (10.0 * np.tan(0.45))
    assert off.std() == pytest.approx(np.radians(0.05), rel=0.2)


def test_lifted_beams_start_higher() -> None:
    builder = MeshBuilder(lambda a, b: np.zeros_like(a))
    builder.add(box(100.0, 100.0, 1.0, z=-3.0), ROAD, ground="none")
    points = ahead(Scene(builder.build()), lift=(0.5,) * 64)
    assert points[:, 2] == pytest.approx(-2.0, abs=1e-3)
    distance = np.hypot(points[:, 0], points[:, 1])
    assert distance.min() == pytest.approx(2.5 / np.tan(np.radians(24.4)), abs=0.01)


def test_mixed_ranges_lie_between() -> None:
    builder = wall(12.0)
    # its face at 11.2, 0.8 m before the wall
    builder.add(box(0.2, 0.6, 40.0, x=11.3, z=-20.0), WALL, ground="none")
    clean, mixed = (ahead(Scene(builder.build()), divergence=d) for d in (0.0, 0.003))
    # apart from the sides of the bar
    assert ((clean[:, 0] > 11.45) & (clean[:, 0] < 11.95)).sum() == 0
    between = (mixed[:, 0] > 11.25) & (mixed[:, 0] < 11.95)
    # two edges x 64 beams; 0.994 of the beams at an edge are cut, 1.5 / (1.5 + 0.8) of these mix,
    # 0.875 of these within the band
    assert between.sum() == pytest.approx(2 * 64 * 0.994 * 0.652 * 0.875, rel=0.2)
    assert mixed[:, 0].min() > 11.19
    assert mixed[:, 0].max() < 12.01


def test_far_steps_rarely_mix_and_nothing_mixes_with_the_sky() -> None:
    grid = np.full((4000, 1), 5.0, np.float32)
    grid[1::2] = 65.0
    mixed = mixed_ranges(np.random.default_rng(0), grid, 0.003, 0.003)
    assert ((mixed > 5.01) & (mixed < 64.99)).mean() == pytest.approx(1.5 / 61.5 * 2 * 0.5, rel=0.3)
    grid[1::2] = np.inf
    np.testing.assert_array_equal(mixed_ranges(np.random.default_rng(0), grid, 0.003, 0.003), grid)


def test_echoes_fade_with_range_and_incidence() -> None:
    rng = np.random.default_rng(0)

    def heard(distance: float, cosine: float, reflected: float) -> float:
        n = 20_000
        return float(
            is_heard(rng, np.full(n, distance), np.full(n, cosine), np.full(n, reflected)).mean()
        )

    assert heard(20.0, 1.0, 0.3) > 0.99
    # asphalt from 1.73 m at 50 m: 0.18 * 1.73 / 50 / 50^2 = 2.49e-6, 1 - exp(-1.1 * 2.49 / 1.2)
    assert heard(50.0, 1.73 / 50, 0.18) == pytest.approx(0.898, abs=0.02)
    assert heard(90.0, 1.73 / 90, 0.18) < 0.4
    assert heard(50.0, 1.73 / 50, 0.018) == pytest.approx(0.204, abs=0.02)  # wet


def test_cars_lose_a_tenth_of_their_echoes_and_houses_a_hundredth() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(-30, 30, (100_000, 3))
    lost = {}
    for label in (CAR, BUILDING, VEGETATION):
        labels = np.full(len(points), label, np.uint8)
        distance = np.full(len(points), 12.0)
        cosine = np.full(len(points), 0.7)
        lost[label] = 1 - is_heard(rng, distance, cosine, reflectance(points, labels)).mean()
    assert 0.05 < lost[CAR] < 0.15
    assert 0.003 < lost[BUILDING] < 0.03
    assert lost[VEGETATION] < 0.005
    assert is_pane(points, np.full(len(points), CAR, np.uint8)).mean() == pytest.approx(
        0.11, abs=0.01
    )


def test_water_darkens_the_road_alone() -> None:
    points = np.random.default_rng(1).uniform(-30, 30, (100, 3))
    for label, factor in ((ROAD, 0.1), (VEGETATION, 1.0)):
        labels = np.full(100, label, np.uint8)
        np.testing.assert_allclose(
            reflectance(points, labels, 1.0), factor * reflectance(points, labels)
        )


def test_the_vehicle_hides_what_is_behind_it() -> None:
    model = MODELS["hdl64"]
    directions, _, _ = beam_directions(model, 360)
    blocked = is_blocked(model, directions)
    azimuth = np.degrees(np.arctan2(directions[:, 1], directions[:, 0])) % 360
    elevation = np.degrees(np.arcsin(directions[:, 2]))
    assert blocked[(azimuth > 160) & (azimuth < 200) & (elevation < -18.5)].all()
    assert not blocked[(azimuth < 100) | (elevation > -16.8)].any()
    builder = MeshBuilder(lambda a, b: np.zeros_like(a))
    builder.add(box(100.0, 100.0, 1.0, z=-1.0), ROAD, ground="none")
    turn = full_sweep(
        Scene(builder.build()),
        yaw_transform(0.0, (0.0, 0.0, 1.73)),
        np.random.default_rng(0),
        model,
    )
    behind = (np.abs(turn.points[:, 1]) < 0.5) & (turn.points[:, 0] < 0)
    before = (np.abs(turn.points[:, 1]) < 0.5) & (turn.points[:, 0] > 0)
    assert np.abs(turn.points[behind, 0]).min() > 5.0
    assert turn.points[before, 0].min() < 4.5


@pytest.mark.parametrize(
    ("name", "width", "rise", "points"),
    [("rosette", 70.4, 77.2, 24_000), ("raster", 120.0, 25.0, 40_000)],
)
def test_solid_state_sensors_see_a_window(
    name: str, width: float, rise: float, points: int
) -> None:
    model = MODELS[name]
    directions, ring, turn = beam_directions(model, model.columns, moment=0.3)
    assert len(directions) == len(ring) == len(turn) == points
    azimuth = np.degrees(np.arctan2(directions[:, 1], directions[:, 0]))
    elevation = np.degrees(np.arcsin(directions[:, 2]))
    assert np.ptp(azimuth) == pytest.approx(width, rel=0.02)
    assert np.ptp(elevation) == pytest.approx(rise, rel=0.04)
    assert (turn >= 0).all()
    assert (turn < 1).all()


def test_a_rosette_fills_its_window_with_time_and_a_raster_does_not() -> None:
    def cells(name: str, moment: float) -> set[int]:
        directions, _, _ = beam_directions(MODELS[name], MODELS[name].columns, moment=moment)
        return set(
            (np.round(directions[:, 1] * 200) * 10_000 + np.round(directions[:, 2] * 200))
            .astype(int)
            .tolist()
        )

    assert len(cells("rosette", 0.0) | cells("rosette", 0.1)) > 1.3 * len(cells("rosette", 0.0))
    assert cells("raster", 0.0) == cells("raster", 0.1)


def grid_of_labels() -> tuple[np.ndarray, np.ndarray]:
    grid = np.stack(
        np.meshgrid(np.arange(0, 40, 0.1), np.arange(0, 40, 0.1), [0.2], indexing="ij"), -1
    ).reshape(-1, 3)
    return grid, np.full(len(grid), BUILDING, np.uint8)


@pytest.mark.parametrize("rate", [0.05, 0.12, 0.3])
def test_as_many_labels_are_wrong_as_asked(rate: float) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-60, 60, (100_000, 3))
    labels = rng.choice(np.array(sorted(CONFUSIONS), np.uint8), len(points))
    for frame in (None, 4):
        assert (
            corrupt_labels(points, labels, 5, rate, frame=frame) != labels
        ).mean() == pytest.approx(rate, rel=0.06)


def test_half_of_the_errors_stay_from_frame_to_frame() -> None:
    points, labels = grid_of_labels()
    first, second = (corrupt_labels(points, labels, 1, 0.12, frame=k) != labels for k in (0, 1))
    stays = (first & second).mean() / first.mean()
    # 45 of 100 errors are fixed to places; of the others one in ten falls on another by chance
    assert stays == pytest.approx(0.45 + 0.55 * 0.08, abs=0.12)


def test_errors_are_alike_nearby() -> None:
    points, labels = grid_of_labels()
    wrong = (corrupt_labels(points, labels, 1, 0.12, frame=0) != labels).reshape(400, 400)
    share_near = wrong[2:][wrong[:-2]].mean()
    far = wrong[100:][wrong[:-100]].mean()
    assert share_near > 0.5
    assert far < 0.25


def test_classes_bleed_over_edges_only() -> None:
    distance = np.full((100, 4), 20.0, np.float32)
    labels = np.full((100, 4), BUILDING, np.uint8)
    distance[40:60], labels[40:60] = 8.0, CAR
    beyond = beyond_edges(distance, labels)
    assert (np.flatnonzero(beyond[:, 0] != labels[:, 0]) == [38, 39, 40, 41, 58, 59, 60, 61]).all()
    assert (beyond[[38, 39]] == CAR).all()
    assert (beyond[[40, 41]] == BUILDING).all()
    # where both surfaces meet without a step nothing bleeds
    assert (beyond_edges(np.full((100, 4), 20.0, np.float32), labels) == labels).all()
    points = np.random.default_rng(0).uniform(-20, 20, (400, 3))
    wrong = corrupt_labels(points, labels.ravel(), 0, 0.15, frame=0, beyond=beyond.ravel())
    bled = (wrong == beyond.ravel()) & (wrong != labels.ravel())
    assert 3 <= bled.sum() <= 25
