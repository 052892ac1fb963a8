"""Pictures of a stereo pair as they come -> points with labels: partners by time, calibrations by
topic, and why there are none.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from semloc_logs.errors import LogError
from semloc_logs.frames import F64, Camera, ImageFrame
from semloc_logs.logs.roles import Roles
from semloc_logs.logs.sensors.depth import (
    USUAL_NOISE,
    LabelImages,
    RangeNoise,
    RangePoints,
    same_calibration,
)
from semloc_logs.logs.sensors.rectification import rectification
from semloc_logs.logs.sensors.stereo import StereoMatcher

MOST_KEPT = 80  # right pictures, more than the left ones that may wait for their pose
MOST_KEPT_BYTES = 256 << 20
# between partners: half a period at 10 Hz, until the period is known, and later still
_LARGEST_GAP_NS = 50_000_000

RightTLeft = Callable[[str, str, int], F64 | None]


class StereoClouds:
    """Finds partners for left pictures and turns both into points.

    ``cameras``: the newest calibration by CameraInfo topic, kept by the caller. ``right_T_left``
    gives the transform (4, 4) from one frame id to another at a time, None where nothing says it.
    ``lost``: sentences about calibrations that cannot be used.
    """

    def __init__(
        self,
        roles: Roles,
        cameras: Mapping[str, Camera],
        labels: LabelImages,
        right_T_left: RightTLeft,
        *,
        stride: int | None = None,
        noise: RangeNoise = USUAL_NOISE,
    ) -> None:
        self.lost: dict[str, None] = {}
        self._roles, self._cameras, self._labels, self._right_T_left = (
            roles,
            cameras,
            labels,
            right_T_left,
        )
        self._stride, self._noise = stride, noise
        self._rights: deque[ImageFrame] = deque()
        self._bytes = 0
        self._left_stamps: deque[int] = deque(maxlen=16)
        self._known: tuple[Camera, Camera, tuple[int, ...], F64 | None] | None = None
        self._matcher: StereoMatcher | None = None

    def take_left(self, frame: ImageFrame) -> None:
        """Learns the frame period from a left picture."""
        self._left_stamps.append(frame.header.stamp_ns)

    def take_right(self, frame: ImageFrame) -> None:
        """Remembers a right picture until its partner has come."""
        self._rights.append(frame)
        self._bytes += frame.image.nbytes
        while len(self._rights) > MOST_KEPT or self._bytes > MOST_KEPT_BYTES:
            self._forget()

    def _forget(self) -> None:
        self._bytes -= self._rights.popleft().image.nbytes

    @property
    def tolerance_ns(self) -> int:
        """How far apart the stamps of partners may lie: half the period of the left pictures, and
        no more than 50 ms.
        """
        steps = np.diff(np.array(self._left_stamps, np.int64))
        steps = steps[steps > 0]
        return min(int(np.median(steps)) // 2, _LARGEST_GAP_NS) if len(steps) else _LARGEST_GAP_NS

    def has_all(self, left: ImageFrame) -> bool:
        """Whether right picture, calibrations, label image and the transform between the cameras
        have come, as far as one may expect.
        """
        stamp_ns = left.header.stamp_ns
        if not self._rights or self._rights[-1].header.stamp_ns < stamp_ns:
            return False
        infos = [self._info(self._roles.stereo_left), self._info(self._roles.stereo_right)]
        if not all(info is None or info in self._cameras for info in infos) or not self._labels.has(
            left
        ):
            return False
        right = self._rights[-1].header
        camera = self._cameras.get(infos[1] or "")
        has_baseline = camera is not None and camera.P[0, 3] != 0
        return (
            has_baseline
            or self._right_T_left(right.frame_id, left.header.frame_id, stamp_ns) is not None
        )

    def _info(self, topic: str | None) -> str | None:
        return self._roles.info_of.get(topic or "")

    def points(self, left: ImageFrame, min_range: float, max_range: float) -> RangePoints | str:
        """Points in the left optical frame; or the reason why there are none."""
        stamp_ns = left.header.stamp_ns
        right = min(self._rights, key=lambda r: abs(r.header.stamp_ns - stamp_ns), default=None)
        while self._rights and self._rights[0].header.stamp_ns < stamp_ns - _LARGEST_GAP_NS:
            self._forget()
        if right is None or abs(right.header.stamp_ns - stamp_ns) > self.tolerance_ns:
            return "no partner"
        if left.image.shape[:2] != right.image.shape[:2]:
            return "other size"
        cameras = [self._cameras.get(self._info(f.header.topic) or "") for f in (left, right)]
        if cameras[0] is None or cameras[1] is None:
            return "no calibration" if cameras[0] is None else "no calibration of the right"
        matcher = self._matcher_for(left, right, cameras[0], cameras[1], (min_range, max_range))
        if matcher is None:
            return "unusable pair"
        if np.array_equal(left.image, right.image):
            return "same picture"
        found = matcher.points(*_grey(left.image, right.image))
        label = self._labels.of(left, left.image.shape[:2])
        return RangePoints(
            found.points, None if label is None else label.reshape(-1)[found.pixels], found.sigma
        )

    def _matcher_for(
        self,
        left: ImageFrame,
        right: ImageFrame,
        left_camera: Camera,
        right_camera: Camera,
        ranges: tuple[float, float],
    ) -> StereoMatcher | None:
        shape = left.image.shape[:2]
        right_T_left = self._right_T_left(
            right.header.frame_id, left.header.frame_id, left.header.stamp_ns
        )
        if self._known is not None:
            a, b, known_shape, known_transform = self._known
            is_same = (
                same_calibration(a, left_camera)
                and same_calibration(b, right_camera)
                and known_shape == shape
            )
            if is_same and _same_transform(known_transform, right_T_left):
                return self._matcher
        self._known = (left_camera, right_camera, shape, right_T_left)
        self._matcher = None
        try:
            how = rectification(
                left_camera, right_camera, shape, right_T_left, rectified=is_rectified(self._roles)
            )
            self._matcher = StereoMatcher(
                how,
                min_range=ranges[0],
                max_range=ranges[1],
                stride=self._stride,
                noise=self._noise.disparity,
            )
        except LogError as error:
            self.lost.setdefault(str(error))
        return self._matcher


def is_rectified(roles: Roles) -> bool:
    """Whether the names of both topics say that their pictures come rectified."""
    return all("rect" in (topic or "").lower() for topic in (roles.stereo_left, roles.stereo_right))


def _same_transform(a: F64 | None, b: F64 | None) -> bool:
    return a is b or (a is not None and b is not None and bool(np.allclose(a, b, atol=1e-7)))


def _grey(*images: NDArray[np.uint8] | NDArray[np.uint16]) -> tuple[NDArray[np.uint8], ...]:
    """Pictures of any kind as 8-bit grey; 16 bits lose the same number of low bits in all of them."""
    bits = (
        max(int(i.max()).bit_length() for i in images)
        if any(i.dtype == np.uint16 for i in images)
        else 8
    )
    grey = []
    for image in images:
        flat = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image)
        grey.append((flat.astype(np.uint16) >> max(0, bits - 8)).astype(np.uint8))
    return tuple(grey)
