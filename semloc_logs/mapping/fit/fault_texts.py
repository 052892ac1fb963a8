"""Sentences about the faults that explain how poses and range data differ, each with its remedy."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64
from semloc_logs.mapping.fit.clock_drift import ClockDrift
from semloc_logs.mapping.fit.keyframe_pairs import Clouds

OTHER_END = 0.5, 1.5  # of a sweep: an offset may be from its other end
BENT = 0.5  # of a sweep: in drives of 50 and 130 m offsets of clocks were off by 0.5 of it at most
MIRRORED = 0.25  # of a shift, by which it differs from twice the mounting it is of
HARDLY_MOVE = 0.05  # times as far as the poses: registration may have found no motion at all
FOOT, NEAR_FOOT = np.log(1 / 0.3048), 0.03  # of the logarithm of a scale
OPTICAL = np.radians(120.0)  # between the axes of a body and of an optical frame


def clock_text(topic: str, offset: float, sigma: float, clouds: Clouds) -> str:
    """The sentence's end about stamps that are ``offset`` seconds behind the poses' clock."""
    side = "behind" if offset > 0 else "ahead of"
    span = clouds.span
    # points were freed of the motion at the wrong time, which shifts the estimate
    spread = max(sigma, 0.01, BENT * span)
    least, most = OTHER_END
    ends = ""
    if least * span <= abs(offset) <= most * span:
        ends = (
            f" (a sweep takes {span:.2f} s: its stamps, or the times of its points, may be counted"
            " from its other end)"
        )
    return (
        f"its stamps are {abs(offset):.2f} \u00b1 {spread:.2f} s {side} the clock"
        f" of the poses{ends}; give --set logs.time_offset.{topic}="
        f"{rounded(offset + clouds.time_offset)}"
    )


def clock_drift_text(drift: ClockDrift) -> str:
    """The sentence's end about a clock that drifts away from the one of the poses."""
    return (
        f"beside the clock of the poses its stamps have to change by {drift.first:+.2f} s in the"
        f" first part of the drive and by {drift.last:+.2f} s in the last (\u00b1 {drift.sigma:.2f}"
        " s): the clocks drift apart; keep them together (PTP, NTP), or use the times of recording"
        " with --set logs.stamps=log"
    )


def rounded(seconds: float) -> str:
    """An offset for the settings, with its sign; a zero has a plus."""
    return f"{round(seconds, 2) + 0.0:+.2f}"


def mounting_text(shift: F64, turn: F64, sigma: F64, clouds: Clouds) -> str:
    """The sentence's end about a mounting that has to move by ``shift`` (3,) and ``turn`` (3,).

    Metres and a rotation vector in the base frame, 0 where nothing is known, with the standard
    deviations (6,) of both.
    """
    moves = [
        f"{shift[k]:+.2f} \u00b1 {sigma[k]:.2f} m along {'xyz'[k]}" for k in np.flatnonzero(shift)
    ]
    turns = [
        f"{np.degrees(turn[k]):+.1f} \u00b1 {np.degrees(sigma[3 + k]):.1f} degrees about {'xyz'[k]}"
        for k in np.flatnonzero(turn)
    ]
    parts = []
    if turns:
        parts.append(f"be turned by {', '.join(turns)} of the base frame{_convention(turn)}")
    if moves:
        parts.append(f"move by {', '.join(moves)} of the base frame{_signs(shift, clouds)}")
    return f"its mounting has to {' and to '.join(parts)}; {_remedy(shift, turn, clouds)}"


def _convention(turn: F64) -> str:
    """A usual mistake that a turn is near to; else empty."""
    rotation = Rotation.from_rotvec(turn)
    is_cycle = abs(rotation.magnitude() - OPTICAL) < np.radians(10.0)
    if is_cycle and _is_axis_rotation(rotation):
        return ", as where the axes of an optical frame are taken for the axes of a body frame"
    return ""


def _signs(shift: F64, clouds: Clouds) -> str:
    """Coordinates of the mounting that a shift mirrors; else empty."""
    mirrored = [
        f"{axis} of {given:.2f} m"
        for axis, change, given in zip("xyz", shift, clouds.mounting(), strict=True)
        if change and abs(change + 2.0 * given) < MIRRORED * abs(change)
    ]
    return f", as where its {' and its '.join(mirrored)} has the wrong sign" if mirrored else ""


def _remedy(shift: F64, turn: F64, clouds: Clouds) -> str:
    """How to set the mounting right."""
    if clouds.mounted is None:
        return "correct its transform"
    pose = corrected(clouds.mounted.base_T_sensor, shift, turn)
    position = ",".join(f"{v + 0.0:.3f}" for v in pose[:3, 3].round(3))
    rotation = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True).round(5)
    quaternion = ",".join(f"{v + 0.0:.5f}" for v in rotation)
    return (
        f"correct its transform, or give --set logs.mountings.{clouds.mounted.frame}=[{position},"
        f"{quaternion}]"
    )


def corrected(base_T_sensor: F64, shift: F64, turn: F64) -> F64:
    """A mounting (4, 4) that is turned and moved in the base frame.

    A coordinate that is not shifted stays as it is, also where the mounting is turned: it was not
    in doubt.
    """
    rotation = Rotation.from_rotvec(turn).as_matrix()
    pose = base_T_sensor.copy()
    pose[:3, :3] = rotation @ base_T_sensor[:3, :3]
    moved = rotation @ base_T_sensor[:3, 3] + shift
    pose[:3, 3] = np.where(shift == 0, base_T_sensor[:3, 3], moved)
    return pose


def _is_axis_rotation(rotation: Rotation) -> bool:
    """Whether a rotation takes axes to axes, within 10 degrees."""
    group = Rotation.create_group("O")
    return bool((group.inv() * rotation).magnitude().min() < np.radians(10.0))


def scale_text(log_scale: float, sigma: float) -> str:
    """The sentence's end about clouds that move otherwise than the poses by a factor."""
    factor = float(np.exp(log_scale))
    if factor < HARDLY_MOVE:
        return (
            f"its clouds move less than {HARDLY_MOVE:g} times as far as the poses: the positions of"
            " the poses are in another unit or along other axes, or the clouds are not of the time"
            " of their stamps"
        )
    unit = " (a foot is 0.305 m)" if abs(abs(log_scale) - FOOT) < NEAR_FOOT else ""
    return (
        f"its clouds move {factor:.3f} \u00b1 {factor * sigma:.3f} times as far as the"
        f" poses: one of both is not in metres{unit}, or the odometry is badly scaled"
    )
