"""Alignments of queries in targets, the decisions about them, and what becomes of each."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from enum import Enum
from typing import Generic, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
Rows = NDArray[np.int64] | NDArray[np.bool_]
Value = TypeVar("Value", float, F64)  # of one alignment, or the values (n,) of several


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """Base of dataclasses whose fields are floats, or arrays with one row an alignment."""

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))

    def part(self, rows: Rows) -> Self:
        """Some of the rows."""
        return replace(self, **{f.name: getattr(self, f.name)[rows] for f in fields(self)})

    def vector(self) -> F64:
        """The values (..., d) in the order of the fields, as a model takes them."""
        return np.stack([getattr(self, f.name) for f in fields(self)], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class Features(Columns, Generic[Value]):
    """Evidence for an alignment by itself.

    The columns of the same names are described in ``schemas/parquet/rejected.json``.
    """

    structure: Value
    coverage: Value
    contradiction: Value
    fit: Value
    support: Value
    stiffness: Value
    range_sigma: Value


FEATURES = tuple(f.name for f in fields(Features))


@dataclass(frozen=True, slots=True)
class Agreement(Columns, Generic[Value]):
    """How other queries of the session vote on an alignment.

    ``own_probability`` is what the features of the query's alignments with the target give.
    ``support`` and ``conflict`` are sums of own probabilities of near neighbours that agree and
    that do not; ``far_support`` and ``far_conflict`` those farther along the road. ``ambiguity`` in
    [0, 1] is how much the road around either end matches other places. See
    ``schemas/parquet/rejected.json``.
    """

    own_probability: Value
    neighbours: Value
    support: Value
    conflict: Value
    far_support: Value
    far_conflict: Value
    ambiguity: Value

    def row(self: Agreement[F64], k: int) -> Agreement[float]:
        """The agreement of alignment ``k`` of several."""
        return Agreement(*(float(getattr(self, f.name)[k]) for f in fields(self)))


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """A verified hypothesis before any decision about it.

    The keyframes are the query's, and the target's nearest one; ``covariance`` (6, 6) is in the
    axes of the target's, metres and radians.
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
    inliers: int
    words: int
    features: Features[float]

    @property
    def sigma(self) -> float:
        """Standard deviation of the position in its worst direction, metres."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))


class Veto(Enum):
    """What rejects an alignment whatever its probability is."""

    CONTRADICTS_ODOMETRY = "contradicts_odometry"
    AMBIGUOUS_PLACE = "ambiguous_place"
    LOOSE_FIT = "loose_fit"


@dataclass(frozen=True, slots=True)
class Decision:
    """The probability of an alignment after all queries are compared, and its factors.

    ``probability`` is the product of ``place_probability`` (the place is right), ``mode_share`` (of
    the poses that fit this place, this is the right one) and ``position_confidence`` (the position
    is known well enough). At least ``min_probability`` and no ``vetoes`` are required.
    """

    vetoes: frozenset[Veto]
    place_probability: float
    mode_share: float
    position_confidence: float
    agreement: Agreement[float]
    min_probability: float

    @property
    def probability(self) -> float:
        """The product of the factors."""
        return self.place_probability * self.mode_share * self.position_confidence


class Reason(Enum):
    """Why an alignment is rejected: a sentence with the figures of :meth:`Rejected.figures`."""

    CONTRADICTS_ODOMETRY = "contradicts the session's own odometry"
    POSE_MODES = "other poses fit this place too: this one has {mode_share:.0f} % of the odds"
    UNCERTAIN_POSITION = "position uncertainty {sigma:.2f} m (1 sigma) is too large"
    AMBIGUOUS_PLACE = "ambiguous place: {ambiguity:.0f} % of nearby queries match elsewhere"
    NEIGHBOURS_CONFLICT = (
        "neighbouring queries conflict: of {neighbours:.0f}, {support:.1f} support this place and"
        " {conflict:.1f} match elsewhere"
    )
    FREE_SPACE = "{contradiction:.0f} % of the structure of both sides lies in free space"
    RIVAL_PLACE = "other places fit too: by itself this one has a probability of {own:.2f}"
    LOOSE_FIT = "only {fit:.0f} % of the points lie on a surface"
    UNCERTAIN_RANGES = "the ranges are too uncertain ({range_sigma:.1f} voxels)"
    SECOND_CHOICE = "another place of the same session fits better"


@dataclass(frozen=True, slots=True, eq=False)
class Closure:
    """An accepted alignment."""

    alignment: Alignment
    decision: Decision


@dataclass(frozen=True, slots=True, eq=False)
class Rejected:
    """A rejected alignment; ``reason`` is the gate that it did not pass."""

    alignment: Alignment
    decision: Decision
    reason: Reason

    @property
    def sentence(self) -> str:
        """The reason with its figures."""
        sentence = self.reason.value.format(**self.figures())
        decision = self.decision
        if self.reason is Reason.SECOND_CHOICE or decision.vetoes:
            return sentence
        return (
            f"probability {decision.probability:.3f} below {decision.min_probability:g}: {sentence}"
        )

    def figures(self) -> dict[str, float]:
        """The figures that sentences may have: shares in per cent, ``sigma`` in metres."""
        features = self.alignment.features
        agreement = self.decision.agreement
        return {
            "mode_share": 100 * self.decision.mode_share,
            "sigma": self.alignment.sigma,
            "ambiguity": 100 * agreement.ambiguity,
            "neighbours": agreement.neighbours,
            "support": agreement.support,
            "conflict": agreement.conflict,
            "contradiction": 100 * features.contradiction,
            "own": agreement.own_probability,
            "fit": 100 * features.fit,
            "range_sigma": features.range_sigma,
        }
