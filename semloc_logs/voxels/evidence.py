"""The evidence of several submaps about the same voxels, added up: log-odds and class votes.

The sum is the one of OctoMap (Hornung et al. 2013, equation 4) over maps instead of scans: it is
associative and does not depend on an order, because it is clamped at the end only. So a voxel that
one submap saw occupied and the next one carved free does not survive.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zstandard
from numpy.typing import NDArray

from semloc_logs.labels.space import UNLABELLED
from semloc_logs.voxels.carve import UNOBSERVED
from semloc_logs.voxels.grid import BlockMap, winners
from semloc_logs.voxels.keys import BLOCK, morton, unpack

CELLS = BLOCK**3
CLASSES = 256
Tile = tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Sums over any number of submaps, of whole blocks.

    ``keys`` (n,) packed block coordinates, ascending; ``log_odds`` (n, 4096) int32, sums in units
    of 1/20, 0 where nothing was observed; ``ballots`` (m,) int64, ascending, ``(row * 4096 + cell)
    * 256 + class``, and ``votes`` (m,) int64 for each.
    """

    keys: NDArray[np.int64]
    log_odds: NDArray[np.int32]
    ballots: NDArray[np.int64]
    votes: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Voxels:
    """Occupied voxels in Morton order.

    ``ijk`` (n, 3), ``label`` (n,), ``log_odds`` (n,) clamped, in 1/20, ``hits`` (n,) all votes.
    """

    ijk: NDArray[np.int32]
    label: NDArray[np.uint8]
    log_odds: NDArray[np.int32]
    hits: NDArray[np.int64]


def evidence(blocks: BlockMap, tile: int) -> Iterator[tuple[Tile, Evidence]]:
    """The evidence of one submap, tile by tile.

    Tiles are ``tile`` voxels wide (a multiple of 16) in x and y.
    """
    row = blocks.ballots // (CELLS * CLASSES)
    where = unpack(blocks.keys)[:, :2] // (tile // BLOCK)
    for x, y in np.unique(where, axis=0).tolist():
        rows = np.flatnonzero((where == (x, y)).all(1))
        log_odds = blocks.log_odds[rows].astype(np.int32)
        log_odds[log_odds == UNOBSERVED] = 0
        place = np.searchsorted(rows, row)
        is_of_tile = (place < len(rows)) & (rows[np.minimum(place, len(rows) - 1)] == row)
        moved = (place[is_of_tile] - row[is_of_tile]) * (CELLS * CLASSES)
        yield (
            (x, y),
            Evidence(
                blocks.keys[rows],
                log_odds,
                blocks.ballots[is_of_tile] + moved,
                blocks.votes[is_of_tile],
            ),
        )


def merge(a: Evidence, b: Evidence) -> Evidence:
    """The evidence of both: sums, so any order and any grouping of merges gives the same."""
    keys = np.union1d(a.keys, b.keys)
    log_odds = np.zeros((len(keys), CELLS), np.int32)
    ballots = []
    votes = []
    for part in (a, b):
        rows = np.searchsorted(keys, part.keys)
        log_odds[rows] += part.log_odds
        row, rest = np.divmod(part.ballots, CELLS * CLASSES)
        ballots.append(rows[row] * (CELLS * CLASSES) + rest)
        votes.append(part.votes)
    every, index = np.unique(np.concatenate(ballots), return_inverse=True)
    total = np.zeros(len(every), np.int64)
    np.add.at(total, index, np.concatenate(votes))
    return Evidence(keys, log_odds, every, total)


def resolve(evidence_: Evidence, low: int, high: int) -> Voxels:
    """The occupied voxels: summed log-odds, clamped to [``low``, ``high``] (1/20), are positive.

    The class has most votes; the lowest id wins a tie, and any known class beats unlabelled.
    Without votes: unlabelled.
    """
    row, cell = np.nonzero(evidence_.log_odds > 0)
    ijk = unpack(evidence_.keys)[row] * BLOCK + np.stack(
        [cell // 256, cell // 16 % 16, cell % 16], 1
    ).astype(np.int32)
    order = np.argsort(morton(ijk))
    ijk = ijk[order]
    row = row[order]
    cell = cell[order]
    voters, label, hits = winners(evidence_.ballots, evidence_.votes)
    voter = np.searchsorted(voters, row * CELLS + cell)
    voter = np.where(np.r_[voters, -1][voter] == row * CELLS + cell, voter, len(voters))
    log_odds = np.clip(evidence_.log_odds[row, cell], low, high)
    return Voxels(ijk, np.r_[label, np.uint8(UNLABELLED)][voter], log_odds, np.r_[hits, 0][voter])


class Tiles:
    """Evidence of a whole session by tile.

    Only the tiles of the last submap are in memory; the others are in files of ``folder``, whose
    size is bounded by the ground covered, however often it was covered.
    """

    def __init__(self, folder: Path, tile: int) -> None:
        self._folder, self._tile = folder, tile
        self._open: dict[Tile, Evidence] = {}
        self._written: dict[Tile, Path] = {}

    def add(self, blocks: BlockMap) -> None:
        """Add one submap."""
        opened: dict[Tile, Evidence] = {}
        for tile, part in evidence(blocks, self._tile):
            opened[tile] = merge(self.take(tile), part) if tile in self.names() else part
        for tile, left in self._open.items():
            self._written[tile] = self._folder / f"{tile[0]}_{tile[1]}.zst"
            _save(self._written[tile], left)
        self._open = opened

    def names(self) -> set[Tile]:
        """Tiles that hold anything observed."""
        return self._open.keys() | self._written.keys()

    def take(self, tile: Tile) -> Evidence:
        """The evidence of a tile, which is forgotten here."""
        if tile in self._open:
            return self._open.pop(tile)
        path = self._written.pop(tile)
        loaded = _load(path)
        path.unlink()
        return loaded


def _save(path: Path, saved: Evidence) -> None:
    with zstandard.open(path, "wb", cctx=zstandard.ZstdCompressor(level=1)) as file:
        for array in (saved.keys, saved.log_odds, saved.ballots, saved.votes):
            np.lib.format.write_array(file, array, allow_pickle=False)


def _load(path: Path) -> Evidence:
    with zstandard.open(path, "rb") as file:
        return Evidence(*(np.lib.format.read_array(file, allow_pickle=False) for _ in range(4)))
