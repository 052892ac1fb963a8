"""The order of stamps: outliers, clocks that are set back, and poses that do not move."""

from __future__ import annotations

import numpy as np
import pytest

from semloc_logs.logs.messages.stamps import StampOrder, time_range, utc
from semloc_logs.logs.poses.standstill import Standstill
from semloc_logs.logs.poses.track import PoseTrack
from semloc_logs.numerics.transforms import yaw_transform

S = 1_000_000_000


@pytest.mark.parametrize(
    ("seconds", "refused"),
    [
        ([0, 1, 2, 3], []),
        ([0, 1, 1, 2], []),
        ([0, 1.0, 0.5, 2], []),  # overtaken
        ([0, 1, 2, 3600, 3, 4], []),  # one leaps; it has no pose, so it is left out by that
        ([0, 1, 2, 100, 101, 102], []),  # a pause
        ([0, 1, 50, 100, 150], []),  # a slow stream
        ([100, 101, 102, 50, 51, 103], [50, 51]),
        ([3600, 0, 1, 2], []),  # the first one leaps
        ([0, 1, 2, 3600, 3601, 3, 4], [3, 4]),
        ([0, 1, 3600, 7200, 2, 3], []),
    ],
)
def test_stamps_that_go_back_are_refused(seconds: list[float], refused: list[float]) -> None:
    order = StampOrder()
    assert [s for s in seconds if not order.accepts(round(s * S))] == refused


def test_whether_a_track_moves() -> None:
    made = PoseTrack()
    assert not made.moves
    for k in range(5):
        made.append(k * S, yaw_transform(0.1 * k, (1.0, 2.0, 3.0)))
    assert not made.moves
    made.append(9 * S, yaw_transform(0.0, (1.0, 2.0, 3.01)))
    assert made.moves


@pytest.mark.parametrize("still", [slice(0, 20), slice(0, 10), slice(10, 20)])
@pytest.mark.parametrize(("speed", "moves"), [(0.0, False), (0.2, True), (3.0, True)])
def test_surroundings_that_move_while_the_poses_stand(
    speed: float, moves: bool, still: slice
) -> None:
    """The poses stand still all the time, or for half of it; else they are right."""
    rng = np.random.default_rng(2)
    watch = Standstill()
    frozen = range(20)[still]
    for k in range(20):
        street = np.c_[
            rng.uniform(-20, 20, 5000), rng.choice([-6.0, 6.0], 5000), rng.uniform(0, 4, 5000)
        ]
        street = np.r_[
            street, np.c_[np.full(5000, 25.0), rng.uniform(-6, 6, 5000), rng.uniform(0, 4, 5000)]
        ]
        street += rng.normal(0, 0.02, street.shape)
        x = speed * (frozen[0] if k in frozen else k)
        cloud = (street - [speed * k, 0, 0]).astype(np.float32)
        watch.add(cloud, yaw_transform(0.0, (x, 0, 0)), k * S)
    assert (watch.shift > 0) == moves
    if watch.worst is not None:
        assert watch.worst.start_ns == frozen[0] * S
        assert watch.worst.end_ns == frozen[-1] * S


def test_surroundings_that_move_while_the_poses_only_turn() -> None:
    """Positions in degrees hardly change, but rotations and altitudes are right."""
    rng = np.random.default_rng(3)
    watch = Standstill()
    still = Standstill()
    corner = np.r_[
        np.c_[rng.uniform(-20, 20, 5000), np.full(5000, 6.0), rng.uniform(0, 4, 5000)],
        np.c_[np.full(5000, 25.0), rng.uniform(-6, 6, 5000), rng.uniform(0, 4, 5000)],
    ]
    for k in range(24):
        pose = yaw_transform(0.03 * k, (8.4, 49.0, 0.0))
        for watched, way in ((watch, 2.0 * k), (still, 0.0)):
            seen = corner - [way, 0.0, 0.0] + rng.normal(0, 0.02, corner.shape)
            cloud = (seen @ pose[:3, :3]).astype(np.float32)
            pose[2, 3] = 0.01 * k
            watched.add(cloud, pose, k * S)
    assert watch.shift > 1.0
    assert still.shift == 0.0


def test_times_for_people() -> None:
    assert utc(1_700_000_000_123_456_789) == "2023-11-14T22:13:20.123Z"
    assert utc(1 << 62) == "2116-02-20T23:53:38.427Z"
    assert utc(1 << 80) == f"{1 << 80} ns"
    assert time_range(0, 1_500_000_000) == "1970-01-01T00:00:00.000Z to 1970-01-01T00:00:01.500Z"
    assert time_range(None, 1) == "none"
