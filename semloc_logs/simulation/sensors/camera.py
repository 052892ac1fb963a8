"""Depth cameras and stereo pairs in a triangle world: true depth by rays, with the errors and holes
that such sensors have.

Camera frames are optical: x right, y down, z ahead. A disparity d has an error that does not depend
on depth, so that z = f b / d is wrong by z^2 sigma_d / (f b) (Gallup et al., Variable
Baseline/Resolution Stereo, CVPR 2008, equation 2); it is alike over patches as large as the matched
windows, surfaces in front bleed over those behind them, and nothing is measured where the second
view sees nothing, on panes, and for want of texture.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F32, F64, I64, U8
from semloc_logs.simulation.meshes.world import (
    BUILDING,
    CAR,
    ROAD,
    SIDEWALK,
    UNLABELLED,
    VEGETATION,
    WALL,
    Scene,
)

MOUNT_AHEAD = 0.3  # m before the base frame's origin, over the front axle


@dataclass(frozen=True, slots=True)
class CameraModel:
    """A camera with depth by a baseline, square pixels and its centre in the middle.

    Pixels, horizontal field of view in radians, height over ground, ``baseline`` and ranges (along
    the axis) in metres, ``disparity_noise`` in pixels, ``bleed``: pixels by which surfaces in front
    grow at most. ``yaw`` radians turn it to the left about the base's z axis: 0 looks ahead, pi / 2
    to the left, pi back.
    """

    name: str
    width: int
    height: int
    horizontal_fov: float
    mount_height: float
    baseline: float
    max_range: float
    min_range: float = 0.5
    disparity_noise: float = 0.25
    bleed: int = 3
    yaw: float = 0.0

    @property
    def focal(self) -> float:
        """Focal length in pixels."""
        return self.width / 2 / math.tan(self.horizontal_fov / 2)

    @property
    def centre(self) -> tuple[float, float]:
        """Principal point (cx, cy) in pixels, the middle of the first pixel being 0."""
        return (self.width - 1) / 2, (self.height - 1) / 2

    @property
    def matrix(self) -> F64:
        """K (3, 3)."""
        cx, cy = self.centre
        return np.array([[self.focal, 0.0, cx], [0.0, self.focal, cy], [0.0, 0.0, 1.0]])

    def depth_sigma(self, z: F32) -> F32:
        """Standard deviation of depths (m) along the axis."""
        return np.asarray(
            z * z * np.float32(self.disparity_noise / (self.focal * self.baseline)), np.float32
        )


CAMERAS = {
    "stereo": CameraModel("stereo", 640, 360, math.radians(90), 1.6, 0.5, 40.0, min_range=1.5),
    "depth": CameraModel(
        "depth",
        640,
        480,
        math.radians(70),
        1.2,
        0.095,
        16.0,
        min_range=0.4,
        disparity_noise=0.08,
        bleed=2,
    ),
}


class Hits(NamedTuple):
    """What the pixels (h, w) of a camera see: depth along the axis in metres (inf = sky), label
    (255 = none or unlabelled), triangle (-1 = none), whether it is of the moving scene, normal (h,
    w, 3) in the world, not of length 1.
    """

    depth: F32
    labels: U8
    triangle: I64
    moving: NDArray[np.bool_]
    normal: F64


@dataclass(frozen=True, slots=True, eq=False)
class CameraFrame:
    """``points`` (n, 3) float32 in the optical frame in metres, ``labels`` (n,) Cityscapes train
    ids, ``sigma`` (n,) metres along the ray; ``depth`` (h, w) float32 metres along the axis with 0
    for holes, and ``label_image`` (h, w) of every pixel, the sky 255.
    """

    points: F32
    labels: U8
    depth: F32
    label_image: U8
    sigma: F32


def base_T_camera(model: CameraModel) -> F64:
    """Pose (4, 4) of the optical frame on a vehicle."""
    c = math.cos(model.yaw)
    s = math.sin(model.yaw)
    pose = np.eye(4)
    pose[:3, :3] = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ [
        [0.0, 0.0, 1.0],
        [-1.0, 0.0, 0.0],
        [0.0, -1.0, 0.0],
    ]
    pose[:3, 3] = MOUNT_AHEAD * c, MOUNT_AHEAD * s, model.mount_height
    return pose


def pixel_rays(model: CameraModel, step: int = 1) -> F32:
    """Viewing rays (h, w, 3) with z = 1 in the optical frame, of every ``step``-th pixel of every
    ``step``-th row.
    """
    cx, cy = model.centre
    x = (np.arange(0, model.width, step) - cx) / model.focal
    y = (np.arange(0, model.height, step) - cy) / model.focal
    rays = np.ones((len(y), len(x), 3), np.float32)
    rays[..., 0], rays[..., 1] = x, y[:, None]
    return rays


def first_hits(scene: Scene, world_T_camera: F64, rays: F32, traffic: Scene | None = None) -> Hits:
    """What the rays (h, w, 3) of a camera meet first, in the scene or in the moving one."""
    shape = rays.shape[:2]
    directions = rays.reshape(-1, 3) @ world_T_camera[:3, :3].T.astype(np.float32)
    origins = np.broadcast_to(world_T_camera[:3, 3].astype(np.float32), directions.shape)
    depth, triangle, normal = scene.cast(origins, directions)
    labels = np.where(triangle >= 0, scene.labels[triangle], UNLABELLED).astype(np.uint8)
    moving = np.zeros(len(depth), bool)
    if traffic is not None:
        nearer, other, other_normal = traffic.cast(origins, directions)
        moving = nearer < depth
        depth[moving], triangle[moving] = nearer[moving], other[moving]
        labels[moving], normal[moving] = traffic.labels[other[moving]], other_normal[moving]
    return Hits(
        depth.reshape(shape),
        labels.reshape(shape),
        triangle.reshape(shape),
        moving.reshape(shape),
        np.asarray(normal).reshape(*shape, 3),
    )


def depth_frame(
    scene: Scene,
    world_T_camera: F64,
    rng: np.random.Generator,
    model: CameraModel,
    *,
    traffic: Scene | None = None,
    step: int = 1,
) -> CameraFrame:
    """What the depth camera at ``world_T_camera`` (4, 4, optical frame) measures, of every
    ``step``-th pixel and row.

    ``traffic`` is a second scene, of what moves. The images have the chosen pixels only,
    (ceil(h / step), ceil(w / step)).
    """
    rays = pixel_rays(model, step)
    return measure(
        first_hits(scene, world_T_camera, rays, traffic), rays, world_T_camera, rng, model, step
    )


def measure(
    hits: Hits,
    rays: F32,
    world_T_camera: F64,
    rng: np.random.Generator,
    model: CameraModel,
    step: int = 1,
) -> CameraFrame:
    """The measured depth of first hits (:func:`first_hits` of :func:`pixel_rays`)."""
    holes = _holes(hits, rays, world_T_camera, rng, model, step)
    depth, labels, holes = _bleed(hits.depth, hits.labels, holes, rng, model.bleed / step)
    with np.errstate(divide="ignore", invalid="ignore"):
        disparity = model.focal * model.baseline / depth + model.disparity_noise * _patches(
            rng, depth.shape, step
        )
        measured = np.where(disparity > 0, model.focal * model.baseline / disparity, np.inf).astype(
            np.float32
        )
    valid = ~holes & (measured >= model.min_range) & (measured <= model.max_range)
    z = measured[valid]
    sigma = model.depth_sigma(z) * np.linalg.norm(rays[valid], axis=1)
    return CameraFrame(
        rays[valid] * z[:, None],
        labels[valid],
        np.where(valid, measured, np.float32(0)),
        hits.labels,
        sigma,
    )


def camera_points(
    scene: Scene,
    world_T_base: F64,
    rng: np.random.Generator,
    model: CameraModel,
    *,
    traffic: Scene | None = None,
    step: int = 3,
) -> tuple[F32, F32, U8, F32]:
    """A depth frame as a thinned cloud in the base frame.

    Points (n, 3), the camera's place (3,), labels (n,), sigma along the ray (n,). Only every
    ``step``-th pixel is cast.
    """
    mounted = base_T_camera(model)
    frame = depth_frame(scene, world_T_base @ mounted, rng, model, traffic=traffic, step=step)
    points = frame.points @ mounted[:3, :3].T.astype(np.float32) + mounted[:3, 3].astype(np.float32)
    return points, mounted[:3, 3].astype(np.float32), frame.labels, frame.sigma


def _patches(rng: np.random.Generator, shape: tuple[int, ...], step: int = 1) -> F32:
    """Noise (h, w) of about unit variance, most of it alike over patches of 6 and 24 pixels."""
    out = 0.4 * rng.standard_normal(shape, np.float32)
    for size, share in ((6, 0.95), (24, 0.75)):  # interpolation takes about a third of the variance
        coarse = [max(2, math.ceil(n * step / size)) for n in shape]
        out += share * cv2.resize(
            rng.standard_normal(coarse, np.float32), shape[::-1], interpolation=cv2.INTER_LINEAR
        )
    return np.asarray(out, np.float32)


def _holes(
    hits: Hits,
    rays: F32,
    world_T_camera: F64,
    rng: np.random.Generator,
    model: CameraModel,
    step: int,
) -> NDArray[np.bool_]:
    """Pixels (h, w) that nothing is measured of."""
    nothing = ~np.isfinite(hits.depth) | (hits.depth > 1.2 * model.max_range)
    depth = np.where(nothing, np.float32(1.2 * model.max_range), hits.depth)
    points = (rays * depth[..., None]) @ world_T_camera[:3, :3].T.astype(
        np.float32
    ) + world_T_camera[:3, 3].astype(np.float32)
    points += 0.15 * _patches(rng, depth.shape, step)[..., None]  # holes have no sharp borders
    fine = _cells(points, 0.6)
    pane = _cells(points, 1.2)
    smooth = np.full(256, 0, np.int64)  # per mille of places without texture
    smooth[[ROAD, SIDEWALK, BUILDING, WALL, CAR, CAR + 1, CAR + 2]] = 60, 40, 90, 90, 120, 120, 120
    glass = (
        ((hits.labels == BUILDING) & (pane % 100 < 12))
        | ((hits.labels >= CAR) & (hits.labels <= CAR + 2) & (pane % 100 < 35))
    ) & (fine % 10 < 8)
    length = np.maximum(np.sqrt(np.einsum("ijk,ijk->ij", hits.normal, hits.normal)), 1e-12)
    ray = rays @ world_T_camera[:3, :3].T.astype(np.float32)
    grazing = np.abs(np.einsum("ijk,ijk->ij", hits.normal, ray)) < 0.04 * length
    # the further, the less of the texture is left; a logistic curve makes even numbers of the
    # patches
    share = np.clip(depth / model.max_range, 0, 1) ** 2 * np.where(
        hits.labels == VEGETATION, 0.1, 0.25
    )
    fading = share > 1 / (1 + np.exp(-1.7 * _patches(rng, depth.shape, step)))
    holes: NDArray[np.bool_] = (
        nothing
        | (fine % 1000 < smooth[hits.labels])
        | glass
        | grazing
        | fading
        | _hidden(depth, model, step)
    )
    return holes


def _cells(points: F32, size: float) -> I64:
    """A number in [0, 2^20) for the cube of ``size`` metres of each point (h, w, 3)."""
    cell = np.floor(points / np.float32(size)).astype(np.int32)
    mixed = (
        (cell[..., 0] * np.int32(73856093))
        ^ (cell[..., 1] * np.int32(19349663))
        ^ (cell[..., 2] * np.int32(83492791))
    )
    mixed ^= mixed >> 13
    mixed *= np.int32(1540483477)
    return np.asarray((mixed ^ (mixed >> 15)) & 0xFFFFF, np.int64)


def _hidden(depth: F32, model: CameraModel, step: int) -> NDArray[np.bool_]:
    """Pixels (h, w) that the second camera, ``baseline`` to the right, does not see: out of its
    picture or behind nearer surfaces.
    """
    height, width = depth.shape
    disparity = np.float32(model.focal * model.baseline / step) / depth
    column = np.rint(np.arange(width, dtype=np.float32) - disparity).astype(np.int64)
    outside = (column < 0) | (column >= width)
    flat = np.clip(column, 0, width - 1) + width * np.arange(height)[:, None]
    nearest = np.zeros(height * width, np.float32)
    np.maximum.at(nearest, flat[~outside], disparity[~outside])
    nearest = cv2.morphologyEx(
        nearest.reshape(height, width), cv2.MORPH_CLOSE, np.ones((1, 3), np.uint8)
    ).ravel()
    return np.asarray(outside | (nearest[flat] > disparity + max(1.0, 1.5 / step)))


def _bleed(
    depth: F32, labels: U8, holes: NDArray[np.bool_], rng: np.random.Generator, pixels: float
) -> tuple[F32, U8, NDArray[np.bool_]]:
    """Surfaces in front grown over those behind by up to ``pixels``, by patches more or less."""
    rounds = math.ceil(pixels)
    if rounds < 1:
        return depth, labels, holes
    reach = (0.5 + 0.25 * _patches(rng, depth.shape)) * pixels + 0.5
    for k in range(rounds):
        for axis, shift in ((1, 1), (1, -1), (0, 1)):
            neighbour = np.roll(depth, shift, axis)
            taken = (neighbour < 0.93 * depth - 0.1) & (reach > k + 1) & np.isfinite(neighbour)
            taken[:, 0 if shift > 0 else -1] = False
            taken[0] = False
            depth = np.where(taken, neighbour, depth)
            labels = np.where(taken, np.roll(labels, shift, axis), labels)
            holes = np.where(taken, np.roll(holes, shift, axis), holes)
    return depth, labels, holes
