"""A range sensor whose mounting is turned about the way, which a straight drive hides from its map.

All clouds of such a drive are turned alike, so they fit each other and the poses. Its ground and
walls then contradict gravity, as the IMU and the convention of frames have it.
"""

from __future__ import annotations

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.numerics.transforms import angle_between

LEAST_TURN = np.radians(4.0)  # lanes are banked by a degree or two, an IMU is off by one
SURE = np.radians(2.5)  # by so much the IMU and the convention of frames may differ
STRAIGHT = 0.8  # chord over way, of a drive along one direction
LEAST_WAY = 30.0  # voxels
# a wall beside the way: its normal is this near to perpendicular to up, and across the way
PLUMB = np.sin(np.radians(2.0))
ACROSS = 0.5  # at most, the cosine between the normal and the way
LEAST_WALLS = 0.02  # of all flat places, by weight
MORE_PLUMB = 2.0  # times as much is plumb where the ground is level as by gravity


def turn_about_way(
    up: F64, imu: F64, convention: F64, way: F64, normals: F64, weights: F64
) -> float:
    """Angle (rad) about the ``way`` (3,) from gravity to ``up`` (3,) of ground and walls; else 0.

    It is reported where the ``imu`` (3,) and the ``convention`` (3,) agree about gravity, and where
    walls beside the way, of flat places with ``normals`` (n, 3) and ``weights`` (n,), stand at
    right angles to the ground: a road may be inclined, a house is not.
    """
    if angle_between(imu, convention) > SURE:
        return 0.0
    seen = up - (up @ way) * way
    true = imu - (imu @ way) * way
    turn = float(np.arctan2(np.cross(true, seen) @ way, true @ seen))
    if abs(turn) < LEAST_TURN:
        return 0.0
    beside = np.abs(normals @ way) < ACROSS

    def plumb_weight(direction: F64) -> float:
        """Of the places beside the way that are plumb if ``direction`` (3,) is up."""
        return float(weights[beside & (np.abs(normals @ direction) < PLUMB)].sum())

    plumb = plumb_weight(up)
    is_wall = plumb >= LEAST_WALLS * float(weights.sum()) and plumb > MORE_PLUMB * plumb_weight(imu)
    return turn if is_wall else 0.0


def straight_way(positions: F64, voxel: float) -> F64 | None:
    """The unit direction (3,) of a drive through ``positions`` (n, 3); None where it turns."""
    if len(positions) < 2:
        return None
    chord = positions[-1] - positions[0]
    length = float(np.linalg.norm(chord))
    way = float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
    if length < max(LEAST_WAY * voxel, STRAIGHT * way):
        return None
    return np.asarray(chord / length)
