"""Sentences about the faults that explain how poses and range data differ, each with its remedy."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from semloc_logs.mapping.fit.keyframe_pairs import Clouds
from semloc_logs.mapping.fit.model import CLOCK, ROTATION, SCALE, Fault

F64 = NDArray[np.float64]
OTHER_END = 0.5, 1.5  # of a sweep: an offset may be from its other end
BENT = 0.5  # of a sweep: in drives of 50 and 130 m offsets of clocks were off by 0.5 of it at most
MIRRORED = 0.25  # of a shift, by which it differs from twice the mounting it is of
HARDLY_MOVE = 0.05  # times as far as the poses: registration may have found no motion at all
FOOT, NEAR_FOOT = np.log(1 / 0.3048), 0.03  # of the logarithm of a scale
OPTICAL = np.radians(120.0)  # between the axes of a body and of an optical frame


def fault_text(
    fault: Fault, known: F64, sigma: Callable[[int], float], topic: str, clouds: Clouds
) -> str:
    """The sentence's end about a fault with these parameters (8,)."""
    if fault is Fault.CLOCK:
        return _clock_text(topic, known, sigma, clouds)
    if fault is Fault.LEVER:
        return _lever_text(known, sigma, clouds.mounting())
    return _rotation_text(known, sigma) if fault is Fault.ROTATION else _scale_text(known, sigma)


def _clock_text(topic: str, parameters: F64, sigma: Callable[[int], float], clouds: Clouds) -> str:
    offset = float(parameters[CLOCK])
    side = "behind" if offset > 0 else "ahead of"
    span = clouds.span
    # points were freed of the motion at the wrong time, which shifts the estimate
    spread = max(sigma(CLOCK), 0.01, BENT * span)
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


def rounded(seconds: float) -> str:
    """An offset for the settings, with its sign; a zero has a plus."""
    return f"{round(seconds, 2) + 0.0:+.2f}"


def _rotation_text(parameters: F64, sigma: Callable[[int], float]) -> str:
    rotation = Rotation.from_rotvec(parameters[ROTATION])
    turns = []
    for column, axis in zip(Fault.ROTATION.columns.tolist(), "xyz", strict=True):
        if parameters[column]:
            angle = np.degrees(parameters[column])
            spread = np.degrees(sigma(column))
            turns.append(f"{angle:.1f} \u00b1 {spread:.1f} degrees about {axis}")
    convention = ""
    is_cycle = abs(rotation.magnitude() - OPTICAL) < np.radians(10.0)
    if is_cycle and _is_axis_rotation(rotation):
        convention = (
            ", as where the axes of an optical frame are taken for the axes of a body frame"
        )
    return (
        f"its mounting is turned by {', '.join(turns)} of the base frame{convention}; correct its"
        " transform"
    )


def _is_axis_rotation(rotation: Rotation) -> bool:
    """Whether a rotation takes axes to axes, within 10 degrees."""
    group = Rotation.create_group("O")
    return bool((group.inv() * rotation).magnitude().min() < np.radians(10.0))


def _lever_text(parameters: F64, sigma: Callable[[int], float], mounting: F64) -> str:
    shifts = []
    mirrored = []
    for column, axis, given in zip(Fault.LEVER.columns.tolist(), "xyz", mounting, strict=True):
        off = float(parameters[column])
        if not off:
            continue
        spread = sigma(column)
        shifts.append(f"{off:.2f} \u00b1 {spread:.2f} m along {axis}")
        if abs(off + 2.0 * given) < MIRRORED * abs(off):
            mirrored.append(f"{axis} of {given:.2f} m")
    sign = f", as where its {' and its '.join(mirrored)} has the wrong sign" if mirrored else ""
    return (
        f"its mounting is off by {', '.join(shifts)} of the base frame{sign}; correct its transform"
    )


def _scale_text(parameters: F64, sigma: Callable[[int], float]) -> str:
    factor = float(np.exp(parameters[SCALE]))
    if factor < HARDLY_MOVE:
        return (
            f"its clouds move less than {HARDLY_MOVE:g} times as far as the poses: the positions of"
            " the poses are in another unit or along other axes, or the clouds are not of the time"
            " of their stamps"
        )
    unit = " (a foot is 0.305 m)" if abs(abs(parameters[SCALE]) - FOOT) < NEAR_FOOT else ""
    return (
        f"its clouds move {factor:.3f} \u00b1 {factor * sigma(SCALE):.3f} times as far as the"
        f" poses: one of both is not in metres{unit}, or the odometry is badly scaled"
    )
