"""A semantic occupancy map in hashed blocks: log-odds and class votes of voxels (paper 3.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.arrays import I64, U8
from semloc_logs.labels.space import UNLABELLED
from semloc_logs.numerics.bits import EACH_BYTE, bytes_set, popcount
from semloc_logs.numerics.hash_table import EMPTY
from semloc_logs.settings import ResolvedFusion
from semloc_logs.voxels.carve import (
    BITS,
    CLASSES,
    UNOBSERVED,
    VOTE_CLASSES,
    Carver,
    LogOddsUnits,
    Marks,
    add_votes,
    flush,
    rehash,
    vote_table,
)
from semloc_logs.voxels.keys import BLOCK, pack, unpack

FREE_STATE, UNOBSERVED_STATE = 254, 253
EIGHTS = BLOCK**3 // 8  # words of eight states in a block
SCALE = 20  # int8 log-odds are in units of 1/20
FIRST_PLACES = 1 << 15  # of the table of votes, which grows


@dataclass(frozen=True, slots=True, eq=False)
class BlockMap:
    """A finished map, block by block; voxel (i, j, k) of a block is at (i * 16 + j) * 16 + k.

    ``keys`` (n,) packed block coordinates ascending; ``log_odds`` (n, 4096) int8 (-128 unobserved);
    ``state`` (n, 4096) uint8: a class, 255 unlabelled, 254 free, 253 unobserved; and the class
    votes of every voxel that was ever hit: ``ballots`` (m,) int64 ascending, ``(row * 4096 + cell)
    * 256 + class``, with their numbers ``votes`` (m,).
    """

    keys: I64
    log_odds: NDArray[np.int8]
    state: U8
    ballots: I64
    votes: I64

    def occupied(self) -> tuple[NDArray[np.int32], U8]:
        """Voxel coordinates (m, 3) and class of the occupied voxels, in block order."""
        corner = unpack(self.keys).astype(np.int32) * np.int32(BLOCK)
        return _occupied(corner, np.ascontiguousarray(self.state))

    def bounds(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Lowest voxel and one past the highest voxel of the blocks; zeros without blocks."""
        if not len(self.keys):
            return np.zeros(3, np.int32), np.zeros(3, np.int32)
        b = unpack(self.keys)
        return b.min(0) * BLOCK, (b.max(0) + 1) * BLOCK

    def at(self, ijk: I64) -> U8:
        """State (n,) of voxels (n, 3), unobserved without a block."""
        out = np.full(len(ijk), UNOBSERVED_STATE, np.uint8)
        if not len(self.keys):
            return out
        keys = pack(ijk // BLOCK)
        row = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        is_known = self.keys[row] == keys
        inner = ijk[is_known] % BLOCK
        cell = (inner[:, 0] * BLOCK + inner[:, 1]) * BLOCK + inner[:, 2]
        out[is_known] = self.state[row[is_known], cell]
        return out

    def dense(self, low: NDArray[np.integer], shape: tuple[int, int, int]) -> U8:
        """State of ``shape`` voxels from voxel ``low`` on, unobserved without a block."""
        out = np.full(shape, UNOBSERVED_STATE, np.uint8)
        corner = unpack(self.keys).astype(np.int64) * BLOCK - np.asarray(low, np.int64)
        inside = np.flatnonzero(((corner > -BLOCK) & (corner < np.array(shape))).all(1))
        _copy_blocks(out, corner[inside], self.state, inside)
        return out


@njit(cache=True, nogil=True)
def _occupied(corner: NDArray[np.int32], state: U8) -> tuple[NDArray[np.int32], U8]:
    """Coordinates (m, 3) and classes of occupied voxels; blocks lie at ``corner`` (n, 3)."""
    eights = state.view(np.uint64)
    count = 0
    for n in range(len(eights)):
        for e in range(EIGHTS):
            count += popcount(_are_occupied(eights[n, e]))
    ijk = np.empty((count, 3), np.int32)
    label = np.empty(count, np.uint8)
    row = 0
    for n in range(len(eights)):
        for e in range(EIGHTS):
            if not _are_occupied(eights[n, e]):  # as in nearly all
                continue
            for m in range(8 * e, 8 * e + 8):
                value = state[n, m]
                if value != FREE_STATE and value != UNOBSERVED_STATE:
                    ijk[row, 0] = corner[n, 0] + m // BLOCK**2
                    ijk[row, 1] = corner[n, 1] + m // BLOCK % BLOCK
                    ijk[row, 2] = corner[n, 2] + m % BLOCK
                    label[row] = value
                    row += 1
    return ijk, label


@njit(cache=True, nogil=True)
def _are_occupied(eight: np.uint64) -> np.uint64:
    """A bit for each of eight states, the bytes of a word, that is neither free nor unobserved."""
    not_free = bytes_set(eight ^ np.uint64(FREE_STATE * EACH_BYTE))
    return not_free & bytes_set(eight ^ np.uint64(UNOBSERVED_STATE * EACH_BYTE))


@njit(cache=True, nogil=True)
def _copy_blocks(out: U8, corner: I64, state: U8, rows: I64) -> None:
    """Copy blocks, ``rows`` (m,) of ``state``, to ``corner`` (m, 3) of ``out``, where inside it."""
    nx, ny, nz = out.shape
    flat = out.ravel()
    for n in range(len(rows)):
        x, y, z = corner[n]
        first = max(z, 0)
        end = min(z + BLOCK, nz)
        block = state[rows[n]]
        for i in range(max(x, 0), min(x + BLOCK, nx)):
            for j in range(max(y, 0), min(y + BLOCK, ny)):
                source = ((i - x) * BLOCK + j - y) * BLOCK - z
                to = (i * ny + j) * nz
                if end - first == BLOCK:  # of a known length: the compiler moves them together
                    for k in range(BLOCK):
                        flat[np.uint64(to + first + k)] = block[np.uint64(source + first + k)]
                else:
                    for k in range(first, end):
                        flat[np.uint64(to + k)] = block[np.uint64(source + k)]


def empty_map() -> BlockMap:
    """A map without blocks."""
    shape = (0, BLOCK**3)
    nothing = np.zeros(0, np.int64)
    return BlockMap(nothing, np.zeros(shape, np.int8), np.zeros(shape, np.uint8), nothing, nothing)


class Fuser:
    """Fuses labelled points frame by frame; :meth:`finish` gives the map.

    Class votes are counted for each (voxel, class), so the classes do not depend on the order of
    the frames.
    """

    def __init__(self, fusion: ResolvedFusion) -> None:
        self._units = LogOddsUnits(
            *(round(SCALE * a) for a in (fusion.hit, fusion.miss, fusion.clamp[0], fusion.clamp[1]))
        )
        self._carver = Carver(fusion)
        self._slots: dict[int, int] = {}  # row of _log_odds of each packed block
        self._log_odds = np.zeros((0, BLOCK**3), np.int8)
        self._votes = vote_table(FIRST_PLACES)
        self._voted = 0  # keys in the table of votes

    def add(
        self,
        points: NDArray[np.floating],
        label: U8,
        origin: NDArray[np.floating],
        sigma: NDArray[np.floating] | None = None,
        map_T_points: NDArray[np.float64] | None = None,
    ) -> None:
        """Integrate a frame; the arguments are as of :meth:`Carver.marks`."""
        self.take(self._carver.marks(points, label, origin, sigma, map_T_points))

    def take(self, marks: Marks) -> None:
        """Integrate a frame that is carved already: maps that overlap share the work."""
        slots = self._slots_of(marks.blocks)
        flush(marks.grid, marks.runs, slots, self._log_odds, self._units)
        slot_of_run = np.zeros(len(marks.grid) >> BITS, np.int64)
        slot_of_run[marks.runs] = slots
        self._reserve_votes(int(np.count_nonzero(marks.votes)))
        self._voted += add_votes(self._votes, marks.ends, marks.votes, slot_of_run)

    def _slots_of(self, block: NDArray[np.integer]) -> I64:
        """Rows of ``_log_odds`` of blocks (m, 3), made where they are new."""
        slots = np.array(
            [self._slots.setdefault(k, len(self._slots)) for k in pack(block).tolist()], np.int64
        )
        if len(self._slots) > len(self._log_odds):
            grown = np.full((max(64, 2 * len(self._slots)), BLOCK**3), UNOBSERVED, np.int8)
            grown[: len(self._log_odds)] = self._log_odds
            self._log_odds = grown
        return slots

    def _reserve_votes(self, more: int) -> None:
        """Room in the table of votes for ``more`` keys, with half of it empty."""
        places = len(self._votes.keys)
        while places < 2 * (self._voted + more):
            places *= 2
        if places > len(self._votes.keys):
            larger = vote_table(places)
            rehash(self._votes, larger)
            self._votes = larger

    def finish(self) -> BlockMap:
        """The fused map.

        A voxel is occupied where its log-odds are positive; its class has the most votes (the lower
        id wins a tie).
        """
        if not self._slots:
            return empty_map()
        count = len(self._slots)
        keys = np.fromiter(self._slots.keys(), np.int64, count)
        order = np.argsort(keys)
        log_odds = self._log_odds[np.fromiter(self._slots.values(), np.int64, count)[order]]
        ballots, votes = self._ballots(np.argsort(order))

        is_observed = log_odds != UNOBSERVED
        state = np.where(is_observed, np.uint8(FREE_STATE), np.uint8(UNOBSERVED_STATE))
        state[log_odds > 0] = UNLABELLED
        voxel, winner, _ = winners(ballots, votes)
        occupied = log_odds.reshape(-1)[voxel] > 0
        state.reshape(-1)[voxel[occupied]] = winner[occupied]
        return BlockMap(keys[order], log_odds, state, ballots, votes)

    def _ballots(self, row_of_slot: I64) -> tuple[I64, I64]:
        """Ballots (m,) in order, as in :class:`BlockMap`, and their votes (m,)."""
        used = self._votes.keys != EMPTY
        voxel, label = np.divmod(self._votes.keys[used], VOTE_CLASSES)
        slot, cell = np.divmod(voxel, BLOCK**3)
        label = np.where(label == CLASSES - 1, UNLABELLED, label)
        ballots = (row_of_slot[slot] * BLOCK**3 + cell) * 256 + label
        order = np.argsort(ballots)
        return ballots[order], self._votes.counts[used][order].astype(np.int64)


def winners(ballots: I64, votes: I64) -> tuple[I64, U8, I64]:
    """Voxels (row * 4096 + cell, ascending) that have votes, their class, the number of votes.

    The class has most votes; the lowest id wins a tie, and any known class beats unlabelled.
    """
    voxel, label = np.divmod(ballots, 256)
    if not len(voxel):
        return voxel, label.astype(np.uint8), votes
    best = np.lexsort((label, np.where(label == UNLABELLED, 0, -votes), voxel))
    group = np.flatnonzero(np.r_[True, voxel[1:] != voxel[:-1]])
    return voxel[group], label[best[group]].astype(np.uint8), np.add.reduceat(votes, group)
