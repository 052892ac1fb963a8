"""A semantic occupancy map in hashed blocks: log-odds of every observed voxel, class votes of every
hit (paper 3.1).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.labels.space import UNLABELLED
from semloc_logs.settings import ResolvedFusion
from semloc_logs.voxels.carve import BITS, CLASSES, Carver, Marks, add_votes, flush, rehash
from semloc_logs.voxels.keys import BLOCK, pack, unpack

FREE_STATE, UNOBSERVED_STATE = 254, 253
UNOBSERVED = -128  # in log-odds
SCALE = 20  # int8 log-odds are in units of 1/20

U8 = NDArray[np.uint8]
I64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class BlockMap:
    """A finished map: ``keys`` (n,) packed block coordinates ascending, ``log_odds`` (n, 4096) int8
    (-128 unobserved), ``state`` (n, 4096) uint8: a class, 255 unlabelled, 254 free, 253 unobserved;
    and the class votes of every voxel that was ever hit: ``ballots`` (m,) int64 ascending, ``(row *
    4096 + cell) * 256 + class``, with their numbers ``votes`` (m,).

    Voxel (i, j, k) of a block is at index (i * 16 + j) * 16 + k.
    """

    keys: I64
    log_odds: NDArray[np.int8]
    state: U8
    ballots: I64
    votes: I64

    def occupied(self) -> tuple[NDArray[np.int32], U8]:
        """Voxel coordinates (m, 3) and class of the occupied voxels, in block order."""
        return _occupied(unpack(self.keys).astype(np.int32) * np.int32(BLOCK), self.state)

    def bounds(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Lowest voxel and one past the highest voxel of the blocks; two zeros if there are none."""
        if not len(self.keys):
            return np.zeros(3, np.int32), np.zeros(3, np.int32)
        b = unpack(self.keys)
        return b.min(0) * BLOCK, (b.max(0) + 1) * BLOCK

    def dense(self, low: NDArray[np.integer], shape: tuple[int, int, int]) -> U8:
        """State of the box of ``shape`` voxels from voxel ``low``, unobserved where there is no
        block.
        """
        out = np.full(shape, UNOBSERVED_STATE, np.uint8)
        corner = unpack(self.keys).astype(np.int64) * BLOCK - np.asarray(low, np.int64)
        inside = np.flatnonzero(((corner > -BLOCK) & (corner < np.array(shape))).all(1))
        _copy_blocks(out, corner[inside], self.state, inside)
        return out


@njit(cache=True, nogil=True)
def _occupied(corner: NDArray[np.int32], state: U8) -> tuple[NDArray[np.int32], U8]:
    """Coordinates (m, 3) and classes (m,) of the occupied voxels of blocks with their corner at
    ``corner`` (n, 3).
    """
    count = 0
    for value in state.ravel():
        count += value != FREE_STATE and value != UNOBSERVED_STATE
    ijk = np.empty((count, 3), np.int32)
    label = np.empty(count, np.uint8)
    at = 0
    for n in range(len(state)):
        for m in range(state.shape[1]):
            value = state[n, m]
            if value != FREE_STATE and value != UNOBSERVED_STATE:
                ijk[at, 0], ijk[at, 1], ijk[at, 2] = (
                    corner[n, 0] + m // 256,
                    corner[n, 1] + m // 16 % 16,
                    corner[n, 2] + m % 16,
                )
                label[at] = value
                at += 1
    return ijk, label


@njit(cache=True, nogil=True)
def _copy_blocks(out: U8, corner: I64, state: U8, rows: I64) -> None:
    """The ``rows`` (m,) of ``state``, blocks with their corner at ``corner`` (m, 3) of ``out``, as
    far as they lie in it.
    """
    nx, ny, nz = out.shape
    flat = out.ravel()
    for n in range(len(rows)):
        x, y, z = corner[n]
        first = max(z, 0)
        end = min(z + BLOCK, nz)
        block = state[rows[n]]
        for i in range(max(x, 0), min(x + BLOCK, nx)):
            for j in range(max(y, 0), min(y + BLOCK, ny)):
                at = ((i - x) * BLOCK + j - y) * BLOCK - z
                to = (i * ny + j) * nz
                if end - first == BLOCK:  # of a known length: the compiler moves them together
                    for k in range(BLOCK):
                        flat[np.uint64(to + first + k)] = block[np.uint64(at + first + k)]
                else:
                    for k in range(first, end):
                        flat[np.uint64(to + k)] = block[np.uint64(at + k)]


