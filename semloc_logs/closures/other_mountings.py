"""Sessions whose mountings of one sensor contradict each other, so that closures would be false.

A drive may hide that its mounting is wrong: by how much the base frames of two sessions differ
follows from their mountings then, and nothing tells which of both is right.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64
from semloc_logs.mapping.fit.findings import LEAST_PAIRS, NAMES, NEAR_VOXELS
from semloc_logs.mapping.session_map import SessionMap

Both = frozenset[str]  # two sessions by name

# voxels by which such a difference moves a closure, at least; 0.75 m or 4.3 degrees at street scale
LEAST = 2.5
OTHER_AXES = np.radians(20.0)  # base frames that differ by more have other axes, such as NED
ALIKE = 0.5  # of a difference of mountings in height, by which the sensor is as high all the same


@dataclass(frozen=True, slots=True, eq=False)
class Mounted:
    """The mountings of the range sensors of a session.

    ``base_T_sensors`` (4, 4) by frame, and the faults of each that its drive does not show
    (``hidden``); ``height`` of the base frame above the ground (m), nan where no ground was seen.
    """

    base_frame: str
    base_T_sensors: Mapping[str, F64]
    hidden: Mapping[str, frozenset[str]]
    height: float
    voxel: float

    @staticmethod
    def of(session: SessionMap) -> Mounted:
        """The mountings of a session with keyframes."""
        hidden: dict[str, frozenset[str]] = {}
        for stream in _streams(session):
            untold = NAMES if stream["pairs"] < LEAST_PAIRS else stream["hidden"]
            for frame in stream.get("frames", ()):
                # another sensor in this frame may show them
                hidden[frame] = hidden.get(frame, frozenset(NAMES)) & {*untold}
        heights = session.map_T_base[:, 2, 3] - session.ground_z
        known = heights[np.isfinite(heights)]
        return Mounted(
            str(session.json.get("base_frame", "")),
            {frame: np.array(T) for frame, T in _base_T_sensors(session).items()},
            hidden,
            float(np.median(known)) if len(known) else np.nan,
            float(session.json["voxel_size"]),
        )


def _streams(session: SessionMap) -> list[dict[str, Any]]:
    """The check of each range stream."""
    return list((session.json.get("fit") or {"streams": []})["streams"])


def _base_T_sensors(session: SessionMap) -> dict[str, Any]:
    """``base_T_sensor`` of the frames of range sensors; cameras that only paint labels are none."""
    frames = {frame for stream in _streams(session) for frame in stream.get("frames", ())}
    base_T_sensors = session.json.get("base_T_sensors", {})
    return {frame: T for frame, T in base_T_sensors.items() if frame in frames}


def contradictions(maps: Mapping[str, SessionMap]) -> dict[Both, str]:
    """The pairs of sessions that contradict each other, with the end of a sentence about them."""
    sessions = {name: m for name, m in sorted(maps.items()) if m.posed and not m.is_map}
    mountings = {name: _base_T_sensors(session) for name, session in sessions.items()}
    pairs = [
        (name, other)
        for name, other in combinations(sessions, 2)
        if mountings[name] != mountings[other]  # most of many sessions have equal ones
    ]
    mounted = {name: Mounted.of(sessions[name]) for name in {name for p in pairs for name in p}}
    texts = {Both(pair): contradiction(*(mounted[name] for name in pair)) for pair in pairs}
    return {pair: text for pair, text in texts.items() if text}


def contradiction(one: Mounted, other: Mounted) -> str:
    """How the mountings of two sessions contradict each other; empty where they do not."""
    if one.base_frame != other.base_frame:
        return ""
    for frame in sorted(one.base_T_sensors.keys() & other.base_T_sensors.keys()):
        first = one.base_T_sensors[frame]
        second = other.base_T_sensors[frame]
        hidden = one.hidden[frame] | other.hidden[frame]
        shift = first[:3, 3] - second[:3, 3]
        turn = Rotation.from_matrix(first[:3, :3] @ second[:3, :3].T).as_rotvec()
        if np.linalg.norm(turn) > OTHER_AXES:
            continue
        height = one.height - other.height
        for k, axis in enumerate("xyz"):
            if abs(turn[k]) * NEAR_VOXELS > LEAST and f"rotation_{axis}_rad" in hidden:
                degrees = np.degrees(abs(turn[k]))
                return _unclear(
                    frame, one.base_frame, f"turned by {degrees:.1f} degrees about {axis}"
                )
            if abs(shift[k]) <= LEAST * one.voxel:
                continue
            if axis != "z" and f"lever_{axis}_m" in hidden:
                shifted = f"shifted by {abs(shift[k]):.2f} m along {axis}"
                return _unclear(frame, one.base_frame, shifted)
            if axis == "z" and abs(height + shift[k]) < ALIKE * abs(shift[k]):
                return (
                    f"'{frame}' is mounted in '{one.base_frame}' at z = {first[2, 3]:.2f} m in one"
                    f" and at {second[2, 3]:.2f} m in the other, although it is as high above the"
                    " ground in both"
                )
    return ""


def _unclear(frame: str, base_frame: str, difference: str) -> str:
    return (
        f"'{frame}' is mounted in '{base_frame}' {difference} between both, and their drives are"
        " too straight or too short to show which is right"
    )
