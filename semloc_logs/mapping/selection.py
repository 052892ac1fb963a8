"""Which frames of a session become keyframes, and which keyframes a submap; thinning of points."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.numerics.hash_table import EMPTY, empty_table, place_of
from semloc_logs.numerics.transforms import inverse, rotation_angle
from semloc_logs.settings import ResolvedFusion

UNPOSED_SPACING_NS = 400_000_000  # frames of a log without poses are taken this far apart


def thin(points: NDArray[np.floating], cell: float) -> NDArray[np.int64]:
    """Indices (m,) of the first of ``points`` (n, 3) in each cell of ``cell`` metres, ascending."""
    return _first_in_cells(np.ascontiguousarray(points, np.float32), np.float32(cell))


@njit(cache=True, nogil=True)
def _first_in_cells(points: NDArray[np.float32], cell: np.float32) -> NDArray[np.int64]:
    """By a hash table of the cells: sorting them takes ten times as long."""
    table = empty_table(len(points))
    kept = np.empty(len(points), np.int64)
    count = 0
    last = np.int64(EMPTY)
    for i in range(len(points)):
        x = np.int64(np.floor(points[i, 0] / cell))
        y = np.int64(np.floor(points[i, 1] / cell))
        z = np.int64(np.floor(points[i, 2] / cell))
        key = (x << 42) + (y << 21) + z
        if key == last:
            continue
        last = key
        place = place_of(table, key)
        if table[place] == EMPTY:
            table[place] = key
            kept[count] = i
            count += 1
    return kept[:count]


class KeyframeSelector:
    """Decides in turn of each frame of a stream whether it has moved or turned enough.

    The measure is the stream's last keyframe.
    """

    def __init__(self, fusion: ResolvedFusion) -> None:
        self._distance = fusion.keyframe_distance
        self._angle = fusion.keyframe_angle
        self._last: dict[str, tuple[int, NDArray[np.float64] | None]] = {}

    def wants(self, topic: str, stamp_ns: int, session_T_base: NDArray[np.float64] | None) -> bool:
        """Whether the frame is a keyframe; if so it is the stream's last one from now on."""
        last_stamp, last = self._last.get(topic, (None, None))
        if last_stamp is not None:
            if session_T_base is None or last is None:
                is_close = stamp_ns - last_stamp < UNPOSED_SPACING_NS
            else:
                moved = inverse(last) @ session_T_base
                is_close = (
                    float(np.linalg.norm(moved[:3, 3])) < self._distance
                    and rotation_angle(moved[:3, :3]) < self._angle
                )
            if is_close:
                return False
        self._last[topic] = (stamp_ns, session_T_base)
        return True


def road_distance(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance (n,) travelled from the first of poses (n, 4, 4), metres."""
    if not len(poses):
        return np.zeros(0)
    return np.asarray(
        np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))]
    )


def submap_ranges(
    distance: NDArray[np.float64], length: float, overlap: float
) -> list[tuple[int, int]]:
    """Ranges [first, last) of keyframes in overlapping stretches of road of ``length`` metres.

    ``distance`` (n,) is the road travelled up to each keyframe. The last stretch is pulled back to
    full length, so that no submap is a short remnant.
    """
    if not len(distance):
        return []
    total = float(distance[-1])
    step = length * (1.0 - overlap)
    slack = 1e-9 * max(total, 1.0)  # (total - length) + length may round to less than total

    def held(start: float) -> tuple[int, int]:
        ends = start - slack, start + length + slack
        return int(np.searchsorted(distance, ends[0])), int(
            np.searchsorted(distance, ends[1], side="right")
        )

    ranges = dict[tuple[int, int], None]()
    k = 0
    while k * step < total - length:
        first, last = held(k * step)
        if first < last:
            ranges[first, last] = None
        # stretches up to where a keyframe leaves or comes are the same, or hold none: where poses
        # jump these are very many
        leaves = distance[first] / step
        comes = (distance[last] - length) / step if last < len(distance) else np.inf
        k = max(k + 1, int(min(leaves, comes)) - 1)
    ranges[held(max(total - length, 0.0))] = None
    return list(ranges)
