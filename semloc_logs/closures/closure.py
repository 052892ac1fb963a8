"""Alignments of queries in targets: what is decided about and what is reported."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semloc_logs.alignment.verify import (
    Features,
)

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """A verified hypothesis with everything that is reported; ``accepted`` or with a ``reason``.

    ``probability`` is that of the alignment alone until
    :func:`semloc_logs.closures.acceptance.consistency.decide` has compared all queries.
    """

    query_session: str
    target_session: str
    query_keyframe: int
    target_keyframe: int
    query_stamp_ns: int
    target_stamp_ns: int
    target_T_query: F64
    covariance: F64
    overlap: float
    probability: float
    inliers: int
    words: int
    features: Features
    agreement: Agreement
    reason: str = "not yet compared with other queries"

    @property
    def accepted(self) -> bool:
        return not self.reason

    @property
    def sigma(self) -> float:
        """Standard deviation of the position in its worst direction, metres."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))


@dataclass(frozen=True, slots=True)
class Agreement:
    """What other queries of the session say about an alignment; see
    ``schemas/parquet/rejected.json``.

    ``alone`` is the probability from the alignment's own features; the sums are of the ``alone`` of
    other queries' alignments.
    """

    alone: float
    neighbours: int = 0
    agreeing: float = 0.0
    opposing: float = 0.0
    far_agreeing: float = 0.0
    far_opposing: float = 0.0
    lookalike: float = 0.0
