"""The probability that an alignment is right: by its own features, and with neighbours' votes."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from semloc_logs.alignment.scores import alignment_score
from semloc_logs.closures.closure import FEATURES, Agreement, Columns, Features
from semloc_logs.settings import STREET_VOXEL

F64 = NDArray[np.float64]
Bools = NDArray[np.bool_]

# names in calibration.json of the fields of NeighbourEvidence
NEIGHBOUR_EVIDENCE = (
    "log_odds",
    "log_agreeing",
    "share",
    "log_opposing",
    "log_far_agreeing",
    "log_far_opposing",
)
RIVAL_RATIO = 0.7  # of the best score: what looks like a copy of the best place
# of the best score, and a score: no right alignment has less
MIN_RELATIVE_SCORE = 0.8
MIN_SCORE = 0.3
RIGHT_WITHIN = 1.0  # m, at voxels of 0.30 m (docs/reference/truth.md)
# standard deviations that count as one: from 0.2 m on 99 % of errors in simulated towns are within
# 2.2, of normal ones 2.6
MARGIN = 1.2
# below both the points hold nothing: the right place, but a metre off
LOOSE_FIT = 0.12
LOOSE_STIFFNESS = 0.3
LEAST_ODDS = 1e-6  # probabilities are clipped to it and its complement before their logarithm


@dataclass(frozen=True, slots=True, eq=False)
class NeighbourEvidence(Columns):
    """What the models with neighbours look at (n,): log-odds of the own probability, votes."""

    log_odds: F64
    log_support: F64
    support_share: F64
    log_conflict: F64
    log_far_support: F64
    log_far_conflict: F64

    @classmethod
    def of(cls, agreement: Agreement[F64]) -> NeighbourEvidence:
        """The evidence in an agreement; of no neighbours the share is 0."""
        p = np.clip(agreement.own_probability, LEAST_ODDS, 1 - LEAST_ODDS)
        return cls(
            log_odds=np.log(p / (1 - p)),
            log_support=np.log1p(agreement.support),
            support_share=agreement.support / np.maximum(agreement.neighbours, 1),
            log_conflict=np.log1p(agreement.conflict),
            log_far_support=np.log1p(agreement.far_support),
            log_far_conflict=np.log1p(agreement.far_conflict),
        )


def position_confidence(sigma: F64 | float, voxel_size: float) -> F64:
    """Probability (n,) that positions are within the bound of right ones.

    ``sigma`` (n,) is their standard deviation in the worst direction, metres. A place may be right
    and the position in it uncertain. The bound is 1 m at voxels of 0.30 m.
    """
    bound = RIGHT_WITHIN * voxel_size / STREET_VOXEL
    return np.asarray(erf(bound / (np.sqrt(2) * MARGIN * np.maximum(sigma, 1e-6))))


def is_plausible(features: Features[F64]) -> Bools:
    """Which alignments (n,) score near the best of their query, and are held by their points."""
    score = alignment_score(features.structure, features.coverage, features.contradiction)
    loose = (features.fit < LOOSE_FIT) & (features.stiffness < LOOSE_STIFFNESS)
    return np.asarray((score >= MIN_SCORE) & ~loose & ~(features.distinct > 1 / MIN_RELATIVE_SCORE))


def probability_ignoring_rivals(
    own: Callable[[Features[F64]], F64], features: Features[F64]
) -> F64:
    """The probability ``own`` (n,) if no other place fitted; 0 where another fits far better."""
    without = replace(features, distinct=np.zeros_like(features.distinct))
    return np.where(features.distinct > 1 / RIVAL_RATIO, 0.0, own(without))


def has_far(agreement: Agreement[F64]) -> Bools:
    """Where queries far along the road have been placed at all (n,)."""
    return np.asarray(agreement.far_support + agreement.far_conflict > 0)


@dataclass(frozen=True, slots=True)
class Calibration:
    """A logistic model: ``weights`` of values clipped to ``low`` .. ``high``, and ``bias``."""

    weights: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    bias: float

    def probability(self, values: F64) -> F64:
        """In [0, 1], of values (..., d)."""
        x = np.clip(np.nan_to_num(values, nan=0.0, posinf=1e3, neginf=-1e3), self.low, self.high)
        return np.asarray(1.0 / (1.0 + np.exp(-(x @ np.array(self.weights) + self.bias))))

    @classmethod
    def from_json(cls, content: dict[str, Any], names: Sequence[str]) -> Calibration:
        """One of the models of calibration.json."""
        rows = [content["features"][name] for name in names]
        weights, low, high = (tuple(float(r[k]) for r in rows) for k in ("weight", "low", "high"))
        return cls(weights, low, high, float(content["bias"]))

    def to_json(self, names: Sequence[str]) -> dict[str, Any]:
        """The inverse of :meth:`from_json`, to four decimals."""
        rows = {
            n: {k: round(float(x), 4) for k, x in zip(("weight", "low", "high"), row, strict=True)}
            for n, *row in zip(names, self.weights, self.low, self.high, strict=True)
        }
        return {"bias": round(self.bias, 4), "features": rows}


@dataclass(frozen=True, slots=True)
class Model:
    """Three logistic models: of an alignment's own features, and with near and far neighbours.

    ``own_features`` is of the alignment alone; ``near`` of its log-odds and near neighbours;
    ``together`` of far ones too. A short log has no far neighbours, which is not evidence against
    an alignment. With less support than ``min_support`` hardly any right alignment was ever seen: a
    handful of voxels fits anywhere, and the probability is 0. Where the ambiguity exceeds
    ``max_ambiguity`` the drive may as well have been in a copy of the place: whatever agrees, the
    probability is at most a half.
    """

    own_features: Calibration
    near: Calibration
    together: Calibration
    min_support: float
    max_ambiguity: float

    def own(self, features: Features[Any]) -> F64:
        """Probability of alignments by their own features: of one, or of several (n,)."""
        return np.where(
            features.support < self.min_support,
            0.0,
            self.own_features.probability(features.vector()),
        )

    def agreed(self, agreement: Agreement[F64]) -> F64:
        """Probabilities (n,) with all votes; without neighbours the own ones."""
        values = NeighbourEvidence.of(agreement).vector()
        by_neighbours = np.where(
            has_far(agreement), self.together.probability(values), self.near.probability(values)
        )
        has_votes = (agreement.neighbours > 0) & (agreement.own_probability > 0)
        return np.where(has_votes, by_neighbours, agreement.own_probability)

    def decided(self, agreement: Agreement[F64]) -> F64:
        """The same, at most a half in ambiguous places."""
        p = self.agreed(agreement)
        return np.where(self.is_ambiguous(agreement), p / 2, p)

    def is_ambiguous(self, agreement: Agreement[F64]) -> Bools:
        """Which places are ambiguous (n,)."""
        return np.asarray(agreement.ambiguity > self.max_ambiguity)


@cache
def shipped() -> Model:
    """The calibration in the package; ``benchmarks/calibrate.py`` makes it."""
    content = json.loads(
        files("semloc_logs.closures.acceptance").joinpath("calibration.json").read_text()
    )
    return Model(
        Calibration.from_json(content["alone"], FEATURES),
        Calibration.from_json(content["near"], NEIGHBOUR_EVIDENCE),
        Calibration.from_json(content["together"], NEIGHBOUR_EVIDENCE),
        float(content["least_support"]),
        float(content["most_alike"]),
    )


def fit_logistic(
    x: F64,
    right: NDArray[np.bool_],
    ridge: float = 1.0,
    counts: F64 | None = None,
    offset: F64 | float = 0.0,
) -> tuple[F64, float]:
    """Weights (d,) and bias of a ridge logistic regression of ``right`` (n,) on ``x`` (n, d).

    By Newton's method. Row i counts ``counts`` (n,) times; ``offset`` (n,) adds to the log-odds.
    """
    counts = np.ones(len(x)) if counts is None else counts
    mean = x.mean(0)
    scale = x.std(0) + 1e-9
    a = np.c_[(x - mean) / scale, np.ones(len(x))]
    w = np.zeros(a.shape[1])
    penalty = np.r_[np.full(x.shape[1], ridge), 1e-6]
    for _ in range(50):
        p = 1 / (1 + np.exp(-np.clip(a @ w + offset, -30, 30)))
        gradient = a.T @ (counts * (p - right)) + penalty * w
        hessian = (a * (counts * p * (1 - p))[:, None]).T @ a + np.diag(penalty)
        step = np.linalg.solve(hessian, gradient)
        w -= step
        if np.abs(step).max() < 1e-8:
            break
    weights = w[:-1] / scale
    return weights, float(w[-1] - weights @ mean)
