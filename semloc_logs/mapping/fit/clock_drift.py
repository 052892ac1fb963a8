"""Whether the clock of a stream and the one of the poses drift apart during a drive."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semloc_logs.mapping.fit.findings import LEAST_SIGMAS
from semloc_logs.mapping.fit.model import CLOCK, Estimate, Pairs, PosesAt, fit

FEWEST = 8  # pairs at either end of the drive
ENDS = 3  # either end is a part of so many


@dataclass(frozen=True, slots=True)
class ClockDrift:
    """By how much (s) stamps of clouds have to change in the ``first`` and in the ``last`` part.

    ``sigma`` is the standard deviation (s) of their difference.
    """

    first: float
    last: float
    sigma: float

    @property
    def change(self) -> float:
        """What the offset changes by (s)."""
        return self.last - self.first

    @property
    def is_sure(self) -> bool:
        """Whether the offset changes."""
        return abs(self.change) >= LEAST_SIGMAS * self.sigma


def clock_drift(pairs: Pairs, poses_at: PosesAt, estimate: Estimate) -> ClockDrift | None:
    """The offsets at both ends of a drive, beside the other parameters of an ``estimate``.

    None where there are too few pairs.
    """
    count = len(pairs) // ENDS
    if count < FEWEST:
        return None
    order = np.argsort(pairs.stamps_ns[:, 0], kind="stable")
    free = np.array([CLOCK])
    ends = [
        fit(pairs.some(rows), poses_at, free, estimate.parameters)
        for rows in (order[:count], order[-count:])
    ]
    first, last = (float(end.parameters[CLOCK]) for end in ends)
    variance = sum(end.sigma(CLOCK) ** 2 for end in ends)
    return ClockDrift(first, last, float(np.sqrt(variance)))
