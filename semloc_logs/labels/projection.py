"""Points in front of a camera -> pixels, by the lenses of logs/sensors/picture_calibration.py."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.frames import Camera
from semloc_logs.logs.sensors.picture_calibration import fitted_camera, optics_of

_NEAREST = 0.1  # m along the optical axis: nearer points are not projected
_STEEPEST = np.radians(85)
# points so much further from the middle than the picture's corner still are projected
_MARGIN = 1.25


class Projector:
    """Projects points of a camera's optical frame into its pictures, ``height`` x ``width`` pixels.

    The optical frame has x right, y down, z forward. ``rectified``: the picture is undistorted, so
    R and P hold, not K and D. A picture that was scaled as a whole is allowed for.
    ``assumptions``: sentences about what the calibration does not settle. LogError when it cannot
    be used.
    """

    def __init__(self, camera: Camera, height: int, width: int, *, rectified: bool = False) -> None:
        camera, assumption = fitted_camera(camera, height, width, rectified=rectified, scaled=True)
        matrix, lens, camera_R_picture = optics_of(camera, rectified=rectified)
        self._rotation = camera_R_picture.T
        self.assumptions = [text for text in (assumption, lens.assumption) if text]
        self._matrix = matrix
        self._distortion = lens.coefficients
        self._fisheye = lens.is_fisheye
        self.height = height
        self.width = width
        self.focal = float(matrix[0, 0])

        # the corner of the picture that is farthest from the axis, at focal length 1
        u = np.array([-0.5, width - 0.5]) - self._matrix[0, 2]
        v = np.array([-0.5, height - 0.5]) - self._matrix[1, 2]
        x = np.repeat(u, 2) / self._matrix[0, 0]
        y = np.tile(v, 2) / self._matrix[1, 1]
        corner = float(np.hypot(x, y).max())
        self._widest = _widest(self._distortion, self._fisheye, _MARGIN * corner)

    def pixels(self, points: NDArray[np.floating]) -> tuple[F64, NDArray[np.bool_]]:
        """Pixels (n, 2) of ``points`` (n, 3), and which of them may be in the picture.

        These are in front of the camera and near its field of view. The others have no pixel
        coordinates (NaN).
        """
        p = points if np.array_equal(self._rotation, np.eye(3)) else points @ self._rotation.T
        out = np.full((len(p), 2), np.nan)
        front = p[:, 2] > _NEAREST
        # a distortion polynomial turns back far outside of the picture and would fold the
        # surroundings into it
        steepest = np.tan(self._widest)
        front &= np.square(p[:, 0]) + np.square(p[:, 1]) <= np.square(p[:, 2] * steepest)
        rows = np.flatnonzero(front)
        if not len(rows):
            return out, front
        rays = np.asarray(p[rows], float)
        rays /= rays[:, 2:]
        if not np.any(self._distortion) and not self._fisheye:
            m = self._matrix
            out[rows, 0] = m[0, 0] * rays[:, 0] + m[0, 1] * rays[:, 1] + m[0, 2]
            out[rows, 1] = m[1, 1] * rays[:, 1] + m[1, 2]
        else:
            project = cv2.fisheye.projectPoints if self._fisheye else cv2.projectPoints
            projected = project(
                rays[:, None], np.zeros((1, 3)), np.zeros((1, 3)), self._matrix, self._distortion
            )[0]
            out[rows] = np.asarray(projected, float).reshape(-1, 2)
        return out, front

    def inside(self, pixels: F64) -> NDArray[np.bool_]:
        """Which of ``pixels`` (n, 2) lie in the picture."""
        return self.near(pixels, 0.0)

    def near(self, pixels: F64, margin: float) -> NDArray[np.bool_]:
        """Which of ``pixels`` (n, 2) lie in the picture or beside it.

        ``margin`` is the distance that is allowed, a share of the picture's size.
        """
        u = pixels[:, 0]
        v = pixels[:, 1]
        x = margin * self.width
        y = margin * self.height
        return np.asarray(
            (u >= -0.5 - x)
            & (u < self.width - 0.5 + x)
            & (v >= -0.5 - y)
            & (v < self.height - 0.5 + y)
        )


def _widest(distortion: F64, fisheye: bool, corner: float) -> float:
    """Angle from the optical axis (rad) up to which the distorted radius grows.

    The radius does not exceed ``corner`` (at focal length 1).
    """
    angle = np.linspace(0, _STEEPEST, 2000)
    k = np.zeros(14)
    k[: len(distortion)] = distortion
    if fisheye:
        radius = angle * (1 + k[0] * angle**2 + k[1] * angle**4 + k[2] * angle**6 + k[3] * angle**8)
    else:
        r2 = np.tan(angle) ** 2
        with np.errstate(divide="ignore", invalid="ignore"):
            radius = (
                np.sqrt(r2)
                * (1 + k[0] * r2 + k[1] * r2**2 + k[4] * r2**3)
                / (1 + k[5] * r2 + k[6] * r2**2 + k[7] * r2**3)
            )
    beyond = np.flatnonzero(~(np.diff(radius) > 0) | (radius[:-1] > corner))
    return float(angle[beyond[0]] if len(beyond) else _STEEPEST)
