"""Pictures -> points, from depth images and stereo pairs alike."""

from __future__ import annotations

from semloc_logs.frames import Camera, DepthFrame, ImageFrame
from semloc_logs.logs.problems import NoCloud, Problem
from semloc_logs.logs.roles import Roles
from semloc_logs.logs.sensors.depth import (
    USUAL_NOISE,
    DepthClouds,
    LabelImages,
    RangeNoise,
    RangePoints,
)
from semloc_logs.logs.sensors.stereo_pairs import RightTLeft, StereoClouds


class CameraClouds:
    """Depth images and stereo pairs -> points with labels.

    ``calibrations``: the newest one by CameraInfo topic; ``labels``: the label images;
    ``right_T_left`` as in StereoClouds; ``depth_unit`` as in DepthUnits.
    """

    def __init__(
        self,
        roles: Roles,
        right_T_left: RightTLeft,
        *,
        stride: int | None = None,
        noise: RangeNoise = USUAL_NOISE,
        depth_unit: float | None = None,
    ) -> None:
        self._roles = roles
        self._depth = DepthClouds(roles, stride, noise, depth_unit)
        self.labels: LabelImages = self._depth.labels
        self.calibrations: dict[str, Camera] = self._depth.calibrations
        self._stereo = StereoClouds(
            roles, self.calibrations, self.labels, right_T_left, stride=stride, noise=noise
        )

    @property
    def problems(self) -> list[Problem]:
        """Depth units, and calibrations (lost) and label images that cannot be used."""
        return [
            *self._depth.units.problems,
            *self._depth.unmeasured.problems,
            *self._depth.problems,
            *self._stereo.problems,
            *self.labels.problems,
        ]

    def take(self, frame: DepthFrame | ImageFrame) -> None:
        """Remembers a label image or a picture of a stereo pair; any other is ignored."""
        topic = frame.header.topic
        if topic in self._roles.label_of.values():
            self.labels.take(frame)
        if isinstance(frame, ImageFrame):
            if topic == self._roles.stereo_left:
                self._stereo.take_left(frame)
            elif topic == self._roles.stereo_right:
                self._stereo.take_right(frame)

    def has_all(self, frame: DepthFrame | ImageFrame) -> bool:
        """Whether calibration, labels and partner of a frame have come, if the log has them."""
        if frame.header.topic != self._roles.stereo_left:
            return self._depth.has_all(frame)
        return not isinstance(frame, ImageFrame) or self._stereo.has_all(frame)

    def points(
        self, frame: DepthFrame | ImageFrame, min_range: float, max_range: float
    ) -> RangePoints | NoCloud:
        """Points in the optical frame between the ranges (m, along the ray), or the reason."""
        if frame.header.topic != self._roles.stereo_left:
            return self._depth.points(frame, min_range, max_range)
        if not isinstance(frame, ImageFrame):
            return NoCloud.NO_PICTURE
        return self._stereo.points(frame, min_range, max_range)
