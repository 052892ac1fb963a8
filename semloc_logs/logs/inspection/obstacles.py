"""What keeps a log, or a part of it, from being fused, as far as an inspection knows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from semloc_logs.errors import LogError
from semloc_logs.frames import Camera, DepthFrame, ImageFrame, LidarFrame
from semloc_logs.logs.inspection.verdict import SCAN_REMEDY, is_planar
from semloc_logs.logs.log import Stream
from semloc_logs.logs.messages.stamps import time_range, utc
from semloc_logs.logs.poses.base_frame import BasePoses
from semloc_logs.logs.problems import Problem, ProblemKind
from semloc_logs.logs.role_types import no_sensor
from semloc_logs.logs.roles import Roles
from semloc_logs.logs.sensors.depth import DepthUnits, Unprojector
from semloc_logs.logs.sensors.rectification import rectification
from semloc_logs.logs.sensors.stereo_pairs import is_rectified
from semloc_logs.logs.session.frame_queue import RangeFrame
from semloc_logs.logs.session.pose_problems import never_moves, no_poses

# a sensor that starts so far outside of the poses has another clock
_OTHER_CLOCK_NS = 60_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What an inspection has seen of a log.

    ``name`` of the file; ``streams`` with the counts of messages that can be read; ``cameras`` by
    topic of their CameraInfo; ``first``: the first good frame of each range sensor, ``right`` of
    the right camera of a pair; ``empty``: clouds without points, by topic; ``depth_unit``: the
    setting; ``is_complete``: all messages were read.
    """

    name: str
    streams: Sequence[Stream]
    roles: Roles
    poses: BasePoses
    cameras: Mapping[str, Camera]
    first: Mapping[str, RangeFrame]
    right: ImageFrame | None
    empty: Mapping[str, int]
    depth_unit: float | None = field(default=None, kw_only=True)
    is_complete: bool = field(kw_only=True)


def obstacles_of(seen: Seen) -> list[Problem]:
    """Problems that keep the log, or a part of it, from being fused; nothing is lost yet."""
    roles = seen.roles
    if not any(s.count for s in seen.streams):
        return [_obstacle("", ProblemKind.FILE, f"{seen.name} holds no messages.")]
    obstacles = list(roles.problems)
    if not roles.ranging:
        obstacles.append(_obstacle("", ProblemKind.ROLE, no_sensor(seen.streams)))
    base = seen.poses.base
    if base is not None and base.pose_frame is None and not roles.problems:
        obstacles.append(no_poses())
    elif not len(seen.poses.track) and not roles.problems:
        text = f"{roles.pose or 'TF'} gave no usable pose."
        obstacles.append(_obstacle(roles.pose or "", ProblemKind.POSE, text))
    for topic, count in sorted(seen.empty.items()):
        clouds = f"{count} cloud{'s' if count > 1 else ''}"
        text = f"{topic}: no point with a position in the first {clouds}."
        obstacles.append(_obstacle(topic, ProblemKind.FRAME, text))
    for topic in roles.depth:
        obstacles += _depth_obstacles(seen, topic)
    obstacles += _stereo_obstacles(seen)
    obstacles += _pose_obstacles(seen)
    for topic, frame in seen.first.items():
        obstacles += _sensor_obstacles(seen, topic, frame)
    return obstacles


def _depth_obstacles(seen: Seen, topic: str) -> Iterator[Problem]:
    info = seen.roles.info_of.get(topic)
    frame = seen.first.get(topic)
    if isinstance(frame, DepthFrame):
        units = DepthUnits(seen.depth_unit)
        units.metres(frame)
        yield from units.problems
    if info is None or info not in seen.cameras:
        text = (
            f"{topic} has no CameraInfo: it cannot become points; record it, or name it with "
            f"--topic camera_info=TOPIC."
        )
        yield _obstacle(topic, ProblemKind.CALIBRATION, text)
    elif isinstance(frame, DepthFrame):
        try:
            unprojector = Unprojector(
                seen.cameras[info], *frame.depth.shape, rectified="rect" in topic
            )
            for text in unprojector.assumptions:
                yield _assumption(topic, text)
        except LogError as error:
            yield _obstacle(topic, ProblemKind.CALIBRATION, str(error))


