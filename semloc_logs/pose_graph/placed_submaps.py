"""Submaps of a session in the common frame: each voxel moves with the keyframe nearest to it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from semloc_logs.arrays import F64, I64, U8
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import inverse
from semloc_logs.voxels.grid import BlockMap
from semloc_logs.voxels.keys import BLOCK, unpack
from semloc_logs.voxels.store import blocks_path, read_blocks

KEPT = 16  # submaps in memory: the ones of a tile


@lru_cache(maxsize=KEPT)
def _states(path: Path) -> BlockMap:
    return read_blocks(path, states_only=True)


@dataclass(eq=False)
class PlacedSubmap:
    """A submap, and the poses ``common_T_base`` (n, 4, 4) of the session's keyframes."""

    session: SessionMap
    number: int
    first: int
    last: int
    common_T_base: F64

    @property
    def blocks(self) -> BlockMap:
        """Its state, without log-odds and votes."""
        return _states(blocks_path(self.session.folder.blocks, self.number))

    @property
    def voxel_size(self) -> float:
        """Metres."""
        return float(self.session.json["voxel_size"])

    def occupied(self) -> tuple[I64, U8, I64]:
        """Voxels (n, 3) of the common grid, their classes (n,), and stamps (n,)."""
        ijk, label = self.blocks.occupied()
        points = (ijk + 0.5) * self.voxel_size
        moved, stamps_ns = self._moved(points, self._map_T_base, self._common_T_base)
        return np.floor(moved / self.voxel_size).astype(np.int64), label, stamps_ns

    def bounds(self) -> tuple[F64, F64]:
        """Lowest and highest corner of its blocks in the common frame, metres."""
        corners = unpack(self.blocks.keys) * (BLOCK * self.voxel_size)
        middle = corners + 0.5 * BLOCK * self.voxel_size
        moved, _ = self._moved(middle, self._map_T_base, self._common_T_base)
        return moved.min(0) - BLOCK * self.voxel_size, moved.max(0) + BLOCK * self.voxel_size

    def state(self, ijk: I64) -> tuple[U8, I64]:
        """States (n,) of voxels (n, 3) of the common grid, and stamps (n,) of their keyframes."""
        points = (ijk + 0.5) * self.voxel_size
        here, stamps_ns = self._moved(points, self._common_T_base, self._map_T_base)
        return self.blocks.at(np.floor(here / self.voxel_size).astype(np.int64)), stamps_ns

    @cached_property
    def _rows(self) -> slice:
        return slice(self.first, self.last + 1)

    @property
    def _map_T_base(self) -> F64:
        return self.session.map_T_base[self._rows]

    @property
    def _common_T_base(self) -> F64:
        return self.common_T_base[self._rows]

    def _moved(
        self, points: NDArray[np.floating], from_T_base: F64, to_T_base: F64
    ) -> tuple[F64, I64]:
        """Points (n, 3) with the keyframes nearest to them, and the stamps (n,) of these."""
        _, nearest = cKDTree(from_T_base[:, :3, 3]).query(points)
        to_T_from = (to_T_base @ inverse(from_T_base))[nearest]
        moved = np.einsum("nij,nj->ni", to_T_from[:, :3, :3], points) + to_T_from[:, :3, 3]
        return moved, self.session.stamps_ns[self._rows][nearest]
