"""The voxels of a closure, cut around the aligned query, drawn as lit cubes."""

from __future__ import annotations

import numpy as np

from semloc_logs.alignment.mask_grid import FREE_BIT, look_up
from semloc_logs.arrays import F64, U8
from semloc_logs.numerics.transforms import apply
from semloc_logs.pictures.closure_view import ClosureView
from semloc_logs.pictures.colours import (
    ALIGNED,
    IN_FREE_SPACE,
    PALE,
    UNOBSERVED,
    Legend,
    class_colours,
    class_legend,
)
from semloc_logs.pictures.solids import Solid, View, draw_solids, top_view

PANEL = 640  # pixels along an edge of a picture from above
PALENESS = 0.78  # how far the target's colours are from their own to pale
HEADROOM = 2  # voxels above the sensor that are drawn under a roof
ROOF_CELL = 4  # voxels along an edge of the columns in which a roof is looked for
# the scene holds this percentage of the query's voxels, but so many voxels around it at least
WITHIN, LEAST_RADIUS = 99.5, 20
# of the view from the side: to the right of straight from behind, and down; its pixels are smaller
AZIMUTH, ELEVATION = 0.45, np.radians(28)
SIDE_METRES = 0.75
SIDE_SHAPE = (3 * PANEL // 2, PANEL * 5 // 8)


class ClosureScene:
    """A query and the map of its target, as voxels within ``radius`` metres of the aligned query.

    Pictures from above have pixels of ``metres``. Where most of the query's drive lies under
    something, voxels higher than the sensor are left out.
    """

    def __init__(self, view: ClosureView) -> None:
        self._view = view
        size = self._size = view.query.voxel_size
        self._query, self._query_label = view.query.blocks.occupied()
        centre = view.map_T_query[:3, 3]
        self._centre = (float(centre[0]), float(centre[1]), float(centre[2]))
        away = np.abs((self._query[:, :2] + 0.5) * size).max(1, initial=0.0)
        within = float(np.percentile(away, WITHIN)) if len(away) else 0.0
        self.radius = max(within + 2 * size, LEAST_RADIUS * size)
        self.metres = 2 * self.radius / PANEL
        ijk, label = view.target.blocks.occupied()
        inside = (np.abs((ijk[:, :2] + 0.5) * size - centre[:2]) < self.radius).all(1)
        self._target = ijk[inside]
        self._target_label = label[inside]
        self._cut_roof()

    def _cut_roof(self) -> None:
        """Leave out voxels higher than the sensor, where most of the query's drive is roofed."""
        size = self._size
        query_drive = self._view.roads[1]
        aligned_drive = apply(self._view.map_T_query, query_drive)
        headroom = (HEADROOM + 1) * size
        above = (self._target[:, 2] + 0.5) * size > aligned_drive[:, 2].mean() + headroom
        roofed = set(_columns((self._target[above] + 0.5) * size, size))
        covered = np.mean([c in roofed for c in _columns(aligned_drive, size)])
        if covered > 0.5:
            self._target = self._target[~above]
            self._target_label = self._target_label[~above]
            low = (self._query[:, 2] + 0.5) * size <= query_drive[:, 2].mean() + headroom
            self._query = self._query[low]
            self._query_label = self._query_label[low]

    def top_view(self) -> View:
        """From above, x to the right and y up."""
        return top_view(self._centre, PANEL, PANEL, self.metres)

    def side_view(self) -> View:
        """Obliquely from behind the aligned query."""
        map_T_base = self._view.map_T_query @ self._view.query_T_base
        azimuth = float(np.arctan2(map_T_base[1, 0], map_T_base[0, 0])) + np.pi + AZIMUTH
        return View(azimuth, ELEVATION, self._centre, *SIDE_SHAPE, self.metres * SIDE_METRES)

    def draw(self, map_T_query: F64, view: View) -> U8:
        """The query in the colours of its classes over the pale map."""
        return draw_solids(self._solids(map_T_query, class_colours()[self._query_label]), view)

    def draw_agreement(self, view: View) -> U8:
        """The aligned query over the pale map; the map gives each of its voxels a colour."""
        map_T_query = self._view.map_T_query
        mask = look_up(
            self._view.target.mask_grid, apply(map_T_query, (self._query + 0.5) * self._size)
        )
        is_occupied = (mask & ~np.uint8(FREE_BIT)) != 0
        observed = np.where((mask != 0)[:, None], IN_FREE_SPACE, UNOBSERVED)
        colours = np.where(is_occupied[:, None], ALIGNED, observed).astype(np.uint8)
        return draw_solids(self._solids(map_T_query, colours), view)

    def _solids(self, map_T_query: F64, colours: U8) -> list[Solid]:
        own = class_colours()[self._target_label]
        pale = (PALENESS * np.array(PALE) + (1 - PALENESS) * own).astype(np.uint8)
        return [
            Solid(self._target, pale, self._size, np.eye(4)),
            Solid(self._query, colours, self._size, map_T_query),
        ]

    def drives(self, map_T_query: F64) -> tuple[F64, F64]:
        """Positions (n, 3) of the target's and of the query's keyframes in the map."""
        target, query = self._view.roads
        return target, apply(map_T_query, query)

    def heading(self, map_T_query: F64, length: float) -> F64:
        """The query's position and the point ``length`` metres ahead of it (2, 3), in the map."""
        base = map_T_query @ self._view.query_T_base
        return np.stack([base[:3, 3], base[:3, 3] + base[:3, 0] * length])

    def classes(self) -> Legend:
        """Classes of the query, the most frequent first."""
        return class_legend(self._query_label, self._view.label_source)


def _columns(points: F64, size: float) -> list[tuple[int, ...]]:
    """The column of each of the points (n, 3)."""
    cells = np.floor(points[:, :2] / (ROOF_CELL * size)).astype(int)
    return [tuple(c) for c in cells.tolist()]
