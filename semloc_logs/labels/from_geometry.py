"""Classes from geometry alone: ground, wall-like, vegetation-like, pole-like.

Points above the ground are summed up in voxels of the map's size; the surroundings of each voxel
decide (:func:`_class_of`), and then the majority of its neighbours. Vehicles and the rest stay
unlabelled. All lengths are at street scale (0.30 m voxels) and follow ``scale``.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.arrays import F64, I64, U8
from semloc_logs.labels.space import BUILDING, POLE, ROAD, UNLABELLED, VEGETATION
from semloc_logs.labels.sweep_ground import REACH, GroundSurface, ground_surface
from semloc_logs.labels.voxel_features import Voxels, VoxelShapes, objects, voxel_shapes, voxelise

VOXEL = 0.30  # (m)
# points lower than this are ground; a small scale does not make sensors better (m)
ON_GROUND, LEAST_ON_GROUND = 0.10, 0.04
# cars are not taller; objects that may be vehicles are lower (m)
TALL, LOW = 1.8, 2.3


def classify(
    points: NDArray[np.floating],
    origin: NDArray[np.floating],
    scale: float = 1.0,
    ground: GroundSurface | None = None,
) -> U8:
    """Class (n,) of level ``points`` (n, 3), z up, of a sensor at ``origin`` (3,).

    255 where the shape does not decide. ``scale`` is the voxel size over 0.30 m: a room is a street
    in miniature. ``ground`` saves estimating the ground again. Points beyond 120 m of the sensor
    (at street scale) stay unlabelled.
    """
    label = np.full(len(points), UNLABELLED, np.uint8)
    p = np.asarray(points, np.float64)
    o = np.asarray(origin, np.float64)
    in_reach = np.flatnonzero((np.abs(p - o) <= REACH * scale).all(1))
    if not len(in_reach):
        return label
    p = p[in_reach]
    height = p[:, 2] - (ground or ground_surface(p, o, scale)).height_at(p[:, :2])
    low = height < max(ON_GROUND * scale, LEAST_ON_GROUND)
    label[in_reach[low]] = ROAD
    standing = np.flatnonzero(~low)
    if len(standing):
        label[in_reach[standing]] = _standing_classes(p[standing], height[standing], scale)
    return label


def _standing_classes(points: F64, height: F64, scale: float) -> U8:
    """Class (n,) of ``points`` (n, 3) that are not on the ground, at ``height`` (n,) above it."""
    size = VOXEL * scale
    voxels = voxelise(points, size)
    mean = np.bincount(voxels.of_point, height) / np.bincount(voxels.of_point)
    own = _class_of(voxels, voxel_shapes(points, voxels, size), mean, scale)
    smooth = _majority(voxels.ijk, own, voxels.start, *voxels.shape)
    return np.where((own == POLE) | (smooth == POLE), own, smooth)[voxels.of_point]


def _class_of(voxels: Voxels, s: VoxelShapes, height: F64, scale: float) -> U8:
    """Class (m,) of ``voxels`` at ``height`` (m,), each by its own surroundings."""
    h = height / scale
    top = h + s.up / scale
    extent = (s.up + s.down) / scale + VOXEL
    tall = top > TALL
    length, width, highest = (
        a / scale for a in objects(voxels, (top < LOW) & (h < LOW), height, VOXEL * scale)
    )
    vehicle = (width > 0.9) & (width < 4.0) & (length < 6.5) & (highest > 0.9)
    wall = ((s.wide_disorder < 0.06) | (s.wide_tilt < 0.12)) & (s.wide_disorder < 0.12)
    out = np.full(len(h), UNLABELLED, np.uint8)
    out[tall & ~wall & ~(vehicle & (highest < 2.1))] = VEGETATION
    out[tall & wall] = BUILDING
    out[~tall & ~vehicle & (s.tilt < 0.05) & (s.disorder < 0.02)] = BUILDING  # low walls and fences
    out[~tall & ~vehicle & (s.wide_disorder > 0.06)] = VEGETATION
    # high grass, beds
    out[~tall & (s.wide_tilt > 0.6) & (h < 0.45) & (s.rough > 0.025 * scale)] = VEGETATION
    out[(s.tilt > 0.8) & (s.disorder < 0.05) & (h > 2)] = BUILDING  # roofs and ceilings
    thin = (s.thick < 0.12 * scale) & (s.long > 0.25 * scale) & (extent > 1.0)
    out[thin & (s.crown < 4) & (s.beside < 8) & (top > 1.3)] = POLE
    return out


@njit(cache=True, nogil=True)
def _majority(ijk: I64, label: U8, start: I64, nx: int, ny: int) -> U8:
    """The class (m,) of most of a voxel and its 26 neighbours.

    The voxel's own class counts twice and wins a tie.
    """
    out = label.copy()
    votes = np.zeros(256, np.int64)
    for k in range(len(ijk)):
        i, j, z = ijk[k]
        votes[:] = 0
        votes[label[k]] = 1
        for u in range(max(i - 1, 0), min(i + 2, nx)):
            for v in range(max(j - 1, 0), min(j + 2, ny)):
                for q in range(start[u * ny + v], start[u * ny + v + 1]):
                    if ijk[q, 2] > z + 1:
                        break
                    if ijk[q, 2] >= z - 1:
                        votes[label[q]] += 1
        best = label[k]
        for c in range(256):
            if votes[c] > votes[best]:
                best = c
        out[k] = best
    return out
