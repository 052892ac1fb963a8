"""Other readings of poses, on pairs made by hand: parts of poses that are of different times."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from semloc_logs.arrays import F64
from semloc_logs.logs.poses.track import PoseTrack
from semloc_logs.mapping.fit.model import Pairs, cost_of, pose_motion
from semloc_logs.mapping.fit.readings import near_reading
from semloc_logs.numerics.transforms import inverse, yaw_transform

SECOND = 1_000_000_000
END = 12.0  # s; of the poses
SIGMAS = np.diag([0.02, 0.02, 0.02, 0.005, 0.005, 0.005]) ** 2


def winding(seconds: float) -> F64:
    """6 m/s along x; the vehicle swerves by 2 m and turns by 14 degrees to and fro."""
    side = 2.0 * np.sin(0.8 * seconds)
    return yaw_transform(0.25 * np.cos(0.8 * seconds), (6.0 * seconds, side, 0.0))


def recorded(part: slice, lag: float) -> PoseTrack:
    """Poses twenty times a second until :data:`END`, one part of which is ``lag`` seconds late."""
    track = PoseTrack()
    for seconds in np.arange(0.0, END + 0.01, 0.05):
        pose = winding(seconds)
        pose[:3, part] = winding(seconds - lag)[:3, part]
        track.append(round(seconds * SECOND), pose)
    return track


def pairs_of(poses: Callable[[float], F64]) -> Pairs:
    """Pairs of clouds 0.5 s apart until the end of the poses, registered as ``poses`` have it."""
    starts = np.arange(0.5, END - 0.4, 0.5)
    stamps = np.round(np.c_[starts, starts + 0.5] * SECOND).astype(np.int64)
    measured = np.array([inverse(poses(s)) @ poses(s + 0.5) for s in starts])
    return Pairs(stamps, measured, np.tile(SIGMAS, (len(starts), 1, 1)))


def reading(pairs: Pairs, track: PoseTrack) -> str:
    none = cost_of(pairs.residuals(pose_motion(pairs, track.at_many, np.zeros(8))))
    return near_reading(pairs, track.at_many, none, none)


@pytest.mark.parametrize("lag", [0.6, -0.6])
@pytest.mark.parametrize(("part", "name"), [(slice(3), "rotations"), (slice(3, 4), "positions")])
def test_a_lag_is_found_where_it_leads_beyond_the_ends_of_the_poses(
    lag: float, part: slice, name: str
) -> None:
    """Of 23 pairs the last two, or the first one, would need poses that were not recorded."""
    text = reading(pairs_of(winding), recorded(part, lag))
    side = "later" if lag > 0 else "earlier"
    assert f"the poses fit when their {name} are taken 0.60 s {side}" in text


def test_pairs_that_a_lag_would_lose_do_not_speak_for_it() -> None:
    """Wheels slip by 3 m in the last pair: without this pair any lag would fit far better."""

    def straight(seconds: float) -> F64:
        """A steady drive, which no lag contradicts."""
        return yaw_transform(0.0, (6.0 * seconds, 0.0, 0.0))

    def slipping(seconds: float) -> F64:
        slip = 3.0 if seconds > END - 0.3 else 0.0
        return yaw_transform(0.0, (6.0 * seconds + slip, 0.0, 0.0))

    track = PoseTrack()
    for seconds in np.arange(0.0, END + 0.01, 0.05):
        track.append(round(seconds * SECOND), straight(seconds))
    assert reading(pairs_of(slipping), track) == ""
