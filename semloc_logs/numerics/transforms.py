"""Rigid transforms as 4x4 float64 matrices named ``target_T_source``.

``p_target = target_T_source @ p_source``. Quaternions are xyzw, angles radians; arrays of
transforms have shape (n, 4, 4).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from semloc_logs.arrays import F64


def transform(translation: F64, quaternion_xyzw: F64) -> F64:
    """4x4 matrices from translations (..., 3), m, and quaternions (..., 4) xyzw of any length."""
    t = np.asarray(translation, float)
    q = np.asarray(quaternion_xyzw, float)
    out = np.zeros((*t.shape[:-1], 4, 4))
    out[..., :3, :3] = Rotation.from_quat(q.reshape(-1, 4)).as_matrix().reshape(*t.shape[:-1], 3, 3)
    out[..., :3, 3] = t
    out[..., 3, 3] = 1.0
    return out


def translation_quaternion(target_T_source: F64) -> tuple[F64, F64]:
    """Translations (..., 3) and unit quaternions (..., 4) xyzw, w >= 0, of matrices (..., 4, 4)."""
    m = np.asarray(target_T_source, float)
    q = Rotation.from_matrix(m[..., :3, :3].reshape(-1, 3, 3)).as_quat(canonical=True)
    return m[..., :3, 3].copy(), q.reshape(*m.shape[:-2], 4)


def inverse(target_T_source: F64) -> F64:
    """``source_T_target`` for matrices (..., 4, 4)."""
    m = np.asarray(target_T_source, float)
    out = np.zeros_like(m)
    rt = np.swapaxes(m[..., :3, :3], -1, -2)
    out[..., :3, :3] = rt
    out[..., :3, 3] = -np.einsum("...ij,...j->...i", rt, m[..., :3, 3])
    out[..., 3, 3] = 1.0
    return out


def apply(target_T_source: F64, points: NDArray[np.floating]) -> F64:
    """Points (n, 3) of the source frame expressed in the target frame, float64."""
    return np.asarray(points, float) @ target_T_source[:3, :3].T + target_T_source[:3, 3]


def yaw_transform(
    yaw: float, translation: F64 | tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> F64:
    """Rotation by ``yaw`` about +z, then translation."""
    out = np.eye(4)
    c = np.cos(yaw)
    s = np.sin(yaw)
    out[:2, :2] = [[c, -s], [s, c]]
    out[:3, 3] = translation
    return out


def turned_about_z(points: F64, yaw: F64) -> F64:
    """Points (n, 3), each turned about +z by its own of ``yaw`` (n,)."""
    c = np.cos(yaw)
    s = np.sin(yaw)
    return np.stack(
        [c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1], points[:, 2]], 1
    )


def exp_se3(t: F64, rotation_vector: F64) -> F64:
    """Left increment of a transform: translation ``t`` and ``Exp(rotation_vector)`` side by side.

    This is not the exponential of se(3).
    """
    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec(rotation_vector).as_matrix()
    out[:3, 3] = t
    return out


def rotation_angle(rotation: F64) -> float:
    """Angle in radians of a 3x3 rotation matrix, accurate near zero."""
    return float(np.linalg.norm(Rotation.from_matrix(rotation).as_rotvec()))


def angle_between(a: F64, b: F64) -> float:
    """Angle in radians between two directions (3,) of any length, accurate near zero."""
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def rotation_between(source: F64, target: F64) -> F64:
    """The smallest rotation (3, 3) that turns direction ``source`` into direction ``target``."""
    a = source / np.linalg.norm(source)
    b = target / np.linalg.norm(target)
    axis = np.cross(a, b)
    sine = np.linalg.norm(axis)
    cosine = float(a @ b)
    if sine < 1e-12:
        if cosine > 0:
            return np.eye(3)
        helper = np.eye(3)[np.argmin(np.abs(a))]
        axis = np.cross(a, helper)
        return np.asarray(Rotation.from_rotvec(np.pi * axis / np.linalg.norm(axis)).as_matrix())
    return np.asarray(Rotation.from_rotvec(axis / sine * np.arctan2(sine, cosine)).as_matrix())


def interpolate(stamps_ns: NDArray[np.int64], poses: F64, at_ns: NDArray[np.int64]) -> F64:
    """Poses (m, 4, 4) at ``at_ns`` (m,), interpolated on SO(3) x R^3.

    ``poses`` (n, 4, 4) are at strictly increasing ``stamps_ns`` (n,). Times outside the range take
    the nearest end; the caller decides what a gap is.
    """
    clipped = np.clip(np.asarray(at_ns, np.int64), stamps_ns[0], stamps_ns[-1])
    if len(stamps_ns) == 1 or not len(clipped):
        return np.repeat(poses[:1], len(clipped), axis=0)
    # seconds from the first stamp: nanoseconds since 1970 do not fit float64
    base = np.asarray(stamps_ns[0], np.int64)
    wanted = (clipped - base) * 1e-9
    # few poses of a long track cost no more than their neighbours
    before = np.maximum(np.searchsorted(stamps_ns, clipped) - 1, 0)
    rows = np.unique(np.r_[before, before + 1])
    s = (stamps_ns[rows] - base) * 1e-9
    out = np.zeros((len(clipped), 4, 4))
    out[:, :3, :3] = Slerp(s, Rotation.from_matrix(poses[rows, :3, :3]))(wanted).as_matrix()
    for k in range(3):
        out[:, k, 3] = np.interp(wanted, s, poses[rows, k, 3])
    out[:, 3, 3] = 1.0
    return out
