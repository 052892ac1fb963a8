"""The ground of a session: its height below each keyframe, and a level grid of the whole map.

Two estimates, for two purposes. :func:`ground_height` is one number below the sensor, the mode of
all points around it: robust, cheap enough for every keyframe, and what queries and submaps are cut
by (``ground_z``). :class:`GroundMapper` puts together the surfaces of
:mod:`semloc_logs.labels.sweep_ground`, which follow the ground outwards over slopes, kerbs and
hidden places; they cost ten times as much and are made where they add something. Below the sensor
the two differ by 1 cm in the median of 71 keyframes, by 27 cm at most (0.30 m voxels).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.labels.sweep_ground import CELL, GroundSurface
from semloc_logs.tables import contracts
from semloc_logs.tables.table import write_table
from semloc_logs.voxels.keys import pack, unpack

# of the height below a keyframe, at street scale (m): how far around the sensor, from how far below
# it on to how far, in which steps, and where it is assumed without points
AROUND = 15.0
HIGHEST, LOWEST = 0.3, 5.0
STEP = 0.1
ASSUMED_HEIGHT = 1.7
LEAST_POINTS = 100  # below the sensor, for a mode
LOW_PERCENTILE = 2  # of the heights, in place of the mode

# of the grid, at street scale (m)
SEEN_WITHIN = 40.0  # of the sensor; farther off few rays reach the ground
NEAR = 10.0  # a cell at this distance counts half of one at the sensor's feet
LEVEL = 1.0  # heights of a cell that differ by more are two levels: a bridge, the road below it
APART = 4.0  # keyframes nearer to each other than this see the same ground
COMPACT = 400_000  # rows in memory before they are added up


def ground_height(
    level_points: NDArray[np.floating], origin: NDArray[np.floating], scale: float = 1.0
) -> float:
    """Height of the ground below a sensor at ``origin`` (3,) from points (n, 3), level frame, m.

    The mode of the heights at least 0.3 m below the sensor and within 15 m, else the lowest 2 %;
    ``scale`` is the voxel size over 0.30 m.
    """
    points = np.ascontiguousarray(level_points)
    z = _heights_around(points, np.asarray(origin, float), AROUND * scale)
    if not len(z):
        return float(origin[2]) - ASSUMED_HEIGHT * scale
    low = z[(z < origin[2] - HIGHEST * scale) & (z > origin[2] - LOWEST * scale)]
    if len(low) < LEAST_POINTS:
        return float(np.percentile(z, LOW_PERCENTILE))
    bins = np.floor(low / (STEP * scale)).astype(np.int64)
    values, counts = np.unique(bins, return_counts=True)
    best = values[np.argmax(counts)]
    return float(np.median(low[np.abs(bins - best) <= 1]))


@njit(cache=True, nogil=True)
def _heights_around(points: F64, origin: F64, radius: float) -> F64:
    """Heights of the points (n, 3) within ``radius`` of ``origin`` (3,) on the level."""
    out = np.empty(len(points))
    count = 0
    for i in range(len(points)):
        if (points[i, 0] - origin[0]) ** 2 + (points[i, 1] - origin[1]) ** 2 < radius * radius:
            out[count] = points[i, 2]
            count += 1
    return out[:count]


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """Weights and weighted heights (n,) of cells (n, 3): ix, iy and the level."""

    cell: NDArray[np.int64]
    weight: F64
    total: F64
    frames: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class GroundMap:
    """Ground that was seen: cells ``ij`` (n, 2) of ``cell`` metres.

    ``z`` (n,) is their height in the map frame, ``frames`` (n,) the number of keyframes that saw
    them.
    """

    cell: float
    ij: NDArray[np.int32]
    z: F64
    frames: NDArray[np.int32]


@dataclass(slots=True, eq=False)
class GroundMapper:
    """Collects the ground of keyframes; ``scale`` is the voxel size over 0.30 m.

    The order in which they are added does not matter.
    """

    scale: float
    _rows: list[_Rows] = field(default_factory=list)
    _last: F64 | None = None

    def wants(self, origin: NDArray[np.floating]) -> bool:
        """Whether a keyframe seen from ``origin`` (3,) is far enough from the last one added."""
        return (
            self._last is None
            or float(np.linalg.norm(np.asarray(origin, float) - self._last)) >= APART * self.scale
        )

    def add(self, surface: GroundSurface, origin: NDArray[np.floating]) -> None:
        """The ground below a keyframe, in the map frame, seen from ``origin`` (3,)."""
        self._last = np.array(origin, float)
        cell = CELL * self.scale
        centres = surface.centres()[surface.gap == 0]
        distance = np.hypot(*(centres - np.asarray(origin, float)[:2]).T)
        in_reach = distance <= SEEN_WITHIN * self.scale
        if not in_reach.any():
            return
        ij, first = np.unique(
            np.floor(centres[in_reach] / cell).astype(np.int64), axis=0, return_index=True
        )
        z = surface.height_at((ij + 0.5) * cell)
        weight = 1.0 / (1.0 + (distance[in_reach][first] / (NEAR * self.scale)) ** 2)
        level = np.floor(z / (LEVEL * self.scale)).astype(np.int64)
        self._rows.append(
            _Rows(pack(np.c_[ij, level]), weight, weight * z, np.ones(len(z), np.int64))
        )
        if sum(len(r.cell) for r in self._rows) > COMPACT:
            self._rows = [_added(self._rows)]

    def finish(self) -> GroundMap:
        """Of each cell the level with most weight, with the next level where it belongs to it."""
        cell = CELL * self.scale
        if not self._rows:
            return GroundMap(cell, np.zeros((0, 2), np.int32), np.zeros(0), np.zeros(0, np.int32))
        rows = _added(self._rows)
        ijl = unpack(rows.cell)
        column = pack(np.c_[ijl[:, :2], np.zeros(len(ijl), np.int32)])
        order = np.lexsort((ijl[:, 2], -rows.weight, column))
        best = order[np.r_[True, column[order][1:] != column[order][:-1]]]
        weight = rows.weight[best]
        total = rows.total[best]
        frames = rows.frames[best]
        for step in (-1, 1):  # a height near the border of two levels has rows in both
            beside = rows.cell[best] + step
            row = np.minimum(np.searchsorted(rows.cell, beside), len(rows.cell) - 1)
            other = rows.total[row] / rows.weight[row]
            same = (rows.cell[row] == beside) & (
                np.abs(other - rows.total[best] / rows.weight[best]) < 0.5 * LEVEL * self.scale
            )
            weight = weight + np.where(same, rows.weight[row], 0.0)
            total = total + np.where(same, rows.total[row], 0.0)
            frames = frames + np.where(same, rows.frames[row], 0)
        return GroundMap(
            cell, ijl[best, :2], total / weight, np.minimum(frames, 2**31 - 1).astype(np.int32)
        )


def _added(parts: list[_Rows]) -> _Rows:
    """One row for each cell, ascending."""
    cell, inverse = np.unique(np.concatenate([p.cell for p in parts]), return_inverse=True)
    weight, total = (
        np.bincount(inverse, np.concatenate([getattr(p, n) for p in parts]))
        for n in ("weight", "total")
    )
    frames = np.bincount(inverse, np.concatenate([p.frames for p in parts])).astype(np.int64)
    return _Rows(cell, np.asarray(weight, float), np.asarray(total, float), frames)


def write_ground(path: Path, ground: GroundMap, metadata: dict[str, Any]) -> None:
    """The table ``ground``: one row for each seen cell."""
    columns = {
        "ix": ground.ij[:, 0],
        "iy": ground.ij[:, 1],
        "z": ground.z.astype(np.float32),
        "frames": ground.frames,
    }
    write_table(
        path, contracts.table("ground", columns), {**metadata, "cell": ground.cell}, ("ix", "iy")
    )