def empty_map() -> BlockMap:
    """A map without blocks."""
    shape = (0, BLOCK**3)
    nothing = np.zeros(0, np.int64)
    return BlockMap(nothing, np.zeros(shape, np.int8), np.zeros(shape, np.uint8), nothing, nothing)


@dataclass(slots=True, eq=False)
class Fuser:
    """Fuses labelled points frame by frame; :meth:`finish` gives the map.

    Class votes are counted for each (voxel, class), so the classes do not depend on the order of
    the frames.
    """

    fusion: ResolvedFusion
    _slots: dict[int, int] = field(default_factory=dict)
    _log_odds: NDArray[np.int8] = field(default_factory=lambda: np.zeros((0, BLOCK**3), np.int8))
    _vote_keys: I64 = field(default_factory=lambda: np.full(1 << 15, -1, np.int64))
    _vote_counts: NDArray[np.uint32] = field(default_factory=lambda: np.zeros(1 << 15, np.uint32))
    _votes: int = 0
    _carver: Carver | None = None

    def add(
        self,
        points: NDArray[np.floating],
        label: U8,
        origin: NDArray[np.floating],
        sigma: NDArray[np.floating] | None = None,
        map_T_points: NDArray[np.float64] | None = None,
    ) -> None:
        """Integrate a frame; the arguments are those of :meth:`Carver.marks`."""
        self._carver = self._carver or Carver(self.fusion)
        self.take(self._carver.marks(points, label, origin, sigma, map_T_points))

    def take(self, marks: Marks) -> None:
        """Integrate a frame that is carved already: maps that overlap share the work."""
        slots = self._slots_of(marks.blocks)
        f = self.fusion
        flush(
            marks.grid,
            marks.runs,
            slots,
            self._log_odds,
            *(round(SCALE * a) for a in (f.hit, f.miss, f.clamp[0], f.clamp[1])),
        )
        slot_of_run = np.zeros(len(marks.grid) >> BITS, np.int64)
        slot_of_run[marks.runs] = slots
        self._reserve_votes(int(np.count_nonzero(marks.votes)))
        self._votes = add_votes(
            self._vote_keys, self._vote_counts, self._votes, marks.ends, marks.votes, slot_of_run
        )

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
        """Room in the hash table of votes for ``more`` at a load of at most a half."""
        size = len(self._vote_keys)
        while size < 2 * (self._votes + more):
            size *= 2
        if size > len(self._vote_keys):
            keys = np.full(size, -1, np.int64)
            counts = np.zeros(size, np.uint32)
            rehash(self._vote_keys, self._vote_counts, keys, counts)
            self._vote_keys, self._vote_counts = keys, counts

    def finish(self) -> BlockMap:
        """The fused map. A voxel is occupied where its log-odds are positive; its class has the
        most votes (the lower id wins a tie).
        """
        if not self._slots:
            return empty_map()
        keys = np.fromiter(self._slots.keys(), np.int64, len(self._slots))
        order = np.argsort(keys)
        log_odds = self._log_odds[
            np.fromiter(self._slots.values(), np.int64, len(self._slots))[order]
        ]
        used = self._vote_keys >= 0
        key = self._vote_keys[used]
        count = self._vote_counts[used]
        row = np.argsort(order)[key >> (BITS + 5)]
        label = key & 31
        cell = key >> 5 & (BLOCK**3 - 1)
        ballots = (row * BLOCK**3 + cell) * 256 + np.where(label == CLASSES - 1, UNLABELLED, label)
        sort = np.argsort(ballots)
        ballots = ballots[sort]
        votes = count[sort].astype(np.int64)
        state = np.where(
            log_odds > 0, UNLABELLED, np.where(log_odds == UNOBSERVED, UNOBSERVED_STATE, FREE_STATE)
        ).astype(np.uint8)
        voxel, winner, _ = winners(ballots, votes)
        occupied = log_odds.reshape(-1)[voxel] > 0
        state.reshape(-1)[voxel[occupied]] = winner[occupied]
        return BlockMap(keys[order], log_odds, state, ballots, votes)


def winners(ballots: I64, votes: I64) -> tuple[I64, U8, I64]:
    """Voxels (row * 4096 + cell, ascending) that have votes, their class and the number of all
    their votes.

    The class has most votes; the lowest id wins a tie, and any known class beats unlabelled.
    """
    voxel, label = np.divmod(ballots, 256)
    if not len(voxel):
        return voxel, label.astype(np.uint8), votes
    best = np.lexsort((label, np.where(label == UNLABELLED, 0, -votes), voxel))
    group = np.flatnonzero(np.r_[True, voxel[1:] != voxel[:-1]])
    return voxel[group], label[best[group]].astype(np.uint8), np.add.reduceat(votes, group)
