"""A driver that hangs and publishes its last measurement again is found where the vehicle moves."""

from __future__ import annotations

import numpy as np
import pytest

from semloc_logs.frames import DepthFrame, Header, LidarFrame
from semloc_logs.logs.poses.track import PoseTrack
from semloc_logs.logs.session.frame_queue import RangeFrame
from semloc_logs.logs.session.repeats import Repeats
from semloc_logs.numerics.transforms import yaw_transform

S = 1_000_000_000


def _frame(second: int, content: int, size: int = 1000, *, is_depth: bool = False) -> RangeFrame:
    header = Header("/points", second * S, second * S, "lidar")
    values = np.random.default_rng(content).uniform(1, 9, (size, 3)).astype(np.float32)
    if is_depth:
        return DepthFrame(header, values)
    return LidarFrame(header, values, None, None)


def _track(speed: float) -> PoseTrack:
    track = PoseTrack()
    for second in range(20):
        track.append(second * S, yaw_transform(0.0, (speed * second, 0.0, 0.0)))
    return track


@pytest.mark.parametrize("is_depth", [False, True])
def test_repeated_measurements_are_named_where_the_vehicle_moves(
    is_depth: bool,
) -> None:
    repeats = Repeats()
    contents = [1, 2, 3, 3, 3, 3, 4, 5, 5, 6]
    taken = [
        repeats.take(_frame(second, content, is_depth=is_depth))
        for second, content in enumerate(contents)
    ]
    assert taken == [False, False, False, True, True, True, False, False, True, False]
    assert repeats.text("/points", _track(0.0)) == ""
    text = repeats.text("/points", _track(1.0))
    assert "4 of its measurements are exactly the one before" in text
    assert "1970-01-01T00:00:02.000Z to 1970-01-01T00:00:05.000Z" in text
    assert repeats.text("/other", _track(1.0)) == ""


def test_frames_of_few_points_may_be_alike() -> None:
    repeats = Repeats()
    assert not any(repeats.take(_frame(second, 1, size=100)) for second in range(5))
