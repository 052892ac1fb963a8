"""Cutting and turning subvolumes: voxel states -> network codes.

Whole maps are turned by a heading; training takes single subvolumes. A subvolume is 32^3 voxels.
The encoder sees a margin of 8 voxels around it in x and y, which is its receptive field, so that
the descriptors of a whole map can be computed at once and equal the descriptors of single
subvolumes to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.arrays import U8
from semloc_logs.labels.space import UNLABELLED
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE

SIZE, MARGIN = 32, 8
GRID = 8  # voxels: the coarsest stride
WIDE = SIZE + 2 * MARGIN
CLASSES = {"semantic": 19, "geometric": 1}


def plain_name(variant: str) -> str:
    """The name of the shipped files of the paper's method, weights and words."""
    return f"paper_{variant}"


def code_table(variant: str) -> U8:
    """Voxel state (0..255) -> network code.

    0..L-1 classes, L free, L + 1 unobserved, L + 2 occupied of unknown class. ``geometric`` knows a
    single class (the paper's uniform semantics).
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
def turn(
    state: U8, low: NDArray[np.int64], yaw: float, centre: NDArray[np.float64], out: U8
) -> None:
    """Fill ``out`` (x, y, z) with the box of the same centre, turned.

    The voxel at offset d from the middle of ``out`` is the map's voxel at ``centre`` + R(yaw) d
    (all in voxels, map coordinates), unobserved outside ``state``, whose corner is ``low``.
    """
    c = np.cos(yaw)
    s = np.sin(yaw)
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


@dataclass(frozen=True, slots=True, eq=False)
class Turned:
    """A map that was turned by -``yaw`` about z.

    ``state`` (x, y, z) with its corner at voxel ``low`` (3,) of the turned map. The axis is at
    ``middle`` (2,), voxels of the map.
    """

    state: U8
    low: NDArray[np.int64]
    middle: NDArray[np.float64]
    yaw: float

    @property
    def _map_R_turned(self) -> NDArray[np.float64]:
        c = np.cos(self.yaw)
        s = np.sin(self.yaw)
        return np.array([[c, -s], [s, c]])

    def from_map(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Places (n, 2) of the map, in voxels, in the turned one."""
        return np.asarray((points - self.middle) @ self._map_R_turned)

    def to_map(self, points: NDArray[np.floating]) -> NDArray[np.float32]:
        """Places (n, 3) of the turned map, in voxels, in the map."""
        out = points.astype(float)
        out[:, :2] = out[:, :2] @ self._map_R_turned.T + self.middle
        return out.astype(np.float32)


def turned_map(state: U8, low: NDArray[np.integer], yaw: float) -> Turned:
    """The box ``state`` with its corner at voxel ``low``, as a query at heading ``yaw`` sees it.

    There is room for all of it. Corner and axis are multiples of 8 voxels: subvolumes of a map that
    is not turned stay on its grid.
    """
    shape = np.array(state.shape)
    middle = np.round((np.asarray(low) + shape / 2)[:2] / GRID) * GRID
    c = abs(np.cos(yaw))
    s = abs(np.sin(yaw))
    half = (
        np.ceil(np.array([[c, s], [s, c]]) @ (shape[:2] / 2 + GRID) / GRID).astype(np.int64) * GRID
    )
    box = np.empty((2 * half[0], 2 * half[1], shape[2]), np.uint8)
    turn(state, np.asarray(low, np.int64), yaw, np.array([*middle, low[2] + shape[2] / 2]), box)
    return Turned(box, np.array([-half[0], -half[1], low[2]], np.int64), middle, yaw)
