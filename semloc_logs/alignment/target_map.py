"""The map of a target: a submap's voxels, and the surfaces that a query's points align with."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from semloc_logs.alignment.mask_grid import MaskGrid, build_mask_grid
from semloc_logs.alignment.query_map import structure_of
from semloc_logs.alignment.surface import Surface, flattened_surface, surface_of, thin_points
from semloc_logs.arrays import F64, U8
from semloc_logs.labels.space import cityscapes
from semloc_logs.mapping.selection import thin
from semloc_logs.voxels.grid import BlockMap

# of correspondences, voxels: the model of the acceptance was fitted with them
COARSE_RADII = (3.0, 1.5)
FINE_RADII = (0.7, 0.4)
UNCERTAIN_RADII = (3.0, 2.0)  # where points are uncertain
UNCERTAIN = 0.25  # voxels: the median standard deviation above which points are uncertain
PLANE_NOISE = 1 / 6  # voxels: of planes whose points are certain
SURFACE_SPACING = 2.5  # points of a surface in each voxel's edge: one every 0.4 voxels
SURFACE_CELL = 2.0  # voxels: edge of the cells that a surface's points are found by


@dataclass(eq=False)
class Target:
    """A submap of the database as verification needs it; its parts are built on first use."""

    blocks: BlockMap
    voxel_size: float

    @cached_property
    def occupied(self) -> tuple[NDArray[np.int32], U8]:
        """Coordinates (n, 3) and class (n,) of the occupied voxels."""
        return self.blocks.occupied()

    @cached_property
    def mask_grid(self) -> MaskGrid:
        """Bit masks to look voxels up in."""
        return build_mask_grid(self.blocks, self.occupied, self.voxel_size, cityscapes().coarse)

    @cached_property
    def structure(self) -> tuple[F64, U8]:
        """Centres (n, 3) in metres and class bits (n,) of all structure voxels."""
        return structure_of(self.occupied, self.voxel_size)

    @cached_property
    def surface(self) -> Surface:
        """The centres of the occupied voxels, to align with to a fraction of a voxel."""
        ijk, _ = self.occupied
        return surface_of((ijk + 0.5) * self.voxel_size, COARSE_RADII[0] * self.voxel_size)


def is_uncertain(sigma: float, voxel_size: float) -> bool:
    """Whether points lie in slabs and not on surfaces.

    ``sigma`` is the median of their standard deviations along their rays, metres.
    """
    return sigma > UNCERTAIN * voxel_size


def point_surface(points: F64, spread: F64, voxel_size: float) -> Surface:
    """The surface of a target's ``points`` (n, 3), for a fine fit.

    ``spread`` (n, 3) is one standard deviation of each point along its ray, metres.
    """
    kept = thin_points(points, voxel_size / SURFACE_SPACING, spread)
    points = points[kept]
    spread = spread[kept]
    sigma = np.linalg.norm(spread, axis=1)
    if len(kept) and is_uncertain(float(np.median(sigma)), voxel_size):
        one_a_voxel = thin(points.astype(np.float32), voxel_size)
        radius = UNCERTAIN_RADII[1] * voxel_size
        return flattened_surface(points, spread, one_a_voxel, radius, PLANE_NOISE * voxel_size)
    return surface_of(points, SURFACE_CELL * voxel_size)
