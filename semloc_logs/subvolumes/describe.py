"""Descriptors of a whole map: the encoder run fully convolutionally over it, layer by layer (paper
3.3).

Subvolumes lie on a grid in x and y. Their height follows the ground: layers are 8 voxels apart,
counted from one metre below the ground, and of each column of layers the one is described whose
lowest eight voxels hold the lowest surface of the place.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from semloc_logs.errors import SettingsError
from semloc_logs.settings import STREET_VOXEL
from semloc_logs.subvolumes.cut import MARGIN, SIZE, code_table
from semloc_logs.subvolumes.network import Encoder, descriptors
from semloc_logs.subvolumes.weight_files import load_weights
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]
BELOW_GROUND = 1.0  # of the lowest layer (m at 0.30 m voxels)
LAYER = 8
RARE = 0.05  # a layer with a smaller share of the subvolumes is not worth a pass of the network
PATCH = 256  # voxels along the edge of the part of a map that is encoded at once


@dataclass(frozen=True, slots=True, eq=False)
class Described:
    """``centre`` (n, 3) of the subvolumes in voxels (map coordinates) and unit ``descriptor`` (n,
    latent).
    """

    centre: F32
    descriptor: F32


def quarter_turns(descriptor: F32, turns: int) -> F32:
    """What descriptors (n, latent) become when the map is turned by ``turns`` quarters about z,
    counter-clockwise: the encoder turns with its input, so nothing is computed again.
    """
    return np.roll(descriptor.reshape(len(descriptor), 4, -1), turns, 1).reshape(
        len(descriptor), -1
    )


@lru_cache(maxsize=8)
def load_encoder(variant: str, weights: Path | None = None) -> Encoder:
    """The shipped encoder of ``variant``, or that of a file. Raises SettingsError when the file
    does not hold one.
    """
    encoder = load_weights(Encoder, "encoder.", variant, weights)
    # more cores are used by more processes: the same sums in the same order, whatever the engine
    torch.set_num_threads(1)
    return encoder


def random_encoder(variant: str, seed: int = 0) -> Encoder:
    """An untrained encoder: what training has to beat."""
    torch.manual_seed(seed)
    return Encoder(variant).eval()


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
    """The lowest surface in each 4 x 4 columns (x / 4, y / 4): the voxel up to which two are
    occupied; NaN where there are fewer.
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
    """Layer of each window: the one whose lowest 8 voxels hold the lowest surface (10 % quantile
    over 4 x 4 columns).
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


@torch.inference_mode()
def describe_map(
    state: U8,
    low: NDArray[np.integer],
    ground_z: float,
    voxel_size: float,
    encoder: Encoder,
    stride: int,
    min_occupied: int,
    road: NDArray[np.floating] | None = None,
    reach: float = np.inf,
) -> Described:
    """Describe the box ``state`` (x, y, z) of voxel states whose corner is voxel ``low`` of the
    map; ``ground_z`` in metres.

    ``stride`` is 4 or 8 voxels. Positions are multiples of it in the map's voxel grid only if
    ``low`` is. With a ``road`` (m, 2), metres, only subvolumes whose centre lies within ``reach``
    metres of it are described.
    """
    if stride not in (4, 8):
        raise SettingsError(f"A stride of {stride} voxels is not possible: 4 or 8.")
    span = np.argwhere(_filled(state, 0, state.shape[2]))
    if not len(span):
        return Described(np.zeros((0, 3), np.float32), np.zeros((0, encoder.latent), np.float32))
    # crop to what is occupied, with room for windows that hang over the edge, on the stride's grid
    first = np.maximum((span.min(0) - SIZE // 2) // 8 * 8, -SIZE // 2)
    size = -(-(span.max(0) + SIZE // 2 - first) // 8) * 8
    bottom_z = round((ground_z - BELOW_GROUND * voxel_size / STREET_VOXEL) / voxel_size) - int(
        low[2]
    )
    height = state.shape[2] + 2 * SIZE
    box = np.full((*(size + 2 * MARGIN), height), 253, np.uint8)
    a = np.maximum(first, 0)
    b = np.minimum(first + size, state.shape[:2])
    o = a - first + MARGIN
    box[o[0] : o[0] + b[0] - a[0], o[1] : o[1] + b[1] - a[1], SIZE : SIZE + state.shape[2]] = state[
        a[0] : b[0], a[1] : b[1]
    ]
    bottom = bottom_z + SIZE  # of layer 0 in the box
    inner = box[MARGIN:-MARGIN, MARGIN:-MARGIN]
    layer = _layers(inner, bottom, stride)
    table = code_table(encoder.variant)
    centres = []
    found = []
    has_enough = _window_sums(_filled(inner, 0, height), stride) >= min_occupied
    if road is not None:
        corners = (
            np.moveaxis(np.indices(has_enough.shape), 0, -1) * stride + first + np.asarray(low)[:2]
        )
        has_enough &= (
            cKDTree(road).query((corners + SIZE / 2) * voxel_size, distance_upper_bound=reach)[0]
            < reach
        )
    values, counts = np.unique(layer[has_enough], return_counts=True)
    for index in values[counts >= RARE * counts.sum()]:
        z = bottom + LAYER * int(index)
        if z < 0 or z + SIZE > height:
            continue
        enough = _window_sums(_filled(inner, z, z + SIZE), stride) >= min_occupied
        # corners of the windows within the inner box
        wanted = np.argwhere(enough & has_enough & (layer == index)) * stride
        if not len(wanted):
            continue
        codes = np.take(table, box[:, :, z : z + SIZE])
        out = _encode(codes, wanted, encoder, stride)
        corner = np.concatenate(
            [wanted + first, np.full((len(wanted), 1), z - SIZE)], 1
        ) + np.asarray(low)
        centres.append(corner + SIZE / 2)
        found.append(out)
    if not centres:
        return Described(np.zeros((0, 3), np.float32), np.zeros((0, encoder.latent), np.float32))
    return Described(np.concatenate(centres).astype(np.float32), np.concatenate(found))


def _encode(codes: U8, wanted: NDArray[np.int64], encoder: Encoder, stride: int) -> F32:
    """Descriptors (n, latent) of the windows whose corners within the margin are ``wanted`` (n, 2),
    patch by patch.
    """
    out = np.zeros((len(wanted), encoder.latent), np.float32)
    phase = wanted % 8
    for dx in range(0, 8, stride):
        for dy in range(0, 8, stride):
            mine = np.flatnonzero((phase == (dx, dy)).all(1))
            patch = wanted[mine] // PATCH
            for px, py in np.unique(patch, axis=0):
                rows = mine[(patch == (px, py)).all(1)]
                corner = wanted[rows].min(0)
                extent = wanted[rows].max(0) - corner + SIZE + 2 * MARGIN
                part = np.ascontiguousarray(
                    codes[corner[0] : corner[0] + extent[0], corner[1] : corner[1] + extent[1]]
                )
                with torch.autocast("cpu", dtype=torch.bfloat16):
                    mu = encoder(torch.from_numpy(part)[None])
                grid = (wanted[rows] - corner) // 8
                out[rows] = descriptors(mu[:, :, grid[:, 0], grid[:, 1]].unsqueeze(3)).numpy()
    return out
