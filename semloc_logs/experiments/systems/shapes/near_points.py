"""Neighbours within a radius, by a grid of cells: for descriptors of many points."""

from __future__ import annotations

import numpy as np
from numba import njit

from semloc_logs.arrays import F64, I64
from semloc_logs.numerics.cells import by_cell

# the order of points by cells, where each cell starts, the cell (n, 3) of each point, and the
# number of cells along each axis (3,): a plain tuple, which compiled functions pass on
Cells = tuple[I64, I64, I64, I64]
NEAREST = 1e-6  # m: points nearer than this are one


def cells_of(points: F64, radius: float) -> Cells:
    """Cells of ``radius`` metres of the ``points`` (n, 3)."""
    ijk = ((points - points.min(0)) / radius).astype(np.int64)
    shape = ijk.max(0) + 1
    cell = (ijk[:, 0] * shape[1] + ijk[:, 1]) * shape[2] + ijk[:, 2]
    order, start = by_cell(cell, int(shape.prod()))
    return order, start.astype(np.int64), ijk, shape


@njit(cache=True, nogil=True)
def neighbours(points: F64, cells: Cells, row: int, radius: float, out: I64) -> int:
    """Rows of the points within ``radius`` of point ``row``, into ``out`` (n,); their number.

    ``radius`` is not larger than the cells.
    """
    order, start, ijk, shape = cells
    count = 0
    for i in range(max(ijk[row, 0] - 1, 0), min(ijk[row, 0] + 2, shape[0])):
        for j in range(max(ijk[row, 1] - 1, 0), min(ijk[row, 1] + 2, shape[1])):
            for k in range(max(ijk[row, 2] - 1, 0), min(ijk[row, 2] + 2, shape[2])):
                cell = (i * shape[1] + j) * shape[2] + k
                for place in range(start[cell], start[cell + 1]):
                    other = order[place]
                    dx = points[other, 0] - points[row, 0]
                    dy = points[other, 1] - points[row, 1]
                    dz = points[other, 2] - points[row, 2]
                    far = dx * dx + dy * dy + dz * dz
                    if NEAREST**2 < far < radius**2:
                        out[count] = other
                        count += 1
    return count
