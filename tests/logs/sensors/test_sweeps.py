"""LIDAR sweeps freed of the vehicle's motion."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.frames import Header, LidarFrame
from semloc_logs.logs.poses.track import PoseTrack
from semloc_logs.logs.sensors.sweeps import deskew, sweep_in_base
from semloc_logs.numerics import transforms
from semloc_logs.numerics.transforms import yaw_transform

S = 1_000_000_000
STAMP = 1_700_000_000 * S
BASE_T_SENSOR = yaw_transform(0.3, (1.0, 0.2, 1.5))


def pose(seconds: float) -> F64:
    """15 m/s in a bend of 0.5 rad/s."""
    return yaw_transform(0.5 * seconds, (15.0 * seconds, 0.4 * seconds, 0.0))


def track(first: float = -0.2, last: float = 0.31) -> PoseTrack:
    made = PoseTrack()
    for t in np.arange(first, last, 0.01):
        made.append(STAMP + round(t * S), pose(t))
    return made


def world_points(n: int = 500) -> F64:
    return np.random.default_rng(3).uniform(-40, 40, (n, 3))


def measured(world: F64, offset_ns: NDArray[np.int64]) -> F64:
    """What a moving sensor sees of resting points, point by point."""
    seen = [
        transforms.apply(transforms.inverse(pose(o * 1e-9) @ BASE_T_SENSOR), p[None])[0]
        for p, o in zip(world, offset_ns, strict=True)
    ]
    return np.array(seen)


@pytest.mark.parametrize(
    ("first", "last"), [(0, 100_000_000), (-100_000_000, 0), (-50_000_000, 50_000_000)]
)
def test_resting_points_come_out_where_they_are(first: int, last: int) -> None:
    world = world_points()
    offset = np.linspace(first, last, len(world)).astype(np.int64)
    frame = LidarFrame(
        Header("/l", STAMP, STAMP, "lidar"),
        measured(world, offset).astype(np.float32),
        offset_ns=offset,
    )
    points, _, is_deskewed = sweep_in_base(
        frame, BASE_T_SENSOR, track().at_many, min_range=0.0, max_range=200.0
    )
    assert is_deskewed
    # bins of a millisecond: 15 m/s * 0.5 ms, and 60 m * 0.5 rad/s * 0.5 ms
    np.testing.assert_allclose(points, world, atol=0.03)
    skewed, _, _ = sweep_in_base(frame, BASE_T_SENSOR, None, min_range=0.0, max_range=200.0)
    assert np.abs(skewed - world).max() > 0.5


def test_without_poses_for_the_whole_span_the_sweep_stays() -> None:
    world = world_points(50)
    offset = np.linspace(0, 400_000_000, 50).astype(np.int64)
    assert (
        deskew(world.astype(np.float32), offset, STAMP, BASE_T_SENSOR, track(-0.2, 0.2).at_many)
        is None
    )
    frame = LidarFrame(
        Header("/l", STAMP, STAMP, "lidar"), world.astype(np.float32), offset_ns=offset
    )
    points, _, is_deskewed = sweep_in_base(
        frame, BASE_T_SENSOR, track(-0.2, 0.2).at_many, min_range=0.0, max_range=200.0
    )
    assert not is_deskewed
    np.testing.assert_allclose(points, transforms.apply(BASE_T_SENSOR, world), atol=1e-4)


@pytest.mark.parametrize("span", [0, 5 * S, 2**62])
def test_times_that_are_no_sweep_are_not_used(span: int) -> None:
    points = world_points(10).astype(np.float32)
    offset = np.linspace(0, 1, 10) * span
    assert deskew(points, offset.astype(np.int64), STAMP, BASE_T_SENSOR, track().at_many) is None


def test_range_limits_and_labels_go_together() -> None:
    points = np.array([[0.2, 0, 0], [1, 0, 0], [50, 0, 0], [90, 0, 0]], np.float32)
    label = np.array([1, 2, 3, 4], np.uint32)
    frame = LidarFrame(Header("/l", STAMP, STAMP, "lidar"), points, label=label)
    kept, labels, _ = sweep_in_base(frame, np.eye(4), None, min_range=0.5, max_range=80.0)
    assert kept[:, 0].tolist() == [1, 50]
    assert labels is not None
    assert labels.tolist() == [2, 3]


def test_ranges_are_from_the_sensor_where_it_is_not_at_the_origin_of_its_frame() -> None:
    points = np.array([[10, 0, 0], [13, 0, 0], [0.1, 0, 0]], np.float32)
    header = Header("/l", STAMP, STAMP, "lidar")
    frame = LidarFrame(header, points, origin=np.array([9.8, 0, 0], np.float32))
    kept, _, _ = sweep_in_base(frame, np.eye(4), None, min_range=0.5, max_range=4.0)
    assert kept.tolist() == [[13, 0, 0]]
    frame = LidarFrame(header, points)
    kept, _, _ = sweep_in_base(frame, np.eye(4), None, min_range=0.5, max_range=4.0)
    assert len(kept) == 0
