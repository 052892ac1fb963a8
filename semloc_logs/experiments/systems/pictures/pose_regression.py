"""PoseNet (Kendall et al., ICCV 2015): the pose of a picture, regressed by a network that is
trained from scratch for each database. It gives one pose and no measure of its certainty.

The network is a small one for a CPU; the loss is the paper's, with positions in units of the
database's extent. Training ends when the loss has stopped falling.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semloc_logs.arrays import F64, U8
from semloc_logs.experiments.system import Query, RankedPose, View
from semloc_logs.experiments.systems.catalogue import SystemOptions
from semloc_logs.experiments.systems.trained_networks import key_of, trained
from semloc_logs.numerics.transforms import transform, translation_quaternion

WIDTH, HEIGHT = 160, 64  # pixels that pictures are scaled to
CHANNELS = (16, 32, 64, 96)
POOLED = (2, 5)
HIDDEN = 256
BATCH, RATE = 16, 1e-3
CROP = 4  # pixels that training pictures are shifted by, at most
BRIGHTER = 0.2  # share that they are made brighter or darker by, at most
TURN_WEIGHT = 1.0  # of the quaternion's error against the position's in extents
CHECKED = 200  # steps after which the loss has to have fallen ...
FALL = 0.03  # ... by this share, or training ends
STEPS, QUICK_STEPS = 8000, 20  # few steps show only that it runs


class PoseNet(nn.Module):
    """Pictures (n, 1, 64, 160) to positions (n, 3) in extents and quaternions (n, 4) xyzw."""

    centre: Tensor
    extent: Tensor

    def __init__(self) -> None:
        super().__init__()
        widths = (1, *CHANNELS)
        layers: list[nn.Module] = []
        for a, b in pairwise(widths):
            layers += [nn.Conv2d(a, b, 5, 2, 2), nn.ReLU()]
        self.layers = nn.Sequential(
            *layers,
            nn.AdaptiveAvgPool2d(POOLED),
            nn.Flatten(),
            nn.Linear(CHANNELS[-1] * POOLED[0] * POOLED[1], HIDDEN),
            nn.ReLU(),
            nn.Linear(HIDDEN, 7),
        )
        self.register_buffer("centre", torch.zeros(3, dtype=torch.float64))
        self.register_buffer("extent", torch.ones(1, dtype=torch.float64))

    def forward(self, pictures: Tensor) -> tuple[Tensor, Tensor]:
        out = self.layers(pictures)
        return out[:, :3], F.normalize(out[:, 3:], dim=1)


class PoseNetSystem:
    """One pose a query, after at most ``steps`` of training; weights are kept in ``folder``."""

    name = "posenet"

    def __init__(self, folder: Path, steps: int) -> None:
        self._folder = folder
        self._steps = steps
        self._network: PoseNet | None = None

    def fit(self, database: Sequence[View]) -> None:
        pictures = []
        poses = []
        for number in range(len(database)):
            view = database[number]
            if view.picture is not None:
                pictures.append(small_picture(view.picture.image))
                poses.append(view.world_T_base)
        self._network = None
        if not pictures:
            return
        self._network = PoseNet()
        key = key_of(database, self._steps)
        trained(
            self._folder / f"posenet-{key}.safetensors",
            self._network,
            lambda: self._train(np.stack(pictures), np.stack(poses)),
        )

    def localise(self, query: Query) -> list[RankedPose]:
        picture = query.views[-1].picture
        if picture is None or self._network is None:
            return []
        with torch.inference_mode():
            place, turn = self._network(_tensor(small_picture(picture.image)[None]))
        centre = self._network.centre.numpy()
        position = place[0].numpy() * float(self._network.extent) + centre
        return [RankedPose(transform(position, turn[0].double().numpy()), 1.0)]

    def _train(self, pictures: U8, poses: F64) -> None:
        assert self._network is not None
        rng = np.random.default_rng(0)
        position, quaternion = translation_quaternion(poses)
        centre = position.mean(0)
        extent = max(float(np.linalg.norm(position - centre, axis=1).max()), 1.0)
        self._network.centre.copy_(torch.from_numpy(centre))
        self._network.extent.fill_(extent)
        wanted = torch.from_numpy(((position - centre) / extent).astype(np.float32))
        wanted_turn = torch.from_numpy(quaternion.astype(np.float32))
        optimiser = torch.optim.Adam(self._network.parameters(), RATE)
        losses: list[float] = []
        while len(losses) < self._steps and not _has_settled(losses):
            rows = rng.integers(0, len(pictures), BATCH)
            place, turn = self._network(_tensor(_varied(pictures[rows], rng)))
            loss = (place - wanted[rows]).norm(dim=1).mean()
            loss = loss + TURN_WEIGHT * _turn_error(turn, wanted_turn[rows]).mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            losses.append(loss.item())


def small_picture(image: U8) -> U8:
    """A grey picture (64, 160) of any picture."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return np.asarray(cv2.resize(grey, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA), np.uint8)


def _turn_error(predicted: Tensor, wanted: Tensor) -> Tensor:
    """Distance (n,) of unit quaternions, q and -q being one turn."""
    return torch.minimum((predicted - wanted).norm(dim=1), (predicted + wanted).norm(dim=1))


def _has_settled(losses: Sequence[float]) -> bool:
    """Whether the mean loss of the last steps is hardly below the mean of the steps before."""
    if len(losses) < 2 * CHECKED or len(losses) % CHECKED:
        return False
    last = float(np.mean(losses[-CHECKED:]))
    return last > (1 - FALL) * float(np.mean(losses[-2 * CHECKED : -CHECKED]))


def _varied(pictures: U8, rng: np.random.Generator) -> U8:
    """Pictures shifted and made brighter at random."""
    padded = np.pad(pictures, ((0, 0), (CROP, CROP), (CROP, CROP)), mode="edge")
    out = np.empty_like(pictures)
    for n in range(len(pictures)):
        x, y = rng.integers(0, 2 * CROP + 1, 2)
        gain = 1 + rng.uniform(-BRIGHTER, BRIGHTER)
        out[n] = np.clip(gain * padded[n, y : y + HEIGHT, x : x + WIDTH], 0, 255)
    return out


def _tensor(pictures: U8) -> Tensor:
    """Pictures as the network's input: without their mean, in units of 64 levels."""
    values = torch.from_numpy(pictures.astype(np.float32))[:, None]
    return (values - values.mean((1, 2, 3), keepdim=True)) / 64


def make_posenet(options: SystemOptions) -> PoseNetSystem:
    """PoseNet."""
    return PoseNetSystem(options.folder, QUICK_STEPS if options.quick else STEPS)
