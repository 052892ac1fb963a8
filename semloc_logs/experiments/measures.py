"""Measures of answers: ratios within a threshold, rank-recall, error curves, precision and recall,
false discoveries beside coverage; each with confidence bounds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from semloc_logs.arrays import F64, I64, Bools

THRESHOLDS_M = 1.0, 5.0  # of the rank-recall curves (paper, section 4.4)
SAMPLES = 2000  # of a bootstrap
CONFIDENCE = 0.95
_Z = 1.959963984540054  # standard normal quantile of (1 + CONFIDENCE) / 2
FEWEST_PASSAGES = 5  # that a bootstrap needs


class Bounded(NamedTuple):
    """A figure and the bounds that hold it with 95 % confidence; ``n`` independent samples."""

    value: float
    low: float
    high: float
    n: int


def wilson(successes: float, n: int) -> Bounded:
    """The score interval of a share (Wilson, JASA 1927); NaN without samples."""
    if n == 0:
        return Bounded(math.nan, 0.0, 1.0, 0)
    share = successes / n
    centre = (share + _Z**2 / (2 * n)) / (1 + _Z**2 / n)
    half = _Z / (1 + _Z**2 / n) * math.sqrt(share * (1 - share) / n + _Z**2 / (4 * n**2))
    return Bounded(share, max(0.0, centre - half), min(1.0, centre + half), n)


def resampled(passage: I64, samples: int = SAMPLES, seed: int = 0) -> F64:
    """How often each query (q,) is drawn in each of ``samples`` bootstraps: (samples, q).

    Whole passages are drawn: queries of one passage see the same place (cluster bootstrap; Davison
    and Hinkley, Bootstrap Methods, 1997, section 3.8).
    """
    _, cluster = np.unique(passage, return_inverse=True)
    return _drawn(cluster.astype(np.int64).tobytes(), samples, seed)


@lru_cache(maxsize=8)
def _drawn(clusters: bytes, samples: int, seed: int) -> F64:
    """The draws of the numbered clusters of the queries; many figures share them."""
    cluster = np.frombuffer(clusters, np.int64)
    count = int(cluster.max()) + 1 if len(cluster) else 0
    rng = np.random.default_rng([seed, 91])
    drawn = rng.integers(0, max(1, count), (samples, count))
    weights = np.zeros((samples, count))
    np.add.at(weights, (np.arange(samples)[:, None], drawn), 1.0)
    out = weights[:, cluster]
    out.flags.writeable = False
    return np.asarray(out)


def ratio(right: Bools, passage: I64) -> Bounded:
    """The share of queries (q,) that are right.

    Bounds by bootstrap over passages. With few passages, or where all queries are alike, they are
    Wilson's, with the passages as the samples.
    """
    right = np.asarray(right, float)
    passages = len(np.unique(passage))
    if not len(right):
        return wilson(0, 0)
    share = float(right.mean())
    if passages < FEWEST_PASSAGES or share in (0.0, 1.0):
        return wilson(share * passages, passages)
    weights = resampled(passage)
    low, high = _interval((weights @ right) / weights.sum(axis=1))
    return Bounded(share, low, high, passages)


def difference(one: Bools, other: Bools, passage: I64) -> Bounded:
    """How much larger the share of ``one`` (q,) is than the share of ``other`` (q,) on the same
    queries, by a paired bootstrap over passages.
    """
    off = np.asarray(one, float) - np.asarray(other, float)
    passages = len(np.unique(passage))
    if not len(off):
        return Bounded(math.nan, -1.0, 1.0, 0)
    if passages < FEWEST_PASSAGES:
        return _unpaired(ratio(one, passage), ratio(other, passage))
    weights = resampled(passage)
    low, high = _interval((weights @ off) / weights.sum(axis=1))
    return Bounded(float(off.mean()), low, high, passages)


def difference_of_ratios(one: Bounded, other: Bounded) -> Bounded:
    """The difference of two shares of different queries (Newcombe, Statistics in Medicine 1998,
    method 10, with the bounds at hand).
    """
    return _unpaired(one, other)


def _unpaired(one: Bounded, other: Bounded) -> Bounded:
    value = one.value - other.value
    below = math.hypot(one.value - one.low, other.high - other.value)
    above = math.hypot(one.high - one.value, other.value - other.low)
    return Bounded(value, max(-1.0, value - below), min(1.0, value + above), min(one.n, other.n))


def _interval(values: F64) -> tuple[float, float]:
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(values, [tail, 1 - tail])
    return float(low), float(high)


# -- the paper's curves


def localised(errors_m: F64, threshold_m: float, ranks: int = 1) -> Bools:
    """Which queries (q,) have a pose within the threshold among the first ``ranks`` of (q, r)."""
    return np.asarray((errors_m[:, :ranks] <= threshold_m).any(axis=1))


def rank_recall(errors_m: F64, threshold_m: float) -> F64:
    """The share (r,) of queries with a pose within the threshold among the first 1 to r of (q, r)
    (paper, Fig. 5).
    """
    if not len(errors_m):
        return np.full(errors_m.shape[1], np.nan)
    within = np.maximum.accumulate(errors_m <= threshold_m, axis=1)
    return np.asarray(within.mean(axis=0))


def error_curve(first_m: F64, at_m: F64) -> F64:
    """The share (k,) of queries whose first pose is within each of the errors (k,)."""
    if not len(first_m):
        return np.full(len(at_m), np.nan)
    return np.asarray((first_m[:, None] <= at_m).mean(axis=0))


# -- precision and recall


@dataclass(frozen=True, eq=False)
class PrecisionRecall:
    """Precision and recall (k,) at every threshold (k,) of the score, the greatest first."""

    threshold: F64
    precision: F64
    recall: F64

    @property
    def average_precision(self) -> float:
        """The area below the steps of the curve: sum of (R_k - R_k-1) P_k."""
        if not len(self.recall):
            return 0.0
        return float(np.sum(np.diff(self.recall, prepend=0.0) * self.precision))

    @property
    def best_f1(self) -> float:
        """The greatest harmonic mean of precision and recall."""
        total = self.precision + self.recall
        if not len(total) or not total.max() > 0:
            return 0.0
        both = 2 * self.precision * self.recall
        return float(np.max(np.divide(both, total, out=np.zeros_like(total), where=total > 0)))

    @property
    def recall_at_full_precision(self) -> float:
        """The greatest recall without a wrong one."""
        full = self.recall[self.precision >= 1.0]
        return float(full.max()) if len(full) else 0.0

    @property
    def extended_precision(self) -> float:
        """(P_R0 + R_P100) / 2: precision at the least recall, and recall at full precision (SSC,
        IROS 2021).
        """
        if not len(self.precision):
            return 0.0
        return (float(self.precision[0]) + self.recall_at_full_precision) / 2


def precision_recall(score: F64, right: Bools, positives: int) -> PrecisionRecall:
    """The curve of decisions that are accepted from the greatest ``score`` (n,) on; ``right`` (n,)
    tells which are true, ``positives`` how many true ones there are in all.

    Decisions of one score are accepted together; -inf is never accepted.
    """
    kept = np.flatnonzero(score > -np.inf)
    order = kept[np.argsort(-score[kept], kind="stable")]
    if not len(order) or positives == 0:
        return PrecisionRecall(np.zeros(0), np.zeros(0), np.zeros(0))
    true = np.cumsum(right[order])
    values = score[order]
    last = np.flatnonzero(np.append(values[1:] != values[:-1], True))
    count = last + 1
    return PrecisionRecall(values[last], true[last] / count, true[last] / positives)


# -- abstaining


class Abstaining(NamedTuple):
    """What a system does that answers only above a threshold of its score: the share of its answers
    that are wrong, and the share of queries that it answers.
    """

    false_discovery: Bounded
    coverage: Bounded


def abstaining(score: F64, right: Bools, passage: I64, allowed: float = 0.05) -> Abstaining:
    """False discovery rate and coverage (q,), with the least threshold that keeps the rate at or
    below ``allowed`` on other passages.

    Passages are dealt to two halves in turn; each half is judged with the threshold of the other
    one, so that no query is judged by a threshold that it has chosen.
    """
    _, cluster = np.unique(passage, return_inverse=True)
    half = cluster % 2
    answered = np.zeros(len(score), bool)
    for own in (0, 1):
        others = half != own
        threshold = admission(score[others], right[others], allowed)
        answered[half == own] = score[half == own] >= threshold
    answered &= score > -np.inf
    wrong = ~np.asarray(right[answered], bool)
    return Abstaining(ratio(wrong, passage[answered]), ratio(answered, passage))


def admission(score: F64, right: Bools, allowed: float) -> float:
    """The least score that may be accepted for a share of wrong ones of at most ``allowed``;
    infinite where none may.
    """
    curve = precision_recall(score, right, len(score))
    fine = curve.threshold[1 - curve.precision <= allowed + 1e-12]
    return float(fine.min()) if len(fine) else math.inf


def median_within(errors_m: F64, threshold_m: float) -> float:
    """The median of the errors (q,) within a threshold; NaN without any."""
    within = errors_m[errors_m <= threshold_m]
    return float(np.median(within)) if len(within) else math.nan
