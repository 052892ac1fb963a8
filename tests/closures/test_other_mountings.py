"""Two sessions that mount one sensor differently, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from semloc_logs.closures.other_mountings import Mounted, contradiction
from semloc_logs.numerics.transforms import exp_se3


def session(
    x: float = 0.3,
    z: float = 1.9,
    roll: float = 0.0,
    *,
    height: float = 0.0,
    hidden: tuple[str, ...] = (),
    base: str = "base_link",
) -> Mounted:
    """A LIDAR at x, z with a roll (degrees), in a base frame ``height`` above the ground."""
    pose = exp_se3(np.zeros(3), np.array([np.radians(roll), 0.0, 0.0]))
    pose[:3, 3] = x, 0.0, z
    return Mounted(base, {"lidar": pose}, frozenset(hidden), height, 0.3)


@pytest.mark.parametrize(
    ("other", "words"),
    [
        (session(z=0.0, height=1.9), "at z = 1.90 m in one and at 0.00 m in the other"),
        (session(x=1.8, hidden=("lever_x_m",)), "shifted by 1.50 m along x between both"),
        (session(roll=5.0, hidden=("rotation_x_rad",)), "turned by 5.0 degrees about x"),
    ],
)
def test_mountings_of_which_one_is_wrong_are_named(other: Mounted, words: str) -> None:
    text = contradiction(session(), other)
    assert text.startswith("'lidar' is mounted in 'base_link' ")
    assert words in text
    assert contradiction(other, session()) != ""


@pytest.mark.parametrize(
    "other",
    [
        session(),
        session(z=0.0, height=0.0),  # a low vehicle: its sensor is lower, too
        session(z=0.0, height=np.nan),
        session(x=1.8),  # another vehicle, whose drive showed that its mounting fits
        session(x=0.9, hidden=("lever_x_m",)),  # 0.6 m: 2 voxels
        session(z=-1.9, roll=180.0, hidden=("rotation_x_rad",)),  # a base frame with z down
        session(roll=4.0, hidden=("rotation_x_rad",)),
        session(x=1.8, hidden=("lever_y_m", "rotation_x_rad")),
        session(x=1.8, hidden=("lever_x_m",), base="body"),
    ],
)
def test_other_vehicles_and_small_differences_are_not_named(other: Mounted) -> None:
    assert contradiction(session(), other) == ""
