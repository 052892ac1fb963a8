"""Scores of an alignment: how a query's structure lies on the target's voxels.

Ground lies on ground everywhere, so *structure* counts: voxels that are neither ground nor able to
move. The paper's ratio tau is reported beside it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from semloc_logs.alignment.mask_grid import FREE_BIT, Arrays, MaskGrid
from semloc_logs.alignment.query_map import Query
from semloc_logs.alignment.target_map import Target
from semloc_logs.arrays import F64, U8
from semloc_logs.numerics.transforms import inverse

DOUBT = 150  # voxels that are added to the observed ones, and their shares in wrong poses
DOUBTFUL_ALIGNED, DOUBTFUL_FREE = 0.5, 0.2
# of the structure of both sides, in free space: less in most right poses, more in most wrong ones
CONSISTENT = 0.1
ENOUGH_COVERAGE = 0.5  # of the query's structure in observed space: less of it lowers the score


def alignment_score(
    structure: F64 | float, coverage: F64 | float, contradiction: F64 | float
) -> F64:
    """Aligned structure less what contradicts free space, at most 1: the rank of an alignment."""
    covered = np.minimum(1.0, np.divide(coverage, ENOUGH_COVERAGE))
    return np.asarray(structure * covered - contradiction)


class Scores(NamedTuple):
    """Counts of structure voxels: all, those in observed space, ``aligned`` and in ``free`` space.

    Aligned are those within a voxel of structure of their class.
    """

    total: int
    observed: int
    aligned: int
    free: int

    @property
    def structure(self) -> float:
        """Share of the observed voxels that are aligned."""
        return self.aligned / max(self.observed, 1)

    @property
    def coverage(self) -> float:
        """Share of the voxels in observed space."""
        return self.observed / max(self.total, 1)

    @property
    def contradiction(self) -> float:
        """Share of the voxels in free space."""
        return self.free / max(self.total, 1)

    @property
    def score(self) -> float:
        """The rank among alignments of one query."""
        return float(alignment_score(self.structure, self.coverage, self.contradiction))


def structure_scores(query: Query, target: Target, target_T_query: F64) -> Scores:
    """The scores of a query's structure on a target's map."""
    return _scores(query.structure, target.mask_grid, target_T_query)


def reverse_scores(query: Query, target: Target, target_T_query: F64) -> Scores:
    """The scores of a target's structure on a query's map."""
    return _scores(target.structure, query.mask_grid, inverse(target_T_query))


def mutual_shares(forward: Scores, reverse: Scores) -> tuple[float, float]:
    """Of the voxels that the other side observed, the shares that are aligned and in free space.

    They are weighted geometric means of both sides, where the worse side counts twice: new or
    missing things contradict one side alone, a wrong pose both. A handful of voxels fits anywhere,
    so some are added that fit as in wrong poses.
    """
    sides = (forward, reverse)
    aligned = [(s.aligned + DOUBT * DOUBTFUL_ALIGNED) / (s.observed + DOUBT) for s in sides]
    free = [(s.free + DOUBT * DOUBTFUL_FREE) / (s.observed + DOUBT) for s in sides]
    return _weighted(min(aligned), max(aligned)), _weighted(max(free), min(free))


class MutualScores(NamedTuple):
    """``forward``: the query's structure on the target's map; ``reverse``: the target's on the
    query's.
    """

    forward: Scores
    reverse: Scores

    @property
    def score(self) -> float:
        """The rank among alignments of one query, in [-1, 1]."""
        aligned, free = mutual_shares(*self)
        return aligned - free

    @property
    def is_consistent(self) -> bool:
        """Whether so little structure of either side is in free space that it may be right."""
        return mutual_shares(*self)[1] < CONSISTENT


def mutual_scores(query: Query, target: Target, target_T_query: F64) -> MutualScores:
    """The scores of a pose on both sides."""
    return MutualScores(
        structure_scores(query, target, target_T_query),
        reverse_scores(query, target, target_T_query),
    )


def _weighted(worse: float, better: float) -> float:
    return float(np.cbrt(worse * worse * better))


def _scores(structure: tuple[F64, U8], grid: MaskGrid, grid_T_structure: F64) -> Scores:
    centres, bits = structure
    return Scores(len(bits), *_count(grid.arrays, centres, bits, grid_T_structure))


@njit(cache=True, nogil=True)
def _count(grid: Arrays, centres: F64, bits: U8, grid_T_structure: F64) -> tuple[int, int, int]:
    """Of the voxels in a grid the observed ones, the aligned ones, and those in free space.

    In one pass: the structure of a submap is large, and most of it lies outside a query's grid.
    """
    mask, corner, cell = grid
    nx, ny, nz = mask.shape
    R = grid_T_structure[:3, :3] / cell
    t = (grid_T_structure[:3, 3] - corner) / cell
    observed = aligned = free = 0
    for n in range(len(bits)):
        x = np.floor(
            R[0, 0] * centres[n, 0] + R[0, 1] * centres[n, 1] + R[0, 2] * centres[n, 2] + t[0]
        )
        y = np.floor(
            R[1, 0] * centres[n, 0] + R[1, 1] * centres[n, 1] + R[1, 2] * centres[n, 2] + t[1]
        )
        z = np.floor(
            R[2, 0] * centres[n, 0] + R[2, 1] * centres[n, 1] + R[2, 2] * centres[n, 2] + t[2]
        )
        if 0 <= x < nx and 0 <= y < ny and 0 <= z < nz:
            states = mask[int(x), int(y), int(z)]
            observed += states != 0
            aligned += (states & bits[n]) != 0
            free += (states & FREE_BIT) != 0
    return observed, aligned, free
