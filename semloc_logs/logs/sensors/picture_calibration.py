"""The calibration of one picture: region of interest, binning and lens of a CameraInfo.

The size, K and P of a sensor_msgs/CameraInfo are of the full picture of the sensor. The recorded
picture is its part ``roi``, and ``binning`` pixels of the sensor make one pixel of it (REP 104):
K of the picture = (K - offset of the roi) / binning. Some drivers write the size or K of the
recorded picture instead. The size of the picture tells the first, the principal point, which lies
near the middle of the picture that it belongs to, the second.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.errors import LogError
from semloc_logs.frames import WHOLE_PICTURE, Camera

# share of a picture's side by which a principal point is off its middle at most
_OFF_MIDDLE = 0.2
# and by which it usually is: between two readings that differ by less, nothing can be told
_NEAR_MIDDLE = 0.08
# share by which it is off where it lies near the middle of the picture turned by 90 degrees
_OFF_TURNED = 0.1
_NO_MATTER = 0.01  # share of a side: readings that differ by less give the same map
_MOST_STRETCH = 0.02  # by which a picture may be scaled differently along its axes
_REMEDY = "name another calibration with --topic camera_info=TOPIC"

# lens models by name; the coefficients are in the order of OpenCV
_WITHOUT_DISTORTION = {"", "none", "pinhole", "no_distortion", "undistorted", "perspective"}
_POLYNOMIAL = {
    "plumb_bob", "rational_polynomial", "thin_prism", "radtan", "radial_tangential",
    "brown_conrady",
}  # fmt: skip
_POLYNOMIAL_COEFFICIENTS = (4, 5, 8, 12, 14)
_FISHEYE = {
    "equidistant", "equi", "fisheye", "kannala_brandt", "kannala_brandt4", "kannalabrandt4",
}  # fmt: skip
_FISHEYE_COEFFICIENTS = 4
# models that cannot be undone here, but are pinholes where all coefficients are 0
_PINHOLE_AT_ZERO = {"inverse_brown_conrady", "modified_brown_conrady"}


class Lens(NamedTuple):
    """How a lens distorts: by OpenCV's polynomial or its fisheye model (``is_fisheye``).

    ``coefficients`` (n,), empty for a pinhole; ``assumption``: a sentence where the calibration
    does not settle the model, else "".
    """

    is_fisheye: bool
    coefficients: F64
    assumption: str = ""


def lens_of(camera: Camera) -> Lens:
    """The lens of a camera. LogError where its model is unknown, or its coefficients do not fit."""
    D = np.atleast_1d(np.asarray(camera.D, float))
    name = camera.model.strip().lower().replace(" ", "_").replace("-", "_")
    topic = camera.header.topic
    is_zero = not D.any()
    if is_zero and name in _WITHOUT_DISTORTION | _POLYNOMIAL | _PINHOLE_AT_ZERO:
        return Lens(is_fisheye=False, coefficients=np.zeros(0))
    if is_zero and name in _FISHEYE:
        return Lens(
            is_fisheye=True,
            coefficients=np.zeros(_FISHEYE_COEFFICIENTS),
            assumption=f"CameraInfo {topic} has the distortion model '{camera.model}' without "
            f"coefficients: it is taken as a fisheye lens whose angles are proportional to the "
            f"radius, not as a pinhole; {_REMEDY} if it is one.",
        )

    if name in _FISHEYE:
        coefficients = _with_length(D, (_FISHEYE_COEFFICIENTS,))
    elif name in _POLYNOMIAL or name == "":
        coefficients = _with_length(D, _POLYNOMIAL_COEFFICIENTS)
    else:
        coefficients = None
    if coefficients is None:
        raise LogError(
            f"CameraInfo {topic} has the distortion model '{camera.model[:40]}' with {len(D)} "
            f"coefficients, which is not supported: record rectified pictures, or {_REMEDY}."
        )
    assumption = ""
    if name == "":
        assumption = (
            f"CameraInfo {topic} has {len(D)} distortion coefficients but does not name their "
            f"model: they are taken as plumb_bob or rational_polynomial; {_REMEDY} if they are not."
        )
    return Lens(name in _FISHEYE, coefficients, assumption)


def _with_length(D: F64, lengths: tuple[int, ...]) -> F64 | None:
    """``D`` with as many coefficients as one of ``lengths``; zeros at its end may be left out."""
    if len(D) < lengths[0]:
        return None
    used = int(np.flatnonzero(D)[-1]) + 1
    length = next((n for n in lengths if n == len(D)), None)
    length = length or next((n for n in lengths if n >= used), None)
    if length is None:
        return None
    out = np.zeros(length)
    out[: min(length, len(D))] = D[:length]
    return out


class FittedCamera(NamedTuple):
    """A calibration of exactly one picture: its size, K and P are of that picture.

    ``assumption``: a sentence where the calibration contradicts itself, else "".
    """

    camera: Camera
    assumption: str = ""


class _Reading(NamedTuple):
    """``size`` (x, y) of the picture where ``offset`` (px) and ``binning`` (x, y) apply."""

    size: F64
    offset: F64
    binning: F64

    def is_of(self, size: F64) -> bool:
        """Whether it gives a picture of this size; sensors round halves as they like."""
        return bool((np.abs(self.size - size) < 1.0).all())

    def of_picture(self, point: F64) -> F64:
        """A place (x, y) on the full picture in pixels of the recorded one."""
        place: F64 = (point - self.offset) / self.binning
        return place


def fitted_camera(
    camera: Camera,
    height: int,
    width: int,
    *,
    rectified: bool = False,
    what: str = "picture",
    scaled: bool = False,
) -> FittedCamera:
    """The calibration of a picture of ``height`` x ``width`` pixels.

    ``rectified``: P holds for it, not K; ``what`` it is called; ``scaled``: it may have been scaled
    as a whole. LogError where the calibration is of another size.
    """
    size = np.array([width, height], float)
    full = _full_size(camera, size)
    by_definition = _by_definition(camera, full)
    is_whole = np.array_equal(by_definition.size, full) and (by_definition.binning == 1).all()
    fitted: FittedCamera | None = None
    if is_whole and by_definition.is_of(size):
        fitted = FittedCamera(camera, _other_size(camera, "P" if rectified else "K", full))
    elif not is_whole:
        matrix = "P" if rectified else "K"
        fitted = _with_region(_Claim(camera, matrix, full, by_definition), size)
    if fitted is not None:
        return FittedCamera(_of_size(fitted.camera, height, width), fitted.assumption)

    recorded = by_definition.size
    stretch = size / recorded
    if scaled and abs(stretch[0] / stretch[1] - 1) <= _MOST_STRETCH:
        reduced = _reduced(camera, by_definition)
        return FittedCamera(_of_size(_scaled(reduced, stretch), height, width))
    stated = _pixels(full)
    if not is_whole:
        stated += f" ({_region_and_binning(camera)}: {_pixels(recorded)})"
    raise LogError(
        f"CameraInfo {camera.header.topic} is for {stated} pixels but the {what} has "
        f"{_pixels(size)}: record the CameraInfo of the {what}, or name it with "
        f"--topic camera_info=TOPIC."
    )


def _of_size(camera: Camera, height: int, width: int) -> Camera:
    return replace(camera, width=width, height=height, binning=(1, 1), roi=WHOLE_PICTURE)


def _full_size(camera: Camera, size: F64) -> F64:
    """Size (x, y) of the full picture; where it is not recorded, as large as it has to be."""
    stated = np.array([camera.width, camera.height], float)
    return np.where(stated > 0, stated, size * _binning(camera) + _region(camera).offset)


class _RegionPixels(NamedTuple):
    offset: F64
    size: F64  # 0: all of the picture


def _region(camera: Camera) -> _RegionPixels:
    roi = camera.roi
    is_empty = roi.width <= 0 or roi.height <= 0
    used = WHOLE_PICTURE if is_empty else roi
    return _RegionPixels(
        np.array([used.x_offset, used.y_offset], float),
        np.array([used.width, used.height], float),
    )


def _binning(camera: Camera) -> F64:
    """Pixels of the sensor in one of the picture (x, y); 0 stands for 1."""
    binning: F64 = np.maximum(np.array(camera.binning, float), 1.0)
    return binning


def _by_definition(camera: Camera, full: F64) -> _Reading:
    region = _region(camera)
    binning = _binning(camera)
    size = np.where(region.size > 0, region.size, full)
    return _Reading(size / binning, region.offset, binning)


class _Claim(NamedTuple):
    """A calibration with binning or region.

    ``matrix``: which of K and P holds for the picture; ``full`` (x, y): size of the picture of the
    whole sensor; ``by_definition``: how the message is defined.
    """

    camera: Camera
    matrix: str
    full: F64
    by_definition: _Reading

    @property
    def name(self) -> str:
        """Of the CameraInfo, for sentences."""
        return f"CameraInfo {self.camera.header.topic}"

    @property
    def told(self) -> str:
        """What it has of region and binning, for sentences."""
        return _region_and_binning(self.camera)

    @property
    def point(self) -> F64:
        """The principal point (x, y)."""
        return np.asarray(getattr(self.camera, self.matrix)[:2, 2])


def _other_size(camera: Camera, matrix: str, full: F64) -> str:
    """What is assumed where a calibration seems to be of a picture of another size; else ""."""
    point = np.asarray(getattr(camera, matrix)[:2, 2])
    off = _off(point, full / 2, full)
    off_turned = _off(point, full[::-1] / 2, full)
    is_turned = off > _OFF_TURNED and off_turned < _NEAR_MIDDLE
    if not point.any() or (off <= _OFF_MIDDLE and not is_turned):
        return ""
    likeness = (
        "as where its x and y are exchanged, or of a picture that was turned"
        if is_turned
        else "as of a picture of another size"
    )
    return (
        f"CameraInfo {camera.header.topic} is for {_pixels(full)} pixels, but the middle of its "
        f"{matrix} lies at ({point[0]:.0f}, {point[1]:.0f}), {likeness}: it "
        f"is taken as it is; {_REMEDY} if that is wrong."
    )


def _with_region(claim: _Claim, size: F64) -> FittedCamera | None:
    """The one reading of region and binning that gives a picture of ``size``; None: none does."""
    camera, matrix, full, by_definition = claim
    if by_definition.is_of(size):
        return _by_principal_point(claim)

    binning = by_definition.binning
    one = np.ones(2)
    if _Reading(full, np.zeros(2), one).is_of(size):
        # the driver writes the size of the picture
        reduced = by_definition.of_picture(claim.point)
        if (
            _off(claim.point, full / 2, full) > _OFF_MIDDLE
            and _off(reduced, full / 2, full) <= _OFF_MIDDLE
        ):
            return FittedCamera(
                _reduced(camera, by_definition),
                f"{claim.name} is for {_pixels(full)} pixels, but its {matrix} is for a larger "
                f"picture: {matrix} is reduced as its {claim.told} has it; {_REMEDY} if that is "
                f"wrong.",
            )
        return FittedCamera(camera)
    for part, reading in (
        ("binning", _Reading(full / binning, np.zeros(2), binning)),
        ("region", _Reading(by_definition.size * binning, by_definition.offset, one)),
    ):
        if reading.is_of(size):
            return FittedCamera(
                _reduced(camera, reading),
                f"{claim.name} has {claim.told}, but its pictures have {_pixels(size)} pixels: "
                f"only the {part} is applied; {_REMEDY} if that is wrong.",
            )
    return None


def _by_principal_point(claim: _Claim) -> FittedCamera:
    """K of the full picture, as defined, unless it can only be the K of the recorded picture."""
    camera, matrix, full, reading = claim
    off_full = _off(claim.point, full / 2, full)
    off_picture = _off(claim.point, reading.of_picture(full / 2), reading.size)
    told = f"{claim.name} has {claim.told} of {_pixels(full)} pixels"
    if off_full > _OFF_MIDDLE and off_picture < off_full:
        return FittedCamera(
            camera,
            f"{told}, but its {matrix} fits the reduced picture: it is taken as it is; {_REMEDY} "
            f"if that is wrong.",
        )
    reduced = reading.of_picture(claim.point)
    is_doubtful = (
        off_picture < off_full < _NEAR_MIDDLE
        and _off(reduced, claim.point, reading.size) > _NO_MATTER
    )
    assumption = ""
    if is_doubtful:
        assumption = (
            f"{told}; whether its {matrix} is of the full picture cannot be told, so it is taken "
            f"to be, as the message is defined; {_REMEDY} if that is wrong."
        )
    return FittedCamera(_reduced(camera, reading), assumption)


def _off(point: F64, middle: F64, size: F64) -> float:
    """How far a point is from the middle, as a share of the picture's sides."""
    return float((np.abs(point - middle) / size).max())


