"""Compact Geometric Features (Khoury et al., ICCV 2017): spherical histograms embedded to 32
dimensions by a network that is trained on pairs of incomplete and complete maps.

The frame of a keypoint has its normal, towards the sensor, as z, and the direction of most extent
across it as x. Bins are 17 along the radius, with logarithmic borders, 11 in elevation and 12 in
azimuth.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numba import njit
from scipy.spatial import cKDTree
from torch import nn
from torch.nn import functional as F

from semloc_logs.arrays import F32, F64, I64
from semloc_logs.experiments.system import View
from semloc_logs.experiments.systems.catalogue import SystemOptions
from semloc_logs.experiments.systems.level_maps import LevelMap, database_map, view_map
from semloc_logs.experiments.systems.shapes.near_points import Cells, cells_of, neighbours
from semloc_logs.experiments.systems.shapes.shape_matching import (
    STRIDE,
    Described,
    ShapeSystem,
    keypoints_of,
)
from semloc_logs.experiments.systems.shapes.training_views import Training, simulated_training
from semloc_logs.experiments.systems.trained_networks import trained
from semloc_logs.mapping.selection import thin
from semloc_logs.numerics.eigen import eigen
from semloc_logs.settings import Resolved
from semloc_logs.subvolumes.cut import SIZE as SUBVOLUME

RADIAL, ELEVATION, AZIMUTH = 17, 11, 12
SIZE = RADIAL * ELEVATION * AZIMUTH
LEAST_RADIUS = 0.1  # of the first border of the radius, in units of the radius
HIDDEN, LAYERS, EMBEDDED = 512, 5, 32
MARGIN = 1.0  # of the triplet loss
BATCH, STEPS, QUICK_STEPS, RATE = 128, 2000, 50, 1e-3
VIEWS = 100  # of the training that pairs are made of
NEAR, FAR = 2.0, 6.0  # voxels: a pair lies nearer, a negative farther
THINNED = 2.0  # voxels: of the cells that keep one point


class SphericalHistograms:
    """CGF of the centres of occupied voxels; weights are kept in ``folder``."""

    turns = False

    def __init__(self, folder: Path, *, quick: bool) -> None:
        self._folder = folder
        self._steps = QUICK_STEPS if quick else STEPS
        self._network = Embedding()

    def fit(self, training: Training, settings: Resolved) -> None:
        key = f"{training.key}-{self._steps}-{settings.fingerprint('fusion')}"
        trained(
            self._folder / f"cgf-{key}.safetensors",
            self._network,
            lambda: self._train(training.views(), settings),
        )

    def describe(self, level_map: LevelMap, yaw: float) -> Described:
        v = level_map.voxel_size
        points, normals = _thinned(level_map)
        rows = keypoints_of(points, STRIDE * v)
        histograms = spherical_histograms(points, normals, rows, SUBVOLUME / 2 * v)
        with torch.inference_mode():
            embedded = self._network(torch.from_numpy(histograms)).numpy()
        return Described(points[rows], embedded)

    def _train(self, views: Sequence[View], settings: Resolved) -> None:
        anchor, positive, place = training_pairs(views, settings)
        optimiser = torch.optim.Adam(self._network.parameters(), RATE)
        rng = np.random.default_rng(0)
        far = FAR * settings.fusion.voxel_size
        for _ in range(self._steps if len(anchor) > 1 else 0):
            rows = rng.integers(0, len(anchor), BATCH)
            others = rng.integers(0, len(anchor), BATCH)
            a = self._network(torch.from_numpy(anchor[rows]))
            p = self._network(torch.from_numpy(positive[rows]))
            n = self._network(torch.from_numpy(positive[others]))
            apart = np.linalg.norm(place[rows] - place[others], axis=1) > far
            loss = _triplet(a, p, n)[torch.from_numpy(apart)].sum() / max(1, int(apart.sum()))
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()


class Embedding(nn.Module):
    """Histograms (n, 2244) to 32 dimensions."""

    def __init__(self) -> None:
        super().__init__()
        widths = [SIZE] + [HIDDEN] * LAYERS
        layers: list[nn.Module] = []
        for a, b in pairwise(widths):
            layers += [nn.Linear(a, b), nn.ReLU()]
        self.layers = nn.Sequential(*layers, nn.Linear(HIDDEN, EMBEDDED))

    def forward(self, histograms: torch.Tensor) -> torch.Tensor:
        # shares of points are small numbers: their roots are of one order
        return F.normalize(self.layers(histograms.sqrt()), dim=1)


def training_pairs(views: Sequence[View], settings: Resolved) -> tuple[F32, F32, F64]:
    """Histograms (n, 2244) of keypoints in maps of one view, of the same places in the map of all,
    and the places (n, 3).
    """
    v = settings.fusion.voxel_size
    radius = SUBVOLUME / 2 * v
    complete, normals = _thinned(database_map(views, settings))
    tree = cKDTree(complete)
    anchors = [np.zeros((0, SIZE), np.float32)]
    positives = [np.zeros((0, SIZE), np.float32)]
    places = [np.zeros((0, 3))]
    for number in np.unique(np.linspace(0, len(views) - 1, VIEWS).astype(int)):
        points, view_normals = _thinned(view_map(views[number], settings))
        rows = keypoints_of(points, STRIDE * v)
        if not len(rows):
            continue
        distance, nearest = tree.query(points[rows], workers=1)
        is_near = distance < NEAR * v
        rows = rows[is_near]
        nearest = nearest[is_near]
        anchors.append(spherical_histograms(points, view_normals, rows, radius))
        positives.append(spherical_histograms(complete, normals, nearest, radius))
        places.append(points[rows])
    return np.concatenate(anchors), np.concatenate(positives), np.concatenate(places)


def spherical_histograms(points: F64, normals: F64, keypoints: I64, radius: float) -> F32:
    """Histograms (k, 2244), shares of the points within ``radius`` metres, of the ``keypoints``,
    rows of ``points`` (n, 3) with unit ``normals`` (n, 3).
    """
    if not len(points) or not len(keypoints):
        return np.zeros((len(keypoints), SIZE), np.float32)
    rows = np.asarray(keypoints, np.int64)
    return _histograms(points, normals, cells_of(points, radius), rows, radius)


@njit(cache=True, nogil=True)
def _frame(offsets: F64, normal: F64) -> F64:
    """Axes (3, 3), in rows, of the neighbours at ``offsets`` (m, 3) of a keypoint.

    z is the ``normal``; x the direction of most extent across it, on the side of more points.
    """
    flat = offsets - np.outer(offsets @ normal, normal)
    spread = np.empty(3)
    axes = np.empty((3, 3))
    eigen(flat.T @ flat, spread, axes)
    x = axes[:, 2].copy()
    x -= (x @ normal) * normal
    x /= np.sqrt(x @ x) + 1e-12
    if (np.sign(flat @ x) * (flat @ x) ** 2).sum() < 0:
        x = -x
    out = np.empty((3, 3))
    out[0] = x
    out[1] = np.cross(normal, x)
    out[2] = normal
    return out


@njit(cache=True, nogil=True)
def _histograms(points: F64, normals: F64, cells: Cells, keypoints: I64, radius: float) -> F32:
    out = np.zeros((len(keypoints), SIZE), np.float32)
    nearby_rows = np.empty(len(points), np.int64)
    step = np.log(1.0 / LEAST_RADIUS) / (RADIAL - 1)
    for number in range(len(keypoints)):
        row = keypoints[number]
        count = neighbours(points, cells, row, radius, nearby_rows)
        if not count:
            continue
        offsets = np.empty((count, 3))
        for m in range(count):
            offsets[m] = points[nearby_rows[m]] - points[row]
        local = offsets @ _frame(offsets, normals[row]).T
        for x, y, z in local:
            far = np.sqrt(x * x + y * y + z * z)
            ring = max(0, int(np.ceil(np.log(far / (LEAST_RADIUS * radius)) / step)))
            level = int((z / far + 1.0) / 2.0 * ELEVATION)
            sector = int((np.arctan2(y, x) + np.pi) / (2 * np.pi) * AZIMUTH)
            ring = min(ring, RADIAL - 1)
            level = min(level, ELEVATION - 1)
            sector = min(sector, AZIMUTH - 1)
            out[number, (ring * ELEVATION + level) * AZIMUTH + sector] += np.float32(1.0 / count)
    return out


def _thinned(level_map: LevelMap) -> tuple[F64, F64]:
    kept = thin(level_map.points, THINNED * level_map.voxel_size)
    return level_map.points[kept], level_map.normals[kept]


def _triplet(a: torch.Tensor, p: torch.Tensor, n: torch.Tensor) -> torch.Tensor:
    """The loss (b,) of unit vectors: squared distances and a margin."""
    return F.relu((a - p).square().sum(1) - (a - n).square().sum(1) + MARGIN)


def make_cgf(options: SystemOptions) -> ShapeSystem:
    """CGF in our pipeline."""
    return cgf_system(options, simulated_training(quick=options.quick))


def cgf_system(options: SystemOptions, training: Training) -> ShapeSystem:
    """The same, learnt from ``training``."""
    descriptor = SphericalHistograms(options.folder, quick=options.quick)
    return ShapeSystem("cgf", descriptor, options.settings, training, options.folder)
