"""How far poses between poses are off: on a circle, the sagitta of the chord."""

from __future__ import annotations

import numpy as np
import pytest

from semloc_logs.logs.poses.track import PoseTrack
from semloc_logs.mapping.fit.interpolation import interpolation_errors
from semloc_logs.numerics.transforms import yaw_transform

SECOND = 1_000_000_000


def circle(period: float, *, speed: float = 5.0, radius: float = 10.0) -> PoseTrack:
    """20 s at ``speed`` on a circle; the vehicle turns steadily."""
    track = PoseTrack()
    for seconds in np.arange(0.0, 20.0, period):
        angle = speed * seconds / radius
        place = (radius * np.sin(angle), radius * (1.0 - np.cos(angle)), 0.0)
        track.append(round(seconds * SECOND), yaw_transform(angle, place))
    return track


def test_the_error_on_a_circle_is_the_sagitta_of_the_chord() -> None:
    """5 m of a circle of 10 m have a sagitta of 10 (1 - cos 0.25) = 0.31 m; turns are steady."""
    stamps = np.array([5.0, 5.25, 5.5, 6.0, 25.0]) * SECOND
    meters, radians = interpolation_errors(circle(1.0), stamps.astype(np.int64))
    middle = 10.0 * (1.0 - np.cos(0.25))
    assert meters == pytest.approx([0.0, 0.75 * middle, middle, 0.0, 0.0], abs=0.01)
    assert radians == pytest.approx(0.0, abs=1e-6)
    # twice as often: a quarter
    meters, _ = interpolation_errors(circle(0.5), np.array([5.25 * SECOND], np.int64))
    assert meters[0] == pytest.approx(middle / 4.0, abs=0.005)


@pytest.mark.parametrize("apart", [0.1, 1.0])
def test_noise_of_poses_in_pairs_is_taken_for_no_motion(apart: float) -> None:
    """Pairs of poses 1 ms apart with 5 mm of noise, on a straight way."""
    rng = np.random.default_rng(1)
    track = PoseTrack()
    for seconds in np.arange(0.0, 20.0, apart):
        for later in (0.0, 1e-3):
            place = np.array([5.0 * (seconds + later), 0.0, 0.0]) + rng.normal(0, 5e-3, 3)
            pose = yaw_transform(float(rng.normal(0, 5e-4)), (place[0], place[1], place[2]))
            track.append(round((seconds + later) * SECOND), pose)
    stamps = (np.arange(2.0, 18.0, 0.37) * SECOND).astype(np.int64)
    meters, radians = interpolation_errors(track, stamps)
    assert meters.max() < 0.05
    assert radians.max() < 0.01


def test_a_vehicle_that_swings_is_off_in_its_rotation() -> None:
    """20 degrees to and fro in 4 s, at +-45 degrees of it each second: twice +14, twice -14.

    The second difference at the outer ones is 28 degrees: an eighth of it in the middle.
    """
    track = PoseTrack()
    for k in range(20):
        yaw = np.radians(20.0) * np.cos(np.pi / 2 * (k + 0.5))
        track.append(k * SECOND, yaw_transform(yaw, (0.0, 0.0, 0.0)))
    _, radians = interpolation_errors(track, np.array([7.5 * SECOND], np.int64))
    assert np.degrees(radians[0]) == pytest.approx(20.0 * np.cos(np.pi / 4) / 4.0)


def test_gaps_and_few_poses_tell_nothing() -> None:
    gap = PoseTrack()
    for seconds in (*np.arange(0.0, 3.0, 0.1), *np.arange(9.0, 12.0, 0.1)):
        gap.append(round(seconds * SECOND), yaw_transform(seconds, (seconds**2, 0.0, 0.0)))
    stamps = np.array([5 * SECOND], np.int64)
    assert interpolation_errors(gap, stamps)[0].tolist() == [0.0]
    assert interpolation_errors(PoseTrack(), stamps)[0].tolist() == [0.0]
