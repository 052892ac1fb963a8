"""Everything that turns pictures into points, depth images and stereo pairs alike, behind one door."""

from __future__ import annotations

from semloc_logs.frames import Camera, DepthFrame, ImageFrame
from semloc_logs.logs.roles import Roles
from semloc_logs.logs.sensors.depth import (
    USUAL_NOISE,
    DepthClouds,
    LabelImages,
    RangeNoise,
    RangePoints,
)
from semloc_logs.logs.sensors.stereo_pairs import RightTLeft, StereoClouds


class PictureClouds:
    """Depth images and stereo pairs -> points with labels, by the calibrations and label images
    that came with them.

    ``cameras``: the newest calibration by CameraInfo topic; ``labels``: the label images;
    ``right_T_left`` as in StereoClouds.
    """

    def __init__(
        self,
        roles: Roles,
        right_T_left: RightTLeft,
        *,
        stride: int | None = None,
        noise: RangeNoise = USUAL_NOISE,
    ) -> None:
        self._roles = roles
        self._depth = DepthClouds(roles, stride, noise)
        self.labels: LabelImages = self._depth.labels
        self.cameras: dict[str, Camera] = self._depth.cameras
        self._stereo = StereoClouds(
            roles, self.cameras, self.labels, right_T_left, stride=stride, noise=noise
        )

    @property
    def lost(self) -> list[str]:
        """Sentences about calibrations that cannot be used."""
        return [*self._depth.lost, *self._stereo.lost]

    @property
    def notes(self) -> list[str]:
        """Sentences about label images that cannot be used."""
        return [*self.labels.notes]

    def take(self, frame: DepthFrame | ImageFrame) -> None:
        """Remembers a label image or a picture of a stereo pair; any other is of no use here."""
        topic = frame.header.topic
        if topic in self._roles.label_of.values():
            self.labels.take(frame)
        if isinstance(frame, ImageFrame):
            if topic == self._roles.stereo_left:
                self._stereo.take_left(frame)
            elif topic == self._roles.stereo_right:
                self._stereo.take_right(frame)

    def has_all(self, frame: DepthFrame | ImageFrame) -> bool:
        """Whether all that a frame needs has come, as far as the log promises it."""
        if frame.header.topic != self._roles.stereo_left:
            return self._depth.has_all(frame)
        return not isinstance(frame, ImageFrame) or self._stereo.has_all(frame)

    def points(
        self, frame: DepthFrame | ImageFrame, min_range: float, max_range: float
    ) -> RangePoints | str:
        """Points in the optical frame between the ranges (m, along the ray); or the reason why
        there are none.
        """
        if frame.header.topic != self._roles.stereo_left:
            return self._depth.points(frame, min_range, max_range)
        return (
            self._stereo.points(frame, min_range, max_range)
            if isinstance(frame, ImageFrame)
            else "no picture"
        )
