"""One pass over the frames of a session: what is learned on the way, and the clouds that come of
it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from semloc_logs.frames import (
    Camera,
    Frame,
    ImuSample,
    LabelNames,
    LidarFrame,
    NavSatSample,
    PosedCloud,
    PoseSample,
    TransformSample,
)
from semloc_logs.logs.poses.base_frame import BasePoses
from semloc_logs.logs.poses.imu_gravity import Accelerometer
from semloc_logs.logs.roles import Roles
from semloc_logs.logs.sensors.camera_clouds import PictureClouds
from semloc_logs.logs.sensors.sweeps import LONGEST_SWEEP_NS
from semloc_logs.logs.session.cloud_builder import BaseClouds
from semloc_logs.logs.session.frame_queue import RangeFrame, WaitingFrames
from semloc_logs.logs.session.image_relay import ShownPictures
from semloc_logs.logs.session.tally import Tally

_TF_PATIENCE = 16  # frames to wait for a better pose edge in TF than one that is not called odom


class CloudPass:
    """All that is known as far as the pass has come: ``where`` the vehicle is, ``tally`` of frames,
    ``meanings`` of labels by topic.

    ``made`` makes the clouds, ``shown`` are the pictures to be handed on.
    """

    def __init__(
        self,
        roles: Roles,
        where: BasePoses,
        pictures: PictureClouds,
        made: BaseClouds,
        shown: ShownPictures,
    ) -> None:
        self.where = where
        self.pictures = pictures
        self.made = made
        self.accelerometer = Accelerometer()
        self.tally = Tally()
        self.meanings: dict[str, LabelNames] = {}
        self.waiting = WaitingFrames()
        self._roles = roles
        self._shown = shown

    @property
    def topics(self) -> set[str]:
        """What has to be decoded."""
        roles = self._roles
        topics = {
            *roles.ranging,
            *roles.topics("stereo_right"),
            *roles.label_of.values(),
            *roles.tf,
            *roles.tf_static,
        }
        topics |= {
            roles.info_of[t]
            for t in (*topics, *roles.image, *roles.label_image)
            if t in roles.info_of
        }
        return topics | {
            *roles.topics("pose"),
            *roles.topics("imu"),
            *roles.topics("gnss"),
            *roles.label_info,
            *self._shown.topics,
        }

    def clouds(self, frames: Iterable[Frame]) -> Iterator[PosedCloud]:
        """The clouds of all ``frames``, given in the order of recording."""
        for frame in frames:
            self._take(frame)
            yield from self._ready(is_end=False)
        self.where.finish()
        yield from self._ready(is_end=True)

    def _take(self, frame: Frame) -> None:
        topic = frame.header.topic
        if isinstance(frame, TransformSample | PoseSample):
            self.where.take(frame)
        elif isinstance(frame, Camera):
            self.pictures.cameras[topic] = frame
        elif isinstance(frame, ImuSample):
            self.accelerometer.add(frame)
            self.where.show(frame)
        elif isinstance(frame, NavSatSample):
            self.where.show(frame)
        elif isinstance(frame, LabelNames):
            self.meanings.setdefault(topic, frame)
        elif isinstance(frame, RangeFrame):
            if topic in self._roles.ranging:
                self._take_range(frame)
            if not isinstance(frame, LidarFrame):
                self.pictures.take(frame)
                self._shown.take(frame)

    def _take_range(self, frame: RangeFrame) -> None:
        topic = frame.header.topic
        self.tally.saw(topic, frame.header.stamp_ns)
        self.where.show(frame)
        if isinstance(frame, LidarFrame):
            self.tally.measured(frame)
            if not len(frame.points):
                self.tally.leave_out(topic, "empty")
                return
        self.waiting.add(frame)

    def _ready(self, *, is_end: bool) -> Iterator[PosedCloud]:
        """Clouds of the frames that need not wait any longer, first come first served."""
        while self.waiting:
            must = is_end or self.waiting.is_full
            if self.where.base is None:
                sensors = self.waiting.sensors(self._roles.pose)
                self.where.settle(sensors, is_patient=len(self.waiting) < _TF_PATIENCE, must=must)
                # poses that have not even begun are out of reach of a frame that cannot wait
                if self.where.base is None and not must:
                    return
            if not must and not self._has_all(self.waiting.first):
                return
            frame, is_set_back = self.waiting.pop()
            cloud = self.made.cloud(frame, is_end=is_end, is_set_back=is_set_back)
            if isinstance(cloud, str):
                self.tally.leave_out(frame.header.topic, cloud)
            else:
                self.tally.used[frame.header.topic] += 1
                yield cloud

    def _has_all(self, frame: RangeFrame) -> bool:
        stamp_ns = frame.header.stamp_ns
        where = self.where
        if any(
            self._roles.info_of.get(t) not in {None, *self.pictures.cameras}
            for t in self._shown.topics
        ):
            return False
        # poses have to reach the first picture that is not earlier
        if not all(
            s is not None and where.poses_have_passed(s) for s in self._shown.following(stamp_ns)
        ):
            return False
        if not isinstance(frame, LidarFrame) and not self.pictures.has_all(frame):
            return False
        return where.poses_have_passed(
            stamp_ns + _sweep_ns(frame)
        ) and where.transforms_have_passed(frame.header.frame_id, stamp_ns)


def _sweep_ns(frame: RangeFrame) -> int:
    """How long after the stamp the last point was measured."""
    if not isinstance(frame, LidarFrame) or frame.offset_ns is None or not len(frame.offset_ns):
        return 0
    return min(max(0, int(frame.offset_ns.max())), LONGEST_SWEEP_NS)
