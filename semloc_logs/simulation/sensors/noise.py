"""Solid noise, and numbers and patterns that follow from places alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from semloc_logs.arrays import F32, I64

Real = NDArray[np.floating] | float


@njit(cache=True, nogil=True)
def _number(a: int, b: int, c: int, seed: int) -> float:
    """A number in [0, 1) of four integers."""
    h = ((a * 73856093) ^ (b * 19349663) ^ (c * 83492791) ^ (seed * 40503)) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 0x45D9F3B) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 0x45D9F3B) & 0xFFFFFFFF
    return float(h ^ (h >> 16)) / 4294967296.0


class Octaves(NamedTuple):
    """``levels`` octaves of value noise, from lumps of ``size`` metres on.

    An octave is ``keep`` as strong and 0.47 as large as the one before; ``stretch`` is a factor on
    z.
    """

    size: float
    levels: int
    keep: float
    stretch: float = 1.0


@njit(cache=True, nogil=True)
def octaves(points: F32, footprint: F32, noise: Octaves, seed: int) -> F32:
    """Value noise (n,) at ``points`` (n, 3).

    An octave fades where its lumps are as small as ``footprint`` (n,), so that pictures do not
    flicker. Source: Ebert et al., Texturing and Modeling, chapter 2.
    """
    size, count, keep, stretch = noise
    out = np.zeros(len(points), np.float32)
    for n in range(len(points)):
        strength = 1.0
        lump = size
        total = 0.0
        for octave in range(count):
            visible = min(1.0, 0.6 * lump / footprint[n] - 0.5)
            if visible <= 0.0:
                break
            x = points[n, 0] / lump
            y = points[n, 1] / lump
            z = points[n, 2] * stretch / lump
            i = int(np.floor(x))
            j = int(np.floor(y))
            k = int(np.floor(z))
            u = x - i
            v = y - j
            w = z - k
            u = u * u * (3 - 2 * u)
            v = v * v * (3 - 2 * v)
            w = w * w * (3 - 2 * w)
            value = 0.0
            for c in range(2):
                for b in range(2):
                    weight = (w if c else 1 - w) * (v if b else 1 - v)
                    low = _number(i, j + b, k + c, seed + octave)
                    high = _number(i + 1, j + b, k + c, seed + octave)
                    value += weight * (low + (high - low) * u)
            total += strength * visible * (2 * value - 1)
            strength *= keep
            lump *= 0.47
        out[n] = total
    return out


def number(a: I64 | int, b: I64 | int, seed: I64 | int) -> F32:
    """Numbers in [0, 1) that follow from integers; arrays are broadcast."""
    h = (
        np.multiply(a, 73856093) ^ np.multiply(b, 19349663) ^ np.multiply(seed, 40503)
    ) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 0x45D9F3B) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 0x45D9F3B) & 0xFFFFFFFF
    return np.asarray((h ^ (h >> 16)) / 4294967296.0, np.float32)


def cell(value: NDArray[np.floating], size: Real) -> I64:
    """The number of the stretch of ``size`` metres that a coordinate lies in."""
    return np.asarray(np.floor(value / size), np.int64)


def within(
    value: NDArray[np.floating], low: Real, high: Real, footprint: NDArray[np.floating]
) -> F32:
    """How much of a pixel lies between two edges, from 0 to 1."""
    soft = np.maximum(footprint, np.float32(1e-3))
    return np.asarray(
        np.clip((value - low) / soft + 0.5, 0, 1) * np.clip((high - value) / soft + 0.5, 0, 1),
        np.float32,
    )


class Stone(NamedTuple):
    """Length and height of a stone in a course, and width of the joints, in metres."""

    length: float
    height: float
    joint: float


def stones(
    u: NDArray[np.floating],
    v: NDArray[np.floating],
    stone: Stone,
    footprint: F32,
    seed: I64 | int,
) -> tuple[F32, F32]:
    """Courses of stones in the plane (u, v) in metres.

    The share of joint (0 to 1) in a pixel, and the tone (-1 to 1) of the stone.
    """
    length, height, joint = stone
    row = cell(v, height)
    shifted = u + 0.5 * length * (row & 1)
    column = cell(shifted, length)
    a = shifted - column * length
    b = v - row * height
    inside = within(a, joint / 2, length - joint / 2, footprint) * within(
        b, joint / 2, height - joint / 2, footprint
    )
    sharp = np.clip(2.0 - 2.0 * footprint / height, 0, 1)
    inside = sharp * inside + (1 - sharp) * (1 - joint / height)
    return np.asarray(1 - inside, np.float32), np.asarray(
        sharp * (2 * number(column, row, seed) - 1), np.float32
    )


def letters(
    u: NDArray[np.floating], v: NDArray[np.floating], size: float, footprint: F32, seed: I64 | int
) -> F32:
    """Blocks like letters and numbers: 1 on the ink."""
    ink = number(cell(u, size), cell(v, size), seed) < 0.45
    return np.where(footprint > 0.7 * size, np.float32(0.4), ink.astype(np.float32))
