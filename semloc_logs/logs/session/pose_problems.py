"""Problems of a pose stream: it is missing, its stamps make no sense, or it never moves."""

from __future__ import annotations

import numpy as np

from semloc_logs.logs.messages.stamps import time_range
from semloc_logs.logs.poses.track import PoseTrack
from semloc_logs.logs.problems import Problem, ProblemKind

# a vehicle may well stand still so long, but a log of nothing else is suspicious
_STANDSTILL_NS = 10_000_000_000
# of a latitude and a longitude: nearer to zero are the Gulf of Guinea, and positions in metres
_LEAST_DEGREES = 0.5


def no_poses() -> Problem:
    """The consequence of a log without any pose."""
    text = (
        "The log has no pose stream: single frames can be searched, but no map is built; for a map "
        "use --odometry lidar, give a trajectory with --poses FILE, or name a topic with "
        "--topic pose=TOPIC."
    )
    return Problem("", ProblemKind.POSE, text, lost=False)


def clouds_in_fixed_frame(topic: str, frame: str, pose_topic: str) -> Problem:
    """Clouds that the poses were applied to before they were recorded; nothing is lost by that."""
    text = (
        f"{topic} is in '{frame}', the frame that the poses of {pose_topic} are in: its points are "
        f"moved back by the pose of their stamp, and seen from the origin of the base frame."
    )
    return Problem(topic, ProblemKind.TRANSFORM, text, lost=False)


def too_far(topic: str, metres: float) -> Problem:
    """Sweeps of which nothing lies within the range limits."""
    text = (
        f"{topic}: half of the points of a sweep lie beyond {metres:.0f} m: their unit is"
        " millimetres or centimetres, or fusion.max_range is too small; record them in metres."
    )
    return Problem(topic, ProblemKind.FRAME, text, lost=False, assumed=True)


def looks_up(topic: str, frame: str) -> Problem:
    """Pictures whose axes may be wrong: by TF they look up, as if their frame were a body's."""
    text = (
        f"The z axis of '{frame}', along which the pictures of {topic} look, points up in "
        f"'base_link': this is taken as it is; where '{frame}' is not the optical frame, give the "
        f"pose of the optical frame with --set logs.mountings.{frame}=[x,y,z,qx,qy,qz,qw]."
    )
    return Problem(topic, ProblemKind.TRANSFORM, text, lost=False, assumed=True)


def optical_base(topic: str, frame: str) -> Problem:
    """Pictures in the frame of the poses, whose axes the log does not tell."""
    text = (
        f"The poses are taken as poses of the optical frame (z forward) of {topic}, because its "
        f"frame is '{frame}', too; where '{frame}' has other axes, give the pose of the optical "
        f"frame in it with --set logs.mountings.{frame}=[x,y,z,qx,qy,qz,qw]."
    )
    return Problem(topic, ProblemKind.TRANSFORM, text, lost=False, assumed=True)


def refused_poses(topic: str, track: PoseTrack, *, lost: bool) -> list[Problem]:
    """Poses whose stamps make no sense; empty when all is well."""
    kinds = (
        (track.duplicates, "repeated"),
        (track.backwards, "back in time"),
        (track.ahead, "far ahead in time"),
    )
    counts = [f"{count} {kind}" for count, kind in kinds if count]
    if not counts:
        return []
    text = f"{topic}: poses that are {' and '.join(counts)} were left out."
    return [Problem(topic, ProblemKind.POSE, text, lost)]


def invalid_poses(topic: str, track: PoseTrack) -> list[Problem]:
    """Poses that cannot be calculated with; empty when all is well."""
    if not track.invalid:
        return []
    text = (
        f"{topic}: {track.invalid} poses were left out: they are not rigid transforms within "
        f"100,000 km, or their stamps lie outside of the years 1933 to 2116."
    )
    return [Problem(topic, ProblemKind.POSE, text, lost=True)]


def smeared(topic: str, shift: float, track: PoseTrack) -> Problem:
    """Poses that stand still while the surroundings move by ``shift`` metres or more."""
    text = (
        f"{topic} {_hardly_moves(track)}, but the surroundings move by {shift:.1f} m "
        f"or more: its poses, and the map that is built with them, are wrong; "
        f"use --odometry lidar, give poses with --poses FILE, or name a topic with "
        f"--topic pose=TOPIC."
    )
    return Problem(topic, ProblemKind.POSE, text, lost=True)


def _hardly_moves(track: PoseTrack) -> str:
    """That all positions are the same, or nearly; and in which unit they may be."""
    positions = track.poses[:, :3, 3]
    extents = track.extents()
    if not extents.any():
        return "gives the same position all the time"
    first = positions[0]
    are_degrees = bool(np.abs(first[:2]).min() >= _LEAST_DEGREES) and any(
        abs(latitude) <= 90.0 and abs(longitude) <= 180.0
        for latitude, longitude in (first[:2], first[1::-1])
    )
    unit = (
        f" ({first[0]:.5f}, {first[1]:.5f} at first): degrees of latitude and longitude, it seems,"
        " not metres"
        if are_degrees
        else ": in another unit than metres, or never filled in"
    )
    # of positions in degrees the altitude changes in metres
    extent = float(np.linalg.norm(np.sort(extents)[:2]))
    return f"gives positions that change by {extent:.2g} m in all{unit}"


def froze(topic: str, shift: float, start_ns: int, end_ns: int) -> Problem:
    """Poses that stand still for a while, in which the surroundings move by ``shift`` metres."""
    text = (
        f"{topic} gives the same pose from {time_range(start_ns, end_ns)}, but the surroundings"
        f" move by {shift:.1f} m or more: its poses froze, and the map is wrong there; use"
        " --odometry lidar, give poses with --poses FILE, or name a topic with --topic"
        " pose=TOPIC."
    )
    return Problem(topic, ProblemKind.POSE, text, lost=True)


def never_moves(topic: str, track: PoseTrack) -> list[Problem]:
    """A pose stream with a constant position, such as odometry that was never filled in."""
    start_ns = track.start_ns
    end_ns = track.end_ns
    if start_ns is None or end_ns is None:
        return []
    if end_ns - start_ns < _STANDSTILL_NS or track.length() > 0.0:
        return []
    seconds = (end_ns - start_ns) * 1e-9
    text = (
        f"{topic} gives the same position for {seconds:.0f} s: "
        f"name another with --topic pose=TOPIC if the vehicle moved."
    )
    return [Problem(topic, ProblemKind.POSE, text, lost=False)]
