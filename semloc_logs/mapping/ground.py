"""How high the ground is everywhere in a session's map: a coarse level grid, put together from the
ground below each keyframe.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from semloc_logs.labels.sweep_ground import CELL, GroundSurface
from semloc_logs.tables import contracts
from semloc_logs.tables.table import read_metadata, read_table, write_table
from semloc_logs.voxels.keys import pack, unpack

F64 = NDArray[np.float64]

SEEN_WITHIN = 40.0  # of the sensor; farther off few rays reach the ground (m at street scale)
NEAR = 10.0  # a cell at this distance counts half of one at the sensor's feet (m at street scale)
# heights of a cell that differ by more are two levels, a bridge and the road below it (m at street
# scale)
LEVEL = 1.0
APART = 4.0  # keyframes nearer to each other than this see the same ground (m at street scale)
NEIGHBOURS = 4
FAR = 30.0  # nothing is said of places farther than this from any seen ground (m at street scale)
_COMPACT = 400_000  # rows


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """Weights and weighted heights (n,) of cells (n, 3): ix, iy and the level."""

    cell: NDArray[np.int64]
    weight: F64
    total: F64
    frames: NDArray[np.int64]


@dataclass(eq=False)
class GroundMap:
    """Ground that was seen: cells ``ij`` (n, 2) of ``cell`` metres, their height ``z`` (n,) in the
    map frame, and by how many keyframes.
    """

    cell: float
    ij: NDArray[np.int32]
    z: F64
    frames: NDArray[np.int32]

    def ground_at(self, xy: NDArray[np.floating]) -> F64:
        """Height (n,) of the ground at ``xy`` (n, 2), metres in the map frame.

        The mean of the four nearest seen cells, weighted by inverse squared distance; NaN farther
        than 30 cells from all of them.
        """
        at = np.asarray(xy, float).reshape(-1, 2)
        out = np.full(len(at), np.nan)
        usable = np.isfinite(at).all(1)
        if not len(self.z) or not usable.any():
            return out
        limit = FAR / CELL * self.cell
        distance, index = self._tree.query(
            at[usable], k=np.arange(1, min(NEIGHBOURS, len(self.z)) + 1), distance_upper_bound=limit
        )
        known = np.isfinite(distance)
        weight = np.where(
            known, 1.0 / (np.where(known, distance, 1.0) ** 2 + (0.1 * self.cell) ** 2), 0.0
        )
        height = np.where(known, self.z[np.where(known, index, 0)], 0.0)
        total = weight.sum(1)
        out[usable] = np.where(
            total > 0, (weight * height).sum(1) / np.where(total > 0, total, 1.0), np.nan
        )
        return out

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree((self.ij + 0.5) * self.cell)


@dataclass(slots=True, eq=False)
class GroundMapper:
    """Collects the ground of keyframes; ``scale`` is the voxel size over 0.30 m. The order in which
    they are added does not matter.
    """

    scale: float
    _rows: list[_Rows] = field(default_factory=list)
    _last: F64 | None = None

    def wants(self, origin: NDArray[np.floating]) -> bool:
        """Whether a keyframe seen from ``origin`` (3,) is far enough from the last one that was
        added to tell anything new.
        """
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
        near = distance <= SEEN_WITHIN * self.scale
        if not near.any():
            return
        ij, first = np.unique(
            np.floor(centres[near] / cell).astype(np.int64), axis=0, return_index=True
        )
        z = surface.height_at((ij + 0.5) * cell)
        weight = 1.0 / (1.0 + (distance[near][first] / (NEAR * self.scale)) ** 2)
        level = np.floor(z / (LEVEL * self.scale)).astype(np.int64)
        self._rows.append(
            _Rows(pack(np.c_[ij, level]), weight, weight * z, np.ones(len(z), np.int64))
        )
        if sum(len(r.cell) for r in self._rows) > _COMPACT:
            self._rows = [_added(self._rows)]

    def finish(self) -> GroundMap:
        """Of each cell the level that has most weight, together with the half of the next one that
        belongs to it.
        """
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
            at = np.minimum(np.searchsorted(rows.cell, beside), len(rows.cell) - 1)
            other = rows.total[at] / rows.weight[at]
            same = (rows.cell[at] == beside) & (
                np.abs(other - rows.total[best] / rows.weight[best]) < 0.5 * LEVEL * self.scale
            )
            weight = weight + np.where(same, rows.weight[at], 0.0)
            total = total + np.where(same, rows.total[at], 0.0)
            frames = frames + np.where(same, rows.frames[at], 0)
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


def read_ground(path: Path) -> GroundMap:
    """Inverse of :func:`write_ground`; WorkspaceError when the table is missing or damaged."""
    table = read_table(path)
    ij = np.stack([table[c].to_numpy() for c in ("ix", "iy")], 1)
    return GroundMap(
        float(read_metadata(path)["cell"]),
        ij,
        table["z"].to_numpy().astype(float),
        table["frames"].to_numpy(),
    )
