"""Pictures of a stereo pair as they come -> points with labels: partners, calibrations, reasons."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.errors import LogError
from semloc_logs.frames import Camera, ImageFrame
from semloc_logs.logs.problems import NoCloud, ProblemKind, Problems
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

MOST_KEPT_BYTES = 512 << 20  # of right pictures, as of the left ones that wait for their pose
# between partners: half a period at 10 Hz, until the period is known, and later still
_LARGEST_GAP_NS = 50_000_000

RightTLeft = Callable[[str, str, int], F64 | None]


class StereoClouds:
    """Finds partners for left pictures and turns both into points.

    ``cameras``: the newest calibration by CameraInfo topic, kept by the caller. ``right_T_left``
    gives the transform (4, 4) from one frame id to another at a time, None where it is unknown.
    ``problems`` name the calibrations that cannot be used.
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
        self.problems = Problems()
        self._roles = roles
        self._cameras = cameras
        self._labels = labels
        self._right_T_left = right_T_left
        self._stride = stride
        self._noise = noise
        self._rights: deque[ImageFrame] = deque()
        self._bytes = 0
        self._left_stamps: deque[int] = deque(maxlen=16)
        self._matched: _Pair | None = None  # the pair that the matcher is for
        self._matcher: StereoMatcher | None = None

    def take_left(self, frame: ImageFrame) -> None:
        """Learns the frame period from a left picture."""
        self._left_stamps.append(frame.header.stamp_ns)

    def take_right(self, frame: ImageFrame) -> None:
        """Remembers a right picture until its partner has come."""
        self._rights.append(frame)
        self._bytes += frame.image.nbytes
        while self._bytes > MOST_KEPT_BYTES:
            self._forget()

    def _forget(self) -> None:
        self._bytes -= self._rights.popleft().image.nbytes

    @property
    def tolerance_ns(self) -> int:
        """Largest difference of partners' stamps: half the left pictures' period, at most 50 ms."""
        steps = np.diff(np.array(self._left_stamps, np.int64))
        steps = steps[steps > 0]
        return min(int(np.median(steps)) // 2, _LARGEST_GAP_NS) if len(steps) else _LARGEST_GAP_NS

    def has_all(self, left: ImageFrame) -> bool:
        """Whether the right picture, calibrations, label image and transform have come."""
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

    def points(self, left: ImageFrame, min_range: float, max_range: float) -> RangePoints | NoCloud:
        """Points in the left optical frame, or the reason for none."""
        stamp_ns = left.header.stamp_ns
        right = min(self._rights, key=lambda r: abs(r.header.stamp_ns - stamp_ns), default=None)
        while self._rights and self._rights[0].header.stamp_ns < stamp_ns - _LARGEST_GAP_NS:
            self._forget()
        if right is None or abs(right.header.stamp_ns - stamp_ns) > self.tolerance_ns:
            return NoCloud.NO_PARTNER
        if left.image.shape[:2] != right.image.shape[:2]:
            return NoCloud.OTHER_SIZE
        left_camera = self._cameras.get(self._info(left.header.topic) or "")
        right_camera = self._cameras.get(self._info(right.header.topic) or "")
        if left_camera is None:
            return NoCloud.NO_CALIBRATION
        if right_camera is None:
            return NoCloud.NO_RIGHT_CALIBRATION
        right_T_left = self._right_T_left(right.header.frame_id, left.header.frame_id, stamp_ns)
        pair = _Pair(left_camera, right_camera, left.image.shape[:2], right_T_left)
        matcher = self._matcher_for(pair, min_range, max_range)
        if matcher is None:
            return NoCloud.UNUSABLE_PAIR
        if np.array_equal(left.image, right.image):
            return NoCloud.SAME_PICTURE

        seen = matcher.points(*_grey(left.image, right.image))
        label = self._labels.of(left, left.image.shape[:2])
        return RangePoints(
            seen.points, None if label is None else label.reshape(-1)[seen.pixels], seen.sigma
        )

    def _matcher_for(self, pair: _Pair, min_range: float, max_range: float) -> StereoMatcher | None:
        """The matcher of a pair, made anew when the pair changes; None where it cannot be used."""
        if self._matched is not None and self._matched.is_same(pair):
            return self._matcher
        self._matched = pair
        self._matcher = None
        topic = self._roles.stereo_left or ""
        try:
            how = rectification(
                pair.left,
                pair.right,
                pair.shape,
                pair.right_T_left,
                rectified=is_rectified(self._roles),
            )
            for text in how.assumptions:
                self.problems.assume(text, topic=topic, kind=ProblemKind.CALIBRATION)
            self._matcher = StereoMatcher(
                how,
                min_range=min_range,
                max_range=max_range,
                stride=self._stride,
                noise=self._noise.disparity,
            )
        except LogError as error:
            self.problems.add(str(error), topic=topic, kind=ProblemKind.CALIBRATION)
        return self._matcher


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """Calibrations of a pair, the size (h, w) of its pictures, and the transform if known."""

    left: Camera
    right: Camera
    shape: tuple[int, int]
    right_T_left: F64 | None

    def is_same(self, other: _Pair) -> bool:
        return (
            same_calibration(self.left, other.left)
            and same_calibration(self.right, other.right)
            and self.shape == other.shape
            and _same_transform(self.right_T_left, other.right_T_left)
        )


def is_rectified(roles: Roles) -> bool:
    """Whether the pictures come rectified, by the names of both topics."""
    return all("rect" in (topic or "").lower() for topic in (roles.stereo_left, roles.stereo_right))


def _same_transform(a: F64 | None, b: F64 | None) -> bool:
    return a is b or (a is not None and b is not None and bool(np.allclose(a, b, atol=1e-7)))


def _grey(*images: NDArray[np.uint8] | NDArray[np.uint16]) -> tuple[NDArray[np.uint8], ...]:
    """Pictures of any kind as 8-bit grey; 16 bits lose the same number of low bits in all."""
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
