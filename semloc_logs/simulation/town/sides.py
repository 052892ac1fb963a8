"""Sides of roads: coordinates along them, and how they are built up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.simulation.town.road_network import Road

Rng = np.random.Generator


@dataclass(frozen=True, slots=True)
class Style:
    """How one side of a road is built up; lengths in metres, shares in [0, 1].

    ``copies``: every plot has its own house (``none``), the very same one (``same``), or one and
    its mirror image in turn (``mirror``).
    """

    kind: str
    copies: str
    setback: float
    storeys: float
    plot: float
    gap: float
    built: float
    garden: float
    frontage: str
    roofs: tuple[str, ...]
    tree_pitch: float
    tree_size: float
    lamp_pitch: float
    parked: float
    paved: float


_KINDS = {  # setback, storeys, plot, gap, share with a house, garden, share that is paved
    "suburb": (2.3, 2.0, 12.0, 1.8, 0.97, 2.6, 0.6),
    "twins": (2.7, 2.0, 9.0, 1.6, 1.0, 2.0, 0.55),
    "rows": (1.5, 2.6, 7.0, 0.0, 0.97, 1.5, 0.7),
    "terrace": (1.5, 2.3, 6.0, 0.0, 1.0, 1.2, 0.6),
    "city": (0.5, 4.5, 16.0, 0.8, 0.97, 0.2, 0.8),
    "park": (6.0, 1.5, 14.0, 25.0, 0.15, 5.0, 0.1),
    "country": (4.5, 1.6, 15.0, 12.0, 0.6, 4.0, 0.25),
    "yards": (3.5, 1.9, 28.0, 6.0, 0.85, 0.8, 0.7),
    "open": (20.0, 1.0, 30.0, 30.0, 0.05, 0.3, 0.0),
    "car park": (24.0, 1.8, 32.0, 4.0, 0.9, 0.1, 1.0),
    "square": (22.0, 4.0, 14.0, 0.0, 0.95, 0.0, 1.0),
}
_USUAL = (
    "suburb",
    "suburb",
    "suburb",
    "twins",
    "rows",
    "rows",
    "terrace",
    "city",
    "city",
    "park",
    "country",
    "yards",
)
_SOMETIMES = (*_USUAL, "open", "car park", "square")


def drawn_style(rng: Rng, town: Rng) -> Style:
    """A side's style: a kind drawn from what the town has, then all of it varied."""
    favourite = _USUAL[int(town.integers(len(_USUAL)))]
    kind = favourite if rng.random() < 0.7 else _SOMETIMES[int(rng.integers(len(_SOMETIMES)))]
    setback, storeys, plot, gap, built, garden, paved = _KINDS[kind]
    frontage = {
        "city": "none",
        "park": "none",
        "yards": "fence",
        "open": "rail",
        "country": "rail",
        "car park": "none",
        "square": "none",
    }
    roofs = {
        "city": ("flat", "gable", "hip"),
        "square": ("flat", "gable", "hip"),
        "yards": ("flat", "flat", "gable"),
        "car park": ("flat",),
        "rows": ("gable", "cross"),
    }
    return Style(
        kind,
        {"terrace": "same", "twins": "mirror"}.get(kind, "none"),
        setback * rng.uniform(0.4, 1.3) if setback < 10 else setback * rng.uniform(0.8, 1.1),
        max(1.0, storeys * rng.uniform(0.7, 1.4)),
        plot * rng.uniform(0.75, 1.4),
        gap * rng.uniform(0.4, 1.6),
        built,
        garden * rng.uniform(0.4, 1.6),
        frontage.get(kind, "wall" if rng.random() < 0.12 else "any"),
        roofs.get(kind, ("gable", "cross", "hip")),
        float(rng.choice([9.0, 14.0, 25.0, 200.0])) * rng.uniform(0.8, 1.2),
        rng.uniform(0.45, 1.0),
        rng.uniform(26, 55),
        rng.uniform(0.35, 0.97),
        paved,
    )


class Side:
    """One side of a road, with coordinates along it (u) and outwards from the edge of the
    carriageway (v).
    """

    def __init__(self, road: Road, sign: int) -> None:
        self.road, self.sign = road, sign
        self.path = road.path
        self.along = np.concatenate(
            [[0.0], np.cumsum(np.linalg.norm(np.diff(road.path, axis=0), axis=1))]
        )
        self.length = float(self.along[-1])

    def at(self, u: float, v: float) -> tuple[float, float, float]:
        """x, y and the yaw of the road (of the right-hand traffic on this side) at (u, v)."""
        k = int(np.clip(np.searchsorted(self.along, u) - 1, 0, len(self.path) - 2))
        a = self.path[max(k - 2, 0)]
        b = self.path[min(k + 3, len(self.path) - 1)]
        t = (b - a) / np.linalg.norm(b - a)
        out = self.sign * np.array([t[1], -t[0]])
        p = self.path[k] + t * (u - self.along[k]) + out * (self.road.half_width + v)
        return float(p[0]), float(p[1]), float(np.arctan2(t[1] * self.sign, t[0] * self.sign))

    def line(self, u0: float, u1: float, v: float) -> F64:
        """A plan line at distance v from u0 to u1."""
        return np.array(
            [self.at(u, v)[:2] for u in np.linspace(u0, u1, max(2, int((u1 - u0) / 2) + 1))]
        )

    def area(self, u0: float, u1: float, v0: float, v1: float, step: float = 0.3) -> F64:
        """Plan points (n, 2) all over u0 to u1, v0 to v1."""
        us = np.arange(u0, u1, step)
        vs = np.arange(v0, v1, step)
        rows = np.array(
            [[self.at(float(p), 0.0)[:2], self.at(float(p), 10.0)[:2]] for p in us]
        ).reshape(-1, 2, 2)
        return np.asarray(
            (rows[:, :1] + (rows[:, 1:] - rows[:, :1]) * (vs / 10.0)[None, :, None]).reshape(-1, 2)
        )
