"""Alignments of queries in targets, the decisions about them, and what becomes of each."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from enum import Enum
from typing import Any, Generic, Self, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64, I64

Chosen = I64 | NDArray[np.bool_]
Row = TypeVar("Row")
Value = TypeVar("Value", float, F64)  # of one alignment, or the values (n,) of several


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """Base of dataclasses whose fields are floats, or arrays with one row an alignment."""

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))

    def part(self, rows: Chosen) -> Self:
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


class Rows(Sequence[Row]):
    """Base of sequences that hold columns and make a row when it is looked at."""

    def row(self, k: int) -> Row:
        """Row ``k``, from 0 on."""
        raise NotImplementedError

    @overload
    def __getitem__(self, k: int) -> Row: ...

    @overload
    def __getitem__(self, k: slice) -> list[Row]: ...

    def __getitem__(self, k: int | slice) -> Row | list[Row]:
        if isinstance(k, slice):
            return [self.row(i) for i in range(*k.indices(len(self)))]
        if not -len(self) <= k < len(self):
            raise IndexError(k)
        return self.row(k % len(self))

    def __iter__(self) -> Iterator[Row]:
        return (self.row(k) for k in range(len(self)))


@dataclass(frozen=True, slots=True, eq=False)
class Alignments(Rows[Alignment]):
    """Alignments (n) as columns, a third of the memory of their objects.

    ``pair`` (n,) is the number of each one's query and target session among ``pairs``; ``given``
    are the objects that the columns were made of, if any.
    """

    pairs: Sequence[tuple[str, str]]
    pair: I64
    query_keyframe: I64
    target_keyframe: I64
    query_stamp_ns: I64
    target_stamp_ns: I64
    target_T_query: F64
    covariance: F64
    overlap: F64
    inliers: I64
    words: I64
    features: Features[F64]
    given: Sequence[Alignment] | None = None

    def __len__(self) -> int:
        return len(self.pair)

    @classmethod
    def of(cls, alignments: Sequence[Alignment]) -> Alignments:
        """The columns of alignments."""
        if isinstance(alignments, Alignments):
            return alignments
        numbers: dict[tuple[str, str], int] = {}
        pair = [
            numbers.setdefault((a.query_session, a.target_session), len(numbers))
            for a in alignments
        ]

        def column(name: str, kind: type) -> NDArray[Any]:
            return np.array([getattr(a, name) for a in alignments], kind)

        return cls(
            pairs=list(numbers),
            pair=np.array(pair, np.int64),
            query_keyframe=column("query_keyframe", np.int64),
            target_keyframe=column("target_keyframe", np.int64),
            query_stamp_ns=column("query_stamp_ns", np.int64),
            target_stamp_ns=column("target_stamp_ns", np.int64),
            target_T_query=column("target_T_query", float).reshape(-1, 4, 4),
            covariance=column("covariance", float).reshape(-1, 6, 6),
            overlap=column("overlap", float),
            inliers=column("inliers", np.int64),
            words=column("words", np.int64),
            features=Features(
                *(np.array([getattr(a.features, n) for a in alignments], float) for n in FEATURES)
            ),
            given=alignments,
        )

    @classmethod
    def joined(cls, parts: Iterable[Alignments]) -> Alignments:
        """The alignments of all parts, each of pairs that no other has."""
        held = [part for part in parts if len(part)] or [cls.of([])]
        offsets = np.cumsum([0, *(len(part.pairs) for part in held)])

        def column(name: str) -> NDArray[Any]:
            return np.concatenate([getattr(part, name) for part in held])

        names = {f.name for f in fields(cls)} - {"pairs", "pair", "features", "given"}
        columns: dict[str, Any] = {name: column(name) for name in names}
        features = (
            np.concatenate([getattr(part.features, name) for part in held]) for name in FEATURES
        )
        return cls(
            pairs=[pair for part in held for pair in part.pairs],
            pair=np.concatenate([p.pair + o for p, o in zip(held, offsets[:-1], strict=True)]),
            **columns,
            features=Features(*features),
        )

    def row(self, k: int) -> Alignment:
        """Alignment ``k``."""
        if self.given is not None:
            return self.given[k]
        query, target = self.pairs[self.pair[k]]
        return Alignment(
            query_session=query,
            target_session=target,
            query_keyframe=int(self.query_keyframe[k]),
            target_keyframe=int(self.target_keyframe[k]),
            query_stamp_ns=int(self.query_stamp_ns[k]),
            target_stamp_ns=int(self.target_stamp_ns[k]),
            target_T_query=self.target_T_query[k],
            covariance=self.covariance[k],
            overlap=float(self.overlap[k]),
            inliers=int(self.inliers[k]),
            words=int(self.words[k]),
            features=Features(*(float(getattr(self.features, name)[k]) for name in FEATURES)),
        )

    def by_pair(self) -> Iterator[tuple[tuple[str, str], I64]]:
        """Each pair of sessions with the numbers of its alignments."""
        order = np.argsort(self.pair, kind="stable")
        cuts = np.searchsorted(self.pair[order], np.arange(1, len(self.pairs)))
        if self.pairs:
            yield from zip(self.pairs, np.split(order, cuts), strict=True)

    def sessions(self) -> tuple[NDArray[np.object_], NDArray[np.object_]]:
        """Names (n,) of the query sessions and of the target sessions."""
        names = np.array(self.pairs, object).reshape(-1, 2)[self.pair]
        return names[:, 0], names[:, 1]

    def sigma(self) -> F64:
        """Standard deviations (n,) of the positions in their worst directions, metres."""
        if not len(self):
            return np.zeros(0)
        return np.asarray(np.sqrt(np.linalg.eigvalsh(self.covariance[:, :3, :3])[:, -1]))


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


@dataclass(frozen=True, slots=True, eq=False)
class Decisions(Columns):
    """Decisions about alignments (n), as columns: see :class:`Decision`.

    ``vetoes`` (n, vetoes) are in the order of :class:`Veto`.
    """

    place_probability: F64
    mode_share: F64
    position_confidence: F64
    vetoes: NDArray[np.bool_]

    @property
    def probability(self) -> F64:
        """The products (n,) of the factors."""
        return self.place_probability * self.mode_share * self.position_confidence

    def of(self, k: int, agreement: Agreement[F64], min_probability: float) -> Decision:
        """The decision about alignment ``k``."""
        return Decision(
            vetoes=frozenset(v for v, held in zip(Veto, self.vetoes[k], strict=True) if held),
            place_probability=float(self.place_probability[k]),
            mode_share=float(self.mode_share[k]),
            position_confidence=float(self.position_confidence[k]),
            agreement=agreement.row(k),
            min_probability=min_probability,
        )


REASONS = tuple(Reason)
ACCEPTED = -1


@dataclass(frozen=True, slots=True, eq=False)
class Outcomes(Rows[Closure | Rejected]):
    """What becomes of ``alignments``: the numbers of some in ``order`` (m,), and their fates.

    ``reason`` (n,) of each alignment is a number among :data:`REASONS`, or :data:`ACCEPTED`.
    """

    alignments: Alignments
    decisions: Decisions
    agreement: Agreement[F64]
    min_probability: float
    order: I64
    reason: NDArray[np.int8]

    def __len__(self) -> int:
        return len(self.order)

    def decision(self, k: int) -> Decision:
        """The decision about alignment ``k``."""
        return self.decisions.of(k, self.agreement, self.min_probability)

    def row(self, k: int) -> Closure | Rejected:
        """Outcome ``k`` of the order."""
        number = int(self.order[k])
        alignment = self.alignments[number]
        decision = self.decision(number)
        if self.reason[number] == ACCEPTED:
            return Closure(alignment, decision)
        return Rejected(alignment, decision, REASONS[self.reason[number]])

    def accepted(self) -> list[Closure]:
        """The accepted ones, in their order."""
        numbers = np.flatnonzero(self.reason[self.order] == ACCEPTED)
        rows = (self.row(k) for k in numbers.tolist())
        return [row for row in rows if isinstance(row, Closure)]

    def rejected(self) -> RejectedRows:
        """The rejected ones."""
        order = self.order[self.reason[self.order] != ACCEPTED]
        return RejectedRows(replace(self, order=order))


@dataclass(frozen=True, slots=True, eq=False)
class RejectedRows(Rows[Rejected]):
    """The rejected ones of some outcomes."""

    outcomes: Outcomes

    def __len__(self) -> int:
        return len(self.outcomes)

    def row(self, k: int) -> Rejected:
        """Rejected alignment ``k``."""
        row = self.outcomes.row(k)
        if isinstance(row, Closure):
            raise TypeError(f"outcome {k} is a closure")
        return row
