"""The probability that an alignment is right: from its own features, then together with what
neighbouring queries say.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from semloc_logs.alignment.verify import FEATURES, Features, rank
from semloc_logs.closures.closure import Agreement
from semloc_logs.settings import STREET_VOXEL

F64 = NDArray[np.float64]


AGREEMENT = (
    "alone",
    "neighbours",
    "agreeing",
    "opposing",
    "far_agreeing",
    "far_opposing",
    "lookalike",
)
SUPPORT = FEATURES.index("support")
DISTINCT = FEATURES.index("distinct")
TOGETHER = (
    "log_odds",
    "log_agreeing",
    "share",
    "log_opposing",
    "log_far_agreeing",
    "log_far_opposing",
)
AS_GOOD = 0.7  # of the best rank: what looks like a copy of the best place
CLOSE, HOPELESS = 0.8, 0.3  # of the best rank, and rank: below them nothing is right
RIGHT_WITHIN = 1.0  # m, at voxels of 0.30 m: what a right closure is (DESIGN: closures.parquet)
# standard deviations that count as one: from 0.2 m on 99 % of errors in simulated towns are within
# 2.2, of normal ones 2.6
MARGIN = 1.2
# below both the points hold nothing: the right place, but a metre off
LOOSE_FIT, LOOSE_STIFFNESS = 0.12, 0.3


def precise(sigma: F64 | float, voxel_size: float) -> F64:
    """Probability that positions of standard deviation ``sigma`` (n,) in their worst direction,
    metres, are within the bound of right ones.

    A place may be right, and where in it not known: 1 m at voxels of 0.30 m.
    """
    bound = RIGHT_WITHIN * voxel_size / STREET_VOXEL
    return np.asarray(erf(bound / (np.sqrt(2) * MARGIN * np.maximum(sigma, 1e-6))))


def own_values(features: Features) -> F64:
    """The features (8,) in the order of ``FEATURES``."""
    return np.array([getattr(features, name) for name in FEATURES])


def may_be_right(values: F64) -> NDArray[np.bool_]:
    """Whether alignments with features (..., 8) are close to the best of their query, not hopeless
    and held by their points.
    """
    of = {name: values[..., k] for k, name in enumerate(FEATURES)}
    hopeful = rank(of["structure"], of["coverage"], of["contradiction"]) >= HOPELESS
    loose = (of["fit"] < LOOSE_FIT) & (of["stiffness"] < LOOSE_STIFFNESS)
    return np.asarray(hopeful & ~loose & ~(of["distinct"] > 1 / CLOSE))


def unrivalled(own: Callable[[F64], F64], values: F64) -> F64:
    """What ``own`` would say of features (..., 8) if no other place fitted; 0 where another one
    fits better by far.
    """
    alone = np.where(np.arange(len(FEATURES)) == DISTINCT, 0.0, values)
    return np.where(values[..., DISTINCT] > 1 / AS_GOOD, 0.0, own(alone))


def together_values(columns: Sequence[F64]) -> F64:
    """Values (n, 6) in the order of ``TOGETHER`` from the columns (7, n) of ``AGREEMENT``."""
    alone, neighbours, agreeing, opposing, far_agreeing, far_opposing, _ = (
        np.asarray(c, float) for c in columns
    )
    p = np.clip(alone, 1e-6, 1 - 1e-6)
    counts = [np.log1p(c) for c in (agreeing, opposing, far_agreeing, far_opposing)]
    return np.stack(
        [np.log(p / (1 - p)), counts[0], agreeing / np.maximum(neighbours, 1), *counts[1:]], axis=-1
    )


def has_far(columns: Sequence[F64]) -> NDArray[np.bool_]:
    """Where queries far along the road have been placed at all (n,), by the columns (7, n) of
    ``AGREEMENT``.
    """
    return np.asarray(columns[4]) + np.asarray(columns[5]) > 0


@dataclass(frozen=True, slots=True)
class Calibration:
    """A logistic model: ``weights`` of values after clipping to ``low`` .. ``high``, and ``bias``."""

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
    """``alone`` of an alignment's own features; ``near`` of that probability's log-odds and near
    neighbours, ``together`` of far ones too.

    A short log has no far ones, and that says nothing against it. With less support than
    ``least_support`` hardly any right alignment was ever seen: a handful of voxels fits anywhere,
    and the probability is 0. Where streets look like others by more than ``most_alike`` the drive
    may as well have been in a copy: whatever agrees, the probability is at most a half.
    """

    alone: Calibration
    near: Calibration
    together: Calibration
    least_support: float
    most_alike: float

    def own(self, values: F64) -> F64:
        """Probability of an alignment by its own features, values (..., 8) in the order of
        ``FEATURES``.
        """
        return np.where(
            values[..., SUPPORT] < self.least_support, 0.0, self.alone.probability(values)
        )

    def agreed(self, columns: Sequence[F64]) -> F64:
        """Probabilities (n,) from the columns (7, n) of ``AGREEMENT``: that of the alignment alone
        where there are no neighbours.
        """
        values = together_values(columns)
        by_neighbours = np.where(
            has_far(columns), self.together.probability(values), self.near.probability(values)
        )
        return np.where(
            (np.asarray(columns[1]) > 0) & (np.asarray(columns[0]) > 0), by_neighbours, columns[0]
        )

    def decided(self, columns: Sequence[F64]) -> F64:
        """The same, at most a half where streets look like others."""
        p = self.agreed(columns)
        return np.where(self.alike(columns), p / 2, p)

    def alike(self, columns: Sequence[F64]) -> NDArray[np.bool_]:
        """Where streets look like others (n,), by the columns (7, n) of ``AGREEMENT``."""
        return np.asarray(np.asarray(columns[-1]) > self.most_alike)


@cache
def shipped() -> Model:
    """The calibration in the package; ``benchmarks/calibrate.py`` makes it."""
    content = json.loads(
        files("semloc_logs.closures.acceptance").joinpath("calibration.json").read_text()
    )
    return Model(
        Calibration.from_json(content["alone"], FEATURES),
        Calibration.from_json(content["near"], TOGETHER),
        Calibration.from_json(content["together"], TOGETHER),
        float(content["least_support"]),
        float(content["most_alike"]),
    )


def reason(
    features: Features,
    probability: float,
    least: float,
    agreement: Agreement,
    sigma: float = 0.0,
    precision: float = 1.0,
    share: float = 1.0,
) -> str:
    """One sentence that says why a hypothesis was rejected; ``precision`` is that of
    :func:`precise` for ``sigma`` (m), ``share`` what it is worth beside other poses in the same
    place.
    """
    f, a = features, agreement
    of_place = probability / max(precision * share, 1e-9)
    if of_place >= least and share < precision:
        why = f"of the poses in this place it is right with {share:.0%}"
    elif of_place >= least:
        why = f"where in this place is known to {sigma:.2f} m only"
    elif a.lookalike > shipped().most_alike and 2 * of_place >= least:
        # else it would be rejected anyway
        why = f"streets about it look like others ({a.lookalike:.0%})"
    elif a.alone >= least and a.neighbours:
        why = f"of {a.neighbours} neighbouring queries {a.agreeing:.1f} agree and {a.opposing:.1f} lie elsewhere"
    elif f.coverage < 0.2:
        why = f"only {f.coverage:.0%} of the query's structure falls into observed space"
    elif f.structure < 0.5:
        why = f"only {f.structure:.0%} of the query's structure lies on structure of its class"
    elif f.distinct > 0.85:
        why = f"another place fits nearly as well ({f.distinct:.0%})"
    elif f.fit < 0.5:
        why = f"only {f.fit:.0%} of the points lie on a surface"
    else:
        why = "the evidence together is too weak"
    return f"probability {probability:.3f} below {least:g}: {why}"


def fit_logistic(
    x: F64,
    right: NDArray[np.bool_],
    ridge: float = 1.0,
    counts: F64 | None = None,
    offset: F64 | float = 0.0,
) -> tuple[F64, float]:
    """Weights (d,) and bias of a ridge logistic regression of ``right`` (n,) on ``x`` (n, d), by
    Newton's method.

    Row i counts ``counts`` (n,) times; ``offset`` (n,) is added to its log-odds.
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
