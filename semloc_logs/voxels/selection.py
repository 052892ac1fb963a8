"""Which frames of a session become keyframes, which keyframes a submap; thinning of their points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semloc_logs.geometry import inverse, rotation_angle
from semloc_logs.settings import Fusion

UNPOSED_SPACING_NS = 400_000_000  # frames of a log without poses are taken this far apart


def thin(points: NDArray[np.float32], cell: float) -> NDArray[np.int64]:
    """Indices (m,) of the first point in each cell of ``cell`` metres, ascending."""
    ijk = np.floor(points / cell).astype(np.int64)
    key = (ijk[:, 0] << 42) + (ijk[:, 1] << 21) + ijk[:, 2]
    return np.sort(np.unique(key, return_index=True)[1])


class KeyframeSelector:
    """Says of each frame of a stream in turn whether it has moved or turned enough since the stream's last keyframe."""

    def __init__(self, fusion: Fusion) -> None:
        self._distance = fusion.keyframe_distance or 0.0
        self._angle = fusion.keyframe_angle
        self._last: dict[str, tuple[int, NDArray[np.float64] | None]] = {}

    def wants(self, topic: str, stamp_ns: int, session_T_base: NDArray[np.float64] | None) -> bool:
        """Whether the frame is a keyframe; if so it is the stream's last one from now on."""
        last_stamp, last = self._last.get(topic, (None, None))
        if last_stamp is not None:
            if session_T_base is None or last is None:
                near = stamp_ns - last_stamp < UNPOSED_SPACING_NS
            else:
                moved = inverse(last) @ session_T_base
                near = float(np.linalg.norm(moved[:3, 3])) < self._distance and rotation_angle(moved[:3, :3]) < self._angle
            if near:
                return False
        self._last[topic] = (stamp_ns, session_T_base)
        return True


def road_distance(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance (n,) travelled from the first of poses (n, 4, 4), metres."""
    if not len(poses):
        return np.zeros(0)
    return np.asarray(np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))])


def submap_ranges(distance: NDArray[np.float64], length: float, overlap: float) -> list[tuple[int, int]]:
    """Ranges [first, last) of keyframes whose road ``distance`` (n,) lies in stretches of ``length``, each overlapping the next.

    The last stretch is pulled back to full length, so that no submap is a short remnant.
    """
    if not len(distance):
        return []
    total, step = float(distance[-1]), length * (1.0 - overlap)
    starts = [0.0] if total <= length else [*np.arange(0.0, total - length, step), total - length]
    slack = 1e-9 * max(total, 1.0)  # (total - length) + length may round to less than total
    ranges = [(int(np.searchsorted(distance, s - slack)), int(np.searchsorted(distance, s + length + slack, side="right"))) for s in starts]
    return [r for r in dict.fromkeys(ranges) if r[0] < r[1]]
