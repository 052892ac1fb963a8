"""A bird's-eye picture of a session map: class colours shaded by height, the drive, a scale bar and
a legend.

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

from semloc_logs.labels.space import GROUND, UNLABELLED, cityscapes
from semloc_logs.pictures.lettering import Sheet
from semloc_logs.tables.atomic_files import replacing_file
from semloc_logs.tables.table import read_table
from semloc_logs.voxels.keys import BLOCK

# pixels along the longer edge: small maps are enlarged to the first, large ones reduced to the
# second
SMALL, LARGE = 1400, 3600
TRACK = (214, 39, 40)
START = (20, 120, 50)
# what labels from geometry can tell
GEOMETRY_NAMES = {0: "ground", 2: "wall-like", 5: "pole-like", 8: "vegetation-like"}
NOTHING = np.iinfo(np.int32).min
STRAY = 0.001  # this share of the voxels may lie beyond each edge of the picture
STRIP = 128  # rows of pixels that are shaded at once
HEADROOM = 2  # voxels above the sensor that are drawn indoors

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
U8 = NDArray[np.uint8]


def colour_table() -> U8:
    """RGB (256, 3) of class ids: those of Cityscapes, but ground in light greys, for the rest to
    stand out.
    """
    table = np.full((256, 3), 176, np.uint8)
    table[: len(cityscapes().colours)] = cityscapes().colours
    table[list(GROUND)] = ((196, 196, 200), (222, 214, 204), (206, 220, 194))
    # the greys are for ground
    table[2], table[5], table[UNLABELLED] = (104, 92, 92), (148, 84, 176), (150, 166, 190)
    return table


@dataclass(slots=True, eq=False)
class Canvas:
    """The highest voxel over each pixel: ``top`` (height, width) its z, ``label`` (height, width)
    its class.

    ``low`` (2,) is the voxel at the left and bottom, ``step`` how many voxels a pixel is wide.
    """

    low: NDArray[np.int64]
    step: int
    top: I32
    label: U8

    @classmethod
    def over(cls, low: NDArray[np.int64], high: NDArray[np.int64], step: int) -> Canvas:
        """An empty canvas over the voxels from ``low`` (2,) to before ``high`` (2,)."""
        width, height = (int(n) for n in -(-(high - low) // step))
        return cls(
            low,
            step,
            np.full((height, width), NOTHING, np.int32),
            np.full((height, width), UNLABELLED, np.uint8),
        )

    def add(self, ijk: I32, label: U8) -> None:
        """Draw voxels (n, 3); over one pixel the highest shows, among equals the one with the
        lowest class id.
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
        self.top[row[wins], x[wins]], self.label[row[wins], x[wins]] = z[wins], label[wins]

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Pixels (height, width) that show anything."""
        return self.top > NOTHING

    def classes(self) -> list[int]:
        """Class ids that show, the most frequent first."""
        counts = np.bincount(self.label[self.seen], minlength=256)
        return sorted(np.flatnonzero(counts).tolist(), key=lambda c: (-counts[c], c))

    def image(self) -> U8:
        """RGB (height, width, 3): white where nothing was observed, lighter the higher, lit from
        the upper left. Strip by strip, because a large map has ten million pixels.
        """
        out = np.full((*self.top.shape, 3), 255, np.uint8)
        z = self.top[self.seen]
        if not len(z):
            return out
        heights = np.cumsum(np.bincount(z - z.min()))
        bottom, top = (
            int(np.searchsorted(heights, share * len(z))) + int(z.min()) for share in (0.02, 0.98)
        )
        for row in range(0, len(out), STRIP):
            strip = slice(row, row + STRIP)
            above = np.vstack(
                [self.top[row - 1] if row else self.top[:1] * 0 + NOTHING, self.top[strip]]
            )
            out[strip] = _shaded(above.astype(np.float32), self.label[strip], bottom, top)
        return out


def _shaded(z: NDArray[np.float32], label: U8, bottom: float, top: float) -> U8:
    """RGB (n, width, 3) of pixels of height ``z`` (n + 1, width), the row above them first, and
    class ``label`` (n, width).
    """
    seen = z > NOTHING
    share = np.clip((z[1:] - bottom) / max(top - bottom, 1.0), 0, 1)
    bright = np.where(np.isin(label, GROUND), 0.92 + 0.12 * share, 0.75 + 0.45 * share)
    bright += 0.03 * np.where(seen[1:] & seen[:-1], np.clip(z[1:] - z[:-1], -3, 3), 0)
    bright[:, 1:] += 0.03 * np.where(
        seen[1:, 1:] & seen[1:, :-1], np.clip(z[1:, 1:] - z[1:, :-1], -3, 3), 0
    )
    shaded = np.clip(colour_table()[label] * bright[:, :, None], 0, 250).astype(np.uint8)
    return np.where(seen[1:, :, None], shaded, np.uint8(255))


@dataclass(frozen=True, slots=True)
class Caption:
    """What is written beside the map."""

    session: str
    label_source: str
    voxel_size: float


def draw_map(voxels: Path, trajectory: NDArray[np.floating], caption: Caption, path: Path) -> None:
    """PNG of the tables in ``voxels``, x to the right and y up, with the drive ``trajectory`` (n,
    3), metres in the map frame.

    Indoors, where most of the drive is under something, what is higher than the sensor is left out.
    """
    size = caption.voxel_size
    track = np.asarray(trajectory, float).reshape(-1, 3) / size
    low, high = _extent(voxels, track)
    step = max(1, -(-int((high - low).max()) // LARGE))
    canvas = Canvas.over(low, high, step)
    for ijk, label in _rows(voxels):
        canvas.add(ijk, label)
    indoors = _is_roofed(canvas, track, size)
    if indoors:
        canvas = Canvas.over(low, high, step)
        ceiling = cKDTree(track[:, :2])
        for ijk, label in _rows(voxels):
            below = ijk[:, 2] <= _nearest_height(ceiling, track, ijk) + HEADROOM
            canvas.add(ijk[below], label[below])
    zoom = max(1, SMALL // max(canvas.top.shape))
    picture = np.asarray(
        cv2.resize(canvas.image(), None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST),
        np.uint8,
    )
    metres = size * step / zoom
    sheet = Sheet(picture)
    line = np.stack(
        [
            (track[:, 0] - low[0]) / step * zoom,
            picture.shape[0] - (track[:, 1] - low[1]) / step * zoom,
        ],
        1,
    )
    sheet.drive(line, TRACK, START)
    colours = colour_table()
    names = cityscapes().names
    if caption.label_source == "geometry":
        names = tuple(GEOMETRY_NAMES.get(i, name) for i, name in enumerate(names))
    legend = [
        (names[c] if c < len(names) else "class unknown", colours[c]) for c in canvas.classes()
    ]
    road = float(np.linalg.norm(np.diff(track, axis=0), axis=1).sum()) * size
    extent = (high - low) * size
    facts = [
        f"labels: {caption.label_source}",
        f"voxels: {size:g} m",
        f"area: {extent[0]:.4g} m x {extent[1]:.4g} m",
        f"drive: {road:.4g} m" if len(track) else "no poses",
        *(["cut at the height of the sensor"] if indoors else []),
    ]
    image = sheet.finish(caption.session, facts, legend, metres)
    with replacing_file(path) as temporary:
        _, data = cv2.imencode(".png", image[:, :, ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 6])
        temporary.write_bytes(data.tobytes())


def _rows(voxels: Path) -> Iterator[tuple[I32, U8]]:
    """Voxels (n, 3) and classes (n,), tile by tile."""
    for path in sorted(voxels.rglob("*.parquet")):
        table = read_table(path, ["ix", "iy", "iz", "label"])
        yield (
            np.stack([table[c].to_numpy() for c in ("ix", "iy", "iz")], 1),
            table["label"].to_numpy(),
        )


def _extent(voxels: Path, track: F64) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The voxels (2,) from and to which to draw: all of the drive, and of the map but for a few
    strays.
    """
    counts: tuple[Counter[int], Counter[int]] = (Counter(), Counter())
    for ijk, _ in _rows(voxels):
        for axis, count in enumerate(counts):
            cells, n = np.unique(ijk[:, axis] // 8, return_counts=True)
            count.update(dict(zip(cells.tolist(), n.tolist(), strict=True)))
    low = np.zeros(2, np.int64)
    high = np.zeros(2, np.int64)
    for axis, count in enumerate(counts):
        cells = np.array(sorted(count), np.int64)
        share = np.cumsum([count[c] for c in cells.tolist()]) / max(count.total(), 1)
        ends = (
            [
                cells[np.searchsorted(share, STRAY)] * 8,
                cells[np.searchsorted(share, 1 - STRAY)] * 8 + 8,
            ]
            if len(cells)
            else [0, 1]
        )
        if len(track):
            ends = [
                min(ends[0], int(np.floor(track[:, axis].min()))),
                max(ends[1], int(np.floor(track[:, axis].max())) + 1),
            ]
        low[axis], high[axis] = ends
    border = max(4, int((high - low).max()) // 40)
    return low - border, high + border


def _is_roofed(canvas: Canvas, track: F64, voxel_size: float) -> bool:
    """Whether something hangs over most of the drive."""
    if not len(track):
        return False
    reach = max(1, round(3 / canvas.step))
    above = cv2.dilate(
        canvas.top.astype(np.float32), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    )
    column = np.floor((track[:, :2] - canvas.low) / canvas.step).astype(int)
    height = above[canvas.top.shape[0] - 1 - column[:, 1], column[:, 0]]
    return bool(np.mean(height > track[:, 2] + HEADROOM) > 0.5)


def _nearest_height(tree: cKDTree, track: F64, ijk: I32) -> F64:
    """The drive's height (n,) nearest to voxels (n, 3), by blocks."""
    blocks, index = np.unique(ijk[:, :2] // BLOCK, axis=0, return_inverse=True)
    return np.asarray(track[tree.query((blocks + 0.5) * BLOCK)[1], 2][index.ravel()])
