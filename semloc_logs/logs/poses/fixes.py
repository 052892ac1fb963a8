"""Satellite fixes of a log, as they are kept beside its poses."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.frames import NavSatSample
from semloc_logs.logs.poses.track import is_time

LEAST_APART_NS = 200_000_000  # their errors are alike for much longer
MOST_FIXES = 1 << 20  # 58 hours of them


class Fixes:
    """The fixes of one topic, thinned."""

    def __init__(self) -> None:
        self._samples: list[NavSatSample] = []

    def take(self, fix: NavSatSample) -> None:
        """The next one; those without a fix, too close to the last one or late are left out."""
        stamp_ns = fix.header.stamp_ns
        place = (fix.latitude_deg, fix.longitude_deg)
        if not fix.has_fix or not is_time(stamp_ns) or not np.isfinite(place).all():
            return
        last = self._samples[-1].header.stamp_ns if self._samples else None
        if last is not None and stamp_ns - last < LEAST_APART_NS:
            return
        if len(self._samples) < MOST_FIXES:
            self._samples.append(fix)

    def columns(self, base_T: Callable[[str, int], F64 | None]) -> dict[str, Any]:
        """Columns of the table ``fixes``; ``base_T`` gives the mounting of a frame at a time."""
        count = len(self._samples)
        sigma = np.full((count, 3), np.nan)
        antenna = np.full((count, 3), np.nan)
        for k, fix in enumerate(self._samples):
            if fix.covariance is not None:
                sigma[k] = np.sqrt(np.diag(fix.covariance))
            mounting = base_T(fix.header.frame_id, fix.header.stamp_ns)
            if mounting is not None:
                antenna[k] = mounting[:3, 3]
        return {
            "stamp_ns": [fix.header.stamp_ns for fix in self._samples],
            "latitude_deg": [fix.latitude_deg for fix in self._samples],
            "longitude_deg": [fix.longitude_deg for fix in self._samples],
            "height": [fix.altitude for fix in self._samples],
            **dict(zip(("sigma_east", "sigma_north", "sigma_up"), sigma.T, strict=True)),
            **dict(zip(("antenna_x", "antenna_y", "antenna_z"), antenna.T, strict=True)),
        }
