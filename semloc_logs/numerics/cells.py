"""Rows grouped by the cell they lie in, in the form of compressed sparse rows (CSR).

Cells are numbered from 0 on. The rows of cell c are ``order[start[c]:start[c + 1]]``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.arrays import I32, I64


@njit(cache=True, nogil=True)
def cell_starts(cell: NDArray[Any], cells: int) -> I64:
    """Where the rows of each cell start (cells + 1,), of rows with integer cells ``cell`` (n,)."""
    start = np.zeros(cells + 1, np.int64)
    _add_up(cell, start)
    return start


@njit(cache=True, nogil=True)
def by_cell(cell: NDArray[Any], cells: int) -> tuple[I64, I32]:
    """The ``order`` (n,) of rows by their cells and the ``start`` (cells + 1,) of each cell.

    Rows of one cell stay in their order (counting sort). There are less than 2^31 rows: with starts
    of 32 bits a grid of mostly empty cells takes half the time.
    """
    start = np.zeros(cells + 1, np.int32)
    _add_up(cell, start)
    free = start.copy()
    order = np.empty(len(cell), np.int64)
    for row in range(len(cell)):
        c = cell[row]
        order[free[c]] = row
        free[c] += 1
    return order, start


@njit(cache=True, nogil=True)
def _add_up(cell: NDArray[Any], start: NDArray[Any]) -> None:
    """Count the rows of each cell into ``start`` (cells + 1,), zeros, and add them up."""
    for c in cell:
        start[c + 1] += 1
    for c in range(1, len(start)):
        start[c] += start[c - 1]
