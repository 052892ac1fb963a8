"""DSAC (Brachmann et al., CVPR 2017), its smallest version: a network that gives the world's
coordinates at every eighth pixel, and RANSAC that is differentiable in the choice of a hypothesis.

Training has two stages, as the authors suggest: first on the coordinates that the depth gives, then
on the expected error of the pose. A hypothesis is chosen with the probability that the softmax of
the scores gives it; the score is a soft count of inliers. The gradient of the expected error goes
through these probabilities, not through the poses of the hypotheses.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from semloc_logs.arrays import F32, F64, U8
from semloc_logs.experiments.system import Picture, Query, RankedPose, View
from semloc_logs.experiments.systems.catalogue import SystemOptions
from semloc_logs.experiments.systems.pictures.picture_pose import base_pose, pose_of_points
from semloc_logs.experiments.systems.trained_networks import key_of, trained
from semloc_logs.numerics.transforms import apply, inverse, rotation_angle

WIDTH = 320  # pixels that wider pictures are scaled to
CELL = 8  # pixels between coordinates
CHANNELS = (16, 32, 64, 128)
LEAST_EXTENT = 10.0  # m: coordinates are in units of the spread of the places and of this
RATE, END_RATE = 2e-3, 1e-5  # of the first stage and of the second
STEPS, QUICK_STEPS = 4000, 20  # few steps show only that it runs
NEAREST = 3.0  # m: errors of coordinates count in units of their distance, of this at least
END_STEPS, QUICK_END_STEPS = 300, 2
HYPOTHESES = 16  # of a training picture
POINTS = 4  # of a hypothesis
INLIER_PIXELS, SOFTNESS = 5.0, 1.0  # of the soft count
SCORE_SCALE = 0.1  # of the counts in the softmax
MOST_LOSS = 20.0  # of a hypothesis: metres plus degrees, so that lost ones do not rule
LONGEST = 1e3  # pixels: reprojection errors beyond are one


class _Grid(NamedTuple):
    """Cells of a scaled picture: ``grey`` (h, w) levels, ``pixel`` (n, 2) middles of the cells, the
    scaled ``intrinsics``, and the ``points`` (n, 3) of the cells, base frame, NaN without depth.
    """

    grey: U8
    pixel: F32
    intrinsics: F64
    points: F32


class _Example(NamedTuple):
    """A picture of the database and its true poses (4, 4)."""

    grid: _Grid
    world_T_base: F64
    camera_T_world: F64


class Coordinates(nn.Module):
    """Pictures (n, 1, h, w) to coordinates (n, 3, h / 8, w / 8) of the world, metres."""

    centre: Tensor
    extent: Tensor

    def __init__(self) -> None:
        super().__init__()
        a, b, c, d = CHANNELS
        self.layers = nn.Sequential(
            nn.Conv2d(1, a, 3, 1, 1),
            nn.ReLU(),
            nn.Conv2d(a, b, 3, 2, 1),
            nn.ReLU(),
            nn.Conv2d(b, c, 3, 2, 1),
            nn.ReLU(),
            nn.Conv2d(c, d, 3, 2, 1),
            nn.ReLU(),
            nn.Conv2d(d, d, 3, 1, 1),
            nn.ReLU(),
            nn.Conv2d(d, d, 3, 1, 1),
            nn.ReLU(),
            nn.Conv2d(d, d, 1),
            nn.ReLU(),
            nn.Conv2d(d, 3, 1),
        )
        self.register_buffer("centre", torch.zeros(3))
        self.register_buffer("extent", torch.ones(3))

    def forward(self, pictures: Tensor) -> Tensor:
        out: Tensor = self.layers(pictures)
        return out * self.extent[:, None, None] + self.centre[:, None, None]


class SceneCoordinateSystem:
    """The pose by the coordinates of all cells, after the ``steps`` of both stages of training.

    Weights are kept in ``folder``.
    """

    name = "dsac"

    def __init__(self, folder: Path, steps: tuple[int, int]) -> None:
        self._folder = folder
        self._steps = steps
        self._network: Coordinates | None = None

    def fit(self, database: Sequence[View]) -> None:
        examples = []
        for number in range(len(database)):
            view = database[number]
            if view.picture is not None:
                camera_T_world = inverse(view.world_T_base @ view.picture.base_T_camera)
                examples.append(_Example(_grid(view.picture), view.world_T_base, camera_T_world))
        self._network = None
        if not examples:
            return
        self._network = Coordinates()
        key = key_of(database, self._steps)
        trained(
            self._folder / f"dsac-{key}.safetensors",
            self._network,
            lambda: self._train(examples),
        )

    def localise(self, query: Query) -> list[RankedPose]:
        picture = query.views[-1].picture
        if picture is None or self._network is None:
            return []
        grid = _grid(picture)
        with torch.inference_mode():
            coordinates = self._network(_tensor(grid)).flatten(2)[0].T.numpy()
        pose = pose_of_points(grid.pixel, coordinates, grid.intrinsics)
        if pose is None:
            return []
        return [RankedPose(base_pose(pose, picture), float(pose.inliers))]

    def _train(self, examples: Sequence[_Example]) -> None:
        assert self._network is not None
        rng = np.random.default_rng(0)
        places = np.stack([example.world_T_base[:3, 3] for example in examples])
        self._network.centre.copy_(torch.from_numpy(places.mean(0).astype(np.float32)))
        self._network.extent.copy_(
            torch.from_numpy(places.std(0).astype(np.float32)) + LEAST_EXTENT
        )
        optimiser = torch.optim.Adam(self._network.parameters(), RATE)
        for step in range(sum(self._steps)):
            if step == self._steps[0]:
                optimiser = torch.optim.Adam(self._network.parameters(), END_RATE)
            grid, world_T_base, camera_T_world = examples[int(rng.integers(len(examples)))]
            coordinates = self._network(_tensor(grid)).flatten(2)[0].T
            if step < self._steps[0]:
                loss = coordinate_loss(coordinates, grid, world_T_base)
            else:
                loss = expected_loss(coordinates, grid.pixel, grid.intrinsics, camera_T_world, rng)
            if loss is None:
                continue
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()


def coordinate_loss(predicted: Tensor, grid: _Grid, world_T_base: F64) -> Tensor | None:
    """Mean distance of the coordinates from those by the depth, in units of their range.

    None without depth. In metres the far points would count most, though a pose depends least on
    them.
    """
    known = np.isfinite(grid.points).all(1)
    if not known.any():
        return None
    points = grid.points[known]
    truth = torch.from_numpy(apply(world_T_base, points).astype(np.float32))
    far = torch.from_numpy(np.maximum(np.linalg.norm(points, axis=1), NEAREST))
    off: Tensor = (predicted[torch.from_numpy(known)] - truth).norm(dim=1) / far
    return off.mean()


def expected_loss(
    predicted: Tensor, pixel: F32, intrinsics: F64, camera_T_world: F64, rng: np.random.Generator
) -> Tensor | None:
    """The expected error of the pose that RANSAC chooses by coordinates ``predicted`` (n, 3).

    None where no hypothesis can be made.
    """
    poses = hypotheses(predicted.detach().numpy(), pixel, intrinsics, rng)
    if not poses:
        return None
    return chosen_loss(predicted, pixel, intrinsics, camera_T_world, poses)


def hypotheses(points: F32, pixel: F32, intrinsics: F64, rng: np.random.Generator) -> list[F64]:
    """Poses (4, 4), camera_T_world, each by four random cells."""
    out = []
    for _ in range(HYPOTHESES):
        rows = rng.choice(len(pixel), POINTS, replace=False)
        world = np.ascontiguousarray(points[rows], np.float64)
        seen = np.ascontiguousarray(pixel[rows], np.float64)
        ok, turn, shift = cv2.solvePnP(world, seen, intrinsics, None, flags=cv2.SOLVEPNP_AP3P)
        if ok and np.isfinite(turn).all() and np.isfinite(shift).all():
            pose = np.eye(4)
            pose[:3, :3] = cv2.Rodrigues(turn)[0]
            pose[:3, 3] = shift.ravel()
            out.append(pose)
    return out


def chosen_loss(
    predicted: Tensor, pixel: F32, intrinsics: F64, camera_T_world: F64, poses: Sequence[F64]
) -> Tensor:
    """The mean error of ``poses``, weighted by the probability that each is chosen."""
    scores = torch.stack([soft_inliers(predicted, pixel, intrinsics, pose) for pose in poses])
    losses = torch.tensor(
        [pose_loss(pose, camera_T_world) for pose in poses], dtype=predicted.dtype
    )
    return (torch.softmax(SCORE_SCALE * scores, 0) * losses).sum()


def soft_inliers(predicted: Tensor, pixel: F32, intrinsics: F64, pose: F64) -> Tensor:
    """How many cells a pose fits: the sum of a sigmoid of their reprojection errors."""
    T = torch.from_numpy(pose).to(predicted.dtype)
    camera = predicted @ T[:3, :3].T + T[:3, 3]
    depth = camera[:, 2].clamp(min=0.1)
    projected = camera @ torch.from_numpy(intrinsics).to(predicted.dtype).T
    off = (projected[:, :2] / depth[:, None] - torch.from_numpy(pixel).to(predicted.dtype)).norm(
        dim=1
    )
    return torch.sigmoid((INLIER_PIXELS - off.clamp(max=LONGEST)) / SOFTNESS).sum()


def pose_loss(pose: F64, camera_T_world: F64) -> float:
    """The larger of degrees and decimetres, as the authors have it for scenes of rooms in degrees
    and centimetres; at most ``MOST_LOSS``.
    """
    off = inverse(pose) @ camera_T_world
    degrees = float(np.degrees(rotation_angle(off[:3, :3])))
    return min(max(degrees, 10 * float(np.linalg.norm(off[:3, 3]))), MOST_LOSS)


def _grid(picture: Picture) -> _Grid:
    height, width = picture.depth.shape
    scale = min(1.0, WIDTH / width)
    columns = int(width * scale) // CELL
    rows = int(height * scale) // CELL
    size = (columns * CELL, rows * CELL)
    factor = np.array([size[0] / width, size[1] / height])
    full_grey = cv2.cvtColor(picture.image, cv2.COLOR_RGB2GRAY)
    grey = np.asarray(cv2.resize(full_grey, size, interpolation=cv2.INTER_AREA), np.uint8)
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    pixel = (np.c_[x.ravel(), y.ravel()] + 0.5) * CELL - 0.5
    # pixel middles are whole numbers, so scaling goes about the corner of the picture
    intrinsics = picture.intrinsics.copy()
    intrinsics[:2] *= factor[:, None]
    intrinsics[:2, 2] += factor / 2 - 0.5
    full = (pixel + 0.5) / factor - 0.5
    column, row = np.round(full).astype(int).T
    depth = picture.depth[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    rays = np.c_[full, np.ones(len(full))] @ np.linalg.inv(picture.intrinsics).T
    points = apply(picture.base_T_camera, rays * depth[:, None])
    return _Grid(grey, pixel.astype(np.float32), intrinsics, points.astype(np.float32))


def _tensor(grid: _Grid) -> Tensor:
    grey = grid.grey.astype(np.float32)
    return torch.from_numpy((grey - grey.mean()) / 64)[None, None]


def make_dsac(options: SystemOptions) -> SceneCoordinateSystem:
    """DSAC."""
    steps = (QUICK_STEPS, QUICK_END_STEPS) if options.quick else (STEPS, END_STEPS)
    return SceneCoordinateSystem(options.folder, steps)
