"""Viewpoint invariant patches (Wu et al., CVPR 2008) of the ground, as section 4.4 has them.

The depth gives the plane of the ground; the picture is rectified to a view from above, and SIFT,
with orientations, is matched between such views exhaustively. Matches are places on the ground in
metres, so a turn and a shift fit them, and give the pose. The paper selected the road by hand; here
it is the plane with most points below the camera.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from semloc_logs.arrays import F32, F64, U8
from semloc_logs.experiments.system import MOST_POSES, Picture, Query, RankedPose, View
from semloc_logs.experiments.systems.catalogue import SystemOptions
from semloc_logs.experiments.systems.pictures.local_features import root_sift, unit_descriptors
from semloc_logs.experiments.systems.pictures.picture_pose import (
    LEAST_INLIERS,
    SEED,
    mutual_matches,
)
from semloc_logs.numerics.transforms import inverse, yaw_transform

CELL = 0.04  # m: a pixel of the view from above
AHEAD, ACROSS = (2.0, 22.0), (-10.0, 10.0)  # m: what it shows, from the vehicle
STEEPEST = np.cos(np.radians(15.0))  # of the ground's normal against the vertical of the base
PLANE_DISTANCE = 0.1  # m between the plane and its points
PLANE_ROUNDS, PLANE_POINTS = 200, 3000
OCCLUDED = 0.3  # m: depth that is less than the ground's by more hides it
MOST_PATCHES = 1000  # of a picture, the strongest
MATCH_DISTANCE = 0.2  # m between matched places on the ground
SCALES = (0.9, 1.1)  # of a right fit: both views are in metres
ROUNDS, CONFIDENCE = 2000, 0.999


class GroundView(NamedTuple):
    """``grey`` view from above, rows along x and columns along y of the plane; ``seen`` where it
    shows the ground; ``base_T_plane`` (4, 4).
    """

    grey: U8
    seen: U8
    base_T_plane: F64


class Patches(NamedTuple):
    """``places`` (n, 2) on the plane, metres, ``descriptor`` (n, 128), ``base_T_plane``."""

    places: F32
    descriptor: U8
    base_T_plane: F64


@dataclass(frozen=True, slots=True, eq=False)
class _Stored:
    path: Path
    world_T_base: F64


class GroundPatchSystem:
    """The pictures of the database as patches, in files in ``folder`` as long as it is used."""

    def __init__(self, folder: Path) -> None:
        self.name = "vip"
        self._folder = tempfile.TemporaryDirectory(prefix=".scratch.", dir=folder)
        self._stored: list[_Stored] = []

    def fit(self, database: Sequence[View]) -> None:
        self._stored = []
        for number in range(len(database)):
            view = database[number]
            patches = None if view.picture is None else patches_of(view.picture)
            if patches is None:
                continue
            path = Path(self._folder.name) / f"{number:06d}.npz"
            np.savez(path, *patches)
            self._stored.append(_Stored(path, view.world_T_base))

    def localise(self, query: Query) -> list[RankedPose]:
        picture = query.views[-1].picture
        patches = None if picture is None else patches_of(picture)
        if patches is None:
            return []
        answers = []
        for stored in self._stored:
            with np.load(stored.path) as arrays:
                other = Patches(*(arrays[name] for name in arrays.files))
            fit = ground_fit(other, patches)
            if fit is not None:
                pose, inliers = fit
                base_T_base = other.base_T_plane @ pose @ inverse(patches.base_T_plane)
                answers.append(RankedPose(stored.world_T_base @ base_T_base, float(inliers)))
        return sorted(answers, key=lambda pose: -pose.score)[:MOST_POSES]


def ground_plane(picture: Picture) -> F64 | None:
    """``base_T_plane`` (4, 4) of the ground: z its normal, x ahead, the origin below the base. None
    where the depth shows no level plane.
    """
    v, u = np.nonzero(np.isfinite(picture.depth))
    rng = np.random.default_rng(SEED)
    below = v > picture.intrinsics[1, 2]
    rows = rng.permutation(np.flatnonzero(below))[:PLANE_POINTS]
    if len(rows) < LEAST_INLIERS:
        return None
    pixels = np.c_[u[rows], v[rows], np.ones(len(rows))]
    camera = pixels @ np.linalg.inv(picture.intrinsics).T * picture.depth[v, u][rows, None]
    pose = picture.base_T_camera
    points = camera @ pose[:3, :3].T + pose[:3, 3]
    best = np.zeros(len(points), bool)
    for _ in range(PLANE_ROUNDS):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length < 1e-6 or abs(normal[2]) < STEEPEST * length:
            continue
        inside = np.abs((points - a) @ normal) < PLANE_DISTANCE * length
        if inside.sum() > best.sum():
            best = inside
    if best.sum() < LEAST_INLIERS:
        return None
    mean = points[best].mean(0)
    normal = np.linalg.svd(points[best] - mean, full_matrices=False)[2][2]
    normal *= np.sign(normal[2])
    ahead = np.array([1.0, 0, 0]) - normal[0] * normal
    ahead /= np.linalg.norm(ahead)
    out = np.eye(4)
    out[:3, :3] = np.stack([ahead, np.cross(normal, ahead), normal], 1)
    out[:3, 3] = [0.0, 0.0, float(mean @ normal) / normal[2]]
    return out


def view_from_above(picture: Picture) -> GroundView | None:
    """The ground of a picture as seen from above; None where it shows no ground."""
    base_T_plane = ground_plane(picture)
    if base_T_plane is None:
        return None
    x, y = np.meshgrid(np.arange(*AHEAD, CELL), np.arange(*ACROSS, CELL), indexing="ij")
    plane = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
    camera_T_plane = inverse(picture.base_T_camera) @ base_T_plane
    camera = plane @ camera_T_plane[:3, :3].T + camera_T_plane[:3, 3]
    ahead = camera[:, 2] > CELL
    projected = camera @ picture.intrinsics.T
    pixel = projected[:, :2] / np.where(ahead, projected[:, 2], 1.0)[:, None]
    pixel[~ahead] = -1.0
    u, v = (pixel[:, k].reshape(x.shape).astype(np.float32) for k in (0, 1))
    grey = cv2.cvtColor(picture.image, cv2.COLOR_RGB2GRAY)
    depth = cv2.remap(picture.depth, u, v, cv2.INTER_NEAREST, borderValue=np.nan)
    height, width = picture.depth.shape
    inside = (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
    # without a depth nothing is known to hide the ground
    hidden = depth < camera[:, 2].reshape(x.shape) - OCCLUDED
    return GroundView(
        np.asarray(cv2.remap(grey, u, v, cv2.INTER_LINEAR), np.uint8),
        (255 * (inside & ~hidden)).astype(np.uint8),
        base_T_plane,
    )


def patches_of(picture: Picture) -> Patches | None:
    """SIFT on the view from above."""
    view = view_from_above(picture)
    if view is None:
        return None
    detector = cv2.SIFT.create(nfeatures=MOST_PATCHES)
    points, raw = detector.detectAndCompute(view.grey, view.seen)
    if not points:
        return None
    pixel = np.array([p.pt for p in points], np.float64)
    places = np.c_[AHEAD[0] + CELL * pixel[:, 1], ACROSS[0] + CELL * pixel[:, 0]]
    return Patches(places.astype(np.float32), root_sift(np.asarray(raw)), view.base_T_plane)


def ground_fit(target: Patches, query: Patches) -> tuple[F64, int] | None:
    """The turn and shift (4, 4) of the query's plane in the target's, and the number of inliers;
    None below 15.
    """
    matches = mutual_matches(
        unit_descriptors(query.descriptor), unit_descriptors(target.descriptor), target.places
    )
    if len(matches) < LEAST_INLIERS:
        return None
    a = target.places[matches[:, 1]].astype(np.float64)
    b = query.places[matches[:, 0]].astype(np.float64)
    cv2.setRNGSeed(SEED)
    model, mask = cv2.estimateAffinePartial2D(
        b,
        a,
        method=cv2.RANSAC,
        ransacReprojThreshold=MATCH_DISTANCE,
        maxIters=ROUNDS,
        confidence=CONFIDENCE,
    )
    if model is None:
        return None
    inside = mask.ravel().astype(bool)
    scale = float(np.hypot(model[0, 0], model[1, 0]))
    if inside.sum() < LEAST_INLIERS or not SCALES[0] < scale < SCALES[1]:
        return None
    a = a[inside]
    b = b[inside]
    centred = (b - b.mean(0)).T @ (a - a.mean(0))
    yaw = float(np.arctan2(centred[0, 1] - centred[1, 0], centred[0, 0] + centred[1, 1]))
    pose = yaw_transform(yaw)
    pose[:2, 3] = a.mean(0) - pose[:2, :2] @ b.mean(0)
    return pose, int(inside.sum())


def make_vip(options: SystemOptions) -> GroundPatchSystem:
    """SIFT on the ground, rectified by the depth."""
    return GroundPatchSystem(options.folder)
