"""Descriptors of all occupied subvolumes of a map by the paper's network (3.3)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from semloc_logs.arrays import F32, I64, U8
from semloc_logs.subvolumes.cut import SIZE, code_table, plain_name
from semloc_logs.subvolumes.describe import Described
from semloc_logs.subvolumes.plain_network import PlainEncoder
from semloc_logs.subvolumes.weight_files import load_weights, weights_file
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE, BlockMap

TILE = 256  # voxels along the edge of the part of a map that is in memory at once
BATCH = 64  # subvolumes that are encoded together


@lru_cache(maxsize=8)
def load_plain_encoder(variant: str, weights: Path | None = None) -> PlainEncoder:
    """The encoder of a file, or the shipped one; SettingsError when the file does not hold one of
    the paper's network.
    """
    with weights_file(plain_name(variant), weights) as path:
        encoder = load_weights(PlainEncoder, "encoder.", variant, path)
    torch.set_num_threads(1)
    return encoder


@njit(cache=True, nogil=True)
def _occupied_counts(state: U8, edge: int) -> I64:
    """Occupied voxels in each whole cube of ``edge`` voxels."""
    nx, ny, nz = state.shape
    out = np.zeros((nx // edge, ny // edge, nz // edge), np.int64)
    for x in range(out.shape[0] * edge):
        for y in range(out.shape[1] * edge):
            column = state[x, y]
            for k in range(out.shape[2]):
                count = np.uint32(0)
                for z in range(k * edge, (k + 1) * edge):
                    count += (column[z] != FREE_STATE) & (column[z] != UNOBSERVED_STATE)
                out[x // edge, y // edge, k] += count
    return out


def _occupied_sums(state: U8, stride: int) -> I64:
    """Occupied voxels in each 32^3 window, every ``stride`` voxels."""
    edge = math.gcd(stride, SIZE)
    sums = np.pad(_occupied_counts(state, edge), ((1, 0),) * 3)
    for axis, length in enumerate(state.shape):
        sums = sums.cumsum(axis)
        starts = np.arange(0, length - SIZE + 1, stride) // edge
        sums = sums.take(starts + SIZE // edge, axis) - sums.take(starts, axis)
    return sums


@njit(cache=True, nogil=True)
def _looked_up(state: U8, table: U8) -> U8:
    """``table[state]``, four times as fast."""
    out = np.empty(state.shape, np.uint8)
    flat = out.ravel()
    for k, value in enumerate(state.ravel()):
        flat[k] = table[value]
    return out


def occupied_windows(state: U8, low: NDArray[np.integer], stride: int, least: int) -> I64:
    """Corners (n, 3), voxels of the map, of the 32^3 windows with ``least`` occupied voxels.

    They lie on multiples of ``stride`` and within the box ``state``, whose corner ``low`` is one.
    """
    if min(state.shape) < SIZE:
        return np.zeros((0, 3), np.int64)
    return np.argwhere(_occupied_sums(state, stride) >= least) * stride + np.asarray(low, np.int64)


@torch.inference_mode()
def describe_windows(state: U8, corners: I64, encoder: PlainEncoder) -> F32:
    """Descriptors mu (n, latent) of the windows of ``state`` at ``corners`` (n, 3) in it."""
    codes = _looked_up(state, code_table(encoder.variant))
    out = np.zeros((len(corners), encoder.latent), np.float32)
    # the first block pools two voxels along each axis
    odd = corners % 2
    for shift in np.unique(odd, axis=0):
        rows = np.flatnonzero((odd == shift).all(1))
        x, y, z = shift.tolist()
        descriptors = encoder.of_windows(codes[x:, y:, z:], corners[rows] - shift, BATCH)
        out[rows] = torch.cat([*descriptors]).numpy()
    return out


def describe_box(
    state: U8, low: NDArray[np.integer], stride: int, least: int, encoder: PlainEncoder
) -> Described:
    """All occupied subvolumes of the box ``state``, whose corner is at voxel ``low``.

    Windows may reach over its edges. The descriptors are mu, of any length.
    """
    start = np.floor((np.asarray(low) - SIZE + 1) / stride).astype(np.int64) * stride
    before = np.asarray(low, np.int64) - start
    padding = [(int(b), SIZE + stride) for b in before]
    box = np.pad(state, padding, constant_values=UNOBSERVED_STATE)
    corners = occupied_windows(box, start, stride, least)
    vectors = describe_windows(box, corners - start, encoder)
    return Described((corners + SIZE / 2).astype(np.float32), vectors)


def describe_blocks(
    blocks: BlockMap,
    stride: int,
    least: int,
    encoder: PlainEncoder,
    road: tuple[NDArray[np.floating], float] | None = None,
) -> Described:
    """All occupied subvolumes of a map; with a ``road``, its places (m, 2) and a distance, those
    whose centre is so near to it. Lengths are in voxels.
    """
    parts = [
        Described(np.zeros((0, 3), np.float32), np.zeros((0, encoder.latent), np.float32)),
        *_tiles(blocks, stride, least, encoder, road),
    ]
    return Described(
        np.concatenate([p.centre for p in parts]), np.concatenate([p.descriptor for p in parts])
    )


def _tiles(
    blocks: BlockMap,
    stride: int,
    least: int,
    encoder: PlainEncoder,
    road: tuple[NDArray[np.floating], float] | None,
) -> Iterator[Described]:
    low, high = (bound.astype(np.int64) for bound in blocks.bounds())
    start = np.floor((low - SIZE + 1) / stride).astype(np.int64) * stride
    tree = None if road is None else cKDTree(road[0])
    step = TILE // stride * stride
    height = int(high[2] - start[2]) + SIZE + stride
    for x in range(int(start[0]), int(high[0]), step):
        for y in range(int(start[1]), int(high[1]), step):
            corner = np.array([x, y, start[2]])
            if tree is not None and road is not None:
                away, _ = tree.query(corner[:2] + step / 2)
                if away > road[1] + step:
                    continue
            # windows that begin in this tile
            wide = step - stride + SIZE
            state = blocks.dense(corner, (wide, wide, height))
            corners = occupied_windows(state, corner, stride, least)
            if tree is not None and road is not None and len(corners):
                away, _ = tree.query(corners[:, :2] + SIZE / 2)
                corners = corners[away <= road[1]]
            if len(corners):
                vectors = describe_windows(state, corners - corner, encoder)
                yield Described((corners + SIZE / 2).astype(np.float32), vectors)
