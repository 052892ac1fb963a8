"""Directions of travel and the windows of the paper's scenarios: 0, 90 and 180 +- 20 degrees."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64

WINDOW_DEG = 20.0  # about the heading of a scenario (paper, section 4.5)


def headings_deg(poses: F64) -> F64:
    """Direction (n,) of the x axis of ``poses`` (n, 4, 4) in the plane, degrees in [0, 360)."""
    ahead = poses[:, :2, 0]
    return np.asarray(np.degrees(np.arctan2(ahead[:, 1], ahead[:, 0])) % 360.0)


def heading_difference(one_deg: F64 | float, other_deg: F64 | float) -> F64:
    """Angle between headings, degrees in [0, 180]."""
    return np.abs((np.asarray(one_deg) - other_deg + 180.0) % 360.0 - 180.0)


def in_window(
    one_deg: F64 | float, other_deg: F64 | float, heading_deg: float
) -> NDArray[np.bool_]:
    """Whether two headings differ by ``heading_deg`` +- ``WINDOW_DEG``."""
    difference = np.abs(heading_difference(one_deg, other_deg) - heading_deg)
    return np.asarray(difference <= WINDOW_DEG + 1e-9)
