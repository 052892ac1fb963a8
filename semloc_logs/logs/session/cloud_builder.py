"""Range frames -> clouds with poses, points in the base frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semloc_logs.arrays import F32, F64
from semloc_logs.frames import DepthFrame, Header, ImageFrame, LabelForm, LidarFrame, PosedCloud
from semloc_logs.logs.poses.base_frame import BASE_LINK, BasePoses
from semloc_logs.logs.poses.standstill import Standstill
from semloc_logs.logs.poses.tf_tree import frame_name
from semloc_logs.logs.problems import NoCloud
from semloc_logs.logs.roles import Roles
from semloc_logs.logs.sensors.camera_clouds import CameraClouds
from semloc_logs.logs.sensors.sweeps import in_base, sweep_in_base
from semloc_logs.logs.session.duplicate_topics import DuplicateTopics
from semloc_logs.logs.session.frame_queue import RangeFrame

_LOOKS_UP = 0.7  # height of a unit vector: no vehicle's camera looks up by more than 45 degrees


@dataclass(frozen=True, slots=True)
class RangeLimits:
    """Points nearer to the sensor or farther from it (m) are dropped."""

    nearest: float
    farthest: float


@dataclass(frozen=True, slots=True, eq=False)
class _Place:
    """Poses at the time of a frame: ``base_T_sensor`` (4, 4) and ``session_T_base`` or None.

    ``is_fixed``: the frame of the points is fixed in the world, not a sensor's; the poses have
    been applied to them already.
    """

    base_T_sensor: F64
    session_T_base: F64 | None
    is_fixed: bool = False


class CloudBuilder:
    """Makes clouds of the points within ``limits``; ``duplicates`` finds topics that repeat others.

    ``sensors``: the last ``base_T_sensor`` (4, 4) of each frame id that gave a cloud; ``deskewed``:
    sweeps freed of the vehicle's motion; ``fixed``: frame by topic of clouds whose frame is fixed
    in the world; ``looks_up``: frame by topic of pictures that look up by their transform;
    ``is_base``: of pictures in the base frame that is not called optical; ``too_far``: median range
    (m) by topic of sweeps beyond the limit.
    """

    def __init__(
        self,
        roles: Roles,
        poses: BasePoses,
        cameras: CameraClouds,
        duplicates: DuplicateTopics | None,
        limits: RangeLimits,
    ) -> None:
        self.sensors: dict[str, F64] = {}
        self.deskewed = 0
        self.fixed: dict[str, str] = {}
        self.looks_up: dict[str, str] = {}
        self.is_base: dict[str, str] = {}
        self.too_far: dict[str, float] = {}
        self.standstill = Standstill()
        self.duplicates = duplicates
        self._roles = roles
        self._poses = poses
        self.cameras = cameras
        self._limits = limits

    def cloud(self, frame: RangeFrame, *, is_end: bool, is_set_back: bool) -> PosedCloud | NoCloud:
        """The cloud of a frame, or the reason for none; ``is_end``: no more poses will come."""
        header = frame.header
        place = self._place(frame, is_end=is_end)
        if isinstance(place, NoCloud):
            return place
        cloud = (
            self._sweep(frame, place)
            if isinstance(frame, LidarFrame)
            else self._picture(frame, place)
        )
        if isinstance(cloud, NoCloud):
            return cloud
        if not len(cloud.points):
            self._see_unit(frame)
            return NoCloud.NO_POINTS
        if not isinstance(frame, LidarFrame):
            self._see_axes(header, place.base_T_sensor)

        if place.is_fixed:
            self.fixed[header.topic] = header.frame_id
        else:
            self.sensors[header.frame_id] = place.base_T_sensor
        pose = place.session_T_base
        is_main = header.topic == self._roles.ranging[0]
        if pose is not None and is_main:
            self.standstill.add(cloud.points, pose, header.stamp_ns)
        # the pose at the time of a frame that is set back belongs to an earlier frame
        return NoCloud.BACK_IN_TIME if is_set_back and pose is not None else cloud

    def _see_unit(self, frame: RangeFrame) -> None:
        """Keeps the range of the first sweep of a topic that lies beyond the limit."""
        if isinstance(frame, LidarFrame):
            median = float(np.median(np.linalg.norm(frame.points, axis=1)))
            if median > self._limits.farthest:
                self.too_far.setdefault(frame.header.topic, median)

    def _place(self, frame: RangeFrame, *, is_end: bool) -> _Place | NoCloud:
        header = frame.header
        base = self._poses.base
        if base is None:
            return NoCloud.NO_POSE
        is_fixed = self._poses.is_fixed(header.frame_id)
        base_T_sensor = self._poses.base_T(header.frame_id, header.stamp_ns)
        if base_T_sensor is None and not is_fixed:
            is_connected = self._poses.tree.connected(base.name, header.frame_id)
            return NoCloud.TRANSFORM_GAP if is_connected else NoCloud.NO_TRANSFORM
        if base.pose_frame is None and base_T_sensor is not None:
            return _Place(base_T_sensor, None)

        # before the poses have come so far, it is unknown whether the frame lies in a gap: they are
        # continued at the end only
        is_known = is_end or self._poses.poses_have_passed(header.stamp_ns)
        pose = self._poses.track.at(header.stamp_ns) if is_known else None
        if pose is None:
            return NoCloud.NO_POSE
        if base_T_sensor is None:
            return NoCloud.TRANSFORM_GAP
        return _Place(base_T_sensor, pose, is_fixed)

    def _see_axes(self, header: Header, base_T_sensor: F64) -> None:
        """Notices pictures whose frame may have the axes of a body (REP 103: x forward)."""
        base = self._poses.base
        frame = frame_name(header.frame_id)
        if base is None or "optical" in frame or self._poses.is_given(frame):
            return
        if frame in (base.name, base.assumed):
            if base.pose_frame is not None:
                self.is_base[header.topic] = frame
        elif base.name == BASE_LINK and base_T_sensor[2, 2] > _LOOKS_UP:
            self.looks_up[header.topic] = frame

    def _sweep(self, sweep: LidarFrame, place: _Place) -> PosedCloud | NoCloud:
        header = sweep.header
        if self.duplicates is not None and self.duplicates.is_duplicate(
            header.topic, header.stamp_ns, in_base(place.base_T_sensor, sweep.points)
        ):
            return NoCloud.DUPLICATE
        has_motion = place.session_T_base is not None and not place.is_fixed
        points, label, is_deskewed = sweep_in_base(
            sweep,
            place.base_T_sensor,
            self._poses.track.at_many if has_motion else None,
            centre=_origin(place) if place.is_fixed else None,
            min_range=self._limits.nearest,
            max_range=self._limits.farthest,
        )
        self.deskewed += is_deskewed
        origin = _origin(place, sweep.origin)
        return PosedCloud(header, points, origin, place.session_T_base, label)

    def _picture(self, frame: DepthFrame | ImageFrame, place: _Place) -> PosedCloud | NoCloud:
        seen = self.cameras.points(frame, self._limits.nearest, self._limits.farthest)
        if isinstance(seen, NoCloud):
            return seen
        label_topic = None
        label_form = LabelForm.IDS
        if seen.label is not None:
            label_topic = self._roles.label_of.get(frame.header.topic)
            if label_topic in self.cameras.labels.coloured:
                label_form = LabelForm.COLOURS
        return PosedCloud(
            frame.header,
            in_base(place.base_T_sensor, seen.points),
            _origin(place),
            place.session_T_base,
            seen.label,
            label_topic,
            label_form,
            seen.sigma,
        )


def _origin(place: _Place, in_sensor: F32 | None = None) -> F32:
    """The sensor's centre (3,) in the base frame, where ``in_sensor`` (3,) is it in its frame.

    The base where the points do not come in the frame of their sensor.
    """
    if place.is_fixed:
        return np.zeros(3, np.float32)
    if in_sensor is not None:
        return in_base(place.base_T_sensor, in_sensor[None]).reshape(3)
    return place.base_T_sensor[:3, 3].astype(np.float32)
