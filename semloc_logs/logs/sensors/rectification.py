"""Rectification of a pair of calibrated cameras: turned until the rows of the pictures correspond.

A raw pair is rectified by the R and P of its CameraInfos where these carry a baseline
(sensor_msgs/CameraInfo: P[0, 3] = -f * baseline), else by the transform between the cameras, with
the rotations of Bouguet's method as in OpenCV's stereoRectify: half of the rotation between the
cameras each, then both alike until the baseline is the x axis. The distortion model may be any that
OpenCV can undo.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F32, F64
from semloc_logs.errors import LogError
from semloc_logs.frames import Camera
from semloc_logs.logs.sensors.picture_calibration import camera_R_rect, fitted_camera, lens_of
from semloc_logs.numerics.transforms import rotation_angle, rotation_between

_SHORTEST_BASELINE = 1e-3  # m; below, the two frames are one
_LONGEST_BASELINE = 10.0  # m; two cameras of one vehicle are nearer to each other
_SAME_BASELINE = 1.25  # by such a factor the baselines of P and of the transforms may differ
SMALLEST = 32  # px, sides of a picture
_LARGEST_NUMBER = 1e6  # in K (px), D and P
# between the optical axes, or the baseline and the rows; a stereo pair has less
_WIDEST_ANGLE = np.deg2rad(40.0)
# of the focal length, at least: rectified pictures see more than the middle, at the cost of
# resolution there
_WIDER = 0.6
_SAME = 0.02  # focal lengths of rectified pictures differ by no more than this share

_FARTHEST_MIDDLE = 2.0  # of a picture from the rectified axis, in focal lengths

Maps = tuple[NDArray[np.int16], NDArray[np.uint16]]


@dataclass(frozen=True, slots=True, eq=False)
class Rectification:
    """How to rectify both pictures of a pair; then z = focal * baseline / (disparity - offset).

    ``focal`` (px), ``centre`` (x, y) of the left rectified picture (px), ``baseline`` (m),
    ``left_R_rect`` (3, 3) from the rectified to the left optical frame. ``maps`` are for cv2.remap,
    None where the pictures come rectified. ``valid`` (h, w) of left and right: pixels that
    lie on the recorded picture. ``pixels`` (h, w): flat index of the nearest pixel of the recorded
    left picture. ``assumptions``: sentences about what the calibrations do not settle.
    """

    focal: float
    baseline: float
    centre: tuple[float, float]
    offset: float
    left_R_rect: F64
    maps: tuple[Maps, Maps] | None
    valid: tuple[NDArray[np.bool_], NDArray[np.bool_]]
    pixels: NDArray[np.intp]
    assumptions: tuple[str, ...] = ()


def rectification(
    left: Camera,
    right: Camera,
    shape: tuple[int, int],
    right_T_left: F64 | None,
    *,
    rectified: bool,
) -> Rectification:
    """The rectification of pictures (h, w) of these cameras; ``rectified``: as P describes them.

    ``right_T_left`` (4, 4) between the optical frames, None where it is unknown. LogError where
    the calibrations do not allow it.
    """
    _check_size(_Pair(left, right, shape))
    cameras = (left, right)
    fitted = [fitted_camera(camera, *shape, rectified=rectified) for camera in cameras]
    sentences = [fit.assumption for fit in fitted]
    if not rectified:
        sentences += [lens_of(camera).assumption for camera in cameras]
    pair = _Pair(fitted[0].camera, fitted[1].camera, shape)
    _check_numbers(pair)
    how = _rectification(pair, right_T_left, rectified=rectified)
    return replace(how, assumptions=tuple(s for s in sentences if s))


def _rectification(pair: _Pair, right_T_left: F64 | None, *, rectified: bool) -> Rectification:
    """As :func:`rectification`, for calibrations of exactly these pictures."""
    left = pair.left
    right = pair.right
    if right_T_left is not None and np.linalg.norm(right_T_left[:3, 3]) < _SHORTEST_BASELINE:
        # the frame ids of both pictures are the same, as stereo_image_proc wants them
        right_T_left = None
    if rectified:
        return _as_recorded(pair, right_T_left)

    recorded = _baseline_of_infos(left, right)
    if recorded != 0.0 and right_T_left is not None:
        _check_same(recorded, float(np.linalg.norm(right_T_left[:3, 3])), pair)
    is_turned = any(not np.allclose(camera.R, np.eye(3), atol=1e-9) for camera in (left, right))
    if recorded != 0.0 and (is_turned or right_T_left is None):
        _check_sides(recorded, pair)
        return _of_maps(pair, (left.R, right.R), (left.P[:, :3], right.P[:, :3]), recorded)
    if right_T_left is None:
        raise LogError(
            f"The transform between the cameras of {pair.names} is unknown: record /tf_static "
            f"between their frames, or CameraInfos whose P has the baseline."
        )
    _check_angles(right_T_left, pair)
    rotations = bouguet_rotations(right_T_left)
    matrix = _common_matrix(pair, rotations)
    baseline = float(np.linalg.norm(right_T_left[:3, 3]))
    _check_sides(baseline, pair)
    return _of_maps(pair, rotations, (matrix, matrix), baseline)


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """Two cameras and the size (h, w) of their pictures."""

    left: Camera
    right: Camera
    shape: tuple[int, int]

    @property
    def names(self) -> str:
        """The topics of the CameraInfos, for sentences."""
        return f"{self.left.header.topic}, {self.right.header.topic}"


def _check_size(pair: _Pair) -> None:
    height, width = pair.shape
    if min(pair.shape) < SMALLEST:
        raise LogError(
            f"The pictures of {pair.names} have {width} x {height} pixels: too few to be matched."
        )


def bouguet_rotations(right_T_left: F64) -> tuple[F64, F64]:
    """Rotations (3, 3) of the left and the right optical frame into the rectified frames.

    Their x axis is the baseline, left to right.
    """
    rotation = Rotation.from_matrix(right_T_left[:3, :3])
    half = Rotation.from_rotvec(rotation.as_rotvec() / 2)
    axis = -(half.inv().as_matrix() @ right_T_left[:3, 3])
    rect_R_half = rotation_between(axis, np.array([1.0, 0.0, 0.0]))
    return rect_R_half @ half.as_matrix(), rect_R_half @ half.inv().as_matrix()


def _check_numbers(pair: _Pair) -> None:
    """LogError for numbers that no lens has: with them OpenCV computes garbage, or crashes."""
    for camera in (pair.left, pair.right):
        numbers = np.concatenate([camera.K.ravel(), camera.P.ravel(), np.ravel(camera.D)])
        is_rotation = (
            np.allclose(camera.R @ camera.R.T, np.eye(3), atol=1e-2) and np.linalg.det(camera.R) > 0
        )
        if (
            not is_rotation
            or not np.isfinite(numbers).all()
            or np.abs(numbers).max() > _LARGEST_NUMBER
        ):
            raise _senseless(pair)


def _senseless(pair: _Pair) -> LogError:
    return LogError(
        f"The calibrations of {pair.names} make no sense; "
        f"name others with --topic camera_info=TOPIC,TOPIC."
    )


def _check_angles(right_T_left: F64, pair: _Pair) -> None:
    """LogError for cameras that look different ways, or sit one above the other."""
    centre = -right_T_left[:3, :3].T @ right_T_left[:3, 3]
    from_rows = float(np.arccos(np.clip(abs(centre[0]) / np.linalg.norm(centre), 0.0, 1.0)))
    turned = max(rotation_angle(right_T_left[:3, :3]), from_rows)
    if turned > _WIDEST_ANGLE:
        raise LogError(
            f"The cameras of {pair.names} do not form a stereo pair: they would have to be turned "
            f"by {np.rad2deg(turned):.0f} deg to see the same rows; choose two that look the same "
            f"way side by side with --topic stereo_left=TOPIC --topic stereo_right=TOPIC."
        )
    _check_sides(float(centre[0]), pair)


def _check_sides(baseline: float, pair: _Pair) -> None:
    if baseline < 0:
        raise LogError(
            f"The left camera of {pair.names} sits right of the other: exchange them with "
            f"--topic stereo_left=TOPIC --topic stereo_right=TOPIC."
        )
    if baseline > _LONGEST_BASELINE:
        raise LogError(
            f"The cameras of {pair.names} would be {baseline:.4g} m apart: P[0, 3] = -f * baseline "
            f"or the transform between them is not in metres; correct it."
        )


def _check_same(baseline: float, of_transforms: float, pair: _Pair) -> None:
    """LogError where the two baselines (m) that a log has contradict each other."""
    both = sorted((abs(baseline), abs(of_transforms)))
    if both[1] > _SAME_BASELINE * both[0]:
        raise LogError(
            f"The cameras of {pair.names} are {abs(baseline):.4g} m apart by P of their "
            f"CameraInfos and {abs(of_transforms):.4g} m by the transforms: correct one of both."
        )


def _baseline_of_infos(left: Camera, right: Camera) -> float:
    """Metres from the left to the right camera by their P; 0 when P has no baseline."""
    if left.P[0, 0] <= 0 or right.P[0, 0] <= 0:
        return 0.0
    baseline = float(left.P[0, 3] / left.P[0, 0] - right.P[0, 3] / right.P[0, 0])
    return baseline if abs(baseline) >= _SHORTEST_BASELINE and np.isfinite(baseline) else 0.0


def _as_recorded(pair: _Pair, right_T_left: F64 | None) -> Rectification:
    """The rectification of pictures that come rectified."""
    left = pair.left
    right = pair.right
    baseline = _baseline_of_infos(left, right)
    if baseline != 0.0 and right_T_left is not None:
        _check_same(baseline, float(np.linalg.norm(right_T_left[:3, 3])), pair)
    elif right_T_left is not None:
        baseline = float(-right_T_left[0, 3])
    if baseline == 0.0:
        raise LogError(
            f"The CameraInfos {pair.names} have no baseline in P and no transform leads from one "
            f"camera to the other: record CameraInfos with P[0, 3] = -f * baseline, or /tf_static."
        )
    _check_sides(baseline, pair)
    _check_projections(left.P[:, :3], right.P[:, :3], pair)
    valid = np.ones(pair.shape, bool)
    centre = (float(left.P[0, 2]), float(left.P[1, 2]))
    return Rectification(
        focal=float(left.P[0, 0]),
        baseline=baseline,
        centre=centre,
        offset=centre[0] - float(right.P[0, 2]),
        left_R_rect=camera_R_rect(left),
        maps=None,
        valid=(valid, valid),
        pixels=np.arange(valid.size, dtype=np.intp).reshape(pair.shape),
    )


def _check_projections(left: F64, right: F64, pair: _Pair) -> None:
    """LogError unless two K (3, 3) have the same focal length and the same rows."""
    ok = left[0, 0] > 0 and right[0, 0] > 0 and np.isfinite(left).all() and np.isfinite(right).all()
    if (
        not ok
        or abs(left[0, 0] - right[0, 0]) > _SAME * left[0, 0]
        or abs(left[1, 2] - right[1, 2]) > _SAME * left[0, 0]
    ):
        raise LogError(
            f"The projections P of the CameraInfos {pair.names} do not belong to one rectified "
            f"pair: their focal lengths or rows differ; "
            f"name the right ones with --topic camera_info=TOPIC,TOPIC."
        )


def _common_matrix(pair: _Pair, rotations: tuple[F64, F64]) -> F64:
    """One K (3, 3) for both rectified pictures.

    The ends of the middle row and column stay in them where the field of view allows it.
    """
    left = pair.left
    right = pair.right
    height, width = pair.shape
    half = np.array([(width - 1) / 2, (height - 1) / 2])
    cross = half + half * [[0, 0], [-1, 0], [1, 0], [0, -1], [0, 1]]
    own = float(np.mean([left.K[0, 0], left.K[1, 1], right.K[0, 0], right.K[1, 1]]))
    middles = []
    focal = own
    for camera, rotation in ((left, rotations[0]), (right, rotations[1])):
        rays = np.hstack([_undistorted(camera, cross), np.ones((5, 1))]) @ rotation.T
        seen = rays[:, :2] / rays[:, 2:]
        if not np.isfinite(seen[0]).all() or np.abs(seen[0]).max() > _FARTHEST_MIDDLE:
            raise _senseless(pair)
        middles.append(seen[0])
        reach = np.array([seen[2, 0] - seen[1, 0], seen[4, 1] - seen[3, 1]])
        # beyond 90 degrees from the axis of a fisheye the numbers mean nothing
        focal = min(
            focal,
            *(
                2 * h / r if np.isfinite(r) and r > 0 else 0.0
                for h, r in zip(half, reach, strict=True)
            ),
        )
    focal = max(focal, _WIDER * own)
    cx, cy = half - focal * np.mean(middles, axis=0)
    return np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])


def _undistorted(camera: Camera, pixels: F64) -> F64:
    """Pixels (n, 2) -> normalised image coordinates (n, 2)."""
    lens = lens_of(camera)
    undo = cv2.fisheye.undistortPoints if lens.is_fisheye else cv2.undistortPoints
    coefficients = lens.coefficients if len(lens.coefficients) else np.zeros(4)
    return np.asarray(undo(pixels[:, None], camera.K, coefficients), float).reshape(-1, 2)


def _of_maps(
    pair: _Pair, rotations: tuple[F64, F64], matrices: tuple[F64, F64], baseline: float
) -> Rectification:
    """The rectification by rotations (3, 3) and the K (3, 3) of the rectified pictures."""
    left, right = matrices
    _check_projections(left, right, pair)
    left_maps, left_valid, pixels = _lookup(pair.left, pair.shape, rotations[0], left)
    right_maps, right_valid, _ = _lookup(pair.right, pair.shape, rotations[1], right)
    if not (left_valid.any() and right_valid.any()):
        raise LogError(
            f"Nothing of the pictures is left when they are rectified by the CameraInfos "
            f"{pair.names}: their K, D, R and P do not fit each other; "
            f"name others with --topic camera_info=TOPIC,TOPIC."
        )
    return Rectification(
        focal=float(left[0, 0]),
        baseline=baseline,
        centre=(float(left[0, 2]), float(left[1, 2])),
        offset=float(left[0, 2] - right[0, 2]),
        left_R_rect=rotations[0].T,
        maps=(left_maps, right_maps),
        valid=(left_valid, right_valid),
        pixels=pixels,
    )


def _lookup(
    camera: Camera, shape: tuple[int, int], rotation: F64, matrix: F64
) -> tuple[Maps, NDArray[np.bool_], NDArray[np.intp]]:
    """Place of each rectified pixel in the recorded picture.

    For cv2.remap, whether it lies on the picture at all, and as flat index.
    """
    lens = lens_of(camera)
    D = lens.coefficients if len(lens.coefficients) else np.zeros(4)
    size = (shape[1], shape[0])
    make = cv2.fisheye.initUndistortRectifyMap if lens.is_fisheye else cv2.initUndistortRectifyMap
    x, y = (
        np.asarray(m, np.float32) for m in make(camera.K, D, rotation, matrix, size, cv2.CV_32FC1)
    )
    with np.errstate(invalid="ignore"):
        valid = (
            (x >= 0) & (x <= shape[1] - 1) & (y >= 0) & (y <= shape[0] - 1) & _is_one_to_one(x, y)
        )
    x = np.where(valid, x, -1).astype(np.float32)
    y = np.where(valid, y, -1).astype(np.float32)
    pixels = np.rint(np.clip(y, 0, None)).astype(np.intp) * shape[1] + np.rint(
        np.clip(x, 0, None)
    ).astype(np.intp)
    fixed = cv2.convertMaps(x, y, cv2.CV_16SC2)
    return (np.asarray(fixed[0], np.int16), np.asarray(fixed[1], np.uint16)), valid, pixels


def _is_one_to_one(x: F32, y: F32) -> NDArray[np.bool_]:
    """Where the map does not mirror the picture.

    A distortion polynomial may turn back beyond the picture that it was fitted to.
    """
    forward: NDArray[np.bool_] = (np.gradient(x, axis=1) > 0) & (np.gradient(y, axis=0) > 0)
    return forward
