"""What becomes of the true range of a ray before a lidar reports it: weak echoes, mixed edges, bias
and noise.

Ranges come as a grid (columns, beams), inf where nothing is hit; a beam's next measurement is the
next row.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F32, F64, I64, U8
from semloc_logs.simulation.meshes.world import BUILDING, CAR, ROAD, SIDEWALK, VEGETATION

# share of the light of 905 nm that comes back from a surface of each class that faces the sensor
_REFLECTANCE = np.full(256, 0.3)
_REFLECTANCE[:19] = (
    0.18,
    0.3,
    0.35,
    0.35,
    0.3,
    0.3,
    0.3,
    0.9,
    0.45,
    0.35,
    0.3,
    0.35,
    0.35,
    0.3,
    0.35,
    0.35,
    0.35,
    0.2,
    0.2,
)
# of reflectance * cosine / range^2 (1/m^2), for two echoes of three: asphalt at 64 m from a height
# of 1.8 m
_FAINTEST = 1.2e-6
_LEAVES = 0.3  # the least cosine: a beam that meets leaves meets many
_LOST = 0.002  # of all measurements, for no reason that one could see
_PULSE = 1.5  # m: echoes nearer to each other than that are one


def hash_cells(cells: I64, seed: int = 0) -> I64:
    """A number in [0, 2^31) for each integer cell (n, 3)."""
    mixed = cells @ np.array([73856093, 19349663, 83492791]) + seed * 2654435761
    mixed ^= mixed >> 15
    mixed *= 2246822519
    mixed ^= mixed >> 13
    mixed *= 3266489917
    return np.asarray((mixed ^ (mixed >> 16)) & 0x7FFFFFFF)


def reflectance(world_points: F64, labels: U8, wet: float = 0.0) -> F64:
    """Share of light that points (n, 3) send back (n,): by class, varied by place; paint of
    vehicles from white to black; panes hardly any.

    ``wet`` in [0, 1] darkens roads and pavements as a film of water does.
    """
    coarse = hash_cells(np.floor(world_points / [3.0, 3.0, 4.0]).astype(np.int64), 1) % 1024 / 1024
    out = _REFLECTANCE[labels] * (0.6 + 0.8 * coarse)
    is_vehicle = (labels >= CAR) & (labels <= CAR + 2)
    out[is_vehicle] = 0.012 * 60.0 ** coarse[is_vehicle]
    pane = is_pane(world_points, labels)
    out[pane] *= 0.001
    if wet > 0:
        out[(labels == ROAD) | (labels == SIDEWALK)] *= 1.0 - 0.9 * wet
    return np.asarray(out)


def is_pane(world_points: F64, labels: U8) -> NDArray[np.bool_]:
    """Which points (n, 3) lie on panes that let light through: fixed patches of facades and of
    vehicles.
    """
    patch = hash_cells(np.floor(world_points / [0.6, 0.6, 0.5]).astype(np.int64)) % 1000
    pane: NDArray[np.bool_] = ((labels == BUILDING) & (patch < 12)) | (
        (labels >= CAR) & (labels <= CAR + 2) & (patch < 110)
    )
    return pane


def is_heard(
    rng: np.random.Generator,
    distance: NDArray[np.floating],
    cosine: F64,
    reflected: F64,
    labels: U8 | None = None,
) -> NDArray[np.bool_]:
    """Which echoes (n,) are strong enough: strength falls with the square of the range and with the
    cosine of incidence.
    """
    least = 0.01 if labels is None else np.where(labels == VEGETATION, _LEAVES, 0.01)
    strength = reflected * np.clip(cosine, least, 1.0) / np.maximum(distance, 3.0) ** 2
    return np.asarray(
        rng.random(len(distance)) < (1.0 - _LOST) * (1.0 - np.exp(-1.1 * strength / _FAINTEST))
    )


def mixed_ranges(rng: np.random.Generator, distance: F32, gap: float, divergence: float) -> F32:
    """Ranges (columns, beams) where beams that are cut by an edge report something between the near
    and the far surface.

    ``gap``: angle between columns; ``divergence``: angle of a beam (rad). Their ratio is
    the share of beams that an edge cuts. Surfaces further apart than the pulse is long give two
    echoes, of which one is reported, so mixed ranges become rare with the step.
    """
    out = distance.copy()
    cut = min(1.0, divergence / gap)
    nearer = np.minimum(distance[:-1], distance[1:])
    far = np.maximum(distance[:-1], distance[1:])
    with np.errstate(invalid="ignore"):
        step = np.where(np.isfinite(far), far - nearer, 0.0)
    is_edge = step > np.maximum(0.15, 0.02 * nearer)
    i, j = np.nonzero(
        is_edge & (rng.random(step.shape, np.float32) < cut * _PULSE / (_PULSE + step))
    )
    which = i + (rng.random(len(i)) < 0.5)
    out[which, j] = nearer[i, j] + rng.random(len(i)) * step[i, j]
    return out


def beyond_edges(distance: F32, labels: U8, reach: int = 2) -> U8:
    """For every point (columns, beams) the class on the other side of a depth edge within ``reach``
    columns, else its own.
    """
    out = labels.copy()
    for shift in range(reach, 0, -1):
        for here, there in ((np.s_[shift:], np.s_[:-shift]), (np.s_[:-shift], np.s_[shift:])):
            a = distance[here]
            b = distance[there]
            with np.errstate(invalid="ignore"):
                other = (
                    np.isfinite(b)
                    & (np.abs(a - b) > np.maximum(0.4, 0.03 * a))
                    & (labels[here] != labels[there])
                )
            out[here] = np.where(other, labels[there], out[here])
    return out
