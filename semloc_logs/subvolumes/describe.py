"""Descriptors of a whole map: the encoder run over it fully convolutionally (paper 3.3).

Subvolumes lie on a grid in x and y. Their height follows the ground: layers are 8 voxels apart,
counted from one metre below the ground, and of each column of layers the one is described whose
lowest eight voxels hold the lowest surface of the place.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from semloc_logs.arrays import F32, U8
from semloc_logs.errors import SettingsError
from semloc_logs.settings import STREET_VOXEL
from semloc_logs.subvolumes.cut import MARGIN, SIZE, code_table
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE

if TYPE_CHECKING:
    from semloc_logs.subvolumes.network import Encoder

BELOW_GROUND = 1.0  # of the lowest layer (m at 0.30 m voxels)
LAYER = 8
RARE = 0.05  # a layer with a smaller share of the subvolumes is not worth a pass of the network
PATCH = 256  # voxels along the edge of the part of a map that is encoded at once


class DescribesWindows(Protocol):
    """What describes the windows of a map: the encoder, or another one to compare it with.

    ``describe``: descriptors (n, latent) of the ``windows`` (n, 2), counted in eight voxels, of the
    codes (x, y, 32) of a map with its margin.
    """

    variant: str
    latent: int

    def describe(self, codes: U8, windows: NDArray[np.int64]) -> F32: ...


@dataclass(frozen=True, slots=True, eq=False)
class Described:
    """``centre`` (n, 3) of subvolumes, voxels of the map, and unit ``descriptor`` (n, latent)."""

    centre: F32
    descriptor: F32


@dataclass(frozen=True, slots=True)
class Windows:
    """The subvolumes of a map that are described.

    ``voxel_size`` in metres, ``stride`` 4 or 8 voxels, at least ``min_occupied`` voxels in each;
    where there is a road, the centre lies within ``reach`` metres of it.
    """

    voxel_size: float
    stride: int
    min_occupied: int
    reach: float = np.inf


def quarter_turns(descriptor: F32, turns: int) -> F32:
    """Descriptors (n, latent) of a map turned by ``turns`` quarters about z, counter-clockwise.

    The encoder turns with its input, so nothing is computed again.
    """
    return np.roll(descriptor.reshape(len(descriptor), 4, -1), turns, 1).reshape(
        len(descriptor), -1
    )


@lru_cache(maxsize=8)
def load_encoder(variant: str, weights: Path | None = None) -> Encoder:
    """The shipped encoder of ``variant``, or the encoder of a file.

    SettingsError when the file does not hold one.
    """
    # torch takes a second to load: only what describes something loads it
    import torch

    from semloc_logs.subvolumes.network import Encoder
    from semloc_logs.subvolumes.weight_files import load_weights

    encoder = load_weights(Encoder, "encoder.", variant, weights)
    # more cores are used by more processes: the same sums in the same order, whatever the engine
    torch.set_num_threads(1)
    return encoder


def _window_sums(a: NDArray[np.int64], stride: int) -> NDArray[np.int64]:
    """Sums of ``a`` (x, y, ...) over 32 x 32 windows every ``stride`` cells."""
    c = np.pad(a.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    i = np.arange(0, a.shape[0] - SIZE + 1, stride)[:, None]
    j = np.arange(0, a.shape[1] - SIZE + 1, stride)[None, :]
    return np.asarray(c[i + SIZE, j + SIZE] - c[i, j + SIZE] - c[i + SIZE, j] + c[i, j])


@njit(cache=True, nogil=True)
def _filled(state: U8, low: int, high: int) -> NDArray[np.int64]:
    """How many voxels of each column (x, y) are occupied, from ``low`` on and below ``high``."""
    out = np.zeros(state.shape[:2], np.int64)
    for x in range(state.shape[0]):
        for y in range(state.shape[1]):
            column = state[x, y, low:high]
            for z in range(len(column)):
                out[x, y] += (column[z] != FREE_STATE) & (column[z] != UNOBSERVED_STATE)
    return out


@njit(cache=True, nogil=True)
def _lowest(state: U8) -> NDArray[np.float64]:
    """The lowest surface in each 4 x 4 columns (x / 4, y / 4).

    The voxel up to which two are occupied; NaN where there are fewer.
    """
    out = np.full((state.shape[0] // 4, state.shape[1] // 4), np.nan)
    level = np.zeros(state.shape[2], np.uint8)
    for x in range(out.shape[0]):
        for y in range(out.shape[1]):
            level[:] = 0
            for i in range(16):
                column = state[4 * x + i // 4, 4 * y + i % 4]
                for z in range(len(column)):
                    level[z] += np.uint8(
                        (column[z] != FREE_STATE) & (column[z] != UNOBSERVED_STATE)
                    )
            count = 0
            for z in range(len(level)):
                count += level[z]
                if count >= 2:
                    out[x, y] = z
                    break
    return out


def _layers(state: U8, bottom: int, stride: int) -> NDArray[np.int64]:
    """Layer of each window: the one whose lowest 8 voxels hold the lowest surface.

    The lowest surface is the 10 % quantile over 4 x 4 columns.
    """
    lowest = _lowest(state)
    windows = np.lib.stride_tricks.sliding_window_view(lowest, (8, 8))[
        :: stride // 4, :: stride // 4
    ].reshape(-1, 64)
    ordered = np.sort(windows, axis=1)  # NaN last
    known = np.isfinite(ordered).sum(1)
    quantile = ordered[
        np.arange(len(ordered)), np.maximum(0, (known * 0.1).astype(int) - (known == 64))
    ]
    layer = np.floor((np.nan_to_num(quantile, nan=float(bottom)) - bottom) / LAYER).astype(np.int64)
    return np.asarray(layer.reshape(len(range(0, lowest.shape[0] - 7, stride // 4)), -1))


def describe_map(
    state: U8,
    low: NDArray[np.integer],
    ground_z: float,
    encoder: DescribesWindows,
    windows: Windows,
    road: NDArray[np.floating] | None = None,
) -> Described:
    """Describe the box ``state`` (x, y, z) of voxel states with its corner at voxel ``low`` (3,).

    ``ground_z`` and the ``road`` (m, 2) are in metres. Positions are multiples of the stride in the
    map's voxel grid only if ``low`` is.
    """
    stride = windows.stride
    voxel_size = windows.voxel_size
    if stride not in (4, 8):
        raise SettingsError(f"A stride of {stride} voxels is not possible: 4 or 8.")
    corner = np.asarray(low)
    cropped = _cropped(state)
    if cropped is None:
        return _nothing(encoder)
    box, first = cropped
    height = box.shape[2]
    below = BELOW_GROUND * voxel_size / STREET_VOXEL
    bottom = round((ground_z - below) / voxel_size) - int(low[2]) + SIZE  # of layer 0 in the box
    inner = box[MARGIN:-MARGIN, MARGIN:-MARGIN]
    layer = _layers(inner, bottom, stride)

    # windows that are described: enough in them, and close to the road
    described = _window_sums(_filled(inner, 0, height), stride) >= windows.min_occupied
    if road is not None:
        corners = np.moveaxis(np.indices(described.shape), 0, -1) * stride + first + corner[:2]
        middle = (corners + SIZE / 2) * voxel_size
        distance, _ = cKDTree(road).query(middle, distance_upper_bound=windows.reach)
        described &= distance < windows.reach

    table = code_table(encoder.variant)
    centres = []
    vectors = []
    values, counts = np.unique(layer[described], return_counts=True)
    for index in values[counts >= RARE * counts.sum()]:
        z = bottom + LAYER * int(index)
        if z < 0 or z + SIZE > height:
            continue
        enough = _window_sums(_filled(inner, z, z + SIZE), stride) >= windows.min_occupied
        # corners of the windows within the inner box
        wanted = np.argwhere(enough & described & (layer == index)) * stride
        if not len(wanted):
            continue
        codes = np.take(table, box[:, :, z : z + SIZE])
        vectors.append(_encode(codes, wanted, encoder, stride))
        heights = np.full((len(wanted), 1), z - SIZE)
        centres.append(np.concatenate([wanted + first, heights], 1) + corner + SIZE / 2)
    if not centres:
        return _nothing(encoder)
    return Described(np.concatenate(centres).astype(np.float32), np.concatenate(vectors))


def _nothing(encoder: DescribesWindows) -> Described:
    """No subvolumes."""
    return Described(np.zeros((0, 3), np.float32), np.zeros((0, encoder.latent), np.float32))


def _cropped(state: U8) -> tuple[U8, NDArray[np.int64]] | None:
    """The occupied part of ``state`` with room for windows that reach over its edge.

    The second value is the corner (2,) of the part, without its margin, in ``state``: a multiple of
    8 voxels. None without an occupied voxel.
    """
    span = np.argwhere(_filled(state, 0, state.shape[2]))
    if not len(span):
        return None
    first = np.maximum((span.min(0) - SIZE // 2) // 8 * 8, -SIZE // 2)
    size = -(-(span.max(0) + SIZE // 2 - first) // 8) * 8
    box = np.full((*(size + 2 * MARGIN), state.shape[2] + 2 * SIZE), UNOBSERVED_STATE, np.uint8)
    a = np.maximum(first, 0)
    b = np.minimum(first + size, state.shape[:2])
    o = a - first + MARGIN
    rows = slice(o[0], o[0] + b[0] - a[0])
    columns = slice(o[1], o[1] + b[1] - a[1])
    box[rows, columns, SIZE : SIZE + state.shape[2]] = state[a[0] : b[0], a[1] : b[1]]
    return box, first


def _encode(codes: U8, wanted: NDArray[np.int64], encoder: DescribesWindows, stride: int) -> F32:
    """Descriptors (n, latent) of windows, patch by patch.

    Their corners within the margin are ``wanted`` (n, 2).
    """
    out = np.zeros((len(wanted), encoder.latent), np.float32)
    phase = wanted % 8
    for dx in range(0, 8, stride):
        for dy in range(0, 8, stride):
            phase_rows = np.flatnonzero((phase == (dx, dy)).all(1))
            patch = wanted[phase_rows] // PATCH
            for px, py in np.unique(patch, axis=0):
                rows = phase_rows[(patch == (px, py)).all(1)]
                corner = wanted[rows].min(0)
                extent = wanted[rows].max(0) - corner + SIZE + 2 * MARGIN
                part = np.ascontiguousarray(
                    codes[corner[0] : corner[0] + extent[0], corner[1] : corner[1] + extent[1]]
                )
                out[rows] = encoder.describe(part, (wanted[rows] - corner) // 8)
    return out
