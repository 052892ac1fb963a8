"""3DMatch (Zeng et al., CVPR 2017): truncated distances of 30^3 voxels, embedded to 512 dimensions
by a network that is trained from scratch on incomplete and complete subvolumes.

The network is a small one for a CPU, run over whole maps at once: without padding, so that a
subvolume has the same descriptor in a map as alone. Volumes are level and aligned with the map, as
ours, so a query is described in every heading.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numba import njit
from scipy.spatial import cKDTree
from torch import Tensor, nn
from torch.nn import functional as F

from semloc_logs.arrays import F32, F64, I64
from semloc_logs.experiments.system import View
from semloc_logs.experiments.systems.catalogue import SystemOptions
from semloc_logs.experiments.systems.level_maps import LevelMap, database_map, view_map
from semloc_logs.experiments.systems.shapes.shape_matching import (
    STRIDE,
    Described,
    ShapeSystem,
    keypoints_of,
)
from semloc_logs.experiments.systems.shapes.training_views import Training, simulated_training
from semloc_logs.experiments.systems.trained_networks import trained
from semloc_logs.numerics.transforms import turned_about_z
from semloc_logs.settings import Resolved

EDGE = 30  # voxels of a subvolume
FIRST = (EDGE - STRIDE) // 2  # voxels from its corner to the cell that holds its keypoint
TRUNCATED = 5  # voxels: distances beyond are one
CHANNELS = (16, 32, 64)
EMBEDDED = 512
PATCH = 128  # voxels along the edge of the part of a map that is described at once
MARGIN = 1.0  # of the contrastive loss
BATCH, STEPS, QUICK_STEPS, RATE = 24, 800, 16, 1e-3
VIEWS = 100  # of the training that pairs are made of
PER_VIEW = 16  # pairs
SHIFT = 2.0  # voxels: the complete subvolume is off by so much, as keypoints lie on a grid
TURN = np.radians(10.0)  # and turned, half the step of headings


class Volumes(nn.Module):
    """Distances (b, 1, x, y, z) to unit descriptors (b, 512, ...), one every 8 voxels.

    30 - 2 = 28, pooled 14, 12, pooled 6, 4, pooled 2, and a convolution of 2.
    """

    def __init__(self) -> None:
        super().__init__()
        a, b, c = CHANNELS
        self.layers = nn.Sequential(
            nn.Conv3d(1, a, 3),
            nn.ReLU(),
            nn.MaxPool3d(2),
            nn.Conv3d(a, b, 3),
            nn.ReLU(),
            nn.MaxPool3d(2),
            nn.Conv3d(b, c, 3),
            nn.ReLU(),
            nn.MaxPool3d(2),
            nn.Conv3d(c, EMBEDDED, 2),
        )

    def forward(self, volumes: Tensor) -> Tensor:
        return F.normalize(self.layers(volumes), dim=1)


class DistanceVolumes:
    """3DMatch of occupied voxels; weights are kept in ``folder``."""

    turns = True

    def __init__(self, folder: Path, *, quick: bool) -> None:
        self._folder = folder
        self._steps = QUICK_STEPS if quick else STEPS
        self._network = Volumes()
        self._network.to(memory_format=torch.channels_last_3d)  # type: ignore[call-overload]

    def fit(self, training: Training, settings: Resolved) -> None:
        key = f"{training.key}-{self._steps}-{settings.fingerprint('fusion')}"
        trained(
            self._folder / f"3dmatch-{key}.safetensors",
            self._network,
            lambda: self._train(training.views(), settings),
        )

    def describe(self, level_map: LevelMap, yaw: float) -> Described:
        v = level_map.voxel_size
        points = turned_about_z(level_map.points / v, np.full(len(level_map.points), -yaw))
        cell, descriptor = describe_points(points, self._network)
        centre = (cell.astype(np.float64) + 0.5) * STRIDE
        # the height of a surface, so that the ground comes to lie on the ground
        centre[:, 2] = points[cKDTree(points).query(centre, workers=1)[1], 2] if len(cell) else 0.0
        centre *= v
        return Described(turned_about_z(centre, np.full(len(centre), yaw)), descriptor)

    def _train(self, views: Sequence[View], settings: Resolved) -> None:
        incomplete, complete = training_volumes(views, settings)
        optimiser = torch.optim.Adam(self._network.parameters(), RATE)
        rng = np.random.default_rng(0)
        for _ in range(self._steps if len(incomplete) > 1 else 0):
            rows = rng.choice(len(incomplete), min(BATCH, len(incomplete)), replace=False)
            volumes = np.concatenate([incomplete[rows], complete[rows]])
            a, b = self._network(_tensor(volumes)).flatten(1).chunk(2)
            # the others of the batch are the pairs that do not match
            wrong = F.relu(MARGIN - (a - b.roll(1, 0)).norm(dim=1)).square()
            loss = ((a - b).square().sum(1) + wrong).mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()


def describe_points(points: F64, network: Volumes) -> tuple[I64, F32]:
    """Cells (n, 3) of 8 voxels that hold some of ``points`` (m, 3), in voxels, and the descriptors
    (n, 512) of the subvolumes about them.
    """
    cells = np.unique(np.floor(points / STRIDE).astype(np.int64), axis=0)
    out = np.zeros((len(cells), EMBEDDED), np.float32)
    if not len(cells):
        return cells, out
    width = PATCH // STRIDE
    patch = cells[:, :2] // width
    bottom = cells[:, 2].min()
    top = cells[:, 2].max()
    for p in np.unique(patch, axis=0):
        rows = np.flatnonzero((patch == p).all(1))
        first = np.array([*cells[rows, :2].min(0), bottom])
        count = np.array([*(cells[rows, :2].max(0)), top]) - first + 1
        low = first * STRIDE - FIRST
        size = count * STRIDE + EDGE - STRIDE
        volume = distance_volume(points, low.astype(np.float64), (size[0], size[1], size[2]))
        with torch.inference_mode():
            described = network(_tensor(volume[None]))[0].numpy()
        i, j, k = (cells[rows] - first).T
        out[rows] = described[:, i, j, k].T
    return cells, out


def training_volumes(views: Sequence[View], settings: Resolved) -> tuple[F32, F32]:
    """Incomplete subvolumes (n, 30, 30, 30) of maps of one view, and the complete ones of the map
    of all, a little shifted and turned. Both have one random heading.
    """
    v = settings.fusion.voxel_size
    whole = database_map(views, settings).points / v
    rng = np.random.default_rng(0)
    incomplete = [np.zeros((0, EDGE, EDGE, EDGE), np.float32)]
    complete = [np.zeros((0, EDGE, EDGE, EDGE), np.float32)]
    for number in np.unique(np.linspace(0, len(views) - 1, VIEWS).astype(int)):
        part = view_map(views[number], settings).points / v
        rows = rng.permutation(keypoints_of(part, STRIDE))[:PER_VIEW]
        for centre in part[rows]:
            yaw = rng.uniform(0, 2 * np.pi)
            shift = centre + rng.uniform(-SHIFT, SHIFT, 3)
            incomplete.append(_about(part, centre, yaw)[None])
            complete.append(_about(whole, shift, yaw + rng.uniform(-TURN, TURN))[None])
    return np.concatenate(incomplete), np.concatenate(complete)


def _about(points: F64, centre: F64, yaw: float) -> F32:
    """The subvolume about ``centre`` (3,), turned by -``yaw``; all in voxels."""
    off = points - centre
    inside = off[(np.abs(off) < EDGE).all(1)]
    turned = turned_about_z(inside, np.full(len(inside), -yaw))
    return distance_volume(turned, np.full(3, -EDGE / 2), (EDGE, EDGE, EDGE))


def distance_volume(points: F64, low: F64, shape: tuple[int, int, int]) -> F32:
    """1 - the truncated distance of the middles of voxels to the nearest of ``points`` (n, 3).

    All in voxels; the volume begins at ``low`` (3,). 1 is on a point, 0 is 5 voxels or farther off.
    """
    out = np.zeros(shape, np.float32)
    high = low + np.array(shape)
    is_inside = ((points > low - TRUNCATED) & (points < high + TRUNCATED)).all(1)
    _scatter(points[is_inside] - low, out)
    return out


@njit(cache=True, nogil=True)
def _scatter(points: F64, out: F32) -> None:
    nx, ny, nz = out.shape
    for x, y, z in points:
        for i in range(max(int(x) - TRUNCATED, 0), min(int(x) + TRUNCATED + 1, nx)):
            for j in range(max(int(y) - TRUNCATED, 0), min(int(y) + TRUNCATED + 1, ny)):
                across = (i + 0.5 - x) ** 2 + (j + 0.5 - y) ** 2
                if across >= TRUNCATED**2:
                    continue
                for k in range(max(int(z) - TRUNCATED, 0), min(int(z) + TRUNCATED + 1, nz)):
                    far = np.sqrt(across + (k + 0.5 - z) ** 2)
                    out[i, j, k] = max(out[i, j, k], np.float32(1.0 - far / TRUNCATED))


def _tensor(volumes: F32) -> Tensor:
    """Volumes (b, x, y, z) as the network's input."""
    return torch.from_numpy(volumes[:, None]).contiguous(memory_format=torch.channels_last_3d)


def make_3dmatch(options: SystemOptions) -> ShapeSystem:
    """3DMatch in our pipeline."""
    return volume_system(options, simulated_training(quick=options.quick))


def volume_system(options: SystemOptions, training: Training) -> ShapeSystem:
    """The same, learnt from ``training``."""
    descriptor = DistanceVolumes(options.folder, quick=options.quick)
    return ShapeSystem("3dmatch", descriptor, options.settings, training, options.folder)
