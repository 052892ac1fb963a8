"""Which way is up: the direction that a map's floors and walls agree on, close to a prior."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.mapping.selection import thin
from semloc_logs.numerics.local_shape import shape

MOST_POINTS = 12_000  # of a keyframe that normals are taken from
# so many cells lie one behind the other within the median range, where the points are as dense as
# that
FINENESS = 25.0
LEAST_NORMALS = 50  # near a direction, for it to be refined
PLUMB = 5.0  # a wall's word against a floor's: houses are built plumb, streets follow the land


@dataclass(frozen=True, slots=True, eq=False)
class FlatPlaces:
    """Flat places that a sensor sees, relative to it, metres.

    Unit ``normals`` (m, 3) at ``centres`` (m, 3), towards the sensor, with ``weights`` (m,);
    ``points`` (n, 3) are all points that they were taken from, thinned.
    """

    centres: F64
    normals: F64
    weights: F64
    points: F64

    def turned(self, rotation: F64) -> FlatPlaces:
        """The same in other axes, by a ``rotation`` (3, 3)."""
        return FlatPlaces(
            self.centres @ rotation.T,
            self.normals @ rotation.T,
            self.weights,
            self.points @ rotation.T,
        )


def flat_places(
    points: NDArray[np.float32], origin: NDArray[np.floating], cell: float, noise: float = 0.0
) -> FlatPlaces:
    """The flat places among ``points`` (n, 3) that a sensor at ``origin`` (3,) sees.

    The points are thinned to cells of ``cell`` metres, to smaller ones in a room that is small for
    its voxels, and to larger ones where there are too many or where ``noise``, the standard
    deviation of their ranges (m), would turn the normals.
    """
    if not len(points):
        return FlatPlaces(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)))
    cell = max(
        min(cell, float(np.median(np.linalg.norm(points - origin, axis=1))) / FINENESS),
        2 * noise,
        1e-3,
    )
    some = points[thin(points, cell)]
    while len(some) > MOST_POINTS:
        cell *= max(1.05, float(np.sqrt(len(some) / MOST_POINTS)))
        some = some[thin(some, cell)]
    s = shape(some, 12)
    weight = np.where((s.planar > 0.5) & (s.scattered < 0.15), s.planar, 0.0).astype(float)
    keep = weight > 0
    seen = some.astype(float) - np.asarray(origin, float)
    normal = s.normal[keep].astype(float)
    away = (normal * seen[keep]).sum(1) > 0
    return FlatPlaces(seen[keep], np.where(away[:, None], -normal, normal), weight[keep], seen)


def find_up(
    normals: NDArray[np.floating], weights: NDArray[np.floating], prior: F64, within: float = 0.7
) -> F64:
    """The unit direction that most horizontal surfaces have as their normal, close to ``prior``.

    ``within`` is the largest angle to it, radians. ``normals`` (n, 3) of unit length, any sign,
    with ``weights`` (n,). Walls count too: their normals are perpendicular to it. The sum of both
    over candidates taken from the normals is maximised, then the optimum is refined to the
    least-squares direction of the surfaces within 10, 5, 3 and 2 degrees. The prior is returned
    when too few normals agree with it.
    """
    prior = np.asarray(prior, float) / np.linalg.norm(prior)
    n = np.asarray(normals, float)
    w = np.asarray(weights, float)
    flip = np.where(n @ prior < 0, -1.0, 1.0)
    n = n * flip[:, None]
    rows = np.flatnonzero((n @ prior > np.cos(within)) & (w > 0))
    if len(rows) < LEAST_NORMALS:
        return prior
    rng = np.random.default_rng(0)
    candidates = np.concatenate(
        [
            n[rng.choice(rows, min(500, len(rows)), replace=False, p=w[rows] / w[rows].sum())],
            prior[None],
        ]
    )
    some = rng.choice(len(n), min(8000, len(n)), replace=False)
    up = candidates[int(np.argmax([_agreement(n[some] @ c, w[some]) for c in candidates]))]
    return refined(n, w, up, prior)


def refined(normals: F64, weights: F64, up: F64, prior: F64) -> F64:
    """The least-squares direction of the surfaces within 10, 5, 3 and 2 degrees of ``up`` (3,).

    Its sign is the one of the ``prior``.
    """
    for degrees in (10.0, 5.0, 3.0, 2.0, 2.0, 2.0):
        sine = np.sin(np.radians(degrees))
        dot = normals @ up
        floor = np.abs(dot) > np.cos(np.radians(degrees))
        wall = np.abs(dot) < sine
        a = (normals[floor] * weights[floor, None]).T @ normals[floor] - PLUMB * (
            normals[wall] * weights[wall, None]
        ).T @ normals[wall]
        vector = np.linalg.eigh(a)[1][:, -1]
        up = vector if vector @ prior > 0 else -vector
    return np.asarray(up)


def _agreement(dot: F64, weight: F64) -> float:
    """The weight within about 3 degrees of horizontal, and half of the weight that is vertical."""
    wide = 2 * 0.05**2
    return float(
        (weight * (np.exp(-(1 - np.abs(dot)) * 2 / wide) + 0.5 * np.exp(-(dot**2) / wide))).sum()
    )
