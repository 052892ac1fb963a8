"""What the colours of a simulated world are made from: for each piece of a world its number, place
and size, and a plan of its roads.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F32, F64, I32
from semloc_logs.simulation.meshes.world import ROAD, VEGETATION, World

_PLAN_CELL = 0.25  # m
_MOST_CELLS = 8_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """Pieces of a world: ``piece`` (m,) of each triangle; ``seed`` (p,) int64 that is the same in
    every session, ``low`` and ``high`` (p, 3) its box in metres; ``bark`` (m,) are triangles of
    plants without leaves; ``own`` (m,) int64 a number of each triangle.
    """

    piece: I32
    seed: NDArray[np.int64]
    low: F32
    high: F32
    bark: NDArray[np.bool_]
    own: NDArray[np.int64]


def surfaces(world: World, *, moving: bool = False) -> Surfaces:
    """The surfaces of a world. The number of a piece follows from its place, or with ``moving``
    from its size.
    """
    piece = (
        world.objects
        if len(world.objects) == len(world.triangles)
        else np.zeros(len(world.triangles), np.int32)
    )
    corners = world.vertices[world.triangles]
    low = corners.min(1)
    high = corners.max(1)
    starts = np.flatnonzero(np.diff(piece, prepend=-1))
    number = np.cumsum(np.diff(piece, prepend=-1) != 0, dtype=np.int32) - 1
    piece_low = np.minimum.reduceat(low, starts)
    piece_high = np.maximum.reduceat(high, starts)
    if moving:
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).sum(1)
        seed = (
            np.rint(np.add.reduceat(sides, starts, dtype=np.float64) * 20).astype(np.int64) * 7919
        )
    else:
        seed = _number(piece_low) ^ _number(piece_high)
    tall = (high[:, 2] - low[:, 2] > 0.9) & (world.labels == VEGETATION)
    return Surfaces(number, seed & 0x7FFFFFFF, piece_low, piece_high, tall, _number(low))


def _number(place: F32) -> NDArray[np.int64]:
    """A number for each place (n, 3), exact to a centimetre."""
    cells = np.rint(place * 100).astype(np.int64)
    return np.asarray((cells @ np.array([73856093, 19349663, 83492791])) & 0x7FFFFFFF)


@dataclass(frozen=True, slots=True, eq=False)
class RoadPlan:
    """Raster of the carriageways from ``corner`` (x, y) with cells of ``cell`` metres: metres from
    the kerb, and half the road's width.
    """

    corner: F64
    cell: float
    beside: F32
    half_width: F32


def road_plan(world: World) -> RoadPlan:
    """The carriageways of a world seen from above."""
    corners = world.vertices[world.triangles[world.labels == ROAD]][..., :2].astype(np.float64)
    if not len(corners):
        return RoadPlan(np.zeros(2), 1.0, np.zeros((2, 2), np.float32), np.ones((2, 2), np.float32))
    corner = corners.min((0, 1)) - 1.0
    far = corners.max((0, 1)) + 1.0
    cell = max(_PLAN_CELL, float(np.sqrt(np.prod(far - corner) / _MOST_CELLS)))
    shape = np.ceil((far - corner) / cell).astype(int)
    mask = np.zeros((shape[1], shape[0]), np.uint8)
    for start in range(0, len(corners), 20_000):
        pixels = np.rint((corners[start : start + 20_000] - corner) / cell * 16 - 8).astype(
            np.int32
        )
        for triangle in pixels:
            cv2.fillConvexPoly(mask, triangle, 1, shift=4)
    beside = cv2.GaussianBlur(
        cv2.distanceTransform(mask, cv2.DIST_L2, 5) * np.float32(cell), (0, 0), 1.0
    )
    reach = 2 * round(5.0 / cell) + 1
    widest = cv2.dilate(beside, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach)))
    half = cv2.GaussianBlur(np.where(mask > 0, widest, 0), (0, 0), 4.0) / np.maximum(
        cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 4.0), 1e-3
    )
    return RoadPlan(corner, cell, np.asarray(beside, np.float32), np.asarray(half, np.float32))


def markings(plan: RoadPlan, points: F32, footprint: F32) -> F32:
    """How much of a painted line (0 to 1) lies at points (n, 3): along the kerb, and dashed in the
    middle; ``footprint`` (n,) in metres.
    """
    cells = (points[:, :2] - plan.corner) / plan.cell - 0.5
    columns, rows = (np.ascontiguousarray(cells[:, k], np.float32)[None] for k in (0, 1))
    beside = cv2_remap(plan.beside, columns, rows)
    half = cv2_remap(plan.half_width, columns, rows)
    soft = np.maximum(footprint, 0.02)
    edge = np.clip((0.07 + soft / 2 - np.abs(beside - 0.45)) / soft, 0, 1) * np.minimum(
        1, 0.14 / soft
    )
    dash = (np.floor(points[:, 0] / 3.1) + np.floor(points[:, 1] / 3.1)) % 2 == 0
    middle = np.clip((0.16 + soft / 2 - (half - beside)) / soft, 0, 1) * np.minimum(1, 0.2 / soft)
    is_street = (half > 2.2) & (half < 5.0)
    return np.asarray(np.where(is_street, np.maximum(edge, middle * dash), 0.0), np.float32)


def cv2_remap(raster: F32, columns: F32, rows: F32) -> F32:
    """The raster between its cells at columns and rows (1, n); 0 outside."""
    out = np.zeros(columns.shape[1], np.float32)
    for start in range(0, len(out), 30_000):  # OpenCV takes pictures up to 32767 wide
        some = np.s_[:, start : start + 30_000]
        out[start : start + 30_000] = cv2.remap(
            raster, columns[some], rows[some], cv2.INTER_LINEAR
        )[0]
    return out