def _reduced(camera: Camera, reading: _Reading) -> Camera:
    """The calibration of the recorded picture, from the calibration of the full one."""
    K = camera.K.copy()
    P = camera.P.copy()
    for matrix in (K, P):
        matrix[:2, 2] -= reading.offset
        matrix[:2] /= reading.binning[:, None]
    return replace(camera, K=K, P=P)


def _scaled(camera: Camera, scale: F64) -> Camera:
    """The calibration of a picture that was scaled as a whole by ``scale`` (x, y)."""
    K = camera.K.copy()
    P = camera.P.copy()
    for matrix in (K, P):
        # pixel centres are whole numbers: the corner of the picture is at -0.5
        matrix[:2, 2] = (matrix[:2, 2] + 0.5) * scale - 0.5
        matrix[:2, :2] *= scale[:, None]
        matrix[:2, 3:] *= scale[:, None]
    return replace(camera, K=K, P=P)


def _pixels(size: F64) -> str:
    return f"{size[0]:.0f} x {size[1]:.0f}"


def _region_and_binning(camera: Camera) -> str:
    """What a CameraInfo has of the two, for sentences."""
    parts = []
    if camera.roi.width > 0 and camera.roi.height > 0:
        r = camera.roi
        parts.append(
            f"a region of interest of {r.width} x {r.height} at ({r.x_offset}, {r.y_offset})"
        )
    if max(camera.binning) > 1:
        parts.append(f"binning {camera.binning[0] or 1} x {camera.binning[1] or 1}")
    return " and ".join(parts) or "the full picture"


