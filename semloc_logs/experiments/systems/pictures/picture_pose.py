"""The pose of a picture from its features' matches with a picture of the database: two-view
verification, then 2D-3D matches in RANSAC and their refinement (supplement 1).

Points of the database picture come from its own depth, and not from the fusion of all depth maps as
in the paper: the map's voxels of 0.30 m would be coarser than the depth that they are made of.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from semloc_logs.arrays import F32, F64, I64
from semloc_logs.experiments.system import Picture
from semloc_logs.numerics.cells import by_cell
from semloc_logs.numerics.transforms import inverse

RATIO = 0.8  # of the distances to the nearest and the second nearest descriptor (Lowe 2004)
SAME_PLACE = 4.0  # pixels between two features of one place
LEAST_INLIERS = 15
TWO_VIEW_PIXELS, POSE_PIXELS = 4.0, 4.0  # farthest that an inlier is off
ROUNDS, CONFIDENCE = 2000, 0.9999
DEPTH_WINDOW = 2  # pixels around a feature that its depth is looked for in
SEED = 0


class PicturePose(NamedTuple):
    """``camera_T_points`` (4, 4) and the number of 2D-3D ``inliers``."""

    camera_T_points: F64
    inliers: int


def mutual_matches(a: F32, b: F32, places: F32) -> I64:
    """Rows (m, 2) of unit descriptors ``a`` (n, d) and ``b`` (k, d) that are each other's nearest
    and pass the ratio test.

    The second nearest lies at another place: ``places`` (k, 2) are the pixels of ``b``. A point, or
    a region within a region, is often found at several scales.
    """
    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), np.int64)
    similarity = a @ b.T
    best = similarity.argmax(1)
    rows = np.arange(len(a))
    first = similarity[rows, best]
    mutual = similarity.argmax(0)[best] == rows
    neighbours = cKDTree(places).query_pairs(SAME_PLACE, output_type="ndarray")
    beside = [
        np.r_[neighbours[:, 0], neighbours[:, 1], np.arange(len(b))],
        np.r_[neighbours[:, 1], neighbours[:, 0], np.arange(len(b))],
    ]
    order, start = by_cell(beside[0], len(b))
    counts = np.diff(start)[best]
    # the places beside the nearest of each row
    row = np.repeat(rows, counts)
    offset = np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)
    similarity[row, beside[1][order[start[best][row] + offset]]] = -1.0
    second = similarity.max(1)
    # squared distances of unit vectors are 2 - 2 cos
    passed = (1 - first) <= RATIO**2 * (1 - second) + 1e-9
    kept = np.flatnonzero(mutual & passed)
    return np.asarray(np.c_[kept, best[kept]], np.int64)


def points_of(picture: Picture, xy: F32) -> F32:
    """Points (n, 3) that the pixels ``xy`` (n, 2) show, base frame, NaN without depth."""
    height, width = picture.depth.shape
    order = np.argsort([dx * dx + dy * dy for dx in _WINDOW for dy in _WINDOW], kind="stable")
    depth = np.full(len(xy), np.nan, np.float32)
    column, row = np.round(xy).astype(int).T
    for number in order:
        dx, dy = _WINDOW[number // len(_WINDOW)], _WINDOW[number % len(_WINDOW)]
        u = np.clip(column + dx, 0, width - 1)
        v = np.clip(row + dy, 0, height - 1)
        depth = np.where(np.isfinite(depth), depth, picture.depth[v, u])
    rays = np.c_[xy, np.ones(len(xy))] @ np.linalg.inv(picture.intrinsics).T
    camera = rays * depth[:, None]
    pose = picture.base_T_camera
    return np.asarray(camera @ pose[:3, :3].T + pose[:3, 3], np.float32)


_WINDOW = range(-DEPTH_WINDOW, DEPTH_WINDOW + 1)


def two_view_inliers(a: F32, b: F32) -> NDArray[np.bool_]:
    """Which matches of places ``a`` and ``b`` (n, 2) obey one epipolar geometry, or one homography
    where that holds for more of them (a scene in a plane, a camera that only turns).
    """
    none = np.zeros(len(a), bool)
    if len(a) < LEAST_INLIERS:
        return none
    cv2.setRNGSeed(SEED)
    _, by_epipolar = cv2.findFundamentalMat(
        a, b, cv2.FM_RANSAC, TWO_VIEW_PIXELS, CONFIDENCE, ROUNDS
    )
    _, by_homography = cv2.findHomography(
        a, b, cv2.RANSAC, TWO_VIEW_PIXELS, maxIters=ROUNDS, confidence=CONFIDENCE
    )
    epipolar, homography = (
        none if mask is None else mask.ravel().astype(bool) for mask in (by_epipolar, by_homography)
    )
    return epipolar if epipolar.sum() >= homography.sum() else homography


def pose_of_points(xy: F32, points: F32, intrinsics: F64) -> PicturePose | None:
    """The pose from pixels (n, 2) of ``points`` (n, 3); None below 15 inliers."""
    if len(xy) < LEAST_INLIERS:
        return None
    cv2.setRNGSeed(SEED)
    centre = points.mean(0)
    moved = np.ascontiguousarray(points - centre, np.float64)
    pixels = np.ascontiguousarray(xy, np.float64)
    ok, turn, shift, inliers = cv2.solvePnPRansac(
        moved,
        pixels,
        intrinsics,
        None,
        iterationsCount=ROUNDS,
        reprojectionError=POSE_PIXELS,
        confidence=CONFIDENCE,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not ok or inliers is None or len(inliers) < LEAST_INLIERS:
        return None
    rows = inliers.ravel()
    turn, shift = cv2.solvePnPRefineLM(moved[rows], pixels[rows], intrinsics, None, turn, shift)
    projected, _ = cv2.projectPoints(moved, turn, shift, intrinsics, None)
    off = np.linalg.norm(projected.reshape(-1, 2) - pixels, axis=1)
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(turn)[0]
    pose[:3, 3] = shift.ravel() - pose[:3, :3] @ centre
    ahead = moved @ pose[:3, :3].T[:, 2] + shift.ravel()[2] > 0
    count = int(((off < POSE_PIXELS) & ahead).sum())
    return PicturePose(pose, count) if count >= LEAST_INLIERS else None


def base_pose(answer: PicturePose, picture: Picture) -> F64:
    """``points_T_base`` (4, 4) of the vehicle that took ``picture``."""
    return np.asarray(inverse(answer.camera_T_points) @ inverse(picture.base_T_camera))
