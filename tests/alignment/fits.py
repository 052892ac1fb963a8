"""Points of a room, and fits of them, for tests of alignments."""

from __future__ import annotations

import numpy as np

from semloc_logs.alignment.icp import Fit, Step, align
from semloc_logs.alignment.surface import surface_of
from semloc_logs.arrays import F64
from semloc_logs.numerics.transforms import apply, exp_se3, inverse, rotation_angle

CELL = 0.4
STEPS = tuple(Step(radius, 15) for radius in (1.0, 0.5, 0.2))
SMALL = exp_se3(np.array([0.15, -0.2, 0.1]), np.array([0.03, -0.02, 0.06]))


def room(rng: np.random.Generator, n: int, noise: float = 0.01, corridor: bool = False) -> F64:
    """Walls, floor and ceiling of a room of 8 x 5 x 3 m with a slanted panel and a pillar; a
    corridor has two walls and a floor only.
    """
    long = 40.0 if corridor else 8.0
    u, v = rng.uniform(0, 1, (2, n))
    sides = [
        np.c_[u * long - long / 2, np.full(n, -2.5), v * 3],
        np.c_[u * long - long / 2, np.full(n, 2.5), v * 3],
        np.c_[u * long - long / 2, v * 5 - 2.5, np.zeros(n)],
    ]
    if not corridor:
        sides += [
            np.c_[np.full(n, -4), u * 5 - 2.5, v * 3],
            np.c_[np.full(n, 4), u * 5 - 2.5, v * 3],
            np.c_[u * 8 - 4, v * 5 - 2.5, np.full(n, 3)],
            np.c_[u * 2 - 1, v + u - 1, 3 * v],
        ]
    points = np.concatenate(sides)
    return points + rng.normal(0, noise, points.shape)


def error(estimate: F64, truth: F64) -> tuple[float, float]:
    d = inverse(truth) @ estimate
    return float(np.linalg.norm(d[:3, 3])), rotation_angle(d[:3, :3])


def fit(truth: F64, start: F64, seed: int = 0, noise: float = 0.01) -> Fit:
    """The query is the room seen from the frame of ``truth``, sampled anew."""
    rng = np.random.default_rng(seed)
    target = surface_of(room(rng, 1500, noise), CELL)
    return align(apply(inverse(truth), room(rng, 700, noise)), target, start, STEPS)