class Optics(NamedTuple):
    """Which pixels see which directions: the camera matrix (3, 3), the lens before it, and the
    rotation (3, 3) from the picture's axes to the camera's optical frame.
    """

    matrix: F64
    lens: Lens
    camera_R_picture: F64


def optics_of(camera: Camera, *, rectified: bool) -> Optics:
    """The optics of a picture of a calibrated camera; of a ``rectified`` one R and P hold, not K
    and D. LogError where it is not calibrated.
    """
    if (rectified and camera.P[0, 0] > 0) or camera.K[0, 0] <= 0:
        lens = Lens(is_fisheye=False, coefficients=np.zeros(0))
        optics = Optics(camera.P[:, :3], lens, camera_R_rect(camera))
    else:
        optics = Optics(camera.K, lens_of(camera), np.eye(3))
    matrix = optics.matrix
    if not np.isfinite(matrix).all() or matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
        raise LogError(
            f"CameraInfo {camera.header.topic} has no focal length: the camera is not "
            f"calibrated; name another with --topic camera_info=TOPIC."
        )
    return optics


def camera_R_rect(camera: Camera) -> F64:
    """Rotation (3, 3) from the rectified to the camera's optical frame; identity where R is none.

    R of a CameraInfo turns the camera's frame into the frame of the rectified picture.
    """
    R = camera.R
    is_rotation = np.allclose(R @ R.T, np.eye(3), atol=1e-2) and np.linalg.det(R) > 0
    return np.asarray(R.T) if is_rotation else np.eye(3)
