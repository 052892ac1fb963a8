"""A map from above: the highest voxel over each pixel, shaded by height and lit from one side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import I32, I64, U8
from semloc_logs.labels.space import GROUND, UNLABELLED
from semloc_logs.pictures.colours import class_colours

NOTHING = np.iinfo(np.int32).min  # the height where no voxel is
STRIP = 128  # rows of pixels that are shaded at once
# heights are shaded between these shares of the pixels, so that a few outliers do not flatten them
LOW_SHARE, HIGH_SHARE = 0.02, 0.98
# brightness of the lowest pixels, and how much brighter the highest are
GROUND_BRIGHTNESS, GROUND_RANGE = 0.92, 0.12
BRIGHTNESS, RANGE = 0.75, 0.45
# added by a step of one voxel to the upper or left neighbour, up to steps of so many voxels
SLOPE_LIGHT, MOST_SLOPE = 0.03, 3
BRIGHTEST = 250  # darker than the white where nothing was observed


@dataclass(slots=True, eq=False)
class Canvas:
    """The highest voxel over each pixel: its height and its class.

    ``top`` (height, width) is the voxel's z, ``label`` (height, width) its class; ``low`` (2,) the
    voxel at the left and bottom; ``step`` the width of a pixel in voxels.
    """

    low: I64
    step: int
    top: I32
    label: U8

    @classmethod
    def over(cls, low: I64, high: I64, step: int) -> Canvas:
        """An empty canvas over the voxels from ``low`` (2,) to before ``high`` (2,)."""
        width, height = (int(n) for n in -(-(high - low) // step))
        return cls(
            low,
            step,
            np.full((height, width), NOTHING, np.int32),
            np.full((height, width), UNLABELLED, np.uint8),
        )

    def add(self, ijk: I32, label: U8) -> None:
        """Draw voxels (n, 3) with classes (n,).

        Over one pixel the highest shows, among equals the one with the lowest class id.
        """
        height, width = self.top.shape
        column = (ijk[:, :2] - self.low) // self.step
        inside = ((column >= 0) & (column < (width, height))).all(1)
        column = column[inside]
        z = ijk[inside, 2]
        label = label[inside]
        order = np.lexsort((-label.astype(int), z))
        x = column[order, 0]
        row = height - 1 - column[order, 1]
        z = z[order]
        label = label[order]
        wins = (z > self.top[row, x]) | ((z == self.top[row, x]) & (label < self.label[row, x]))
        self.top[row[wins], x[wins]] = z[wins]
        self.label[row[wins], x[wins]] = label[wins]

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Pixels (height, width) that show anything."""
        return self.top > NOTHING

    def image(self) -> U8:
        """RGB (height, width, 3): white where nothing was observed, lighter the higher.

        Strip by strip, because a large map has ten million pixels.
        """
        out = np.full((*self.top.shape, 3), 255, np.uint8)
        z = self.top[self.seen]
        if not len(z):
            return out
        heights = np.cumsum(np.bincount(z - z.min()))
        bottom, top = (
            int(np.searchsorted(heights, share * len(z))) + int(z.min())
            for share in (LOW_SHARE, HIGH_SHARE)
        )
        for row in range(0, len(out), STRIP):
            strip = slice(row, row + STRIP)
            above = np.full_like(self.top[:1], NOTHING) if row == 0 else self.top[row - 1 : row]
            z_strip = np.vstack([above, self.top[strip]]).astype(np.float32)
            out[strip] = _shaded(z_strip, self.label[strip], bottom, top)
        return out


def _shaded(z: NDArray[np.float32], label: U8, bottom: float, top: float) -> U8:
    """RGB (n, width, 3) of pixels of height ``z`` (n + 1, width) and class ``label`` (n, width).

    The first row of ``z`` is the row above the others.
    """
    seen = z > NOTHING
    share = np.clip((z[1:] - bottom) / max(top - bottom, 1.0), 0, 1)
    bright = np.where(
        np.isin(label, GROUND),
        GROUND_BRIGHTNESS + GROUND_RANGE * share,
        BRIGHTNESS + RANGE * share,
    )
    bright += _slope_light(z[1:] - z[:-1], seen[1:] & seen[:-1])
    bright[:, 1:] += _slope_light(z[1:, 1:] - z[1:, :-1], seen[1:, 1:] & seen[1:, :-1])
    shaded = np.clip(class_colours()[label] * bright[:, :, None], 0, BRIGHTEST).astype(np.uint8)
    return np.where(seen[1:, :, None], shaded, np.uint8(255))


def _slope_light(step: NDArray[np.float32], known: NDArray[np.bool_]) -> NDArray[np.float32]:
    """The brightness that a ``step`` (voxels) from one pixel to the next adds."""
    light = SLOPE_LIGHT * np.where(known, np.clip(step, -MOST_SLOPE, MOST_SLOPE), 0)
    return np.asarray(light, np.float32)
