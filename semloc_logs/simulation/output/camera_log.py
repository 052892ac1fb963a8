"""The topics of simulated cameras: compressed pictures, depth and label images with their
calibrations.

A pair: ``/camera/left/image_raw/compressed`` and ``/camera/right/image_raw/compressed`` (JPEG); a
camera with depth: ``/camera/color/image_raw/compressed`` and
``/camera/depth/image/compressedDepth`` (PNG, millimetres), pixel on pixel. Each has a
``camera_info`` beside it. ``/camera/labels/compressed`` (PNG) are Cityscapes train ids of the left
or only camera.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64
from semloc_logs.errors import SemlocError
from semloc_logs.simulation.drives.camera_drive import CameraShot
from semloc_logs.simulation.output.drive_messages import Made, Messages, antenna

LEFT, RIGHT, ONLY = "camera_left_optical", "camera_right_optical", "camera_optical"  # frame ids
_JPEG_QUALITY = 92
_LATENCY_NS = 30_000_000  # exposure, compression
# ROS's compressedDepth: quantisation, which millimetres do not have
_DEPTH_HEAD = struct.pack("<iff", 0, 0.0, 0.0)


def camera_events(
    shots: Iterable[CameraShot], messages: Messages, first_ns: int
) -> Iterator[tuple[int, Made]]:
    """Log times and messages of the shots: mountings and the label space once, then pictures and
    calibrations.
    """
    for k, shot in enumerate(shots):
        if k == 0:
            for frame, pose in _mountings(shot):
                yield first_ns, messages.mounted(first_ns, frame, pose)
            yield first_ns, messages.mounted(first_ns, "gnss", antenna())
            space = messages.label_space("/camera/label_space")
            if space is not None:
                yield first_ns, space
        for made in _shot(shot, messages):
            yield shot.stamp_ns + _LATENCY_NS, made


def _mountings(shot: CameraShot) -> list[tuple[str, F64]]:
    if shot.right is None:
        return [(ONLY, shot.base_T_camera)]
    right = shot.base_T_camera.copy()
    right[:3, 3] += shot.model.baseline * right[:3, 0]
    return [(LEFT, shot.base_T_camera), (RIGHT, right)]


def _shot(shot: CameraShot, messages: Messages) -> Iterator[Made]:
    """Calibrations first, so that nothing has to wait for them."""
    stamp = shot.stamp_ns
    model = shot.model
    frame = ONLY if shot.right is None else LEFT
    name = "color" if shot.right is None else "left"
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    size = model.width, model.height
    yield messages.calibration(f"/camera/{name}/camera_info", stamp, frame, size, model.matrix, 0.0)
    yield messages.picture(
        f"/camera/{name}/image_raw/compressed",
        stamp,
        frame,
        "jpeg",
        _encoded(".jpg", shot.picture[..., ::-1], quality),
    )
    if shot.right is not None:
        yield messages.calibration(
            "/camera/right/camera_info", stamp, RIGHT, size, model.matrix, model.baseline
        )
        data = _encoded(".jpg", shot.right[..., ::-1], quality)
        yield messages.picture("/camera/right/image_raw/compressed", stamp, RIGHT, "jpeg", data)
    if shot.depth is not None:
        yield messages.calibration(
            "/camera/depth/camera_info", stamp, frame, size, model.matrix, 0.0
        )
        millimetres = np.rint(np.clip(shot.depth, 0, 65.5) * 1000).astype(np.uint16)
        data = _DEPTH_HEAD + _encoded(".png", millimetres, [cv2.IMWRITE_PNG_COMPRESSION, 3])
        yield messages.picture(
            "/camera/depth/image/compressedDepth", stamp, frame, "16UC1; compressedDepth png", data
        )
    data = _encoded(".png", shot.labels, [cv2.IMWRITE_PNG_COMPRESSION, 6])
    yield messages.picture("/camera/labels/compressed", stamp, frame, "png", data)


def _encoded(ending: str, pixels: NDArray[np.uint8] | NDArray[np.uint16], how: list[int]) -> bytes:
    done, data = cv2.imencode(ending, np.ascontiguousarray(pixels), how)
    if not done:
        raise SemlocError(
            f"OpenCV cannot write {ending} pictures: install opencv-python-headless with its codecs"
        )
    return bytes(data)
