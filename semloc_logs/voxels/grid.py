"""A semantic occupancy map in hashed blocks: log-odds of every observed voxel, class votes of every hit (paper 3.1)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from semloc_logs.settings import Fusion
from semloc_logs.voxels.carve import carve, flush, touched_blocks
from semloc_logs.voxels.keys import BLOCK, pack, unpack

UNLABELLED = 255  # occupied, class unknown
FREE_STATE, UNOBSERVED_STATE = 254, 253
UNOBSERVED = -128  # in log-odds
SCALE = 20  # int8 log-odds are in units of 1/20

U8 = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class BlockMap:
    """A finished map: ``keys`` (n,) packed block coordinates ascending, ``log_odds`` (n, 4096) int8 (-128 unobserved), ``state``
    (n, 4096) uint8: a class, 255 unlabelled, 254 free, 253 unobserved, and ``hits`` (n, 4096) uint16, votes for occupied voxels.

    Voxel (i, j, k) of a block is at index (i * 16 + j) * 16 + k.
    """

    keys: NDArray[np.int64]
    log_odds: NDArray[np.int8]
    state: U8
    hits: NDArray[np.uint16]

    def occupied(self) -> tuple[NDArray[np.int32], U8, NDArray[np.int8], NDArray[np.uint16]]:
        """Voxel coordinates (m, 3), class, log-odds and hits of the occupied voxels, in block order."""
        row, cell = np.nonzero((self.state != FREE_STATE) & (self.state != UNOBSERVED_STATE))
        base = unpack(self.keys)[row] * BLOCK
        ijk = base + np.stack([cell // 256, cell // 16 % 16, cell % 16], 1).astype(np.int32)
        return ijk, self.state[row, cell], self.log_odds[row, cell], self.hits[row, cell]

    def bounds(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Lowest voxel and one past the highest voxel of the blocks; two zeros if there are none."""
        if not len(self.keys):
            return np.zeros(3, np.int32), np.zeros(3, np.int32)
        b = unpack(self.keys)
        return b.min(0) * BLOCK, (b.max(0) + 1) * BLOCK

    def dense(self, low: NDArray[np.integer], shape: tuple[int, int, int]) -> U8:
        """State of the box of ``shape`` voxels from voxel ``low``, unobserved where there is no block."""
        out = np.full(shape, UNOBSERVED_STATE, np.uint8)
        low = np.asarray(low, np.int64)
        for key, state in zip(unpack(self.keys), self.state, strict=True):
            a = key.astype(np.int64) * BLOCK - low
            s, e = np.maximum(a, 0), np.minimum(a + BLOCK, shape)
            if (s < e).all():
                block = state.reshape(BLOCK, BLOCK, BLOCK)
                out[s[0] : e[0], s[1] : e[1], s[2] : e[2]] = block[
                    s[0] - a[0] : e[0] - a[0], s[1] - a[1] : e[1] - a[1], s[2] - a[2] : e[2] - a[2]
                ]
        return out


def empty_map() -> BlockMap:
    """A map without blocks."""
    shape = (0, BLOCK**3)
    return BlockMap(np.zeros(0, np.int64), np.zeros(shape, np.int8), np.zeros(shape, np.uint8), np.zeros(shape, np.uint16))


