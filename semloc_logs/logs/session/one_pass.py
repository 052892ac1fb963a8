"""One pass over the frames of a session: poses, transforms, calibrations, and the clouds."""

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
from semloc_logs.logs.messages.point_times import LONGEST_SWEEP_NS
from semloc_logs.logs.poses.base_frame import BasePoses
from semloc_logs.logs.poses.fixes import Fixes
from semloc_logs.logs.poses.imu_gravity import Accelerometer
from semloc_logs.logs.problems import NoCloud
from semloc_logs.logs.roles import Roles
from semloc_logs.logs.session.cloud_builder import CloudBuilder
from semloc_logs.logs.session.frame_queue import MOST_WAITING_BYTES, FrameQueue, RangeFrame
from semloc_logs.logs.session.image_relay import ImageRelay
from semloc_logs.logs.session.repeats import Repeats
from semloc_logs.logs.session.stamp_offsets import StampOffsets
from semloc_logs.logs.session.tally import Tally

_TF_PATIENCE = 16  # frames to wait for a better pose edge in TF than one that is not called odom


class CloudPass:
    """The state of a pass: ``poses``, ``tally`` of frames, ``meanings`` of labels by topic.

    ``builder`` makes the clouds, ``relay`` hands pictures on; ``stamp_offsets``: header stamps
    beside log times; ``fixes`` of satellites. Frames that wait for their poses take ``most_bytes``
    at most.
    """

    def __init__(
        self,
        roles: Roles,
        poses: BasePoses,
        builder: CloudBuilder,
        relay: ImageRelay,
        stamp_offsets: StampOffsets,
        most_bytes: int = MOST_WAITING_BYTES,
    ) -> None:
        self.poses = poses
        self.cameras = builder.cameras
        self.builder = builder
        self.accelerometer = Accelerometer()
        self.fixes = Fixes()
        self.tally = Tally()
        self.meanings: dict[str, LabelNames] = {}
        self.stamp_offsets = stamp_offsets
        self.repeats = Repeats()
        self.waiting = FrameQueue(most_bytes)
        self.relay = relay
        self._roles = roles

    @property
    def topics(self) -> set[str]:
        """The topics that have to be decoded."""
        roles = self._roles
        topics = {
            *roles.ranging,
            *roles.topics("stereo_right"),
            *roles.label_of.values(),
            *roles.tf,
            *roles.tf_static,
        }
        with_calibration = (*topics, *roles.image, *roles.label_image)
        topics |= {roles.info_of[t] for t in with_calibration if t in roles.info_of}
        return topics | {
            *roles.topics("pose"),
            *roles.topics("imu"),
            *roles.topics("gnss"),
            *roles.label_info,
            *self.relay.topics,
        }

    def clouds(self, frames: Iterable[Frame]) -> Iterator[PosedCloud]:
        """The clouds of all ``frames``, given in the order of recording."""
        for frame in frames:
            self._take(frame)
            yield from self._ready(is_end=False)
        self.poses.finish()
        yield from self._ready(is_end=True)

    def _take(self, frame: Frame) -> None:
        topic = frame.header.topic
        self.stamp_offsets.take(frame)
        if isinstance(frame, TransformSample | PoseSample):
            self.poses.take(frame)
        elif isinstance(frame, Camera):
            self.cameras.calibrations[topic] = frame
        elif isinstance(frame, ImuSample):
            self.accelerometer.add(frame)
            self.poses.take_measurement(frame)
        elif isinstance(frame, NavSatSample):
            self.poses.take_measurement(frame)
            if topic in self._roles.topics("gnss"):
                self.fixes.take(frame)
        elif isinstance(frame, LabelNames):
            self.meanings.setdefault(topic, frame)
        elif isinstance(frame, RangeFrame):
            if topic in self._roles.ranging:
                self._take_range(frame)
            if not isinstance(frame, LidarFrame):
                self.cameras.take(frame)
                self.relay.take(frame)

    def _take_range(self, frame: RangeFrame) -> None:
        topic = frame.header.topic
        self.tally.saw(topic)
        self.poses.take_measurement(frame)
        if isinstance(frame, LidarFrame):
            self.tally.measured(frame)
            if not len(frame.points):
                self.tally.leave_out(frame.header, NoCloud.EMPTY)
                return
        self.repeats.take(frame)
        self.waiting.add(frame)

    def _ready(self, *, is_end: bool) -> Iterator[PosedCloud]:
        """Clouds of the frames that need not wait any longer, in order."""
        while self.waiting:
            must = is_end or self.waiting.is_full
            if self.poses.base is None:
                self._settle(must=must)
                # poses that have not even begun are out of reach of a frame that cannot wait
                if self.poses.base is None and not must:
                    return
            if not must and not self._has_all(self.waiting.first):
                return
            frame, is_set_back = self.waiting.pop()
            cloud = self.builder.cloud(frame, is_end=is_end, is_set_back=is_set_back)
            if isinstance(cloud, NoCloud):
                self.tally.leave_out(frame.header, cloud)
            else:
                self.tally.used[frame.header.topic] += 1
                yield cloud

    def _settle(self, *, must: bool) -> None:
        sensors = self.waiting.sensors(self._roles.pose)
        is_patient = len(self.waiting) < _TF_PATIENCE
        self.poses.settle(sensors, is_patient=is_patient, must=must)

    def _has_all(self, frame: RangeFrame) -> bool:
        """Whether everything that the cloud of ``frame`` needs has come."""
        stamp_ns = frame.header.stamp_ns
        infos = [self._roles.info_of.get(topic) for topic in self.relay.topics]
        if any(info not in {None, *self.cameras.calibrations} for info in infos):
            return False
        # poses have to reach the first picture that is not earlier
        for picture_ns in self.relay.following(stamp_ns):
            if picture_ns is None or not self.poses.poses_have_passed(picture_ns):
                return False
        if not isinstance(frame, LidarFrame) and not self.cameras.has_all(frame):
            return False
        return self.poses.poses_have_passed(
            stamp_ns + _sweep_ns(frame)
        ) and self.poses.transforms_have_passed(frame.header.frame_id, stamp_ns)


def _sweep_ns(frame: RangeFrame) -> int:
    """Time from the stamp to the measurement of the last point."""
    if not isinstance(frame, LidarFrame) or frame.offset_ns is None or not len(frame.offset_ns):
        return 0
    return min(max(0, int(frame.offset_ns.max())), LONGEST_SWEEP_NS)
