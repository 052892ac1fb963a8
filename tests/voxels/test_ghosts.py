"""A car that drives through the view leaves no trail: later rays through its track carve it free,
within a submap and across submaps.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.settings import ResolvedFusion, Settings
from semloc_logs.voxels.grid import BlockMap, Fuser
from semloc_logs.voxels.store import write_voxels

SENSOR = np.array([0.0, 0.0, 1.2])
# the wall stands across x; cars drive along y before it
WALL_X = 14.0
CAR_X = 7.0
CAR_SIZE = np.array([1.8, 4.0, 1.5])
CAR, BUILDING, ROAD = 13, 2, 0
METADATA = {"schema_version": 1}


def directions() -> F64:
    """A LIDAR of 3 beams a degree sideways and up and down (n, 3)."""
    azimuth, elevation = np.meshgrid(
        np.radians(np.arange(-50, 50, 0.4)), np.radians(np.arange(-14, 8, 0.4))
    )
    return np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        -1,
    ).reshape(-1, 3)


def sweep(car_y: float | None) -> tuple[F64, NDArray[np.uint8]]:
    """End points (n, 3) of the rays and their classes: wall, road, and a box whose middle is at
    ``car_y``.
    """
    rays = directions()
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (WALL_X - SENSOR[0]) / rays[:, 0]
        label = np.full(len(rays), BUILDING, np.uint8)
        to_road = np.where(rays[:, 2] < 0, -SENSOR[2] / rays[:, 2], np.inf)
        label[to_road < reach] = ROAD
        reach = np.minimum(reach, to_road)
        if car_y is not None:
            low = np.array([CAR_X, car_y - CAR_SIZE[1] / 2, 0.02])
            to_low = (low - SENSOR) / rays
            far = (low + CAR_SIZE - SENSOR) / rays
            enters = np.minimum(to_low, far).max(1)
            leaves = np.maximum(to_low, far).min(1)
            hit = (enters < leaves) & (enters > 0) & (enters < reach)
            reach[hit], label[hit] = enters[hit], CAR
    return SENSOR + rays * reach[:, None], label


def settings() -> ResolvedFusion:
    return Settings.model_validate({"fusion": {"voxel_size": 0.3}}).resolved().fusion


def fused(cars: list[float | None]) -> BlockMap:
    fuser = Fuser(settings())
    for car_y in cars:
        points, label = sweep(car_y)
        fuser.add(points, label, SENSOR)
    return fuser.finish()


def on_track(ijk: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Voxels (n, 3) above the road where cars were, in the part of their way that has the wall
    behind it.
    """
    centre = (ijk + 0.5) * 0.3
    return np.asarray(
        (centre[:, 0] > CAR_X - 0.5)
        & (centre[:, 0] < CAR_X + CAR_SIZE[0] + 0.5)
        & (np.abs(centre[:, 1]) < 6)
        & (centre[:, 2] > 0.3)
    )


def wall(ijk: NDArray[np.int32]) -> set[tuple[int, ...]]:
    return {tuple(v) for v in ijk[np.abs((ijk[:, 0] + 0.5) * 0.3 - WALL_X) < 0.31].tolist()}


THROUGH: list[float | None] = [float(y) for y in np.arange(-12, 12.1, 0.8)]  # 8 m/s at 10 Hz
NOBODY: list[float | None] = [None] * 8


def test_while_the_car_is_there_it_is_in_the_map() -> None:
    ijk, label, *_ = fused([0.0] * 3).occupied()
    assert on_track(ijk).sum() > 50
    assert set(label[on_track(ijk)].tolist()) == {CAR}


@pytest.mark.parametrize("before", [0, 3])
def test_a_car_that_drove_by_leaves_no_voxel_on_its_track_and_the_wall_stays(before: int) -> None:
    ghost = fused(NOBODY[:before] + THROUGH + NOBODY)
    alone = fused(NOBODY[:before] + [None] * len(THROUGH) + NOBODY)
    ijk = ghost.occupied()[0]
    assert ijk[on_track(ijk)].tolist() == []
    expected = wall(alone.occupied()[0])
    assert len(expected) > 500
    assert len(wall(ijk) & expected) > 0.99 * len(expected)


def session_map(
    submaps: list[BlockMap], folder: Path
) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
    """Voxels (n, 3) and classes (n,) of the map written from submaps."""
    write_voxels(folder / "voxels", submaps, METADATA, settings().clamp)
    tables = [pq.ParquetFile(p).read() for p in (folder / "voxels").rglob("*.parquet")]
    ijk = np.concatenate(
        [np.stack([t[c].to_numpy() for c in ("ix", "iy", "iz")], 1) for t in tables]
    )
    return ijk, np.concatenate([t["label"].to_numpy() for t in tables])


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_car_that_one_submap_still_holds_is_carved_by_the_next_one(
    order: tuple[int, int], tmp_path: Path
) -> None:
    """The first submap ends while a car at 20 m/s is in view, so that each voxel was hit twice."""
    submaps = [fused([float(y) for y in np.arange(-12, 0.1, 2)]), fused(NOBODY)]
    ijk, label, *_ = submaps[0].occupied()
    assert on_track(ijk).sum() > 10
    assert CAR in label.tolist()
    ijk_left, _ = session_map([submaps[i] for i in order], tmp_path)
    assert ijk_left[on_track(ijk_left)].tolist() == []
    expected = wall(submaps[1].occupied()[0])
    assert len(wall(ijk_left) & expected) > 0.99 * len(expected)


@pytest.mark.parametrize(("visits", "stays"), [(1, True), (2, False)])
def test_a_parked_car_that_left_is_gone_after_two_submaps_without_it(
    visits: int, stays: bool, tmp_path: Path
) -> None:
    """Clamped at 3.5 and -2 a submap, it takes two that saw the place free."""
    ijk, label = session_map([fused([0.0] * 8), *([fused(NOBODY)] * visits)], tmp_path)
    assert (CAR in label[on_track(ijk)].tolist()) == stays


def test_a_car_that_every_submap_saw_stays(tmp_path: Path) -> None:
    ijk, label = session_map([fused([0.0] * 8), fused([0.0] * 8)], tmp_path)
    assert (label[on_track(ijk)] == CAR).sum() > 50
