"""Depth images -> points, by the calibrations and label images that were recorded with them."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from semloc_logs.errors import LogError
from semloc_logs.frames import F32, F64, Camera, DepthFrame, ImageFrame
from semloc_logs.logs.roles import Roles
from semloc_logs.logs.sensors.stereo import DISPARITY_NOISE

DENSE_PIXELS = 200_000  # a larger depth image is thinned to every second pixel of every second row
# a label image belongs to a depth image within half a period at 30 Hz
LABEL_TOLERANCE_NS = 15_000_000
# Noise along the optical axis of a structured-light camera, m: 0.0012 + 0.0019 (z - 0.4)^2, z in m
# (Nguyen, Izadi, Lovell, Modeling Kinect Sensor Noise for Improved 3D Reconstruction and Tracking,
# 3DIMPVT 2012, equation 2, surfaces seen at 10 to 60 degrees)
DEPTH_NOISE = 0.0019  # 1/m, the coefficient of the square
_LEAST_DEPTH_NOISE = 0.0012  # m
_NOISE_FREE_DEPTH = 0.4  # m
_LABELS_KEPT = 80  # more than the depth images that may wait for their pose


@dataclass(frozen=True, slots=True)
class RangeNoise:
    """How uncertain ranges from pictures are: ``depth`` (1/m), the growth of a depth image's
    standard deviation with the square of the depth, and ``disparity`` (px), the standard deviation
    of a stereo pair's disparity where texture is plenty.
    """

    depth: float = DEPTH_NOISE
    disparity: float = DISPARITY_NOISE


USUAL_NOISE = RangeNoise()


class RangePoints(NamedTuple):
    """``points`` (n, 3) in the optical frame (m), their ``label`` (n,) as recorded or None, and
    ``sigma`` (n,) of the range (m).
    """

    points: F32
    label: NDArray[np.uint32] | None
    sigma: F32


def depth_sigma(points: F32, coefficient: float = DEPTH_NOISE) -> F32:
    """Standard deviation (n,) of the range along the ray of points (n, 3) in the optical frame of a
    depth camera (m).
    """
    z = points[:, 2]
    axial = np.float32(_LEAST_DEPTH_NOISE) + np.float32(coefficient) * np.square(
        np.maximum(z - np.float32(_NOISE_FREE_DEPTH), 0)
    )
    sigma: F32 = axial * np.sqrt(np.einsum("ij,ij->i", points, points)) / z
    return sigma


class Unprojector:
    """Viewing rays of a depth camera, computed once and used for every image of that height and
    width.

    ``rectified``: the picture is undistorted, so the projection matrix P holds, not K and D.
    ``stride`` None thins images of more than 200,000 pixels. LogError when the calibration cannot
    be used.
    """

    def __init__(
        self,
        camera: Camera,
        height: int,
        width: int,
        *,
        rectified: bool = False,
        stride: int | None = None,
    ) -> None:
        where = f"CameraInfo {camera.header.topic}"
        if camera.width and camera.height and (camera.width, camera.height) != (width, height):
            raise LogError(
                f"{where} is for {camera.width} x {camera.height} pixels but the depth image has {width} x {height}: "
                f"record the CameraInfo of the depth image, or name it with --topic camera_info=TOPIC."
            )
        matrix = camera.K
        distortion = np.atleast_1d(np.asarray(camera.D, float))
        if (rectified and camera.P[0, 0] > 0) or camera.K[0, 0] <= 0:
            matrix = camera.P[:, :3]
            distortion = np.zeros(0)
        if not np.isfinite(matrix).all() or matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
            raise LogError(
                f"{where} has no focal length: the camera is not calibrated; name another with --topic camera_info=TOPIC."
            )
        self._width = width
        self.step = stride or (2 if height * width > DENSE_PIXELS else 1)
        rows, columns = np.mgrid[0 : height : self.step, 0 : width : self.step]
        pixels = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)
        rays = _normalised(pixels, matrix, distortion, camera.model, where)
        self._rays = np.concatenate([rays, np.ones((len(rays), 1))], axis=1).astype(np.float32)
        self._lengths = np.linalg.norm(self._rays, axis=1)

    def points(
        self, depth: F32, min_range: float, max_range: float
    ) -> tuple[F32, NDArray[np.intp]]:
        """Points (n, 3) in the optical frame and their flat pixel index (n,); ranges in metres
        along the ray, no depth is 0.
        """
        z = depth[:: self.step, :: self.step].reshape(-1)
        with np.errstate(invalid="ignore"):
            distance = z * self._lengths
            kept = np.flatnonzero((z > 0) & (distance >= min_range) & (distance <= max_range))
        columns = -(-self._width // self.step)
        pixels = kept // columns * self.step * self._width + kept % columns * self.step
        return self._rays[kept] * z[kept, None], pixels


def _normalised(pixels: F64, matrix: F64, distortion: F64, model: str, where: str) -> F64:
    """Pixels (n, 2) -> normalised image coordinates (n, 2)."""
    if not np.any(distortion):
        y = (pixels[:, 1] - matrix[1, 2]) / matrix[1, 1]
        return np.stack(
            [(pixels[:, 0] - matrix[0, 2] - matrix[0, 1] * y) / matrix[0, 0], y], axis=1
        )
    name = model.lower()
    rays = None
    try:
        if name in ("plumb_bob", "rational_polynomial", "thin_prism", "") and len(distortion) in (
            4,
            5,
            8,
            12,
            14,
        ):
            rays = cv2.undistortPoints(pixels[:, None], matrix, distortion)
        elif name in ("equidistant", "kannala_brandt", "fisheye") and len(distortion) == 4:
            rays = cv2.fisheye.undistortPoints(pixels[:, None], matrix, distortion)
    except cv2.error:
        rays = None
    if rays is None or not np.isfinite(rays).all():
        raise LogError(
            f"{where} has the distortion model '{model[:40]}' with {len(distortion)} coefficients, which is not supported: "
            f"record rectified depth, or name another calibration with --topic camera_info=TOPIC."
        )
    return np.asarray(rays, float).reshape(-1, 2)


def label_ids(frame: DepthFrame | ImageFrame) -> NDArray[np.uint32]:
    """Ids (h, w) of a frame on a label topic, also where a 16-bit picture was decoded as if it were
    depth.

    Of a colour picture the colours: red in bits 16 to 23, green in 8 to 15, blue in 0 to 7.
    """
    if isinstance(frame, DepthFrame):
        ids: NDArray[np.uint32] = np.rint(frame.depth * 1e3).astype(np.uint32)
        return ids
    wide = frame.image.astype(np.uint32)
    if wide.ndim == 2:
        return wide
    return np.asarray(wide[..., 0] << 16 | wide[..., 1] << 8 | wide[..., 2], np.uint32)


def is_coloured(frame: DepthFrame | ImageFrame) -> bool:
    """Whether the labels of a frame on a label topic are colours."""
    return isinstance(frame, ImageFrame) and frame.image.ndim == 3


def _metres(frame: DepthFrame | ImageFrame) -> F32 | None:
    """A 16-bit picture whose name did not say depth is in millimetres all the same, now that the
    user says so.
    """
    if isinstance(frame, DepthFrame):
        return frame.depth
    if frame.image.ndim == 2 and frame.image.dtype == np.uint16:
        return np.where(frame.image == 65535, 0, frame.image).astype(np.float32) * np.float32(1e-3)
    return None


class LabelImages:
    """Label images as they come, for the pictures that they belong to by name and time. ``notes``:
    sentences about useless ones.
    """

    def __init__(self, roles: Roles) -> None:
        self.notes: dict[str, None] = {}
        self.coloured: set[str] = set()  # label topics whose labels are colours
        self._roles = roles
        self._frames: dict[str, deque[DepthFrame | ImageFrame]] = {}

    def take(self, frame: DepthFrame | ImageFrame) -> None:
        """Remembers a frame of a label topic."""
        if is_coloured(frame):
            self.coloured.add(frame.header.topic)
        self._frames.setdefault(frame.header.topic, deque(maxlen=_LABELS_KEPT)).append(frame)

    def has(self, frame: DepthFrame | ImageFrame) -> bool:
        """Whether the label image of a picture has come, if the log promises one."""
        label = self._roles.label_of.get(frame.header.topic)
        return label is None or (
            label in self._frames
            and self._frames[label][-1].header.stamp_ns >= frame.header.stamp_ns
        )

    def of(
        self, frame: DepthFrame | ImageFrame, shape: tuple[int, ...]
    ) -> NDArray[np.uint32] | None:
        """Ids (h, w) of a picture of this shape; None without a label image at its time."""
        candidates = self._frames.get(self._roles.label_of.get(frame.header.topic, ""))
        if not candidates:
            return None
        nearest = min(candidates, key=lambda c: abs(c.header.stamp_ns - frame.header.stamp_ns))
        if abs(nearest.header.stamp_ns - frame.header.stamp_ns) > LABEL_TOLERANCE_NS:
            return None
        ids = label_ids(nearest)
        if ids.shape == shape:
            return ids
        # else it is painted by its own calibration
        if nearest.header.topic not in self._roles.info_of:
            self.notes.setdefault(
                f"{nearest.header.topic} is not used for labels: it is no picture of the same size as {frame.header.topic}; "
                f"--topic label_image=TOPIC names another."
            )
        return None


class DepthClouds:
    """Depth images -> points with labels, by the calibrations and ``labels`` that came with them.

    ``lost``: sentences about calibrations that cannot be used.
    """

    def __init__(
        self, roles: Roles, stride: int | None = None, noise: RangeNoise = USUAL_NOISE
    ) -> None:
        self.cameras: dict[str, Camera] = {}  # by CameraInfo topic, the newest
        self.labels = LabelImages(roles)
        self.lost: dict[str, None] = {}
        self._roles, self._stride, self._noise = roles, stride, noise
        self._unprojectors: dict[str, tuple[Camera, tuple[int, ...], Unprojector | None]] = {}

    def has_all(self, frame: DepthFrame | ImageFrame) -> bool:
        """Whether calibration and label image of a depth frame have come, as far as the log
        promises them.
        """
        info = self._roles.info_of.get(frame.header.topic)
        return (info is None or info in self.cameras) and self.labels.has(frame)

    def points(
        self, frame: DepthFrame | ImageFrame, min_range: float, max_range: float
    ) -> RangePoints | str:
        """Points in the optical frame; or the reason why there are none."""
        topic = frame.header.topic
        depth = _metres(frame)
        if depth is None:
            return "no depth"
        camera = self.cameras.get(self._roles.info_of.get(topic, ""))
        if camera is None:
            return "no calibration"
        unprojector = self._unprojector(topic, camera, depth.shape)
        if unprojector is None:
            return "unusable calibration"
        points, pixels = unprojector.points(depth, min_range, max_range)
        label = self.labels.of(frame, depth.shape)
        return RangePoints(
            points,
            None if label is None else label.reshape(-1)[pixels],
            depth_sigma(points, self._noise.depth),
        )

    def _unprojector(
        self, topic: str, camera: Camera, shape: tuple[int, ...]
    ) -> Unprojector | None:
        known = self._unprojectors.get(topic)
        if known is not None and same_calibration(known[0], camera) and known[1] == shape:
            return known[2]
        unprojector = None
        try:
            is_rectified = "rect" in topic
            unprojector = Unprojector(
                camera, shape[0], shape[1], rectified=is_rectified, stride=self._stride
            )
        except LogError as error:
            self.lost.setdefault(str(error))
        self._unprojectors[topic] = (camera, shape, unprojector)
        return unprojector


def same_calibration(a: Camera, b: Camera) -> bool:
    """Whether two calibrations say the same."""
    return a is b or (
        (a.width, a.height, a.model) == (b.width, b.height, b.model)
        and all(np.array_equal(x, y) for x, y in ((a.K, b.K), (a.D, b.D), (a.R, b.R), (a.P, b.P)))
    )
