"""The pictures that belong to the keyframes of a session: taken from its logs without distortion,
kept as files, read with the depth of the keyframe's points.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F32, F64, U8
from semloc_logs.errors import LogError
from semloc_logs.experiments.system import Picture
from semloc_logs.frames import Camera, ImageFrame
from semloc_logs.logs.sensors.picture_calibration import fitted_camera, lens_of
from semloc_logs.logs.session.session import Session, SessionOptions, open_session
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import apply, inverse
from semloc_logs.tables.atomic_files import replacing_folder
from semloc_logs.tables.table import read_json, write_json

INDEX = "pictures.json"
MOST_APART_NS = 100_000_000  # between a keyframe and its picture
REACH = 4.0  # px from a projected point that have its depth
HIDDEN_BEHIND = 1.15  # times as far as a point within REACH: seen through a surface of few points
_NEAREST = 0.2  # m along the optical axis
_WAITING = 64  # pictures that wait for their keyframes to pass


@dataclass(frozen=True, eq=False)
class PictureFolder:
    """Pictures of the keyframes of a session in ``path``."""

    path: Path

    @classmethod
    def opened(cls, path: Path) -> PictureFolder | None:
        """The folder, or None where the session has no pictures."""
        if not (path / INDEX).exists():
            return None
        folder = cls(path)
        return folder if len(folder) else None

    @cached_property
    def _entries(self) -> dict[str, Any]:
        entries: dict[str, Any] = read_json(self.path / INDEX)["pictures"]
        return entries

    def __len__(self) -> int:
        return len(self._entries)

    def picture(self, keyframe: int, points: F32) -> Picture | None:
        """The picture of a keyframe with the depth of its ``points`` (n, 3) in the base frame; None
        where the camera took none at its time.
        """
        entry = self._entries.get(str(keyframe))
        if entry is None:
            return None
        path = self.path / entry["file"]
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if image is None:
            raise LogError(f"{path} cannot be read: remove {self.path} and start again.")
        intrinsics = np.array(entry["intrinsics"], float)
        base_T_camera = np.array(entry["base_T_camera"], float)
        seen = apply(inverse(base_T_camera), points.astype(float))
        depth = depth_of_points(seen, intrinsics, (image.shape[0], image.shape[1]))
        rgb = np.ascontiguousarray(np.asarray(image, np.uint8)[..., ::-1])
        return Picture(rgb, depth, intrinsics, base_T_camera)


def depth_of_points(points: F64, intrinsics: F64, shape: tuple[int, int]) -> F32:
    """Depth (h, w) along the optical axis of ``points`` (n, 3) in the camera frame; NaN where no
    point falls within ``REACH`` pixels.
    """
    height, width = shape
    ahead = points[points[:, 2] > _NEAREST]
    pixels = ahead @ intrinsics.T
    u = np.rint(pixels[:, 0] / pixels[:, 2]).astype(np.int64)
    v = np.rint(pixels[:, 1] / pixels[:, 2]).astype(np.int64)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    depth = np.full((height, width), np.inf, np.float32)
    np.minimum.at(depth, (v[inside], u[inside]), ahead[inside, 2].astype(np.float32))

    # a point behind a surface of few points shows between them
    size = 2 * int(REACH) + 1
    nearest = cv2.erode(depth, np.ones((size, size), np.uint8), borderValue=float("inf"))
    depth[depth > HIDDEN_BEHIND * nearest] = np.inf

    measured = np.isfinite(depth)
    if not measured.any():
        return np.full(shape, np.nan, np.float32)
    away, source = cv2.distanceTransformWithLabels(
        np.where(measured, 0, 1).astype(np.uint8),
        cv2.DIST_L2,
        cv2.DIST_MASK_5,
        labelType=cv2.DIST_LABEL_PIXEL,
    )
    of_source = np.zeros(int(source.max()) + 1, np.float32)
    of_source[source[measured]] = depth[measured]
    return np.where(away <= REACH, of_source[source], np.nan).astype(np.float32)


@dataclass(slots=True, eq=False)
class _Best:
    """The picture nearest in time to a keyframe so far."""

    apart_ns: int
    frame: ImageFrame


@dataclass(eq=False)
class _Collector:
    """Takes the pictures of a pass and keeps for each keyframe the one nearest in time."""

    session: Session
    keyframes: SessionMap
    folder: Path
    entries: dict[str, Any] = field(default_factory=dict)
    _waiting: dict[int, _Best] = field(default_factory=dict)
    _maps: dict[tuple[int, ...], tuple[F64, Any, Any]] = field(default_factory=dict)

    def take(self, frame: ImageFrame) -> None:
        """A picture of the log."""
        stamps = self.keyframes.stamps_ns
        row = int(np.searchsorted(stamps, frame.header.stamp_ns))
        for number in range(max(0, row - 1), min(len(stamps), row + 1)):
            apart = abs(int(stamps[number]) - frame.header.stamp_ns)
            best = self._waiting.get(number)
            if apart <= MOST_APART_NS and (best is None or apart < best.apart_ns):
                self._waiting[number] = _Best(apart, frame)
        while len(self._waiting) > _WAITING:
            self._write(min(self._waiting))

    def finish(self) -> None:
        """Write the pictures that still wait."""
        for number in sorted(self._waiting):
            self._write(number)

    def _write(self, number: int) -> None:
        frame = self._waiting.pop(number).frame
        calibration = self.session.cameras.get(frame.header.topic)
        stamp_ns = frame.header.stamp_ns
        frame_id = frame.header.frame_id or (calibration.header.frame_id if calibration else "")
        base_T_camera = self.session.base_T(frame_id, stamp_ns)
        if calibration is None or base_T_camera is None:
            raise LogError(
                f"{frame.header.topic} of {self.session.name} has no calibration or no mounting: "
                "name its CameraInfo with --topic camera_info=TOPIC."
            )
        then = self.session.pose_at(stamp_ns)
        now = self.session.pose_at(int(self.keyframes.stamps_ns[number]))
        moved = np.eye(4) if then is None or now is None else inverse(now) @ then
        image = _colour(frame.image)
        intrinsics, x, y = self._undistortion(calibration, image.shape[:2])
        if x is not None:
            image = np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR), np.uint8)
        name = f"{number:06d}.png"
        cv2.imwrite(
            str(self.folder / name),
            np.ascontiguousarray(image[..., ::-1]),
            [cv2.IMWRITE_PNG_COMPRESSION, 1],
        )
        self.entries[str(number)] = {
            "file": name,
            "intrinsics": intrinsics.tolist(),
            "base_T_camera": (moved @ base_T_camera).tolist(),
        }

    def _undistortion(self, camera: Camera, shape: tuple[int, ...]) -> tuple[F64, Any, Any]:
        """K of the pictures without distortion, and the maps that make them; None for a pinhole."""
        if shape not in self._maps:
            fitted = fitted_camera(camera, shape[0], shape[1], scaled=True).camera
            lens = lens_of(fitted)
            x = y = None
            if len(lens.coefficients):
                make = (
                    cv2.fisheye.initUndistortRectifyMap
                    if lens.is_fisheye
                    else cv2.initUndistortRectifyMap
                )
                size = (shape[1], shape[0])
                turn = np.eye(3)
                x, y = make(fitted.K, lens.coefficients, turn, fitted.K, size, cv2.CV_16SC2)
            self._maps[shape] = np.asarray(fitted.K, float), x, y
        return self._maps[shape]


def _colour(image: NDArray[np.uint8] | NDArray[np.uint16]) -> U8:
    """RGB (h, w, 3) of a picture."""
    small = (image >> 8).astype(np.uint8) if image.dtype == np.uint16 else image
    return np.asarray(np.dstack([small] * 3) if small.ndim == 2 else small, np.uint8)


def keep_pictures(
    logs: Sequence[Path], keyframes: SessionMap, folder: Path, options: SessionOptions
) -> bool:
    """Write the pictures of a session's keyframes to ``folder``, unless they are there and the
    session is the same; whether its logs have a calibrated camera.

    The picture topic is the left one of a pair, else the first that has a calibration.
    """
    made_from = keyframes.json["fingerprint"]
    if (folder / INDEX).exists():
        index = read_json(folder / INDEX)
        if index.get("made_from") == made_from:
            return len(index["pictures"]) > 0
    with closing(open_session(list(logs), options)) as session:
        roles = session.roles
        known = [t for t in roles.image if t in roles.info_of]
        left = roles.stereo_left
        topic = left if left in known else next(iter(known), None)
        with replacing_folder(folder) as temporary:
            collector = _Collector(session, keyframes, temporary)
            if topic is not None:
                for _ in session.clouds(collector.take, {topic}):
                    pass
                collector.finish()
            content = {"made_from": made_from, "topic": topic, "pictures": collector.entries}
            write_json(temporary / INDEX, content)
    return topic is not None and bool(collector.entries)
