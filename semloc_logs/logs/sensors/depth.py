"""Depth images -> points, by the calibrations and label images that were recorded with them."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F32, F64
from semloc_logs.errors import LogError
from semloc_logs.frames import Camera, DepthFrame, ImageFrame
from semloc_logs.logs.messages.image_codecs import METRE, MILLIMETRE, depth_metres
from semloc_logs.logs.problems import NoCloud, ProblemKind, Problems
from semloc_logs.logs.roles import Roles
from semloc_logs.logs.sensors.picture_calibration import Lens, fitted_camera, optics_of
from semloc_logs.logs.sensors.stereo import DISPARITY_NOISE
from semloc_logs.logs.sensors.unmeasured_depths import UnmeasuredDepths

DENSE_PIXELS = 200_000  # a larger depth image is thinned to every second pixel of every second row
# a label image belongs to a depth image within half a period at 30 Hz
LABEL_TOLERANCE_NS = 15_000_000
# Noise along the optical axis of a structured-light camera, m: 0.0012 + 0.0019 (z - 0.4)^2, z in m
# (Nguyen, Izadi, Lovell, Modeling Kinect Sensor Noise for Improved 3D Reconstruction and Tracking,
# 3DIMPVT 2012, equation 2, surfaces seen at 10 to 60 degrees)
DEPTH_NOISE = 0.0019  # 1/m, the coefficient of the square
_LEAST_DEPTH_NOISE = 0.0012  # m
_NOISE_FREE_DEPTH = 0.4  # m
# m; a room or a street is nearer, and further away than a hand: medians of depth images beyond
# either are of another unit
_FARTHEST_MEDIAN = 200.0
_NEAREST_MEDIAN = 0.05
_LEAST_MEASURED = 100  # one pixel in so many has a depth in an image that shows the unit
_LABEL_BYTES = 256 << 20  # of a topic, for the pictures that wait for their pose
_OLD_LABEL_NS = 1_000_000_000  # pictures of several topics come in order, give or take this


@dataclass(frozen=True, slots=True)
class RangeNoise:
    """How uncertain ranges from pictures are.

    ``depth`` (1/m): growth of a depth image's standard deviation with the square of the depth.
    ``disparity`` (px): standard deviation of a stereo pair's disparity where texture is plenty.
    """

    depth: float = DEPTH_NOISE
    disparity: float = DISPARITY_NOISE


USUAL_NOISE = RangeNoise()


class RangePoints(NamedTuple):
    """Points (n, 3) in the optical frame (m), ``label`` (n,) or None, ``sigma`` (n,) of range."""

    points: F32
    label: NDArray[np.uint32] | None
    sigma: F32


def depth_sigma(points: F32, coefficient: float = DEPTH_NOISE) -> F32:
    """Standard deviation (n,) in m of the range of points (n, 3) in a depth camera's frame."""
    z = points[:, 2]
    axial = np.float32(_LEAST_DEPTH_NOISE) + np.float32(coefficient) * np.square(
        np.maximum(z - np.float32(_NOISE_FREE_DEPTH), 0)
    )
    sigma: F32 = axial * np.sqrt(np.einsum("ij,ij->i", points, points)) / z
    return sigma


