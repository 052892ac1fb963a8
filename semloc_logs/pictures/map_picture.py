"""A picture of a session map from above: classes, heights, and the drive.

Tiles are drawn one after the other onto a canvas of bounded size, so memory does not grow with the
map.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from semloc_logs.arrays import F64, I32, I64, U8
from semloc_logs.pictures.canvas import Canvas
from semloc_logs.pictures.colours import DRIVE, START, class_legend
from semloc_logs.pictures.map_marks import draw_drive, draw_grid
from semloc_logs.pictures.sheet import Lettering, Panel, Sheet
from semloc_logs.tables.table import read_table
from semloc_logs.voxels.keys import BLOCK

# pixels along the longer edge: small maps are enlarged to the first, large ones reduced to the
# second
SMALL_MAP, LARGE_MAP = 1400, 3600
STRAY = 0.001  # this share of the voxels may lie beyond each edge of the picture
STRAY_CELL = 8  # voxels by which the edges are found
HEADROOM = 2  # voxels above the sensor that are drawn indoors
ROOF_REACH = 3  # voxels around the drive in which a roof is looked for


@dataclass(frozen=True, slots=True)
class Caption:
    """The facts written beside a map; ``voxel_size`` in metres, ``period`` of the recording."""

    session: str
    label_source: str
    voxel_size: float
    period: str = ""


def draw_map(voxels: Path, trajectory: NDArray[np.floating], caption: Caption, path: Path) -> None:
    """PNG of the tables in ``voxels``, x to the right and y up, with the drive ``trajectory``.

    ``trajectory`` (n, 3) is in metres in the map frame. Indoors, where most of the drive is under
    something, voxels higher than the sensor are left out.
    """
    drive = np.asarray(trajectory, float).reshape(-1, 3) / caption.voxel_size
    low, high = _extent(voxels, drive)
    canvas, indoors = _canvas(voxels, drive, low, high)
    zoom = max(1, SMALL_MAP // max(canvas.top.shape))
    enlarged = cv2.resize(canvas.image(), None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST)
    picture = np.asarray(enlarged, np.uint8)

    facts = _facts(drive, high - low, caption)
    if indoors:
        facts.append("cut at the height of the sensor")
    legend = class_legend(canvas.label[canvas.seen], caption.label_source)
    metres = caption.voxel_size * canvas.step / zoom
    sheet = Sheet([[Panel(picture)]], Lettering(caption.session, facts, legend, metres))

    left, lower = (low * caption.voxel_size).tolist()
    draw_grid(sheet.axes[0][0], (left, lower), metres)
    pixels = (drive[:, :2] - low) / canvas.step * zoom
    pixels[:, 1] = picture.shape[0] - pixels[:, 1]
    draw_drive(sheet.axes[0][0], pixels, DRIVE, START)
    sheet.save(path)


def bare_map(voxels: Path, drive: F64, most: int) -> tuple[Canvas, bool]:
    """The map without letters, at most ``most`` pixels along an edge; ``drive`` (n, 3) in voxels.

    The second value tells whether it was cut because the drive is indoors.
    """
    return _canvas(voxels, drive, *_extent(voxels, drive), most)


def _canvas(
    voxels: Path, drive: F64, low: I64, high: I64, most: int = LARGE_MAP
) -> tuple[Canvas, bool]:
    """The map from ``low`` to ``high``, and whether it was cut because the drive is indoors."""
    step = max(1, -(-int((high - low).max()) // most))
    canvas = Canvas.over(low, high, step)
    for ijk, label in _rows(voxels):
        canvas.add(ijk, label)
    if not _is_roofed(canvas, drive):
        return canvas, False
    canvas = Canvas.over(low, high, step)
    tree = cKDTree(drive[:, :2])
    for ijk, label in _rows(voxels):
        below = ijk[:, 2] <= _nearest_height(tree, drive, ijk) + HEADROOM
        canvas.add(ijk[below], label[below])
    return canvas, True


def _facts(drive: F64, extent: I64, caption: Caption) -> list[str]:
    """Facts of the map; ``drive`` (n, 3) and ``extent`` (2,) in voxels."""
    size = caption.voxel_size
    length = float(np.linalg.norm(np.diff(drive, axis=0), axis=1).sum()) * size
    width, height = (extent * size).tolist()
    return [
        *([caption.period] if caption.period else []),
        f"labels: {caption.label_source}",
        f"voxels: {size:g} m",
        f"area: {width:.4g} m x {height:.4g} m",
        f"drive: {length:.4g} m" if len(drive) else "no poses",
    ]


def _rows(voxels: Path) -> Iterator[tuple[I32, U8]]:
    """Voxels (n, 3) and classes (n,), tile by tile."""
    for path in sorted(voxels.rglob("*.parquet")):
        table = read_table(path, ["ix", "iy", "iz", "label"])
        yield (
            np.stack([table[c].to_numpy() for c in ("ix", "iy", "iz")], 1),
            table["label"].to_numpy(),
        )


def _extent(voxels: Path, drive: F64) -> tuple[I64, I64]:
    """The voxels (2,) from and to which to draw: the whole drive, and the map without strays."""
    counts: tuple[Counter[int], Counter[int]] = (Counter(), Counter())
    for ijk, _ in _rows(voxels):
        for axis, count in enumerate(counts):
            cells, n = np.unique(ijk[:, axis] // STRAY_CELL, return_counts=True)
            count.update(dict(zip(cells.tolist(), n.tolist(), strict=True)))
    ends = np.array([_ends(count, drive[:, axis]) for axis, count in enumerate(counts)], np.int64)
    low = ends[:, 0]
    high = ends[:, 1]
    border = max(4, int((high - low).max()) // 40)
    return low - border, high + border


def _ends(count: Counter[int], drive: F64) -> tuple[int, int]:
    """From and to which voxel along one axis; ``count`` of the voxels by cell, ``drive`` (n,)."""
    first, last = 0, 1
    if count:
        cells = np.array(sorted(count), np.int64)
        share = np.cumsum([count[c] for c in cells.tolist()]) / count.total()
        first = int(cells[np.searchsorted(share, STRAY)]) * STRAY_CELL
        last = int(cells[np.searchsorted(share, 1 - STRAY)] + 1) * STRAY_CELL
    if len(drive):
        first = min(first, int(np.floor(drive.min())))
        last = max(last, int(np.floor(drive.max())) + 1)
    return first, last


def _is_roofed(canvas: Canvas, drive: F64) -> bool:
    """Whether something hangs over most of the drive."""
    if not len(drive):
        return False
    reach = max(1, round(ROOF_REACH / canvas.step))
    window = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    above = cv2.dilate(canvas.top.astype(np.float32), window)
    column = np.floor((drive[:, :2] - canvas.low) / canvas.step).astype(int)
    height = above[canvas.top.shape[0] - 1 - column[:, 1], column[:, 0]]
    return bool(np.mean(height > drive[:, 2] + HEADROOM) > 0.5)


def below_ceiling(ijk: I32, drive: F64) -> NDArray[np.bool_]:
    """Which voxels (n, 3) a picture from above shows: indoors none higher than the sensor.

    ``drive`` (n, 3) in voxels. Indoors is where something hangs over most of the drive.
    """
    if not len(drive) or not len(ijk):
        return np.ones(len(ijk), bool)
    above = ijk[:, 2] > _nearest_height(cKDTree(drive[:, :2]), drive, ijk) + HEADROOM
    if not above.any():
        return ~above
    off, _ = cKDTree(ijk[above, :2]).query(drive[:, :2], distance_upper_bound=ROOF_REACH)
    return ~above if np.mean(np.isfinite(off)) > 0.5 else np.ones(len(ijk), bool)


def _nearest_height(tree: cKDTree, drive: F64, ijk: I32) -> F64:
    """The drive's height (n,) nearest to voxels (n, 3), by blocks."""
    blocks, index = np.unique(ijk[:, :2] // BLOCK, axis=0, return_inverse=True)
    return np.asarray(drive[tree.query((blocks + 0.5) * BLOCK)[1], 2][index.ravel()])
