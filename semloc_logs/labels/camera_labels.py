"""Pictures of a session's cameras, kept until the clouds of their time come and painted on them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64, U32
from semloc_logs.errors import LogError
from semloc_logs.frames import Camera, ImageFrame, PosedCloud
from semloc_logs.labels.painting import Viewpoint, paint, without_borders
from semloc_logs.labels.projection import Projector
from semloc_logs.labels.space import UNPAINTED
from semloc_logs.logs.problems import ProblemKind, Problems
from semloc_logs.logs.session.session import Session
from semloc_logs.numerics.transforms import inverse

# between picture and cloud, where poses take out the motion between them
POSED_TOLERANCE_NS = 250_000_000
UNPOSED_TOLERANCE_NS = 50_000_000  # and where nothing does: half a period at 10 Hz
_MOST_BYTES = 512 << 20  # of pictures that wait for their clouds
_MOST_CAMERAS = 255  # whose numbers fit a byte
# labels of points: an id or a packed colour, or UNPAINTED; the number of the camera; and whether
# the label may belong to something nearer
PAINTED = np.dtype([("label", np.uint32), ("camera", np.uint8), ("is_doubtful", np.bool_)])
Painted = NDArray[np.void]  # (n,) of PAINTED
PointLabels = NDArray[Any]  # (n,) of uint32 as recorded with the points, or of PAINTED


@dataclass(slots=True, eq=False)
class _Camera:
    """The waiting pictures of a topic, its projector, its newest label image, and counts."""

    number: int
    waiting: deque[ImageFrame] = field(default_factory=deque)
    known: tuple[Camera, tuple[int, ...], Projector | None] | None = None
    newest: tuple[int, U32] | None = None
    pictures: int = 0
    points: int = 0


class Pictures:
    """Paints the pictures of ``topics`` onto clouds.

    ``label_of`` makes the labels (h, w) of a picture, or UNPAINTED. ``erode``: pixels next to where
    two labels meet that do not count. ``problems`` name the pictures that cannot be used.
    """

    def __init__(
        self,
        session: Session,
        topics: tuple[str, ...],
        label_of: Callable[[ImageFrame], U32],
        erode: int,
    ) -> None:
        self.topics = topics[:_MOST_CAMERAS]
        self.problems = Problems()
        self.seen = self.painted = self.inside = 0  # points
        self._session = session
        self._label_of = label_of
        self._erode = erode
        self._cameras = {topic: _Camera(i) for i, topic in enumerate(self.topics)}
        self._bytes = 0

    def take(self, frame: ImageFrame) -> None:
        """Remembers a picture."""
        self._cameras[frame.header.topic].waiting.append(frame)
        self._bytes += frame.image.nbytes
        while self._bytes > _MOST_BYTES:
            fullest = max(self._cameras.values(), key=lambda c: len(c.waiting))
            self._bytes -= fullest.waiting.popleft().image.nbytes

    def labels(self, cloud: PosedCloud, keep: NDArray[np.integer]) -> Painted | None:
        """Labels of ``cloud.points[keep]``, of the first camera that sees each, or None."""
        out: Painted = np.zeros(len(keep), PAINTED)
        out["label"] = UNPAINTED
        inside = np.zeros(len(keep), bool)
        viewpoint = None
        for topic, camera in self._cameras.items():
            self._forget(camera, cloud.header.stamp_ns)
            match = self._picture(topic, camera, cloud)
            if match is None:
                continue
            picture, camera_T_base, projector = match
            viewpoint = viewpoint or Viewpoint(cloud.origin, self._axis(cloud))
            if camera.newest is None or camera.newest[0] != picture.header.stamp_ns:
                camera.newest = (
                    picture.header.stamp_ns,
                    without_borders(self._label_of(picture), self._erode),
                )
                camera.pictures += 1
            unpainted = np.flatnonzero(out["label"] == UNPAINTED)
            painted = paint(
                cloud.points, keep[unpainted], viewpoint, camera.newest[1], camera_T_base, projector
            )
            out["label"][unpainted] = painted.label
            out["is_doubtful"][unpainted] = painted.is_doubtful
            out["camera"][unpainted] = camera.number
            inside[unpainted] |= painted.is_inside
            camera.points += int((painted.label != UNPAINTED).sum())
        if viewpoint is None:
            return None
        self.seen += len(out)
        self.inside += int(inside.sum())
        self.painted += int((out["label"] != UNPAINTED).sum())
        return out

    def to_json(self) -> dict[str, object]:
        """Counts of keyframe points: with a picture, within one, painted; and by camera."""
        cameras = {
            topic: {"pictures": c.pictures, "points": c.points}
            for topic, c in self._cameras.items()
        }
        return {
            "points": {"seen": self.seen, "in_a_picture": self.inside, "painted": self.painted},
            "cameras": cameras,
        }

    def _forget(self, camera: _Camera, stamp_ns: int) -> None:
        while (
            len(camera.waiting) > 1
            and camera.waiting[1].header.stamp_ns < stamp_ns - 4 * POSED_TOLERANCE_NS
        ):
            self._bytes -= camera.waiting.popleft().image.nbytes

    def _axis(self, cloud: PosedCloud) -> F64:
        """The axis that a LIDAR turns about; of a depth camera its upright one."""
        base_T_sensor = self._session.base_T(cloud.header.frame_id, cloud.header.stamp_ns)
        if base_T_sensor is None:
            return np.array([0.0, 0.0, 1.0])
        return (
            base_T_sensor[:3, 2]
            if cloud.header.topic in self._session.roles.lidar
            else -base_T_sensor[:3, 1]
        )

    def _picture(
        self, topic: str, camera: _Camera, cloud: PosedCloud
    ) -> tuple[ImageFrame, F64, Projector] | None:
        """The picture nearest in time to a cloud, ``camera_T_base`` (4, 4), and the projector."""
        stamp_ns = cloud.header.stamp_ns
        posed = cloud.session_T_base is not None
        tolerance = POSED_TOLERANCE_NS if posed else UNPOSED_TOLERANCE_NS
        candidates = [p for p in camera.waiting if abs(p.header.stamp_ns - stamp_ns) <= tolerance]
        calibration = self._session.cameras.get(topic)
        if calibration is None:
            if candidates:
                self._cannot_use(
                    topic,
                    ProblemKind.CALIBRATION,
                    f"{topic} has no CameraInfo: its pictures give no labels; "
                    f"name one with --topic camera_info=TOPIC.",
                )
            return None
        for picture in sorted(candidates, key=lambda p: abs(p.header.stamp_ns - stamp_ns)):
            moved = np.eye(4)
            if cloud.session_T_base is not None:
                pose = self._session.pose_at(picture.header.stamp_ns)
                if pose is None:
                    continue
                moved = inverse(pose) @ cloud.session_T_base
            frame_id = picture.header.frame_id or calibration.header.frame_id
            base_T_camera = self._session.base_T(frame_id, picture.header.stamp_ns)
            if base_T_camera is None:
                self._cannot_use(
                    topic,
                    ProblemKind.TRANSFORM,
                    f"No transform connects the camera frame '{frame_id}' of {topic} with "
                    f"'{self._session.base_frame}': its pictures give no labels; "
                    f"record /tf_static.",
                )
                return None
            projector = self._projector(topic, camera, calibration, picture.image.shape)
            return (
                None if projector is None else (picture, inverse(base_T_camera) @ moved, projector)
            )
        return None

    def _cannot_use(self, topic: str, kind: ProblemKind, text: str) -> None:
        self.problems.add(text, topic=topic, kind=kind, lost=False)

    def _projector(
        self, topic: str, camera: _Camera, calibration: Camera, shape: tuple[int, ...]
    ) -> Projector | None:
        known = camera.known
        if known is not None and known[0] is calibration and known[1] == shape:
            return known[2]
        projector = None
        try:
            projector = Projector(calibration, shape[0], shape[1], rectified="rect" in topic)
            for text in projector.assumptions:
                self.problems.assume(text, topic=topic, kind=ProblemKind.CALIBRATION)
        except LogError as error:
            self._cannot_use(topic, ProblemKind.CALIBRATION, str(error))
        camera.known = calibration, shape, projector
        return projector