class Unprojector:
    """Viewing rays of a depth camera, computed once for all images of that height and width.

    ``rectified``: the picture is undistorted, so the projection matrix P holds, not K and D.
    ``stride`` None thins images of more than 200,000 pixels. ``assumptions``: sentences about what
    the calibration does not settle. LogError when it cannot be used.
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
        camera, assumption = fitted_camera(
            camera, height, width, rectified=rectified, what="depth image"
        )
        matrix, lens, camera_R_picture = optics_of(camera, rectified=rectified)
        self.assumptions = [text for text in (assumption, lens.assumption) if text]
        self._width = width
        self.step = stride or (2 if height * width > DENSE_PIXELS else 1)
        rows, columns = np.mgrid[0 : height : self.step, 0 : width : self.step]
        pixels = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)
        flat = _normalised(pixels, matrix, lens, camera.header.topic)
        rays = np.concatenate([flat, np.ones((len(flat), 1))], axis=1)
        self._rays = (rays @ camera_R_picture.T).astype(np.float32)
        self._lengths = np.linalg.norm(self._rays, axis=1)

    def points(
        self, depth: F32, min_range: float, max_range: float
    ) -> tuple[F32, NDArray[np.intp]]:
        """Points (n, 3) in the optical frame and their flat pixel index (n,).

        ``depth`` (h, w) in m, 0 where unknown; ranges in m along the ray.
        """
        z = depth[:: self.step, :: self.step].reshape(-1)
        with np.errstate(invalid="ignore"):
            distance = z * self._lengths
            kept = np.flatnonzero((z > 0) & (distance >= min_range) & (distance <= max_range))
        columns = -(-self._width // self.step)
        pixels = kept // columns * self.step * self._width + kept % columns * self.step
        return self._rays[kept] * z[kept, None], pixels


def _normalised(pixels: F64, matrix: F64, lens: Lens, calibration: str) -> F64:
    """Pixels (n, 2) -> normalised image coordinates (n, 2)."""
    if not lens.is_fisheye and not len(lens.coefficients):
        y = (pixels[:, 1] - matrix[1, 2]) / matrix[1, 1]
        return np.stack(
            [(pixels[:, 0] - matrix[0, 2] - matrix[0, 1] * y) / matrix[0, 0], y], axis=1
        )
    undo = cv2.fisheye.undistortPoints if lens.is_fisheye else cv2.undistortPoints
    try:
        rays = undo(pixels[:, None], matrix, lens.coefficients)
    except cv2.error:
        rays = None
    if rays is None or not np.isfinite(rays).all():
        raise LogError(
            f"The distortion of CameraInfo {calibration} cannot be undone: record rectified depth, "
            f"or name another calibration with --topic camera_info=TOPIC."
        )
    return np.asarray(rays, float).reshape(-1, 2)


def label_ids(frame: DepthFrame | ImageFrame) -> NDArray[np.uint32]:
    """Ids (h, w) of a frame on a label topic, also of a 16-bit picture that was decoded as depth.

    Of a colour picture the packed colours, see :class:`semloc_logs.frames.LabelForm`.
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


