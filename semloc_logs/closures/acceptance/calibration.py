"""The log-odds that an alignment is right: of its own features, and of neighbours' votes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cache
from importlib.resources import files
from typing import Any, Generic

import numpy as np
from scipy.special import erf, expit

from semloc_logs.arrays import F64, Bools
from semloc_logs.closures.closure import Agreement, Columns, Features, Value
from semloc_logs.settings import STREET_VOXEL

LEAST_SHARE = 1e-4  # of structure in free space, before its logarithm
LEAST_ODDS = 1e-9  # probabilities are clipped to it and its complement before their logarithm
# names in calibration.json of the fields of Calibration, Evidence and Votes
COLUMNS = {"weights": "weight", "low": "low", "high": "high", "typical": "typical"}
EVIDENCE = ("log_contradiction", "stiffness", "range_sigma")
VOTES = ("agreeing", "opposing", "far_agreeing", "far_opposing")
RIGHT_WITHIN = 1.0  # m, at voxels of 0.30 m (docs/reference/truth.md)
# standard deviations that count as one: from 0.2 m on 99 % of errors in simulated towns are within
# 2.2, of normal ones 2.6
MARGIN = 1.2
# below both the points hold nothing: the right place, but a metre off
LOOSE_FIT = 0.12
LOOSE_STIFFNESS = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Evidence(Columns, Generic[Value]):
    """What the features of alignments say about their places (n,).

    Coverage, fit and support are left out: they fall with the distance between the sensors, and
    unseen structure tells nothing. Beside contradiction the structure tells nothing more.
    """

    log_contradiction: Value
    stiffness: Value
    range_sigma: Value

    @classmethod
    def of(cls, features: Features[Value]) -> Evidence[Value]:
        """The evidence of some features."""
        return cls(
            log_contradiction=np.log(np.maximum(features.contradiction, LEAST_SHARE)),
            stiffness=features.stiffness,
            range_sigma=features.range_sigma,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Votes(Columns):
    """What neighbours add to log-odds and take from them (n,): logarithms of sums of votes.

    Neighbours share the errors of one drive and one map, so votes count less the more there are.
    """

    support: F64
    conflict: F64
    far_support: F64
    far_conflict: F64

    @classmethod
    def of(cls, agreement: Agreement[F64]) -> Votes:
        """The votes of an agreement; zeros where nothing was observed."""
        return cls(*(np.log1p(getattr(agreement, f.name)) for f in fields(cls)))


def log_odds(p: F64) -> F64:
    """Of probabilities (n,)."""
    p = np.clip(p, LEAST_ODDS, 1 - LEAST_ODDS)
    return np.asarray(np.log(p / (1 - p)))


def probability_of(log_odds: F64) -> F64:
    """Of log-odds (n,)."""
    return np.asarray(expit(log_odds))


def position_confidence(sigma: F64 | float, voxel_size: float) -> F64:
    """Probability (n,) that positions are within the bound of right ones.

    ``sigma`` (n,) is their standard deviation in the worst direction, metres. A place may be right
    and the position in it uncertain. The bound is 1 m at voxels of 0.30 m.
    """
    bound = RIGHT_WITHIN * voxel_size / STREET_VOXEL
    return np.asarray(erf(bound / (np.sqrt(2) * MARGIN * np.maximum(sigma, 1e-6))))


def is_loose(features: Features[F64]) -> Bools:
    """Which alignments (n,) are not held by their points."""
    return np.asarray((features.fit < LOOSE_FIT) & (features.stiffness < LOOSE_STIFFNESS))


@dataclass(frozen=True, slots=True)
class Calibration:
    """A logistic model: ``weights`` of values clipped to ``low`` .. ``high``, and ``bias``.

    ``typical`` are the medians of right alignments.
    """

    weights: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    typical: tuple[float, ...]
    bias: float

    def log_odds(self, values: F64) -> F64:
        """Of values (..., d)."""
        x = np.clip(np.nan_to_num(values, nan=0.0), self.low, self.high)
        return np.asarray(x @ np.array(self.weights) + self.bias)

    @classmethod
    def from_json(cls, content: dict[str, Any], names: Sequence[str]) -> Calibration:
        """One of the models of calibration.json."""
        rows = [content["features"][name] for name in names]
        weights, low, high, typical = (
            tuple(float(row[key]) for row in rows) for key in COLUMNS.values()
        )
        return cls(weights, low, high, typical, float(content["bias"]))

    def to_json(self, names: Sequence[str]) -> dict[str, Any]:
        """The inverse of :meth:`from_json`, to four decimals."""
        rows = {
            name: {key: round(getattr(self, field)[i], 4) for field, key in COLUMNS.items()}
            for i, name in enumerate(names)
        }
        return {"bias": round(self.bias, 4), "features": rows}


@dataclass(frozen=True, slots=True)
class Model:
    """The log-odds that the place of an alignment is right: a sum of its evidence.

    ``own`` is of the features of the alignment by itself, ``votes`` of its neighbours: without any
    they add nothing, agreeing ones never lower the sum, opposing ones never raise it. It is at most
    ``max_log_odds``: rarer errors than one in all alignments of the calibration are not known.
    Where the ambiguity exceeds ``max_ambiguity`` the drive may as well have been in a copy of the
    place, whatever agrees.
    """

    own: Calibration
    votes: Calibration
    max_log_odds: float
    max_ambiguity: float

    def own_log_odds(self, features: Features[Any]) -> F64:
        """By the features: of one alignment, or of several (n,)."""
        return np.minimum(self.own.log_odds(Evidence.of(features).vector()), self.max_log_odds)

    def log_odds(self, own_log_odds: F64, agreement: Agreement[F64]) -> F64:
        """With the votes of neighbours (n,)."""
        total = own_log_odds + self.votes.log_odds(Votes.of(agreement).vector())
        return np.minimum(total, self.max_log_odds)

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
        Calibration.from_json(content["own"], EVIDENCE),
        Calibration.from_json(content["votes"], VOTES),
        float(np.log(content["alignments"])),
        float(content["most_alike"]),
    )


def fit_logistic(x: F64, right: Bools, ridge: float) -> tuple[F64, float]:
    """Weights (d,) and bias of a ridge logistic regression of ``right`` (n,) on ``x`` (n, d)."""
    mean = x.mean(0)
    scale = x.std(0) + 1e-9
    a = np.c_[(x - mean) / scale, np.ones(len(x))]
    penalty = np.r_[np.full(x.shape[1], ridge), 1e-6]
    w = _newton(a, right, penalty, 0.0)
    weights = w[:-1] / scale
    return weights, float(w[-1] - weights @ mean)


def fit_additions(x: F64, right: Bools, ridge: float, offset: F64) -> F64:
    """Weights (d,) of what ``x`` (n, d) adds to the log-odds ``offset`` (n,); 0 where x is 0."""
    scale = x.std(0) + 1e-9
    penalty = np.full(x.shape[1], ridge)
    return np.asarray(_newton(x / scale, right, penalty, offset) / scale)


def _newton(a: F64, right: Bools, penalty: F64, offset: F64 | float) -> F64:
    """Weights of the columns of ``a`` (n, d) by Newton's method."""
    w = np.zeros(a.shape[1])
    for _ in range(50):
        p = 1 / (1 + np.exp(-np.clip(a @ w + offset, -30, 30)))
        gradient = a.T @ (p - right) + penalty * w
        hessian = (a * (p * (1 - p))[:, None]).T @ a + np.diag(penalty)
        step = np.linalg.solve(hessian, gradient)
        w -= step
        if np.abs(step).max() < 1e-8:
            break
    return w