@dataclass(slots=True, eq=False)
class Fuser:
    """Fuses labelled points frame by frame; :meth:`finish` gives the map.

    Class votes are kept as counted (voxel, class) pairs and resolved at the end, so the result does not depend on their order.
    """

    fusion: Fusion  # resolved
    _slots: dict[int, int] = field(default_factory=dict)
    _log_odds: NDArray[np.int8] = field(default_factory=lambda: np.zeros((0, BLOCK**3), np.int8))
    _votes: list[NDArray[np.int64]] = field(default_factory=list)
    _grid: U8 = field(default_factory=lambda: np.zeros((0, 0, 0), np.uint8))

    def add(self, points: NDArray[np.floating], label: U8, origin: NDArray[np.floating]) -> None:
        """Integrate ``points`` (n, 3) in the map frame seen from ``origin`` (3,), with classes ``label`` (n,) (255 unknown).

        Points beyond the maximum range carve and do not hit; points that are not finite are left out.
        """
        v, limit = self.fusion.voxel_size, self.fusion.max_range
        if limit is None:
            raise ValueError("fusion settings must be resolved")
        start = np.asarray(origin, float) / v
        ends = np.asarray(points, float) / v
        reach = np.linalg.norm(ends - start, axis=1)
        usable = np.isfinite(reach)
        if not usable.all():
            ends, reach, label = ends[usable], reach[usable], label[usable]
        if not len(ends):
            return
        hit = reach <= limit / v
        far = ~hit
        ends[far] = start + (ends[far] - start) * (limit / v / reach[far])[:, None]
        low = np.floor(np.minimum(ends.min(0), start) / BLOCK).astype(np.int64) * BLOCK
        start, ends = start - low, ends - low  # floors are taken after this step only: rounding then cannot put a cell beside the grid
        cells = np.floor(ends).astype(np.int64)
        size = (np.maximum(cells.max(0), np.floor(start).astype(np.int64)) // BLOCK + 1) * BLOCK
        if (size > self._grid.shape).any():
            self._grid = np.zeros(np.maximum(size, self._grid.shape), np.uint8)
        # one ray for each end voxel, through its first point: the others would carve nearly the same voxels
        address = (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]
        voted, count = np.unique(address[hit] * 256 + label[hit], return_counts=True)
        _, first = np.unique(address * 2 + far, return_index=True)
        grid = self._grid[: size[0], : size[1], : size[2]]
        carve(grid, start, ends[first], hit[first])
        offsets = touched_blocks(grid)
        keys = pack(offsets + low // BLOCK)
        slots = np.array([self._slots.setdefault(k, len(self._slots)) for k in keys.tolist()], np.int64)
        if len(self._slots) > len(self._log_odds):
            grown = np.full((max(64, 2 * len(self._slots)), BLOCK**3), UNOBSERVED, np.int8)
            grown[: len(self._log_odds)] = self._log_odds
            self._log_odds = grown
        f = self.fusion
        flush(grid, offsets, slots, self._log_odds, *(round(SCALE * a) for a in (f.hit, f.miss, f.clamp[0], f.clamp[1])))
        if not len(voted):
            return
        slot_of = np.zeros(size // BLOCK, np.int64)
        slot_of[tuple(offsets.T)] = slots
        where = np.stack(np.unravel_index(voted // 256, tuple(size.tolist())), 1)
        voxel = slot_of[tuple((where // BLOCK).T)] * BLOCK**3 + _within(where)
        self._votes.append(np.stack([voxel, voted % 256, count], 1))

    def finish(self) -> BlockMap:
        """The fused map. A voxel is occupied where its log-odds are positive; its class has the most votes (the lower id wins a tie)."""
        if not self._slots:
            return empty_map()
        keys = np.fromiter(self._slots.keys(), np.int64, len(self._slots))
        order = np.argsort(keys)
        log_odds = self._log_odds[np.fromiter(self._slots.values(), np.int64, len(self._slots))[order]]
        keys = keys[order]
        occupied = log_odds > 0
        state = np.where(occupied, UNLABELLED, np.where(log_odds == UNOBSERVED, UNOBSERVED_STATE, FREE_STATE)).astype(np.uint8)
        hits = np.zeros(log_odds.shape, np.uint16)
        if self._votes:
            voxel, label, count = _winners(np.concatenate(self._votes))
            row, cell = np.argsort(order)[voxel // BLOCK**3], voxel % BLOCK**3
            keep = occupied[row, cell]
            state[row[keep], cell[keep]] = label[keep]
            hits[row[keep], cell[keep]] = np.minimum(count[keep], 65535)
        return BlockMap(keys, log_odds, state, hits)


def _within(ijk: NDArray[np.int64]) -> NDArray[np.int64]:
    """Index of voxels (n, 3) within their blocks."""
    i = ijk % BLOCK
    return np.asarray((i[:, 0] * BLOCK + i[:, 1]) * BLOCK + i[:, 2])


def _winners(votes: NDArray[np.int64]) -> tuple[NDArray[np.int64], U8, NDArray[np.int64]]:
    """Voxels, their winning class and the number of all their votes, from rows (voxel, class, count). Known classes beat unknown."""
    order = np.lexsort((votes[:, 1], votes[:, 0]))
    votes = votes[order]
    pair = np.flatnonzero(np.r_[True, (votes[1:, :2] != votes[:-1, :2]).any(1)])
    total = np.add.reduceat(votes[:, 2], pair)
    voxel, label = votes[pair, 0], votes[pair, 1]
    weight = np.where(label == UNLABELLED, 0, total)
    best = np.lexsort((label, -weight, voxel))
    first = best[np.r_[True, voxel[best][1:] != voxel[best][:-1]]]
    group = np.flatnonzero(np.r_[True, voxel[1:] != voxel[:-1]])
    return voxel[first], label[first].astype(np.uint8), np.add.reduceat(total, group)