class DepthUnits:
    """Depth images in metres; ``problems`` name the topics whose values cannot be what they claim.

    ``unit`` (m) of one step of all of them; None: as their encodings are defined, millimetres of
    whole numbers and metres of floats, unless the floats cannot be metres.
    """

    def __init__(self, unit: float | None = None) -> None:
        self.problems = Problems()
        self._unit = unit
        self._unit_of: dict[str, float] = {}

    def metres(self, frame: DepthFrame | ImageFrame) -> F32 | None:
        """Depth (h, w) in m; None where a picture that the user named as depth has no depth."""
        if isinstance(frame, DepthFrame):
            recorded = frame.depth
            step = frame.step
        elif frame.image.ndim == 2 and frame.image.dtype == np.uint16:
            recorded = depth_metres(frame.image)
            step = MILLIMETRE
        else:
            return None
        unit = self._unit or self._unit_of.get(frame.header.topic)
        if unit is None:
            unit = self._judge(frame.header.topic, recorded, step)
        return recorded if unit == step else recorded * np.float32(unit / step)

    def _judge(self, topic: str, recorded: F32, step: float) -> float:
        """The unit (m) of a topic, by its first image that shows enough."""
        measured = recorded[recorded > 0]
        # simulators give the sky one large value
        below = measured[measured < measured.max()] if len(measured) else measured
        some = below if len(below) else measured
        if len(some) < max(1, recorded.size // _LEAST_MEASURED):
            return step
        median = float(np.median(some))
        unit = step
        if step == METRE and median > _FARTHEST_MEDIAN:
            unit = MILLIMETRE
            self.problems.assume(
                f"{topic}: half of its depths are beyond {median:.0f}, which would be metres by "
                f"their encoding 32FC1: they are taken as millimetres; "
                f"--set logs.depth_unit=1 takes them as metres.",
                topic=topic,
                kind=ProblemKind.FRAME,
            )
        elif step == MILLIMETRE and median < _NEAREST_MEDIAN:
            self.problems.assume(
                f"{topic}: half of its depths are below {median * 1e3:.0f} mm if their steps are "
                f"millimetres, as their encoding has it; --set logs.depth_unit=METRES gives the "
                f"metres of one step.",
                topic=topic,
                kind=ProblemKind.FRAME,
            )
        self._unit_of[topic] = unit
        return unit


class LabelImages:
    """Label images as they come, for the pictures that they belong to by name and time.

    ``problems`` name the ones that cannot be used.
    """

    def __init__(self, roles: Roles) -> None:
        self.problems = Problems()
        self.coloured: set[str] = set()  # label topics whose labels are colours
        self._roles = roles
        self._frames: dict[str, deque[DepthFrame | ImageFrame]] = {}

    def take(self, frame: DepthFrame | ImageFrame) -> None:
        """Remembers a frame of a label topic."""
        if is_coloured(frame):
            self.coloured.add(frame.header.topic)
        kept = self._frames.setdefault(frame.header.topic, deque())
        kept.append(frame)
        # all pictures of a topic have about the same size
        while len(kept) > 1 and len(kept) * _picture_bytes(frame) > _LABEL_BYTES:
            kept.popleft()

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
        while candidates[0].header.stamp_ns < frame.header.stamp_ns - _OLD_LABEL_NS:
            if len(candidates) == 1:
                break
            candidates.popleft()
        if abs(nearest.header.stamp_ns - frame.header.stamp_ns) > LABEL_TOLERANCE_NS:
            return None
        ids = label_ids(nearest)
        if ids.shape == shape:
            return ids
        # else it is painted by its own calibration
        if nearest.header.topic not in self._roles.info_of:
            self.problems.add(
                f"{nearest.header.topic} is not used for labels: its pictures do not have the size "
                f"of {frame.header.topic}; --topic label_image=TOPIC names another.",
                topic=nearest.header.topic,
                kind=ProblemKind.LABEL,
                lost=False,
            )
        return None


def _picture_bytes(frame: DepthFrame | ImageFrame) -> int:
    return frame.depth.nbytes if isinstance(frame, DepthFrame) else frame.image.nbytes


class DepthClouds:
    """Depth images -> points with labels, by the recorded calibrations and ``labels``.

    ``calibrations``: the newest one by CameraInfo topic; ``problems`` name the unusable ones.
    ``units``: what the values of the images are in, ``unit`` (m) where the user gives it.
    ``unmeasured``: depths that stand for no measurement.
    """

    def __init__(
        self,
        roles: Roles,
        stride: int | None = None,
        noise: RangeNoise = USUAL_NOISE,
        unit: float | None = None,
    ) -> None:
        self.units = DepthUnits(unit)
        self.unmeasured = UnmeasuredDepths()
        self.calibrations: dict[str, Camera] = {}
        self.labels = LabelImages(roles)
        self.problems = Problems()
        self._roles = roles
        self._stride = stride
        self._noise = noise
        self._unprojectors: dict[str, tuple[Camera, tuple[int, ...], Unprojector | None]] = {}

    def has_all(self, frame: DepthFrame | ImageFrame) -> bool:
        """Whether calibration and label image of a depth frame have come, if the log has them."""
        info = self._roles.info_of.get(frame.header.topic)
        return (info is None or info in self.calibrations) and self.labels.has(frame)

    def points(
        self, frame: DepthFrame | ImageFrame, min_range: float, max_range: float
    ) -> RangePoints | NoCloud:
        """Points in the optical frame, or the reason for none."""
        topic = frame.header.topic
        depth = self.units.metres(frame)
        if depth is None:
            return NoCloud.NO_DEPTH
        camera = self.calibrations.get(self._roles.info_of.get(topic, ""))
        if camera is None:
            return NoCloud.NO_CALIBRATION
        unprojector = self._unprojector(topic, camera, depth.shape)
        if unprojector is None:
            return NoCloud.UNUSABLE_CALIBRATION
        depth = self.unmeasured.measured(topic, depth, max_range)
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
            for text in unprojector.assumptions:
                self.problems.assume(text, topic=topic, kind=ProblemKind.CALIBRATION)
        except LogError as error:
            self.problems.add(str(error), topic=topic, kind=ProblemKind.CALIBRATION)
        self._unprojectors[topic] = (camera, shape, unprojector)
        return unprojector


def same_calibration(a: Camera, b: Camera) -> bool:
    """Whether two calibrations are equal, apart from their headers."""
    return a is b or (
        (a.width, a.height, a.model, a.binning, a.roi)
        == (b.width, b.height, b.model, b.binning, b.roi)
        and all(np.array_equal(x, y) for x, y in ((a.K, b.K), (a.D, b.D), (a.R, b.R), (a.P, b.P)))
    )
