"""Scores of an alignment: how a query's structure lies on the target's voxels.

Ground lies on ground everywhere, so *structure* counts: voxels that are neither ground nor able to
move. The paper's ratio tau is reported beside it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semloc_logs.alignment.mask_grid import FREE_BIT, look_up
from semloc_logs.alignment.query_map import Query
from semloc_logs.alignment.target_map import Target
from semloc_logs.numerics.transforms import apply

F64 = NDArray[np.float64]
ENOUGH_COVERAGE = 0.5  # of the query's structure in observed space: less of it lowers the score


def alignment_score(
    structure: F64 | float, coverage: F64 | float, contradiction: F64 | float
) -> F64:
    """Aligned structure less what contradicts free space, at most 1: the rank of an alignment."""
    covered = np.minimum(1.0, np.divide(coverage, ENOUGH_COVERAGE))
    return np.asarray(structure * covered - contradiction)


class Scores(NamedTuple):
    """Shares of a query's structure, and the number of ``aligned`` structure voxels.

    ``structure``: within a voxel of structure of its class, of what falls into observed space;
    ``coverage``: in observed space; ``contradiction``: in free space.
    """

    structure: float
    coverage: float
    contradiction: float
    aligned: int

    @property
    def score(self) -> float:
        """The rank among alignments of one query."""
        return float(alignment_score(self.structure, self.coverage, self.contradiction))


def structure_scores(query: Query, target: Target, target_T_query: F64) -> Scores:
    """The scores of an alignment."""
    centres, bits = query.structure
    if not len(centres):
        return Scores(0.0, 0.0, 0.0, 0)
    mask = look_up(target.mask_grid, apply(target_T_query, centres))
    observed = mask != 0
    aligned = (mask & bits) != 0
    free = (mask & FREE_BIT) != 0
    return Scores(
        float(aligned.sum() / max(observed.sum(), 1)),
        float(observed.mean()),
        float(free.mean()),
        int(aligned.sum()),
    )
