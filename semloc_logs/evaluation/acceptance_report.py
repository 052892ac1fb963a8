"""What the acceptance does in simulated towns: closures accepted and missed, false ones and how
many there may be, and whether probabilities and covariances are true.

It is made from judged alignments alone (:mod:`.judged_alignments`) and the probability of each.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta, chi2

from semloc_logs.arrays import F64, I64, Bools
from semloc_logs.evaluation.judged_alignments import Judged

SURE = 0.99  # what would be accepted
EDGES = (0.0, 0.01, 0.1, 0.3, 0.5, 0.7, 0.9, 0.97, 0.99, 0.999, 1.0)
THRESHOLDS = (0.9, 0.99, 0.999)
CONFIDENCE = 0.95  # of the bounds
ALL = "all"


@dataclass(frozen=True, slots=True)
class AtThreshold:
    """Closures at a least probability: the ``possible`` are the queries that have a right alignment
    with a target, ``towns`` the towns with accepted ones, ``false_towns`` those with a false one.
    """

    threshold: float
    possible: int
    accepted: int
    false: int
    towns: int
    false_towns: int

    @property
    def recall(self) -> float:
        """Share of the possible ones that are accepted and right."""
        return (self.accepted - self.false) / max(self.possible, 1)

    @property
    def recall_bounds(self) -> tuple[float, float]:
        """Between them lies the recall of more such queries."""
        return share_bounds(self.accepted - self.false, self.possible)

    @property
    def false_at_most(self) -> float:
        """The bound of the false discovery rate if closures were independent."""
        return most_of(self.false, self.accepted)

    @property
    def false_towns_at_most(self) -> float:
        """The bound of the share of towns with a false closure: towns are independent."""
        return most_of(self.false_towns, self.towns)

    def to_json(self) -> dict[str, Any]:
        """All figures."""
        bounds = {"recall": self.recall, "recall_bounds": list(self.recall_bounds)}
        most = {
            "false_at_most": self.false_at_most,
            "false_towns_at_most": self.false_towns_at_most,
        }
        return asdict(self) | bounds | most


@dataclass(frozen=True, slots=True)
class Errors:
    """Standardised errors of accepted right closures: their means (3 and 6 expected) and the shares
    within the 95 % ellipses.
    """

    closures: int
    median_m: float
    nees_position: float
    nees_pose: float
    within_position: float
    within_pose: float

    @classmethod
    def of(cls, judged: Judged, rows: I64) -> Errors | None:
        """Of the ``rows`` of some closures; None without any."""
        if not len(rows):
            return None
        position = judged.nees_position[rows]
        pose = judged.nees_pose[rows]
        return cls(
            len(rows),
            float(np.median(judged.error_m[rows])),
            float(position.mean()),
            float(pose.mean()),
            float((position <= chi2.ppf(CONFIDENCE, 3)).mean()),
            float((pose <= chi2.ppf(CONFIDENCE, 6)).mean()),
        )


@dataclass(frozen=True, slots=True)
class Group:
    """The figures of one ``kind`` of towns and one pair of ``sensors``, or of all of them."""

    kind: str
    sensors: str
    at: list[AtThreshold]
    errors: Errors | None

    def to_json(self) -> dict[str, Any]:
        """All figures."""
        return {
            "kind": self.kind,
            "sensors": self.sensors,
            "at": [row.to_json() for row in self.at],
            "errors": None if self.errors is None else asdict(self.errors),
        }


@dataclass(frozen=True, slots=True)
class AcceptanceReport:
    """The groups, and how often alignments of each range of probability are right."""

    queries: int
    towns: int
    groups: list[Group]
    reliability: list[dict[str, float]] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """All figures."""
        return {
            "queries": self.queries,
            "towns": self.towns,
            "groups": [group.to_json() for group in self.groups],
            "reliability": self.reliability,
        }

    def markdown(self) -> str:
        """Three tables: closures, errors, reliability."""
        return "\n".join(
            [
                f"{self.queries:,} queries with alignments, in {self.towns} towns.",
                "",
                *_closure_rows(self.groups),
                "",
                *_error_rows(self.groups),
                "",
                *_reliability_rows(self.reliability),
                "",
            ]
        )


def report_of(judged: Judged, p: F64) -> AcceptanceReport:
    """The report of alignments with probabilities ``p`` (n,)."""
    kinds = kinds_of(judged)
    sensors = sensors_of(judged)
    ordinary = judged.clear & ~judged.copies
    groups = []
    for kind in sorted(set(kinds)):
        of_kind = kinds == kind
        pairs = sorted(set(sensors[of_kind]))
        for name in pairs if len(pairs) == 1 else [ALL, *pairs]:
            rows = of_kind if name == ALL else of_kind & (sensors == name)
            groups.append(_group(judged.part(rows), p[rows], kind, name))
    return AcceptanceReport(
        len({key[:3] for key in _query_keys(judged)}),
        len(set(judged.town)),
        groups,
        reliability(p[ordinary], judged.right[ordinary]),
    )


def _group(judged: Judged, p: F64, kind: str, sensors: str) -> Group:
    accepted = [k for k in answers(judged, p).tolist() if p[k] >= SURE and judged.right[k]]
    errors = Errors.of(judged, np.array(accepted, np.int64))
    return Group(kind, sensors, closures_at(judged, p), errors)


# -- groups


def kinds_of(judged: Judged) -> NDArray[np.object_]:
    """Of each alignment (n,): drives or single sweeps, in ordinary towns or in copied blocks."""
    out = np.full(len(judged), "", object)
    copied = judged.copies
    for town in set(judged.town):
        of_town = judged.town == town
        queries = set(
            zip(judged.placed.query_session[of_town], judged.placed.query[of_town], strict=True)
        )
        sessions = {session for session, _ in queries}
        sweeps = "single sweeps" if len(queries) == len(sessions) else "drives"
        copies = "copied blocks" if copied[of_town].any() else "ordinary towns"
        out[of_town] = f"{sweeps}, {copies}"
    return out


def sensors_of(judged: Judged) -> NDArray[np.object_]:
    """The two sensors of each alignment (n,), in the order of their names.

    Sessions of a simulated town are named after their sensor: ``hdl32_0``.
    """
    placed = judged.placed
    pairs = zip(placed.query_session, placed.target_session, strict=True)
    named = (sorted(session.split("_")[0] for session in pair) for pair in pairs)
    return np.array([f"{one}, {other}" for one, other in named], object)


# -- figures


def answers(judged: Judged, p: F64) -> I64:
    """The most probable alignment of each query with each target, which alone can be accepted,
    ascending.
    """
    best: dict[tuple[Any, ...], int] = {}
    for k, key in enumerate(_query_keys(judged)):
        if key not in best or p[k] > p[best[key]]:
            best[key] = k
    return np.array(sorted(best.values()), np.int64)


def _query_keys(judged: Judged) -> Iterator[tuple[Any, ...]]:
    placed = judged.placed
    return zip(
        judged.town, placed.query_session, placed.query.tolist(), placed.target_session, strict=True
    )


def closures_at(
    judged: Judged, p: F64, thresholds: Sequence[float] = THRESHOLDS
) -> list[AtThreshold]:
    """Accepted and false closures for each least probability."""
    chosen = answers(judged, p)
    able = {key for key, right in zip(_query_keys(judged), judged.right, strict=True) if right}
    out = []
    for least in thresholds:
        accepted = chosen[p[chosen] >= least]
        false = accepted[~judged.right[accepted]]
        counts = (len(able), len(accepted), len(false))
        towns = (len(set(judged.town[accepted])), len(set(judged.town[false])))
        out.append(AtThreshold(least, *counts, *towns))
    return out


def reliability(p: F64, right: Bools, edges: Sequence[float] = EDGES) -> list[dict[str, float]]:
    """How often alignments of each range of probability ``p`` (n,) are right."""
    out = []
    for a, b in pairwise(edges):
        is_inside = (p >= a) & ((p < b) | (b == edges[-1]))
        if is_inside.any():
            out.append(
                {
                    "from": a,
                    "to": b,
                    "alignments": int(is_inside.sum()),
                    "mean": float(p[is_inside].mean()),
                    "right": float(right[is_inside].mean()),
                }
            )
    return out


def share_bounds(count: int, total: int) -> tuple[float, float]:
    """Between them lies a share with 95 % confidence (Clopper and Pearson, 1934)."""
    tail = (1 - CONFIDENCE) / 2
    low = beta.ppf(tail, count, total - count + 1) if count else 0.0
    high = beta.ppf(1 - tail, count + 1, total - count) if count < total else 1.0
    return float(low), float(high)


def most_of(count: int, total: int) -> float:
    """Below it lies a share with 95 % confidence (the same, one-sided); 1 of nothing."""
    return float(beta.ppf(CONFIDENCE, count + 1, total - count)) if count < total else 1.0


# -- tables


def _closure_rows(groups: Sequence[Group]) -> list[str]:
    head = "".join(f" recall at {t:g} (95 %) | false |" for t in THRESHOLDS)
    rows = [
        f"| towns | sensors | possible |{head} false at most | of towns |",
        "| --- " * (5 + 2 * len(THRESHOLDS)) + "|",
    ]
    for group in groups:
        sure = next(row for row in group.at if row.threshold == SURE)
        cells = [group.kind, group.sensors, f"{sure.possible:,}"]
        for row in group.at:
            low, high = row.recall_bounds
            cells += [
                f"{row.recall:.2f} ({low:.2f} to {high:.2f})",
                f"{row.false} of {row.accepted:,}",
            ]
        cells += [f"{sure.false_at_most:.2%}", f"{sure.false_towns_at_most:.0%} of {sure.towns}"]
        rows.append("| " + " | ".join(cells) + " |")
    return rows


def _error_rows(groups: Sequence[Group]) -> list[str]:
    rows = [
        "| towns | sensors | closures | median error | NEES, position (3) | pose (6)"
        " | within 95 % ellipse, position | pose |",
        "| --- " * 8 + "|",
    ]
    for group in groups:
        e = group.errors
        if e is not None:
            cells = [group.kind, group.sensors, f"{e.closures:,}", f"{e.median_m:.3f} m"]
            cells += [f"{e.nees_position:.2f}", f"{e.nees_pose:.2f}"]
            cells += [f"{e.within_position:.0%}", f"{e.within_pose:.0%}"]
            rows.append("| " + " | ".join(cells) + " |")
    return rows


def _reliability_rows(bins: Sequence[dict[str, float]]) -> list[str]:
    rows = [
        "| probability, ordinary towns | alignments | mean | right |",
        "| --- | --- | --- | --- |",
    ]
    for row in bins:
        cells = [f"{row['from']:g} to {row['to']:g}", f"{row['alignments']:,}"]
        cells += [f"{row['mean']:.4f}", f"{row['right']:.4f}"]
        rows.append("| " + " | ".join(cells) + " |")
    return rows