def _stereo_obstacles(seen: Seen) -> list[Problem]:
    roles = seen.roles
    if roles.stereo_left is None or roles.stereo_right is None:
        return []
    pair = (roles.stereo_left, roles.stereo_right)
    left_camera, right_camera = (seen.cameras.get(roles.info_of.get(t, "")) for t in pair)
    obstacles = [
        _obstacle(
            topic,
            ProblemKind.CALIBRATION,
            f"{topic} has no CameraInfo: the pair cannot become points; record it, or name "
            f"both with --topic camera_info=TOPIC,TOPIC.",
        )
        for topic, camera in zip(pair, (left_camera, right_camera), strict=True)
        if camera is None
    ]
    left = seen.first.get(pair[0])
    right = seen.right
    if left_camera is None or right_camera is None:
        return obstacles
    if not isinstance(left, ImageFrame) or right is None:
        return obstacles

    if left.image.shape[:2] != right.image.shape[:2]:
        sizes = " and ".join(f"{i.shape[1]} x {i.shape[0]}" for i in (left.image, right.image))
        text = (
            f"{pair[0]}, {pair[1]} have pictures of {sizes} pixels: "
            f"a stereo pair needs the same size."
        )
        return [_obstacle(pair[0], ProblemKind.CALIBRATION, text)]
    right_T_left = seen.poses.tree.lookup(
        right.header.frame_id, left.header.frame_id, left.header.stamp_ns
    )
    try:
        how = rectification(
            left_camera,
            right_camera,
            left.image.shape[:2],
            right_T_left,
            rectified=is_rectified(roles),
        )
        obstacles += [_assumption(pair[0], text) for text in how.assumptions]
    except LogError as error:
        obstacles.append(_obstacle(pair[0], ProblemKind.CALIBRATION, str(error)))
    return obstacles


def _pose_obstacles(seen: Seen) -> list[Problem]:
    track = seen.poses.track
    source = seen.poses.source
    # of a sample most fixes are left out on purpose
    is_known = source is not None and seen.is_complete
    obstacles = [replace(p, lost=False) for p in source.problems] if source and is_known else []
    name = source.name if source else seen.roles.pose or "TF"
    if not track.moves:
        obstacles += never_moves(name, track)
    if not seen.is_complete:
        return obstacles
    if gaps := track.gaps():
        longest = max(gaps, key=lambda gap: gap[1] - gap[0])
        count = "a gap" if len(gaps) == 1 else f"{len(gaps)} gaps, the longest"
        text = (
            f"The poses have {count} from {time_range(*longest)}: "
            f"frames in it get no pose and are left out."
        )
        obstacles.append(_obstacle(name, ProblemKind.POSE, text))
    return obstacles


def _sensor_obstacles(seen: Seen, topic: str, frame: RangeFrame) -> Iterator[Problem]:
    """A missing transform to the base frame, or another clock than the clock of the poses."""
    track = seen.poses.track
    base = seen.poses.base
    if isinstance(frame, LidarFrame) and is_planar(frame.points):
        text = f"{topic}: all points lie in one plane: {SCAN_REMEDY}"
        yield _obstacle(topic, ProblemKind.ROLE, text)
    stamp_ns = frame.header.stamp_ns
    frame_id = frame.header.frame_id
    if (
        base is not None
        and not seen.poses.tree.connected(base.name, frame_id)
        and base.assumed != frame_id.lstrip("/")
        and not seen.poses.is_fixed(frame_id)
    ):
        text = (
            f"No transform leads from '{frame_id}', the frame of {topic}, to the base frame "
            f"'{base.name}': its frames are left out; record /tf_static."
        )
        yield _obstacle(topic, ProblemKind.TRANSFORM, text)
    start_ns = track.start_ns
    end_ns = track.end_ns
    if start_ns is None or end_ns is None:
        return
    if not start_ns - _OTHER_CLOCK_NS < stamp_ns < end_ns + _OTHER_CLOCK_NS:
        text = (
            f"{topic} starts at {utc(stamp_ns)} but the poses cover "
            f"{time_range(start_ns, end_ns)}: frames without a pose are left out; where the "
            f"clocks differ, give --set logs.time_offset.{topic}=SECONDS."
        )
        yield _obstacle(topic, ProblemKind.POSE, text)


def _obstacle(topic: str, kind: ProblemKind, text: str) -> Problem:
    return Problem(topic, kind, text, lost=False)


def _assumption(topic: str, text: str) -> Problem:
    return Problem(topic, ProblemKind.CALIBRATION, text, lost=False, assumed=True)
