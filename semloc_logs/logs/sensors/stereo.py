"""Depth from stereo pairs: semi-global matching, checks that reject guesses, and uncertainty.

Matching is OpenCV's StereoSGBM (Hirschmueller, Stereo Processing by Semiglobal Matching and Mutual
Information, PAMI 2008, with the pixel cost of Birchfield and Tomasi). A disparity stays when it is
better than all others, is the same seen from the right, belongs to no speckle, and when the picture
has the texture for it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F32
from semloc_logs.errors import LogError
from semloc_logs.logs.sensors.rectification import SMALLEST, Rectification

# px of the matched pictures, where texture is plenty: interpolation, pixel locking, calibration
DISPARITY_NOISE = 0.2
# of the range; beyond that sigma, 1 / disparity is not linear enough for a standard deviation
LARGEST_SHARE = 0.15
MOST_PIXELS = 500_000  # larger pictures are shrunk before they are matched
DENSE_PIXELS = 200_000  # of larger ones every second pixel of every second row becomes a point
_GREY_NOISE = 3.0  # grey levels: noise, and differences between the cameras
_LARGEST_NOISE = 0.8  # px; a disparity that is worse for want of texture is dropped
_TEXTURE = 9  # px; window that texture is measured in
_NEAREST = 1e-3  # m; a smaller min_range would search without end
_BLOCK = 5  # px; matched windows
_FIXED_POINT = 16  # OpenCV's disparities are in sixteenths of a pixel
# disparities up to a tenth of the width are searched: from 0.5 m at 11 cm and a lens of 90 degrees
_SHARE_SEARCHED = 10
_LEFT_RIGHT = 1.0  # px; largest difference of the disparities from both sides
_UNIQUENESS = 10  # percent by which the second best match is worse
_SPECKLE = 0.0004  # share of the picture that a patch of like disparities covers at least
_RIM = 4  # px along the edge of the recorded picture whose windows reach beyond it

Grey = NDArray[np.uint8]


class StereoPoints(NamedTuple):
    """Points of a pair in the left optical frame.

    ``points`` (n, 3) in m, ``sigma`` (n,) of the range along the ray (m), ``pixels`` (n,): flat
    index in the left picture as recorded, so that a label image of the left camera belongs to them.
    """

    points: F32
    sigma: F32
    pixels: NDArray[np.intp]


class StereoMatcher:
    """Turns pictures of one pair of cameras into points.

    ``min_range`` and ``max_range`` (m, along the ray) bound the disparities that are searched.
    ``stride`` n shrinks the pictures n-fold before they are matched; None: they are matched as they
    are up to half a million pixels and shrunk until they have so few, and above 200,000 pixels
    every second pixel of every second row becomes a point. ``noise``: standard deviation of a
    disparity where texture is plenty (px of the matched pictures). LogError where nothing within
    the ranges could be seen by both.
    """

    def __init__(
        self,
        how: Rectification,
        *,
        min_range: float,
        max_range: float,
        stride: int | None = None,
        noise: float = DISPARITY_NOISE,
    ) -> None:
        self._how = how
        self._noise = noise
        self._min_range = min_range
        self._max_range = max_range
        height, width = how.pixels.shape
        shrink = stride or math.ceil(math.sqrt(height * width / MOST_PIXELS))
        self.shrink = max(1, min(shrink, height // SMALLEST, width // SMALLEST))
        self.width = width // self.shrink
        self.height = height // self.shrink
        self.step = 2 if stride is None and self.width * self.height > DENSE_PIXELS else 1
        # recorded pixels in a matched one; more than shrink by less than one pixel in all
        self._scale = width / self.width
        self._fb = how.focal * how.baseline / self._scale
        self._offset = how.offset / self._scale
        self.least, self.count = self._disparities()
        if abs(self.least) + self.count >= self.width:
            raise LogError(
                f"The calibrations of the stereo pair put all within {max_range:g} m at "
                f"disparities of {self.least} pixels and more, too many for pictures "
                f"{self.width} pixels wide; name others with --topic camera_info=TOPIC,TOPIC."
            )
        self._matcher = _matcher(self.least, self.count)
        self._back_least = math.floor(self.least / 2)
        self._back_matcher = _matcher(
            self._back_least, max(16, 16 * math.ceil((self.count + 2) / 32))
        )
        self._right_valid = (
            cv2.resize(
                _inner(how.valid[1]),
                (self.width // 2, self.height // 2),
                interpolation=cv2.INTER_NEAREST,
            )
            > 0
        )
        self._set_rays()

    def _disparities(self) -> tuple[int, int]:
        """The least disparity (px, matched picture) and their number, between the ranges.

        No more than are worth their time.
        """
        at_max_range = self._fb / self._max_range + self._offset
        at_min_range = self._fb / max(self._min_range, _NEAREST) + self._offset
        least = math.floor(max(at_max_range - 1, self._offset))
        most = min(math.ceil(at_min_range) + 1, least + self.width // _SHARE_SEARCHED)
        return least, max(16, 16 * math.ceil((most - least) / 16))

    def _set_rays(self) -> None:
        """Viewing rays (n, 3) in the left optical frame, and their pixels.

        The points have z = 1 along the rectified axis.
        """
        how = self._how
        s = self._scale
        columns = np.arange(0, self.width, self.step)
        rows = np.arange(0, self.height, self.step)
        x = (columns + 0.5) * s - 0.5
        y = (rows + 0.5) * how.pixels.shape[0] / self.height - 0.5
        rays = np.ones((len(y), len(x), 3))
        rays[..., 0] = (x - how.centre[0]) / how.focal
        rays[..., 1] = ((y - how.centre[1]) / how.focal)[:, None]
        self._lengths = np.linalg.norm(rays, axis=2).ravel().astype(np.float32)
        self._rays = np.ascontiguousarray((rays @ how.left_R_rect.T).reshape(-1, 3), np.float32)
        grid = np.ix_(np.rint(y).astype(np.intp), np.rint(x).astype(np.intp))
        self._pixels = how.pixels[grid].ravel()
        self._left_valid = _inner(how.valid[0])[grid] > 0

    def points(self, left: Grey, right: Grey) -> StereoPoints:
        """The points that both pictures (h, w) see, as recorded by the cameras at one time."""
        left = self._rectified(left, 0)
        right = self._rectified(right, 1)
        disparity, noise = self.disparity(left, right)
        some = np.s_[:: self.step, :: self.step]
        kept = np.flatnonzero(np.isfinite(disparity[some]) & self._left_valid)
        d = disparity[some].ravel()[kept] - np.float32(self._offset)
        noise = noise[some].ravel()[kept]
        with np.errstate(divide="ignore", invalid="ignore"):
            z = np.float32(self._fb) / d
            distance = z * self._lengths[kept]
            good = (
                (d > 0)
                & (distance >= self._min_range)
                & (distance <= self._max_range)
                & (noise <= LARGEST_SHARE * d)
            )
        kept = kept[good]
        z = z[good]
        distance = distance[good]
        # z = f b / d, so sigma_z = z^2 / (f b) sigma_d, and the range is as much longer as its ray
        sigma = distance * z * noise[good] / np.float32(self._fb)
        return StereoPoints(
            self._rays[kept] * z[:, None], sigma.astype(np.float32), self._pixels[kept]
        )

    def _rectified(self, image: Grey, side: int) -> Grey:
        if self._how.maps is not None:
            image = np.asarray(cv2.remap(image, *self._how.maps[side], cv2.INTER_LINEAR), np.uint8)
        return (
            image
            if self.shrink == 1
            else np.asarray(
                cv2.resize(image, (self.width, self.height), interpolation=cv2.INTER_AREA), np.uint8
            )
        )

    def disparity(self, left: Grey, right: Grey) -> tuple[F32, F32]:
        """Disparities (h, w) of rectified pictures (px), NaN where unknown, and sigma (h, w)."""
        disparity = _run(self._matcher, left, right, self.least + self.count)
        matched = (disparity >= self.least) & self._same_from_the_right(disparity, left, right)
        noise = disparity_noise(left, self._noise)
        matched &= noise <= _LARGEST_NOISE
        rejected = (self.least - 1) * _FIXED_POINT
        fixed = np.where(matched, np.rint(disparity * _FIXED_POINT), rejected).astype(np.int16)
        cv2.filterSpeckles(fixed, rejected, int(_SPECKLE * fixed.size), _FIXED_POINT)
        is_kept = fixed >= self.least * _FIXED_POINT
        return np.where(is_kept, disparity, np.float32(np.nan)), noise

    def _same_from_the_right(self, disparity: F32, left: Grey, right: Grey) -> NDArray[np.bool_]:
        """Where the right picture, matched on its own, gives the same disparity (h, w).

        At half the size, because the windows see more there.
        """
        size = (self.width // 2, self.height // 2)
        mirrored = [
            np.asarray(cv2.flip(cv2.resize(i, size, interpolation=cv2.INTER_AREA), 1), np.uint8)
            for i in (right, left)
        ]
        back = _run(
            self._back_matcher, mirrored[0], mirrored[1], self._back_least + self.count // 2
        )[:, ::-1]
        back = np.where(
            (back >= self._back_least) & self._right_valid, 2 * back, np.float32(np.nan)
        )
        # column of the partner in the right picture at half the size
        column = (np.arange(self.width, dtype=np.float32) - disparity).astype(np.int32) // 2
        inside = (column >= 0) & (column < size[0])
        rows = np.minimum(np.arange(self.height) // 2, size[1] - 1)[:, None]
        with np.errstate(invalid="ignore"):
            same: NDArray[np.bool_] = inside & (
                np.abs(back[rows, np.clip(column, 0, size[0] - 1)] - disparity) <= _LEFT_RIGHT
            )
        return same


def disparity_noise(left: Grey, least: float) -> F32:
    """Standard deviation (h, w) of disparities (px): ``least``, and the effect of grey noise.

    Grey noise matters where the picture changes little along the row. A shift between two windows
    of noise sigma each can be known to 2 sigma^2 / sum of squared gradients (Cramer-Rao; Foerstner,
    A feature based correspondence algorithm for image matching, 1986).
    """
    gradient = cv2.Sobel(left, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    energy = cv2.sqrBoxFilter(gradient, cv2.CV_32F, (_TEXTURE, _TEXTURE), normalize=False)
    variance = np.float32(2 * _GREY_NOISE**2) / (energy + np.float32(1e-3))
    noise: F32 = np.sqrt(variance + np.float32(least**2))
    return noise


def _matcher(least: int, count: int) -> cv2.StereoSGBM:
    # of OpenCV's ways to aggregate, the one of three directions is the fastest, and on real walls
    # as good as five or eight
    area = _BLOCK * _BLOCK
    return cv2.StereoSGBM.create(
        minDisparity=least,
        numDisparities=count,
        blockSize=_BLOCK,
        P1=8 * area,  # as OpenCV recommends for grey pictures
        P2=32 * area,
        disp12MaxDiff=1,
        preFilterCap=31,
        uniquenessRatio=_UNIQUENESS,
        speckleWindowSize=0,  # speckles are removed after the other checks
        speckleRange=0,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )


def _run(matcher: cv2.StereoSGBM, left: Grey, right: Grey, most: int) -> F32:
    """Disparities (h, w) in pixels.

    The matcher leaves out as many columns as it searches disparities: they are added before.
    """
    margin = max(0, most)
    wide = [cv2.copyMakeBorder(i, 0, 0, margin, 0, cv2.BORDER_REPLICATE) for i in (left, right)]
    fixed = np.asarray(matcher.compute(*wide), np.int16)[:, margin:]
    disparity: F32 = fixed.astype(np.float32) / np.float32(_FIXED_POINT)
    return disparity


def _inner(valid: NDArray[np.bool_]) -> Grey:
    """1 where a window lies on the recorded picture as a whole, else 0."""
    size = 2 * _RIM + 1
    return np.asarray(
        cv2.erode(valid.astype(np.uint8), np.ones((size, size), np.uint8), borderValue=0), np.uint8
    )
