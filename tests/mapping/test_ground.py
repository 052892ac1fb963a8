from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from semloc_logs.arrays import F64
from semloc_logs.labels.sweep_ground import ground_surface
from semloc_logs.mapping.ground import GroundMap, GroundMapper, ground_height, write_ground
from semloc_logs.tables.table import read_metadata, read_table


def hill(xy: F64) -> F64:
    return np.asarray(2.0 * np.sin(xy[:, 0] / 15) + 0.05 * xy[:, 1])


def sweep(
    rng: np.random.Generator, position: tuple[float, float], scale: float = 1.0
) -> tuple[F64, F64]:
    """Ground within 20 m, a bridge 5 m above it, a hole of 3 m where nothing is seen."""
    r = 20 * np.sqrt(rng.random(9000))
    a = rng.uniform(0, 2 * np.pi, 9000)
    xy = np.c_[r * np.cos(a), r * np.sin(a)] + position
    xy = xy[np.hypot(*(xy - [4.0, 4.0]).T) > 3]
    deck = rng.uniform((-30, 8), (60, 11), (3000, 2))
    points = np.concatenate(
        [np.c_[xy, hill(xy) + rng.normal(0, 0.01, len(xy))], np.c_[deck, hill(deck) + 5]]
    )
    eye = np.array([*position, hill(np.array([position]))[0] + 1.8])
    return points * scale, eye * scale


@pytest.mark.parametrize("scale", [1.0, 1 / 6])
def test_a_hill_driven_over(scale: float) -> None:
    rng = np.random.default_rng(0)
    mapper = GroundMapper(scale)
    for x in range(0, 31, 6):
        points, eye = sweep(rng, (float(x), 0.0), scale)
        mapper.add(ground_surface(points, eye, scale), eye)
    ground = mapper.finish()
    centres = (ground.ij + 0.5) * ground.cell / scale
    # around the road, and not below the bridge, whose edge it is for some keyframes
    road = (np.abs(centres - [15.0, 0.0]) < [30.0, 15.0]).all(1)
    off = ground.z[road] / scale - hill(np.asarray(centres[road], float))
    assert len(off) > 1500
    assert np.abs(off).max() < 0.25  # a cell of 1 m at slopes up to 14 %
    assert np.median(np.abs(off)) < 0.05


def test_of_two_levels_the_one_that_is_seen_more() -> None:
    xy = np.random.default_rng(1).uniform(-10, 10, (4000, 2))
    mapper = GroundMapper(1.0)
    for z in (0.02, 0.02, -0.02, 6.0):  # across the border of two levels, and on a deck
        points = np.c_[xy, np.full(len(xy), z)]
        mapper.add(ground_surface(points, np.array([0, 0, z + 1.8])), np.array([0, 0, z + 1.8]))
    ground = mapper.finish()
    middle = (np.abs(ground.ij) <= 2).all(1)
    assert ground.z[middle] == pytest.approx(0.02 / 3, abs=0.005)
    assert ground.frames.max() == 3


def test_the_order_of_keyframes_does_not_matter() -> None:
    rng = np.random.default_rng(2)
    sweeps = [sweep(rng, (float(x), 0.0)) for x in (0, 7, 14)]
    grounds = []
    for order in ((0, 1, 2), (2, 0, 1)):
        mapper = GroundMapper(1.0)
        for k in order:
            points, eye = sweeps[k]
            mapper.add(ground_surface(points, eye), eye)
        grounds.append(mapper.finish())
    assert (grounds[0].ij == grounds[1].ij).all()
    np.testing.assert_allclose(grounds[0].z, grounds[1].z, atol=1e-12)


def test_written_and_read_again(tmp_path: Path) -> None:
    ground = GroundMap(
        0.5,
        np.array([[-3, 2], [4, 5]], np.int32),
        np.array([1.25, -2.5]),
        np.array([1, 7], np.int32),
    )
    write_ground(tmp_path / "ground.parquet", ground, {"schema_version": 1})
    table = read_table(tmp_path / "ground.parquet")
    assert read_metadata(tmp_path / "ground.parquet")["cell"] == 0.5
    assert table.to_pydict() == {
        "ix": [-3, 4],
        "iy": [2, 5],
        "z": [1.25, -2.5],
        "frames": [1, 7],
    }


def test_nothing_seen() -> None:
    assert len(GroundMapper(1.0).finish().z) == 0
    mapper = GroundMapper(1.0)
    mapper.add(ground_surface(np.zeros((0, 3)), np.zeros(3)), np.zeros(3))
    assert len(mapper.finish().z) == 0


def test_keyframes_that_tell_nothing_new_are_not_wanted() -> None:
    mapper = GroundMapper(0.5)  # of voxels of 0.15 m: everything is half as far
    assert mapper.wants(np.zeros(3))
    points = np.random.default_rng(0).uniform([-10, -10, -1], [10, 10, -1], (500, 3))
    mapper.add(ground_surface(points, np.zeros(3), 0.5), np.zeros(3))
    assert not mapper.wants(np.array([1.9, 0, 0]))
    assert mapper.wants(np.array([2.1, 0, 0]))


@pytest.mark.parametrize("scale", [1.0, 1 / 6])
def test_the_height_below_a_sensor(scale: float) -> None:
    rng = np.random.default_rng(0)
    ground = np.c_[rng.uniform(-20, 20, (3000, 2)), rng.normal(-1.73, 0.02, 3000)]
    house = np.c_[rng.uniform(5, 6, (4000, 2)), rng.uniform(-1.7, 6, 4000)]
    below = np.c_[rng.uniform(-20, 20, (40, 2)), rng.uniform(-4, -2, 40)]
    far = np.c_[rng.uniform(30, 40, (9000, 2)), np.full(9000, -3.0)]  # down the hill
    points = scale * np.concatenate([ground, house, below, far])
    assert ground_height(points, np.zeros(3), scale) == pytest.approx(
        -1.73 * scale, abs=0.02 * scale
    )
    there = np.array([40.0, -3.0, 7.0])
    assert ground_height(points + there, there, scale) == pytest.approx(
        7 - 1.73 * scale, abs=0.02 * scale
    )
    assert ground_height(np.zeros((0, 3)), np.array([0, 0, 2.0]), scale) == pytest.approx(
        2 - 1.7 * scale
    )
    few = scale * np.c_[np.zeros((50, 2)), np.linspace(-2, 0, 50)]
    assert ground_height(few, np.zeros(3), scale) == pytest.approx(np.percentile(few[:, 2], 2))
