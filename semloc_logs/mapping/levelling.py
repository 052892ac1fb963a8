"""The gravity-aligned map frame of a session, from its IMU, or from its ground and walls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.errors import LogError
from semloc_logs.logs.messages.stamps import utc
from semloc_logs.logs.poses.tf_tree import frame_name
from semloc_logs.logs.problems import Problem
from semloc_logs.logs.session.session import Session
from semloc_logs.mapping.gravity import (
    Expected,
    Gravity,
    UpSource,
    find_gravity,
    given_gravity,
)
from semloc_logs.mapping.keyframes import Collected
from semloc_logs.mapping.mounting_tilt import straight_way, turn_about_way
from semloc_logs.mapping.up_direction import FlatPlaces, find_up
from semloc_logs.mapping.up_evidence import UpEvidence
from semloc_logs.numerics.transforms import inverse, rotation_between
from semloc_logs.settings import STREET_VOXEL, Resolved

# voxels; of the tables that are indexed by place the coarse one of the ground ends first
# (voxels/keys.py)
REACH = 3_000_000
UP = np.array([0.0, 0.0, 1.0])
DOWN_FRAMES = ("ned", "frd")  # z points down, in frames of this name or with it behind a "_"


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """``session_T_map`` (4, 4), and ``map_T_base`` (n, 4, 4) of every keyframe.

    The map is level; ``gravity`` holds the evidence. ``tilt``: the angle (rad) about the way by
    which the range sensors are mounted otherwise than the log has it; 0 where that is not known.
    """

    session_T_map: F64
    map_T_base: F64
    gravity: Gravity
    tilt: float = 0.0

    @property
    def problems(self) -> tuple[Problem, ...]:
        """What is not sure about it."""
        return self.gravity.problems


def level(session: Session, collected: Collected, settings: Resolved) -> Level:
    """The level map frame of a session; its origin is the first keyframe.

    Poses may be in UTM, and voxels, words and surfaces want small numbers. In a log without poses
    each keyframe is levelled by itself and the map is the session.
    """
    known = np.array([p for p in collected.poses if p is not None]).reshape(-1, 4, 4)
    places = collected.flat_places()
    expected = _expected(session, known)
    gravity = _gravity(expected, places, known, settings)
    if not len(known):
        return Level(np.eye(4), _each_level(len(collected), places, gravity), gravity)
    session_T_map = np.eye(4)
    session_T_map[:3, :3] = rotation_between(UP, gravity.up)
    session_T_map[:3, 3] = known[0][:3, 3]
    is_mounted = any(frame_name(h.frame_id) != session.base_frame for h in collected.headers)
    way = straight_way(known[:, :3, 3], settings.fusion.voxel_size) if is_mounted else None
    tilt = 0.0 if way is None else _tilt(expected, gravity, places, way)
    return Level(session_T_map, inverse(session_T_map) @ known, gravity, tilt)


def _expected(session: Session, known: F64) -> Expected:
    """Up as it is expected, in the frame that :func:`_gravity` gives it in."""
    posed = len(known) > 0
    return Expected(
        session.name,
        (session.session_frame if posed else session.base_frame) or "session",
        _convention(session, known),
        session.imu_up_in_session() if posed else session.imu_up_in_base(),
        session.roles.imu or "",
    )


def _tilt(expected: Expected, gravity: Gravity, places: dict[int, FlatPlaces], way: F64) -> float:
    """The angle about the ``way`` (3,) by which ground and walls contradict gravity; else 0."""
    if expected.imu is None or gravity.source is not UpSource.IMU:
        return 0.0
    normals, weights = _normals(places)
    return turn_about_way(gravity.up, expected.imu, expected.convention, way, normals, weights)


def _normals(places: dict[int, FlatPlaces]) -> tuple[F64, F64]:
    """Normals (n, 3) and weights (n,) of all flat places."""
    views = [*places.values()]
    normals = np.concatenate([v.normals for v in views])
    return normals, np.concatenate([v.weights for v in views])


def _gravity(
    expected: Expected, places: dict[int, FlatPlaces], known: F64, settings: Resolved
) -> Gravity:
    """Up in the session frame, or without poses (``known`` (n, 4, 4)) in the base frame."""
    normals, weights = _normals(places)
    if settings.logs.up_vector is not None:
        return given_gravity(np.array(settings.logs.up_vector), normals, weights)
    evidence = UpEvidence([*places.values()], known, settings.fusion.voxel_size / STREET_VOXEL)
    return find_gravity(expected, normals, weights, evidence)


def _convention(session: Session, known: F64) -> F64:
    """Up by the conventions of frames (REP 103, REP 105).

    A vehicle's frames have z up, and so has its odometry, unless their names say that z is down;
    a camera's world may be any of its frames, so it is the mean of the camera's up.
    """
    optical = session.base_frame.endswith("_optical") or session.base_frame in {
        c.header.frame_id for c in session.cameras.values()
    }
    if optical:
        up_in_base = np.array([0.0, -1.0, 0.0])
        return (known[:, :3, :3] @ up_in_base).mean(0) if len(known) else up_in_base
    frame = session.session_frame if len(known) else session.base_frame
    return -UP if frame.lower().replace("/", "_").split("_")[-1] in DOWN_FRAMES else UP


def check_reach(session: Session, collected: Collected, voxel_size: float) -> None:
    """LogError where poses leave the space of voxel numbers, 3 million from the first keyframe."""
    reach = REACH * voxel_size
    first = None
    for header, pose in zip(collected.headers, collected.poses, strict=True):
        if pose is None:
            continue
        first = pose[:3, 3] if first is None else first
        away = float(np.linalg.norm(pose[:3, 3] - first))
        if away > reach:
            when = utc(header.stamp_ns)
            raise LogError(
                f"{session.name}: the poses have come {away / 1e3:.0f} km from the first at "
                f"{when}, "
                f"but a map of {voxel_size:g} m voxels reaches {reach / 1e3:.0f} km: cut the log "
                "there, or give poses with --poses FILE."
            )


def _each_level(count: int, places: dict[int, FlatPlaces], gravity: Gravity) -> F64:
    """Level poses (n, 4, 4) of ``count`` keyframes without poses.

    The direction of gravity is the one of the nearest keyframe for which it was estimated.
    """
    up_of = {number: find_up(p.normals, p.weights, gravity.prior) for number, p in places.items()}
    keys = np.array(sorted(up_of))
    poses = np.tile(np.eye(4), (count, 1, 1))
    for i in range(count):
        poses[i, :3, :3] = rotation_between(up_of[int(keys[np.argmin(np.abs(keys - i))])], UP)
    return poses
