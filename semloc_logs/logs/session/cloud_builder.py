"""Range frames -> clouds with poses, points in the base frame."""

from __future__ import annotations

import numpy as np

from semloc_logs.frames import F64, LidarFrame, PosedCloud
from semloc_logs.logs.poses.base_frame import BasePoses
from semloc_logs.logs.poses.standstill import Standstill
from semloc_logs.logs.roles import Roles
from semloc_logs.logs.sensors.camera_clouds import PictureClouds
from semloc_logs.logs.sensors.sweeps import in_base, sweep_in_base
from semloc_logs.logs.session.duplicate_topics import Copies
from semloc_logs.logs.session.frame_queue import RangeFrame
from semloc_logs.logs.session.tally import BACK_IN_TIME, COPY


class BaseClouds:
    """Makes clouds of points between ``min_range`` and ``max_range`` (m, from the sensor);
    ``copies`` finds topics that repeat others.

    ``sensors``: the last ``base_T_sensor`` (4, 4) of each frame id that gave a cloud; ``deskewed``:
    sweeps freed of the vehicle's motion.
    """

    def __init__(
        self,
        roles: Roles,
        where: BasePoses,
        pictures: PictureClouds,
        copies: Copies | None,
        *,
        min_range: float,
        max_range: float,
    ) -> None:
        self.sensors: dict[str, F64] = {}
        self.deskewed = 0
        self.standstill = Standstill()
        self.copies = copies
        self._roles = roles
        self._where = where
        self._pictures = pictures
        self._min_range, self._max_range = min_range, max_range

    def cloud(self, frame: RangeFrame, *, is_end: bool, is_set_back: bool) -> PosedCloud | str:
        """The cloud of a frame, or the reason why there is none; ``is_end``: no more poses will
        come.
        """
        cloud = self._cloud(frame, is_end)
        if is_set_back and not isinstance(cloud, str) and cloud.session_T_base is not None:
            return BACK_IN_TIME  # the pose at its time is that of an earlier frame
        return cloud

    def _cloud(self, frame: RangeFrame, is_end: bool) -> PosedCloud | str:
        header = frame.header
        base = self._where.base
        track = self._where.track
        if base is None:
            return "no pose"
        base_T_sensor = self._where.base_T(header.frame_id, header.stamp_ns)
        if base_T_sensor is None:
            return "no transform"
        # before the poses have come so far, nobody knows whether the frame lies in a gap: the
        # nearest pose serves at the end only
        is_known = base.pose_frame is not None and (
            is_end or self._where.poses_have_passed(header.stamp_ns)
        )
        pose = track.at(header.stamp_ns) if is_known else None
        if base.pose_frame is not None and pose is None:
            return "no pose"
        extra: dict[str, str] = {}
        sigma = None
        if isinstance(frame, LidarFrame):
            if self.copies is not None and self.copies.is_copy(
                header.topic, header.stamp_ns, in_base(base_T_sensor, frame.points)
            ):
                return COPY
            poses_at = None if pose is None else track.at_many
            limits = {"min_range": self._min_range, "max_range": self._max_range}
            points, label, is_deskewed = sweep_in_base(frame, base_T_sensor, poses_at, **limits)
            self.deskewed += is_deskewed
        else:
            found = self._pictures.points(frame, self._min_range, self._max_range)
            if isinstance(found, str):
                return found
            points = in_base(base_T_sensor, found.points)
            label = found.label
            sigma = found.sigma
            if label is not None:
                extra = self._label_source(header.topic)
        if not len(points):
            return "no points"
        self.sensors[header.frame_id] = base_T_sensor
        if pose is not None and header.topic == self._roles.ranging[0] and not track.moves:
            self.standstill.add(points, pose)
        return PosedCloud(
            header, points, base_T_sensor[:3, 3].astype(np.float32), pose, label, extra, sigma
        )

    def _label_source(self, topic: str) -> dict[str, str]:
        """Where the labels of a picture's points come from."""
        source = self._roles.label_of.get(topic)
        if source is None:
            return {}
        return {
            "label_topic": source,
            "label_form": "colours" if source in self._pictures.labels.coloured else "ids",
        }
