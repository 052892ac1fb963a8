"""The probability that an alignment is right, from its features, and the choice of what to report."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from semloc_logs.alignment.verify import FEATURES, Features


@dataclass(frozen=True, slots=True)
class Calibration:
    """A logistic model: ``weights`` of the features after clipping to ``low`` .. ``high``, and ``bias``."""

    weights: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    bias: float

    def probability(self, features: Features) -> float:
        """In [0, 1]."""
        values = np.array([getattr(features, name) for name in FEATURES])
        x = np.clip(np.nan_to_num(values, nan=0.0, posinf=1e3, neginf=-1e3), self.low, self.high)
        return float(1.0 / (1.0 + np.exp(-(float(np.dot(self.weights, x)) + self.bias))))


@cache
def shipped() -> Calibration:
    """The calibration in the package; ``benchmarks/calibrate.py`` makes it."""
    content = json.loads(files("semloc_logs.closures").joinpath("calibration.json").read_text())
    rows = [content["features"][name] for name in FEATURES]
    return Calibration(tuple(r["weight"] for r in rows), tuple(r["low"] for r in rows), tuple(r["high"] for r in rows), content["bias"])


def reason(features: Features, probability: float, least: float) -> str:
    """One sentence that says why a hypothesis was rejected."""
    f = features
    if f.coverage < 0.2:
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


def fit_logistic(x: NDArray[np.float64], right: NDArray[np.bool_], ridge: float = 1.0) -> tuple[NDArray[np.float64], float]:
    """Weights (d,) and bias of a ridge logistic regression of ``right`` (n,) on ``x`` (n, d), by Newton's method."""
    mean, scale = x.mean(0), x.std(0) + 1e-9
    a = np.c_[(x - mean) / scale, np.ones(len(x))]
    w = np.zeros(a.shape[1])
    penalty = np.r_[np.full(x.shape[1], ridge), 1e-6]
    for _ in range(50):
        p = 1 / (1 + np.exp(-np.clip(a @ w, -30, 30)))
        gradient = a.T @ (p - right) + penalty * w
        hessian = (a * (p * (1 - p))[:, None]).T @ a + np.diag(penalty)
        step = np.linalg.solve(hessian, gradient)
        w -= step
        if np.abs(step).max() < 1e-8:
            break
    weights = w[:-1] / scale
    return weights, float(w[-1] - weights @ mean)
