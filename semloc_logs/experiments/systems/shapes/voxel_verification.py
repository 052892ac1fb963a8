"""Pose hypotheses ranked by the overlap ratio tau (section 3.5), for the systems on points that
take another descriptor in place of ours.

Every match is a hypothesis. All of them are rated with some of the query's voxels, the best with
more, and the best of these as the plain method does: by the exact tau, after iterative closest
points on aligned voxels. For the first ratings the closest *observed* voxel of every voxel near the
database's map is known beforehand, from the exact distance transform, so a query voxel costs one
look-up. It looks from the middle of the voxel that it falls into.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.ndimage import distance_transform_edt

from semloc_logs.alignment.cell_masks import overlap_map
from semloc_logs.alignment.hypotheses import non_maximum_suppression, pose_matrix
from semloc_logs.alignment.overlaps import Voxels, overlap, query_voxels
from semloc_logs.arrays import F64, U8
from semloc_logs.experiments.system import MOST_POSES
from semloc_logs.experiments.systems.level_maps import LevelMap
from semloc_logs.experiments.systems.plain import refined
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE

TILE = 96  # voxels along the edge of the parts that distances are computed in
FEW, MANY = 64, 1500  # query voxels that rate all hypotheses, and the best
BEST = 2000  # hypotheses that are rated with many voxels
REFINED = 30  # hypotheses that are refined
APART_VOXELS = 2.0  # poses nearer than this with one heading are one
# voxels that a hypothesis may lie too high, as keypoints are half a stride off at most. The ground
# then falls into free space, and nothing fits; where it lies too low, it is the closest surface
HEIGHTS = (0.0, -2.0, -4.0)
ITERATIONS = 20  # of the closest points, at most


class Rated(NamedTuple):
    """``world_T_query`` (4, 4) and the share ``tau`` of the query's voxels that fit."""

    world_T_query: F64
    tau: float


class Verifier:
    """The map of a database, against which hypotheses are rated; ``kappa`` in metres."""

    def __init__(self, database: LevelMap, kappa: float) -> None:
        self._voxel_size = database.voxel_size
        self._reach = kappa / database.voxel_size
        margin = int(self._reach) + 1
        low, high = database.blocks.bounds()
        self._low = low.astype(np.int64) - margin
        self._blocks = database.blocks
        self._margin = margin
        tiles = -(-(high.astype(np.int64) + margin - self._low)[:2] // TILE)
        self._height = int(high[2] + margin - self._low[2])
        # the closest observed state of each voxel, tile by tile where hypotheses lie
        self._closest = np.full(
            (tiles[0] * TILE, tiles[1] * TILE, self._height), UNOBSERVED_STATE, np.uint8
        )
        self._is_known = np.zeros(tuple(tiles), bool)
        self._target = overlap_map(database.blocks, self._reach)

    def ranked(self, query: LevelMap, poses: F64) -> list[Rated]:
        """The best of the hypotheses ``poses`` (n, 4), (yaw, x, y, z) of world_T_query, refined."""
        ijk, label = query.blocks.occupied()
        if not len(ijk) or not len(poses) or not self._closest.size:
            return []
        order = np.random.default_rng(0).permutation(len(ijk))[:MANY]
        centres = (ijk[order] + 0.5).astype(np.float64)
        states = label[order]
        self._complete_tiles(poses, float(np.linalg.norm(centres[:, :2], axis=1).max()))
        lowered = np.repeat(poses[None], len(HEIGHTS), axis=0)
        lowered[:, :, 3] += np.array(HEIGHTS)[:, None] * self._voxel_size
        some = self._tau(centres[:FEW], states[:FEW], lowered.reshape(-1, 4))
        some = some.reshape(len(HEIGHTS), -1)
        height = some.argmax(0)
        best = np.argsort(-some.max(0), kind="stable")[:BEST]
        chosen = lowered[height[best], best]
        tau = self._tau(centres, states, chosen)
        chosen = chosen[np.argsort(-tau, kind="stable")]
        apart = APART_VOXELS * self._voxel_size
        kept = chosen[
            non_maximum_suppression(np.zeros(len(chosen), np.int64), chosen, apart, MOST_POSES)
        ]
        voxels = query_voxels((ijk, label))
        out = [self._exact(pose, voxels, n < REFINED) for n, pose in enumerate(kept)]
        return sorted(out, key=lambda rated: -rated.tau)

    def _exact(self, pose: F64, voxels: Voxels, is_refined: bool) -> Rated:
        """A hypothesis, or the best one that its refinement meets, with the exact tau."""
        start = pose_matrix(pose)
        start[:3, 3] /= self._voxel_size
        if is_refined:
            start, tau = refined(self._target, voxels, start, ITERATIONS)
        else:
            tau = overlap(self._target, voxels, start)
        world_T_query = start.copy()
        world_T_query[:3, 3] *= self._voxel_size
        return Rated(world_T_query, tau)

    def _tau(self, centres: F64, states: U8, poses: F64) -> F64:
        shifted = poses.copy()
        shifted[:, 1:] = poses[:, 1:] / self._voxel_size - self._low
        return _overlap(self._closest, centres, states, np.ascontiguousarray(shifted))

    def _complete_tiles(self, poses: F64, radius: float) -> None:
        """Find the closest voxels in all tiles that a query of ``radius`` voxels reaches."""
        cells = poses[:, 1:3] / self._voxel_size - self._low[:2]
        reach = radius + 2 * self._margin
        first = np.clip(np.floor((cells - reach) / TILE).astype(int), 0, self._is_known.shape)
        last = np.clip(np.ceil((cells + reach) / TILE).astype(int), 0, self._is_known.shape)
        for i, j, k, m in np.unique(np.c_[first, last], axis=0):
            for x in range(i, k):
                for y in range(j, m):
                    if not self._is_known[x, y]:
                        self._complete(x, y)

    def _complete(self, x: int, y: int) -> None:
        self._is_known[x, y] = True
        margin = self._margin
        corner = self._low + np.array([x * TILE - margin, y * TILE - margin, 0])
        width = TILE + 2 * margin
        state = self._blocks.dense(corner, (width, width, self._height))
        unobserved = state == UNOBSERVED_STATE
        if unobserved.all():
            return
        distance, index = distance_transform_edt(unobserved, return_indices=True)
        closest = state[tuple(index)]
        closest[distance >= self._reach] = UNOBSERVED_STATE
        rows = slice(x * TILE, (x + 1) * TILE)
        columns = slice(y * TILE, (y + 1) * TILE)
        self._closest[rows, columns] = closest[margin:-margin, margin:-margin]


@njit(cache=True, nogil=True)
def _overlap(closest: U8, centres: F64, states: U8, poses: F64) -> F64:
    """Share (n,) of ``centres`` (m, 3) whose closest voxel has their state, under each of ``poses``
    (n, 4): yaw, and the shift in voxels of the grid.
    """
    out = np.zeros(len(poses))
    nx, ny, nz = closest.shape
    for h in range(len(poses)):
        c = np.cos(poses[h, 0])
        s = np.sin(poses[h, 0])
        count = 0
        for n in range(len(centres)):
            i = int(np.floor(c * centres[n, 0] - s * centres[n, 1] + poses[h, 1]))
            j = int(np.floor(s * centres[n, 0] + c * centres[n, 1] + poses[h, 2]))
            k = int(np.floor(centres[n, 2] + poses[h, 3]))
            if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
                state = closest[i, j, k]
                count += state == states[n] and state != FREE_STATE
        out[h] = count / len(centres)
    return out
