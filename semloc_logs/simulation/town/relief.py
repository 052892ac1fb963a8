"""Smooth terrain through surveyed heights."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

from semloc_logs.arrays import F64

_CELL = 3.0  # m
_SCALES = (160.0, 40.0, 12.0, 5.0)  # m, widths of the Gaussian weights


class Relief:
    """Heights of a surface over plan positions: weighted means of surveyed heights, from far ones
    only where none are near.
    """

    def __init__(self, survey: F64, low: F64, high: F64) -> None:
        """``survey`` (n, 3) in metres; the surface reaches from ``low`` (2,) to ``high`` (2,) and
        goes on level beyond.
        """
        self._corner = np.asarray(low, np.float64) - 2 * _CELL
        shape = tuple(np.ceil((high + 4 * _CELL - self._corner) / _CELL).astype(int).tolist())
        # every height is shared out among the four nodes around it
        cells = (survey[:, :2] - self._corner) / _CELL
        weight = np.zeros(shape)
        total = np.zeros(shape)
        node = np.floor(cells).astype(int)
        part = cells - np.floor(cells)
        for di in (0, 1):
            for dj in (0, 1):
                share = np.abs(1 - di - part[:, 0]) * np.abs(1 - dj - part[:, 1])
                where = (
                    np.clip(node[:, 0] + di, 0, shape[0] - 1),
                    np.clip(node[:, 1] + dj, 0, shape[1] - 1),
                )
                np.add.at(weight, where, share)
                np.add.at(total, where, share * survey[:, 2])
        height = np.full(shape, float(survey[:, 2].mean()))
        for scale in _SCALES:
            sigma = scale / _CELL
            weights, sums = (
                gaussian_filter(a, sigma, mode="constant", truncate=3.0) for a in (weight, total)
            )
            enough = 0.02 / sigma**2  # a fraction of the weight of one point
            height = (sums + enough * height) / (weights + enough)
        self._coefficients = spline_filter(height, order=3, mode="nearest")

    def __call__(self, x: F64, y: F64) -> F64:
        """Heights (n,) in metres at plan positions (n,)."""
        cells = np.stack(
            [(np.asarray(x) - self._corner[0]) / _CELL, (np.asarray(y) - self._corner[1]) / _CELL]
        )
        return np.asarray(
            map_coordinates(self._coefficients, cells, order=3, mode="nearest", prefilter=False),
            np.float64,
        )
