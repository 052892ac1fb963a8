"""The map of a query: its voxels and points, and the evidence that a search looks up."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from semloc_logs.alignment.mask_grid import MaskGrid, build_mask_grid, wanted_bits
from semloc_logs.arrays import F64, U8
from semloc_logs.labels.space import GROUND, cityscapes
from semloc_logs.voxels.grid import BlockMap

SEARCH_VOXELS = 1200  # of a query that a search looks up, at most
STRUCTURE_SHARE = 0.75  # of the score; the ground has the rest, to hold the height
VIEW_AHEAD = 20.0  # voxels between a sensor and the mean of its points if it looks one way


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Query voxels to look up: ``centres`` (n, 3) metres and class ``bits`` (n,).

    The first ``structure`` of them are structure, the rest ground.
    """

    centres: F64
    bits: U8
    structure: int

    @property
    def arrays(self) -> tuple[F64, U8, int]:
        """All of it, for compiled functions."""
        return self.centres, self.bits, self.structure

    def first(self, count: int) -> Evidence:
        """About ``count`` of the voxels: the first of the structure and of the ground."""
        solid = min(self.structure, int(STRUCTURE_SHARE * count))
        ground = min(len(self.bits) - self.structure, count - int(STRUCTURE_SHARE * count))
        picked = np.r_[0:solid, self.structure : self.structure + ground]
        return Evidence(self.centres[picked], self.bits[picked], solid)


def structure_mask(label: U8) -> NDArray[np.bool_]:
    """Which voxels are structure: neither ground nor of a class that moves."""
    dynamic = np.zeros(256, bool)
    dynamic[: len(cityscapes().dynamic)] = cityscapes().dynamic
    dynamic[list(GROUND)] = True
    return ~dynamic[label]


def structure_of(occupied: tuple[NDArray[np.int32], U8], voxel_size: float) -> tuple[F64, U8]:
    """Centres (n, 3) in metres and class bits (n,) of the structure among ``occupied`` voxels."""
    ijk, label = occupied
    keep = structure_mask(label)
    return voxel_centres(ijk[keep], voxel_size), wanted_bits(label[keep], cityscapes().coarse)


def voxel_centres(ijk: NDArray[np.int32], voxel_size: float) -> F64:
    """Centres (n, 3) in metres of the voxels ``ijk`` (n, 3)."""
    return np.asarray((ijk.astype(float) + 0.5) * voxel_size)


def view_centres(position: F64, mean: F64, voxel_size: float) -> F64:
    """Where sensors look (n, 3): the ``mean`` (n, 3) of their points if they look one way.

    Sensors that look all around look at their own ``position`` (n, 3).
    """
    one_way = np.linalg.norm(mean - position, axis=1) > VIEW_AHEAD * voxel_size
    return np.where(one_way[:, None], mean, position)


@dataclass(eq=False)
class Query:
    """A query map in its own level frame: fused ``blocks``, and ``points`` (n, 3) of keyframes.

    ``spread`` (n, 3) is one standard deviation of each point along its ray, metres; zeros, or None,
    where they are certain.
    """

    blocks: BlockMap
    points: F64
    voxel_size: float
    spread: F64 | None = None

    @cached_property
    def occupied(self) -> tuple[NDArray[np.int32], U8]:
        """Coordinates (n, 3) and classes (n,) of the occupied voxels."""
        return self.blocks.occupied()

    @cached_property
    def reach(self) -> int:
        """Voxels from the origin to the farthest occupied voxel, over the ground."""
        ijk, _ = self.occupied
        return int(np.ceil(np.linalg.norm(ijk[:, :2] + 0.5, axis=1).max(initial=0.0)))

    @cached_property
    def sigma(self) -> float:
        """Median standard deviation of the points along their rays, metres."""
        return (
            0.0
            if self.spread is None or not len(self.spread)
            else float(np.median(np.linalg.norm(self.spread, axis=1)))
        )

    @cached_property
    def view_centre(self) -> F64:
        """Where the query looks (3,), metres in its frame."""
        mean = self.points.mean(0)[None]
        return np.asarray(view_centres(np.zeros((1, 3)), mean, self.voxel_size)[0])

    @cached_property
    def evidence(self) -> Evidence:
        """Voxels to look up in a search: structure, and ground with less weight for the height."""
        ijk, label = self.occupied
        structure = structure_mask(label)
        rng = np.random.default_rng(0)
        picked = []
        for mask, share in ((structure, STRUCTURE_SHARE), (~structure, 1 - STRUCTURE_SHARE)):
            # in random order, so that the first of them stand for all
            picked.append(rng.permutation(np.flatnonzero(mask))[: int(share * SEARCH_VOXELS)])
        index = np.concatenate(picked)
        return Evidence(
            voxel_centres(ijk[index], self.voxel_size),
            wanted_bits(label, cityscapes().coarse)[index],
            len(picked[0]),
        )

    @cached_property
    def structure(self) -> tuple[F64, U8]:
        """Centres (n, 3) in metres and class bits (n,) of all structure voxels."""
        return structure_of(self.occupied, self.voxel_size)

    @cached_property
    def mask_grid(self) -> MaskGrid:
        """Bit masks to look a target's voxels up in."""
        return build_mask_grid(self.blocks, self.occupied, self.voxel_size, cityscapes().coarse)
