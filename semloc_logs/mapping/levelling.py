"""The gravity-aligned map frame of a session, from its IMU or from its floors and walls."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semloc_logs.errors import LogError
from semloc_logs.logs.messages.stamps import utc
from semloc_logs.logs.session.session import Session
from semloc_logs.mapping.keyframes import Collected
from semloc_logs.mapping.up_direction import find_up
from semloc_logs.numerics.transforms import inverse, rotation_between

F64 = NDArray[np.float64]
# voxels; of the tables that are indexed by place the coarse one of the ground ends first
# (voxels/keys.py)
REACH = 3_000_000
UP = np.array([0.0, 0.0, 1.0])


def level(session: Session, collected: Collected) -> tuple[F64, F64]:
    """``session_T_map`` (4, 4) and ``map_T_base`` (n, 4, 4) of every keyframe.

    The map is level and has its origin at the first keyframe, because poses may be in UTM and
    voxels, words and surfaces want small numbers. In a log without poses each keyframe is levelled
    by itself and the map is the session.
    """
    optical = session.base_frame.endswith("_optical") or session.base_frame in {
        c.header.frame_id for c in session.cameras.values()
    }
    up_in_base = np.array([0.0, -1.0, 0.0]) if optical else UP
    known = [p for p in collected.poses if p is not None]
    if not known:
        return np.eye(4), _each_level(collected, up_in_base)
    prior = session.imu_up_in_session()
    if prior is None:
        # a vehicle's frames follow REP 103, and so does its odometry; a camera's world may be any
        # of its frames
        prior = (np.array([p[:3, :3] for p in known]) @ up_in_base).mean(0) if optical else UP
    normals = collected.normals()
    session_T_map = np.eye(4)
    session_T_map[:3, :3] = rotation_between(
        UP,
        find_up(
            np.concatenate([k[1] for k in normals]), np.concatenate([k[2] for k in normals]), prior
        ),
    )
    session_T_map[:3, 3] = known[0][:3, 3]
    return session_T_map, inverse(session_T_map) @ np.array(known)


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


def _each_level(collected: Collected, up_in_base: F64) -> F64:
    """Level poses (n, 4, 4) of keyframes without poses.

    The direction of gravity is the one of the nearest keyframe for which it was estimated.
    """
    up_of = {
        number: find_up(normals, weights, up_in_base)
        for number, normals, weights in collected.normals()
    }
    keys = np.array(sorted(up_of))
    poses = np.tile(np.eye(4), (len(collected), 1, 1))
    for i in range(len(collected)):
        poses[i, :3, :3] = rotation_between(up_of[int(keys[np.argmin(np.abs(keys - i))])], UP)
    return poses
