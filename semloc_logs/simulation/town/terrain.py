"""The ground of a street world: smooth slopes, carriageways, kerbs, pavements and lawns on a raster
of half a metre.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from semloc_logs.arrays import F64
from semloc_logs.simulation.meshes.world import ROAD, SIDEWALK, TERRAIN, Mesh
from semloc_logs.simulation.town.relief import Relief
from semloc_logs.simulation.town.road_network import RoadNetwork

CELL = 0.5  # m; kerbs are exact to half of it
MARGIN = 48.0  # m of ground beside a road
KERB = 0.12  # m
STEEPEST = 0.08  # slope of a road without a survey
_BANKS = (0.0, 0.0, 0.0, 0.06, 0.15, 0.28, -0.06, -0.2)  # slopes beside roads
_DEPTH = 0.5  # m of the ditches
CLEAR = 1.4  # m to either side of a driven line


@dataclass(slots=True, eq=False)
class Ground:
    """Heights and kinds of ground around a network; ``free`` is what still may be built upon."""

    network: RoadNetwork
    rng: np.random.Generator
    corner: F64 = field(init=False)
    kind: NDArray[np.uint8] = field(init=False)  # ROAD, SIDEWALK, TERRAIN; 255 = no ground
    # metres from the edge of the carriageway, negative on it
    beside: NDArray[np.float32] = field(init=False)
    free: NDArray[np.bool_] = field(init=False)
    # terrain that is stone or asphalt: drives, yards, squares
    paved: NDArray[np.bool_] = field(init=False)
    dug: NDArray[np.bool_] = field(init=False)  # dug up by roadworks
    closed: NDArray[np.bool_] = field(init=False)  # sites of roadworks
    covered: NDArray[np.bool_] = field(init=False)  # under bridges
    clear: NDArray[np.bool_] = field(init=False)  # lanes that are driven: nothing may stand there
    _waves: F64 = field(init=False)
    _bank: tuple[float, float] = field(init=False)
    _relief: Relief | None = field(init=False)

    def __post_init__(self) -> None:
        lines = [r.path for r in (*self.network.roads, *self.network.stubs)]
        everything = np.concatenate(
            [*lines, *([self.network.survey[:, :2]] if self.network.survey is not None else [])]
        )
        self.corner = everything.min(0) - MARGIN
        shape = np.ceil((everything.max(0) + MARGIN - self.corner) / CELL).astype(int)
        beside = np.full(shape, np.inf, np.float32)
        walk = np.full(shape, np.inf, np.float32)
        self.clear = np.zeros(shape, np.bool_)
        for road in (*self.network.roads, *self.network.stubs):
            window, distance = self._near(road.path, shape)
            beside[window] = np.minimum(beside[window], distance - road.half_width)
            walk[window] = np.minimum(walk[window], distance - road.half_width - road.sidewalk)
            self.clear[window] |= np.abs(distance - road.lane) < CLEAR
        if self.network.survey is not None:
            for line in np.array_split(
                self.network.survey[:, :2], max(1, len(self.network.survey) // 200)
            ):
                window, distance = self._near(line, shape)
                beside[window] = np.minimum(beside[window], distance - CLEAR - 0.4)
                self.clear[window] |= distance < CLEAR
        rounds = [(c, *self._near(np.array([[c.x, c.y]]), shape)) for c in self.network.circles]
        for circle, window, distance in rounds:
            if circle.outer:
                beside[window] = np.minimum(beside[window], distance - circle.outer)
                walk[window] = np.minimum(walk[window], distance - circle.outer - 2.0)
        self.beside = _rounded_corners(beside)
        # islands last, for rounding the corners would close small ones
        for circle, window, distance in rounds:
            if circle.inner:
                self.beside[window] = np.maximum(self.beside[window], circle.inner - distance)
                walk[window] = np.where(
                    distance < circle.inner, 1.0 if circle.inner > 1.5 else -1.0, walk[window]
                )
            if circle.outer and circle.inner:
                self.clear[window] = np.where(
                    distance < circle.outer,
                    np.abs(distance - circle.lane) < CLEAR,
                    self.clear[window],
                )
        kind = np.where(self.beside < 0, ROAD, np.where(walk < 0, SIDEWALK, TERRAIN))
        self.kind = np.where(self.beside > MARGIN, 255, kind).astype(np.uint8)
        self.free = self.kind == TERRAIN
        self.paved, self.dug, self.closed, self.covered = (
            np.zeros_like(self.free) for _ in range(4)
        )
        wavelength = self.rng.uniform([25, 60, 90, 150], [60, 120, 200, 400])
        slope = self.rng.uniform(0, [0.006, 0.012, 0.02, 0.03])
        angle, phase = self.rng.uniform(0, 2 * np.pi, (2, 4))
        steep = 0.0 if self.network.level else float(self.rng.choice([0.4, 1.0, 1.0, 1.6, 2.4]))
        slope *= min(steep, STEEPEST / slope.sum())
        k = 2 * np.pi / wavelength
        self._waves = np.stack([k * np.cos(angle), k * np.sin(angle), phase, slope / k])
        self._bank = (
            float(self.rng.uniform(4, 14)),
            0.0 if self.network.level else float(self.rng.choice(_BANKS)),
        )
        self._relief = (
            None
            if self.network.survey is None
            else Relief(self.network.survey, self.corner, everything.max(0) + MARGIN)
        )

    def _near(
        self, line: F64, shape: NDArray[np.int64]
    ) -> tuple[tuple[slice, slice], NDArray[np.float32]]:
        """The part of the raster around a plan line, and the distances of its cells from the line
        (infinite beyond the margin).
        """
        low = np.clip(((line.min(0) - MARGIN - 8 - self.corner) / CELL).astype(int), 0, shape)
        high = np.clip(((line.max(0) + MARGIN + 8 - self.corner) / CELL).astype(int), 0, shape)
        x, y = np.meshgrid(
            *(self.corner[k] + CELL * (np.arange(low[k], high[k]) + 0.5) for k in (0, 1)),
            indexing="ij",
        )
        distance = cKDTree(line).query(
            np.column_stack([x.ravel(), y.ravel()]), distance_upper_bound=MARGIN + 8
        )[0]
        return np.s_[low[0] : high[0], low[1] : high[1]], distance.astype(np.float32).reshape(
            x.shape
        )

    def slope_height(self, x: F64, y: F64) -> F64:
        """Height of the carriageway's surface in metres at plan positions (n,)."""
        if self._relief is not None:
            return self._relief(x, y)
        kx, ky, phase, size = self._waves
        return np.asarray(
            (np.sin(np.multiply.outer(x, kx) + np.multiply.outer(y, ky) + phase) * size).sum(-1)
        )

    def cell(self, x: F64, y: F64) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Raster cells of plan positions (n,), kept inside."""
        i = np.clip(((x - self.corner[0]) / CELL).astype(np.int64), 0, self.kind.shape[0] - 1)
        j = np.clip(((y - self.corner[1]) / CELL).astype(np.int64), 0, self.kind.shape[1] - 1)
        return i, j

    def height(self, x: F64, y: F64) -> F64:
        """Height of the ground in metres at plan positions (n,), kerbs and banks included."""
        cell = self.cell(x, y)
        return self.slope_height(x, y) + self._step(x, y, self.kind[cell], self.beside[cell])

    def _step(self, x: F64, y: F64, kind: NDArray[np.uint8], beside: NDArray[np.float32]) -> F64:
        start, bank = self._bank
        rough = (
            (0.0 if self.network.level else 0.05)
            * (np.sin(1.1 * x + 0.4 * y) + np.sin(0.7 * y - 0.5 * x + 1.0))
            * np.clip((beside - 3) / 6, 0, 1)
        )
        rise = bank * np.clip(beside - start, 0, 12.0) * (1 + 0.5 * np.sin(0.03 * x + 0.05 * y))
        return np.where(kind == ROAD, 0.0, KERB + np.where(kind == TERRAIN, rough + rise, 0.0))

    def _snow(
        self, x: F64, y: F64, kind: NDArray[np.uint8], beside: NDArray[np.float32], deep: float
    ) -> F64:
        """How thick the snow lies: as good as cleared off the road, heaped up along the kerb."""
        drift = 1 + 0.25 * np.sin(0.9 * x - 0.6 * y) + 0.15 * np.sin(1.7 * y + 0.4 * x)
        bank = (
            0.45
            * np.clip(0.5 + np.sin(0.21 * x + 0.17 * y), 0, 1)
            * np.clip(1 - np.abs(beside - 0.5) / 0.7, 0, 1)
        )
        return np.where(kind == ROAD, 0.02, deep * drift + bank)

    def allowed(self, points: F64) -> bool:
        """Whether all plan points (n, 2) are free ground."""
        return bool(self.free[self.cell(points[:, 0], points[:, 1])].all())

    def on_road(self, x: float, y: float) -> bool:
        """Whether a plan position is carriageway, at its very edge, or under a bridge."""
        cell = self.cell(np.array([x]), np.array([y]))
        return bool(self.beside[cell][0] < 0.15 or self.covered[cell][0])

    def cover(self, points: F64) -> None:
        """Mark plan points (n, 2) as lying under a bridge, where nothing grows."""
        self.covered[self.cell(points[:, 0], points[:, 1])] = True

    def is_closed(self, x: float, y: float) -> bool:
        """Whether a plan position is in a site of roadworks."""
        return bool(self.closed[self.cell(np.array([x]), np.array([y]))][0])

    def close(self, points: F64) -> None:
        """Close plan points (n, 2) for roadworks."""
        self.closed[self.cell(points[:, 0], points[:, 1])] = True

    def passable(self, parts: list[tuple[Mesh, int]], headroom: float = 2.6) -> bool:
        """Whether lanes stay clear below ``headroom`` metres when a thing, z counted from the
        ground, stands where it is.
        """
        low = np.concatenate(
            [mesh.vertices[mesh.vertices[:, 2] < headroom, :2] for mesh, _ in parts]
        )
        return not self.clear[self.cell(low[:, 0], low[:, 1])].any()

    def pave(self, points: F64) -> None:
        """Make plan points (n, 2) stone or asphalt where they are not road."""
        self.paved[self.cell(points[:, 0], points[:, 1])] = True

    def take(self, points: F64) -> None:
        """Mark plan points (n, 2) as built upon."""
        self.free[self.cell(points[:, 0], points[:, 1])] = False

    def dig(self, points: F64) -> None:
        """Dig the ground up at plan points (n, 2), lanes left out."""
        cell = self.cell(points[:, 0], points[:, 1])
        self.dug[cell] = ~self.clear[cell]

    def mesh(self, snow: float = 0.0) -> tuple[Mesh, NDArray[np.uint8]]:
        """The ground with its kerbs, heights absolute, and the label of each triangle; ``snow``
        metres deep where nobody drives.
        """
        i, j = np.nonzero(self.kind != 255)
        kind = self.kind[i, j]
        dug = self.dug[i, j]
        label = np.where(self.paved[i, j] & (kind == TERRAIN), SIDEWALK, kind)
        label = np.where(dug, TERRAIN, label)
        slope = [np.asarray(np.gradient(self.beside, CELL, axis=k), np.float32) for k in (0, 1)]
        corners = np.zeros((len(i), 4, 3))
        for k, (di, dj) in enumerate(((0, 0), (1, 0), (1, 1), (0, 1))):
            x = self.corner[0] + CELL * (i + di)
            y = self.corner[1] + CELL * (j + dj)
            beside = _at_corners(self.beside, i + di, j + dj)
            # corners next to the kerb move onto it, so that it runs smooth across the raster
            shift = np.where(np.abs(beside) < 0.6 * CELL, beside, 0.0)
            x, y = (
                c - shift * _at_corners(g, i + di, j + dj)
                for c, g in zip((x, y), slope, strict=True)
            )
            up = (
                self._step(x, y, kind, beside)
                - _DEPTH * dug
                + (self._snow(x, y, kind, beside, snow) if snow else 0.0)
            )
            corners[:, k] = np.column_stack([x, y, self.slope_height(x, y) + up])
        start = 4 * np.arange(len(i), dtype=np.int64)[:, None]
        triangles = [start + np.array([0, 1, 2]), start + np.array([0, 2, 3])]
        labels = [label, label]
        number = np.full(self.kind.shape, -1, np.int64)
        number[i, j] = np.arange(len(i))
        for (a, b), (c, d), here, there in (
            ((1, 2), (0, 3), np.s_[:-1, :], np.s_[1:, :]),
            ((3, 2), (0, 1), np.s_[:, :-1], np.s_[:, 1:]),
        ):
            step = ((self.kind[here] == ROAD) != (self.kind[there] == ROAD)) | (
                self.dug[here] != self.dug[there]
            )
            step &= (number[here] >= 0) & (number[there] >= 0)
            p = 4 * number[here][step]
            q = 4 * number[there][step]
            triangles += [
                np.column_stack([p + a, p + b, q + d]),
                np.column_stack([p + a, q + d, q + c]),
            ]
            labels += [np.full(len(p), SIDEWALK, np.uint8)] * 2
        return Mesh(corners.reshape(-1, 3), np.concatenate(triangles)), np.concatenate(
            labels
        ).astype(np.uint8)


def _at_corners(
    raster: NDArray[np.float32], i: NDArray[np.int64], j: NDArray[np.int64]
) -> NDArray[np.float32]:
    """A raster at the corners (i, j) of its cells: the mean of the cells around."""
    n, m = raster.shape
    low_i = np.maximum(i - 1, 0)
    high_i = np.minimum(i, n - 1)
    low_j = np.maximum(j - 1, 0)
    high_j = np.minimum(j, m - 1)
    mean = (
        raster[low_i, low_j]
        + raster[low_i, high_j]
        + raster[high_i, low_j]
        + raster[high_i, high_j]
    ) / 4
    return np.asarray(mean, np.float32)


def _rounded_corners(beside: NDArray[np.float32], radius: float = 3.0) -> NDArray[np.float32]:
    """Close the carriageway by ``radius`` metres, so that kerbs turn round corners in an arc."""
    inside = cv2.distanceTransform((beside < radius).astype(np.uint8), cv2.DIST_L2, 5) * CELL
    closed = (inside > radius) & (beside < radius)
    return np.where(closed & (beside >= 0), np.float32(-0.01), np.minimum(beside, 1e3)).astype(
        np.float32
    )
