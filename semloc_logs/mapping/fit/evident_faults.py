"""Faults of a stream that show without a registration: of clocks, mountings and stamps.

What follows from them would be named with other causes.
"""

from __future__ import annotations

from collections.abc import Set

import numpy as np

from semloc_logs.logs.session.session import Session
from semloc_logs.mapping.fit.fault_texts import rounded
from semloc_logs.mapping.fit.findings import (
    NEAR_VOXELS,
    WRONG,
    Finding,
    Severity,
    StreamFit,
)
from semloc_logs.mapping.fit.interpolation import interpolation_errors
from semloc_logs.mapping.fit.keyframe_pairs import Clouds
from semloc_logs.mapping.fit.model import LONGEST_OFFSET

LATEST_POSES = 5.0  # s; ones that are computed slowly are recorded within two, most of them
OFTEN = 0.9  # of the keyframes have a smaller error
FARTHEST_MOUNTING = 100.0  # m; ships are longer, but carry no sensors so far from their middle
_STUCK_TEXT = (
    "many of its stamps hardly differ although they were recorded at other times; use the times of"
    " recording with --set logs.stamps=log"
)


def add_evident_faults(stream: StreamFit, session: Session, clouds: Clouds) -> None:
    """Enters them, the first one in the place of what it would cause."""
    topic = stream.topic
    cause = (
        _stuck(session, topic)
        or _mounting_text(session, clouds.frames(), clouds.voxel)
        or _far_clock_text(topic, session.shift_of(topic), session.time_offset_of(topic))
        or _coarse_poses_text(session, clouds)
    )
    if cause:
        stream.findings = [Finding(Severity.WRONG, cause)]
    # of the other pictures of a stereo pair as well: depths come from both
    is_stereo = topic in session.roles.topics("stereo_left")
    for part in (topic, *(session.roles.topics("stereo_right") if is_stereo else ())):
        lead = session.lead_of(part)
        text = _lead_text(stream.topic, part, lead, session.time_offset_of(part))
        _add(stream, lead, clouds, text)
    off_stamp = session.off_stamp_of(topic)
    _add(stream, off_stamp, clouds, _off_stamp_text(off_stamp))


def _stuck(session: Session, topic: str) -> str:
    """A clock that stands still, or a sensor that repeats itself; else empty."""
    return _STUCK_TEXT if session.is_stuck(topic) else session.repeats(topic)


def _mounting_text(session: Session, frames: Set[str], voxel: float) -> str:
    """A mounting of ``frames`` that is not in metres, or that changes; else empty."""
    base_T_sensors = session.base_T_sensors()
    for frame in sorted(frames & base_T_sensors.keys()):
        distance = float(np.linalg.norm(base_T_sensors[frame][:3, 3]))
        if distance > FARTHEST_MOUNTING:
            return (
                f"its frame '{frame}' is mounted {distance:.0f} m from '{session.base_frame}': the"
                " transform is not in metres, or of another vehicle; correct it"
            )
        for (parent, child), change in session.mounting_changes(frame).items():
            if change.distance / voxel + change.angle * NEAR_VOXELS >= WRONG:
                return (
                    f"the mounting of '{child}' in '{parent}' is recorded with values that differ"
                    f" by {change.distance:.2f} m and {np.degrees(change.angle):.1f} degrees: it"
                    " was calibrated anew, or has two publishers; cut the log there, or give the"
                    f" right one with --set logs.mountings.{child}=[x,y,z,qx,qy,qz,qw]"
                )
    return ""


def _coarse_poses_text(session: Session, clouds: Clouds) -> str:
    """Poses that are too far apart: errors between them look like a clock. Else empty.

    Fixes scatter, which is not an error between them.
    """
    if session.are_poses_fixes:
        return ""
    track = session.track
    meters, radians = interpolation_errors(track, clouds.stamps_ns())
    effects = meters / clouds.voxel + radians * NEAR_VOXELS
    if not len(effects) or float(np.quantile(effects, OFTEN)) < WRONG:
        return ""
    apart = float(np.median(np.diff(track.stamps_ns))) * 1e-9
    return (
        f"the poses are {apart:.1f} s apart, too far for this drive: between them they are off by"
        f" up to {meters.max():.1f} m and {np.degrees(radians.max()):.0f} degrees; record poses"
        " more often, or use --odometry lidar"
    )


def _far_clock_text(topic: str, shift: float, added: float) -> str:
    """Stamps that are farther off beside their recording than the search for a clock reaches.

    What the search found is something else then. No sensor is recorded so late, poses hardly are.
    Else empty.
    """
    if -LATEST_POSES <= shift <= LONGEST_OFFSET:
        return ""
    side = "earlier" if shift > 0 else "later"
    # the stamps' own problem tells how to mend larger ones
    remedy = (
        "correct the stamps of one of both"
        if abs(shift) > LATEST_POSES
        else f"give --set logs.time_offset.{topic}={rounded(shift + added)}, or --stamps log"
    )
    return (
        f"its stamps are {abs(shift):.2f} s {side} beside their recording than the ones of the"
        f" poses: the clock of one of both is another; {remedy}"
    )


def _add(stream: StreamFit, seconds: float, clouds: Clouds, text: str) -> None:
    """Enters times that are ``seconds`` wrong where the vehicle is far off by then.

    Also where the drive does not show it: a steady drive along a street hides a clock. Nothing is
    added to another finding.
    """
    if not stream.findings and seconds * clouds.rates[0] >= WRONG * clouds.voxel:
        stream.findings.append(Finding(Severity.WRONG, text))


def _lead_text(topic: str, part: str, lead: float, added: float) -> str:
    """Stamps of a ``part`` of a stream that are later than their recording.

    The settings have ``added`` so much (s) to its stamps.
    """
    whose = "its stamps" if part == topic else f"the stamps of {part}"
    return (
        f"{whose} are up to {lead:.2f} s later than their recording, which the stamps of the"
        " poses are not: the clock is another one, or was set; give --set logs.time_offset."
        f"{part}={rounded(added - lead)} where this holds for the whole log, else cut the log"
    )


def _off_stamp_text(seconds: float) -> str:
    """Times of points and of their header that contradict each other."""
    return (
        f"its points were all measured {seconds:.2f} s or more before or after the stamp of"
        " their sweep: the stamps or the times of the points are wrong; record sweeps with"
        " times that agree"
    )
