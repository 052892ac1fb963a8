"""Voxels drawn as lit cubes in parallel projection, without a screen.

Faces are sorted by depth; faces that look away are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64, U8
from semloc_logs.numerics.transforms import apply

SHARPER = 2  # drawn so many times as large, and reduced
LIGHT = np.array([0.3, 0.45, 0.85])  # to the right, towards the viewer over the ground, up
AT_ONCE = 1 << 15  # faces
SHADOW = 0.45  # how dark it is behind an edge of depth
AXES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])


@dataclass(frozen=True, slots=True, eq=False)
class Solid:
    """Voxels ``ijk`` (n, 3) of a grid with edge ``size`` (m) and RGB colours (n, 3).

    ``map_T_grid`` (4, 4) lays the grid into the map.
    """

    ijk: NDArray[np.int32]
    rgb: U8
    size: float
    map_T_grid: F64

    @property
    def centres(self) -> F64:
        """Centres (n, 3) in the map, metres."""
        return apply(self.map_T_grid, (self.ijk + 0.5) * self.size)


@dataclass(frozen=True, slots=True)
class View:
    """A parallel view from ``azimuth``, ``elevation`` (rad) onto the point ``at`` (x, y, z).

    The picture has ``width`` x ``height`` pixels that are ``metres`` wide.
    """

    azimuth: float
    elevation: float
    at: tuple[float, float, float]
    width: int
    height: int
    metres: float

    @property
    def axes(self) -> F64:
        """Unit vectors (3, 3) in the map: to the right, up, towards the viewer."""
        c = np.cos(self.azimuth)
        s = np.sin(self.azimuth)
        towards = np.array(
            [c * np.cos(self.elevation), s * np.cos(self.elevation), np.sin(self.elevation)]
        )
        right = np.array([-s, c, 0.0])
        return np.stack([right, np.cross(towards, right), towards])

    def pixels(self, points: F64) -> F64:
        """Pixels (n, 2) and, as a third column, metres towards the viewer of ``points`` (n, 3)."""
        seen = (np.asarray(points, float).reshape(-1, 3) - self.at) @ self.axes.T
        return np.stack(
            [
                self.width / 2 + seen[:, 0] / self.metres,
                self.height / 2 - seen[:, 1] / self.metres,
                seen[:, 2],
            ],
            1,
        )


def top_view(point: tuple[float, float, float], width: int, height: int, metres: float) -> View:
    """From above, x to the right and y up."""
    return View(-np.pi / 2, np.pi / 2, point, width, height, metres)


def draw_solids(solids: Sequence[Solid], view: View) -> U8:
    """RGB picture (height, width, 3), white where there is nothing."""
    large = View(
        view.azimuth,
        view.elevation,
        view.at,
        view.width * SHARPER,
        view.height * SHARPER,
        view.metres / SHARPER,
    )
    image = np.full((large.height, large.width, 3), 255, np.uint8)
    depth = np.full((large.height, large.width), -np.inf, np.float32)  # metres towards the viewer
    parts = [p for solid in solids for p in _faces(solid, large)]
    if parts:
        centre, edges, rgb = (np.concatenate([p[k] for p in parts]) for k in range(3))
        order = np.argsort(centre[:, 2], kind="stable")
        steps = int(np.ceil(max(s.size for s in solids) / large.metres * 1.5)) + 1
        for first in range(0, len(order), AT_ONCE):
            rows = order[first : first + AT_ONCE]
            _paint(image, depth, (centre[rows], edges[rows], rgb[rows]), steps)
    image = _with_edges(image, depth, 2 * max((s.size for s in solids), default=1.0))
    return np.asarray(
        cv2.resize(image, (view.width, view.height), interpolation=cv2.INTER_AREA), np.uint8
    )


def _faces(solid: Solid, view: View) -> list[tuple[F64, F64, F64]]:
    """The visible faces on each side of the voxels.

    Centres (n, 3) in pixels and depth, edges (n, 2, 2) in pixels, shaded colours (n, 3).
    """
    out: list[tuple[F64, F64, F64]] = []
    if not len(solid.ijk):
        return out
    low = solid.ijk.min(0) - 1
    span = np.ptp(solid.ijk, axis=0) + 3
    filled = np.zeros(span, bool)
    filled[tuple((solid.ijk - low).T)] = True
    rotation = solid.map_T_grid[:3, :3]
    middle = view.pixels(solid.centres)
    level = np.array([np.cos(view.azimuth), np.sin(view.azimuth), 0.0])
    light = LIGHT / np.linalg.norm(LIGHT) @ np.stack([view.axes[0], level, [0.0, 0.0, 1.0]])
    for axis in AXES:
        normal = rotation @ axis
        if normal @ view.axes[2] < 0.02:
            continue
        shows = ~filled[tuple((solid.ijk - low + axis).T)]
        edges = rotation[:, axis == 0].T @ view.axes[:2].T * solid.size / view.metres * [1, -1]
        off = (normal * solid.size / 2) @ view.axes.T / [view.metres, -view.metres, 1]
        bright = 0.58 + 0.5 * max(0.0, float(normal @ light))
        n = int(shows.sum())
        out.append(
            (
                middle[shows] + off,
                np.broadcast_to(edges, (n, 2, 2)),
                np.minimum(solid.rgb[shows] * bright, 255),
            )
        )
    return out


def _paint(image: U8, depth: NDArray[np.float32], faces: tuple[F64, F64, F64], steps: int) -> None:
    """Faces, the farthest first, as grids of ``steps`` x ``steps`` points."""
    centre, edges, rgb = faces
    a, b = (g.ravel() for g in np.meshgrid(*[np.linspace(-0.5, 0.5, steps)] * 2))
    xy = centre[:, None, :2] + a[:, None] * edges[:, None, 0] + b[:, None] * edges[:, None, 1]
    x = np.floor(xy[..., 0]).astype(np.int64)
    y = np.floor(xy[..., 1]).astype(np.int64)
    inside = (x >= 0) & (y >= 0) & (x < image.shape[1]) & (y < image.shape[0])
    face, _ = np.nonzero(inside)  # of equal indices the last assignment stays: the nearest face
    pixel = y[inside] * image.shape[1] + x[inside]
    image.reshape(-1, 3)[pixel] = rgb[face].astype(np.uint8)
    depth.reshape(-1)[pixel] = centre[face, 2]


def _with_edges(image: U8, depth: NDArray[np.float32], reach: float) -> U8:
    """Darker beside something nearer: eye-dome lighting (Boucheny 2009).

    ``reach`` is the largest difference of depth that counts, metres.
    """
    padded = np.pad(depth, SHARPER, mode="edge")
    shade = np.zeros(depth.shape, np.float32)
    height, width = depth.shape
    offsets = [(0, 1), (1, 2), (2, 1), (1, 0), (0, 0), (0, 2), (2, 0), (2, 2)]
    for dy, dx in offsets:
        beside = padded[dy * SHARPER : dy * SHARPER + height, dx * SHARPER : dx * SHARPER + width]
        with np.errstate(invalid="ignore"):
            shade += np.clip(
                np.nan_to_num(beside - depth, nan=0.0, posinf=0.0, neginf=0.0) / reach, 0, 1
            )
    dark = 1 - SHADOW * np.minimum(shade / 3, 1)
    return np.asarray(
        np.where(np.isfinite(depth)[..., None], image * dark[..., None], 255), np.uint8
    )
