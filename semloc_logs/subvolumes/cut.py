"""Cutting and turning subvolumes: voxel states -> network codes, whole maps turned by a heading, single subvolumes for training.

A subvolume is 32^3 voxels. The encoder sees a margin of 8 voxels around it in x and y, which is its receptive field, so that the
descriptors of a whole map can be computed at once and equal those of single subvolumes to rounding.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.labels.space import UNLABELLED
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE

SIZE, MARGIN = 32, 8
WIDE = SIZE + 2 * MARGIN
CLASSES = {"semantic": 19, "geometric": 1}

U8 = NDArray[np.uint8]


def code_table(variant: str) -> U8:
    """Voxel state (0..255) -> network code: 0..L-1 classes, L free, L + 1 unobserved, L + 2 occupied of unknown class.

    ``geometric`` knows a single class (the paper's uniform semantics).
    """
    classes = CLASSES[variant]
    table = np.full(256, classes + 2, np.uint8)
    if variant == "semantic":
        table[:classes] = np.arange(classes)
    else:
        table[:] = 0
    table[FREE_STATE], table[UNOBSERVED_STATE] = classes, classes + 1
    if variant == "semantic":
        table[UNLABELLED] = classes + 2
    return table


@njit(cache=True, nogil=True)
def turn(state: U8, low: NDArray[np.int64], yaw: float, centre: NDArray[np.float64], out: U8) -> None:
    """Fill ``out`` (x, y, z) with the box of the same centre turned: the voxel at offset d from the middle of ``out`` shows the
    map's voxel at ``centre`` + R(yaw) d (all in voxels, map coordinates), unobserved outside ``state``, whose corner is ``low``."""
    c, s = np.cos(yaw), np.sin(yaw)
    nx, ny, nz = out.shape
    z0 = int(np.floor(centre[2] - nz / 2.0 + 0.5)) - low[2]
    for i in range(nx):
        dx = i + 0.5 - nx / 2.0
        for j in range(ny):
            dy = j + 0.5 - ny / 2.0
            x = int(np.floor(centre[0] + c * dx - s * dy)) - low[0]
            y = int(np.floor(centre[1] + s * dx + c * dy)) - low[1]
            if x < 0 or y < 0 or x >= state.shape[0] or y >= state.shape[1]:
                out[i, j, :] = 253
            else:
                for k in range(nz):
                    z = z0 + k
                    out[i, j, k] = state[x, y, z] if 0 <= z < state.shape[2] else 253
