"""Ray carving of one frame: which voxels its rays pass (free) and end in (occupied). The hot loop of fusion.

A frame is marked in a dense local grid first, one ray for each end voxel, hits winning over passes, and the marks are then
added to hashed blocks: each voxel changes once a frame, as in OctoMap (paper 3.1).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.voxels.keys import BLOCK

FREE, HIT = 1, 2


@njit(cache=True, nogil=True)
def carve(grid: NDArray[np.uint8], origin: NDArray[np.float64], ends: NDArray[np.float64], hit: NDArray[np.bool_]) -> None:
    """Mark the rays from ``origin`` (3,) to ``ends`` (n, 3), both in voxels from the grid's corner, inside ``grid`` (x, y, z).

    The end voxel becomes HIT where ``hit``; every other voxel of the ray FREE unless it is HIT already. The digital
    differential analyser of Amanatides and Woo (1987). The grid must hold every ray.
    """
    step = np.empty(3, np.int64)
    cell = np.empty(3, np.int64)
    last = np.empty(3, np.int64)
    next_t = np.empty(3)
    delta_t = np.empty(3)
    for r in range(len(ends)):
        for k in range(3):
            d = ends[r, k] - origin[k]
            cell[k] = int(np.floor(origin[k]))
            last[k] = int(np.floor(ends[r, k]))
            if d > 0:
                step[k] = 1
                next_t[k] = (cell[k] + 1 - origin[k]) / d
                delta_t[k] = 1.0 / d
            elif d < 0:
                step[k] = -1
                next_t[k] = (cell[k] - origin[k]) / d
                delta_t[k] = -1.0 / d
            else:
                step[k] = 0
                next_t[k] = np.inf
                delta_t[k] = np.inf
            if cell[k] == last[k]:  # this axis is done: rounding can then never carry the walk past its end
                next_t[k] = np.inf
        x, y, z = cell[0], cell[1], cell[2]
        for _ in range(abs(last[0] - x) + abs(last[1] - y) + abs(last[2] - z)):
            if grid[x, y, z] == 0:
                grid[x, y, z] = FREE
            if next_t[0] <= next_t[1] and next_t[0] <= next_t[2]:
                x += step[0]
                next_t[0] = next_t[0] + delta_t[0] if x != last[0] else np.inf
            elif next_t[1] <= next_t[2]:
                y += step[1]
                next_t[1] = next_t[1] + delta_t[1] if y != last[1] else np.inf
            else:
                z += step[2]
                next_t[2] = next_t[2] + delta_t[2] if z != last[2] else np.inf
        if hit[r]:
            grid[last[0], last[1], last[2]] = HIT
        elif grid[last[0], last[1], last[2]] == 0:
            grid[last[0], last[1], last[2]] = FREE


@njit(cache=True, nogil=True)
def touched_blocks(grid: NDArray[np.uint8]) -> NDArray[np.int32]:
    """Offsets (m, 3) in blocks of the parts of a block-aligned ``grid`` that hold any mark."""
    nx, ny, nz = grid.shape[0] // BLOCK, grid.shape[1] // BLOCK, grid.shape[2] // BLOCK
    out = np.empty((nx * ny * nz, 3), np.int32)
    n = 0
    for bx in range(nx):
        for by in range(ny):
            for bz in range(nz):
                found = False
                for i in range(BLOCK):
                    for j in range(BLOCK):
                        for k in range(BLOCK):
                            if grid[bx * BLOCK + i, by * BLOCK + j, bz * BLOCK + k]:
                                found = True
                                break
                        if found:
                            break
                    if found:
                        break
                if found:
                    out[n, 0], out[n, 1], out[n, 2] = bx, by, bz
                    n += 1
    return out[:n]


@njit(cache=True, nogil=True)
def flush(
    grid: NDArray[np.uint8],
    offsets: NDArray[np.int32],
    slots: NDArray[np.int64],
    log_odds: NDArray[np.int8],
    hit: int,
    miss: int,
    low: int,
    high: int,
) -> None:
    """Add the marks of ``grid`` to ``log_odds`` (slots, 4096) int8 in units of 1/20, clamped to [low, high]; -128 is unobserved.

    ``offsets`` (m, 3) are blocks of the grid and ``slots`` (m,) their rows in ``log_odds``. The grid is cleared.
    """
    for b in range(len(offsets)):
        row = log_odds[slots[b]]
        x0, y0, z0 = offsets[b, 0] * BLOCK, offsets[b, 1] * BLOCK, offsets[b, 2] * BLOCK
        n = 0
        for i in range(BLOCK):
            for j in range(BLOCK):
                for k in range(BLOCK):
                    mark = grid[x0 + i, y0 + j, z0 + k]
                    if mark:
                        old = int(row[n])
                        if old == -128:
                            old = 0
                        value = old + (hit if mark == HIT else -miss)
                        row[n] = min(max(value, low), high)
                        grid[x0 + i, y0 + j, z0 + k] = 0
                    n += 1
