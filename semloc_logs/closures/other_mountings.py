"""Sessions whose mountings of one sensor contradict each other, so that closures would be false.

A drive may hide that its mounting is wrong: by how much the base frames of two sessions differ
follows from their mountings then, and nothing tells which of both is right.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from semloc_logs.mapping.fit.findings import LEAST_PAIRS, NAMES, NEAR_VOXELS
from semloc_logs.mapping.session_map import SessionMap

F64 = NDArray[np.float64]

# voxels by which such a difference moves a closure, at least; 0.75 m or 4.3 degrees at street scale
LEAST = 2.5
OTHER_AXES = np.radians(20.0)  # base frames that differ by more have other axes, such as NED
ALIKE = 0.5  # of a difference of mountings in height, by which the sensor is as high all the same


@dataclass(frozen=True, slots=True, eq=False)
class Mounted:
    """The mountings of a session.

    ``base_T_sensors`` (4, 4) by frame; ``hidden``: faults that its drive does not show; ``height``:
    of the base frame above the ground (m); nan where no ground was seen.
    """

    base_frame: str
    base_T_sensors: Mapping[str, F64]
    hidden: frozenset[str]
    height: float
    voxel: float

    @property
    def mountings(self) -> dict[str, bytes]:
        """The bytes of the mountings: equal ones are compared at once."""
        return {frame: T.tobytes() for frame, T in self.base_T_sensors.items()}

    @staticmethod
    def of(session: SessionMap) -> Mounted:
        """The one of a session with keyframes."""
        content = session.json
        hidden: set[str] = set()
        for stream in (content.get("fit") or {"streams": []})["streams"]:
            hidden |= {*(NAMES if stream["pairs"] < LEAST_PAIRS else stream["hidden"])}
        heights = session.map_T_base[:, 2, 3] - session.ground_z
        known = heights[np.isfinite(heights)]
        return Mounted(
            str(content.get("base_frame", "")),
            {frame: np.array(T) for frame, T in content.get("base_T_sensors", {}).items()},
            frozenset(hidden),
            float(np.median(known)) if len(known) else np.nan,
            float(content["voxel_size"]),
        )


def contradictions(maps: Mapping[str, SessionMap]) -> dict[frozenset[str], str]:
    """The pairs of sessions that contradict each other, with the end of a sentence about them."""
    mounted = {name: Mounted.of(m) for name, m in sorted(maps.items()) if m.posed and not m.is_map}
    mountings = {name: session.mountings for name, session in mounted.items()}
    found = {}
    for name, other in combinations(mounted, 2):
        if mountings[name] == mountings[other]:  # as of most of many sessions
            continue
        if text := contradiction(mounted[name], mounted[other]):
            found[frozenset((name, other))] = text
    return found


def contradiction(one: Mounted, other: Mounted) -> str:
    """How the mountings of two sessions contradict each other; empty where they do not."""
    if one.base_frame != other.base_frame:
        return ""
    hidden = one.hidden | other.hidden
    for frame in sorted(one.base_T_sensors.keys() & other.base_T_sensors.keys()):
        first = one.base_T_sensors[frame]
        second = other.base_T_sensors[frame]
        shift = first[:3, 3] - second[:3, 3]
        turn = Rotation.from_matrix(first[:3, :3] @ second[:3, :3].T).as_rotvec()
        if np.linalg.norm(turn) > OTHER_AXES:
            continue
        height = one.height - other.height
        for k, axis in enumerate("xyz"):
            if abs(turn[k]) * NEAR_VOXELS > LEAST and f"rotation_{axis}_rad" in hidden:
                degrees = np.degrees(abs(turn[k]))
                return _text(frame, one.base_frame, f"turned by {degrees:.1f} degrees about {axis}")
            if abs(shift[k]) <= LEAST * one.voxel:
                continue
            if axis != "z" and f"lever_{axis}_m" in hidden:
                shifted = f"shifted by {abs(shift[k]):.2f} m along {axis}"
                return _text(frame, one.base_frame, shifted)
            if axis == "z" and abs(height + shift[k]) < ALIKE * abs(shift[k]):
                return (
                    f"'{frame}' is mounted in '{one.base_frame}' at z = {first[2, 3]:.2f} m in one"
                    f" and at {second[2, 3]:.2f} m in the other, although it is as high above the"
                    " ground in both"
                )
    return ""


def _text(frame: str, base_frame: str, difference: str) -> str:
    return (
        f"'{frame}' is mounted in '{base_frame}' {difference} between both, and their drives are"
        " too straight or too short to show which is right"
    )
