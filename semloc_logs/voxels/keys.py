"""Voxel and block addresses: packing, Morton order; pure integer arithmetic.

A block is 16^3 voxels. Block coordinates are packed into an int64, 21 bits each, so they reach 2^20
blocks (5,000 km at 0.30 m) from the origin.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import I64

BLOCK = 16
_BIAS = 1 << 20
_MASK = (1 << 21) - 1


def pack(ijk: NDArray[np.integer]) -> I64:
    """One int64 for each row of integers (n, 3) within +-2^20, in the order of (x, y, z)."""
    a = np.asarray(ijk, np.int64) + _BIAS
    return (a[..., 0] << 42) | (a[..., 1] << 21) | a[..., 2]


def unpack(key: I64) -> NDArray[np.int32]:
    """Inverse of :func:`pack`: (n, 3) int32."""
    k = np.asarray(key, np.int64)
    return np.stack(
        [(k >> 42) - _BIAS, ((k >> 21) & _MASK) - _BIAS, (k & _MASK) - _BIAS], axis=-1
    ).astype(np.int32)


def _spread(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Two zero bits after each of the low 21 bits."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        x = (x | (x << np.uint64(shift))) & np.uint64(mask)
    return x


def morton(ijk: NDArray[np.integer]) -> NDArray[np.uint64]:
    """Morton (Z-order) code of integer coordinates (n, 3) within +-2^20."""
    a = (np.asarray(ijk, np.int64) + _BIAS).astype(np.uint64)
    return np.asarray(
        _spread(a[..., 0])
        | (_spread(a[..., 1]) << np.uint64(1))
        | (_spread(a[..., 2]) << np.uint64(2))
    )
