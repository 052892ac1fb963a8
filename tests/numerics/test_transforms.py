from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64
from semloc_logs.numerics.transforms import (
    apply,
    exp_se3,
    interpolate,
    inverse,
    rotation_angle,
    rotation_between,
    transform,
    translation_quaternion,
    yaw_transform,
)

number = st.floats(-100, 100)
vector = st.tuples(number, number, number).map(np.array)
direction = vector.filter(lambda v: np.linalg.norm(v) > 1e-3)
quaternion = (
    st.tuples(number, number, number, number)
    .map(np.array)
    .filter(lambda q: np.linalg.norm(q) > 1e-3)
)


def by_formula(q: F64) -> F64:
    """The rotation matrix of a quaternion xyzw, written out."""
    x, y, z, w = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


@given(vector, quaternion)
def test_transforms_from_quaternions_and_back(t: F64, q: F64) -> None:
    T = transform(t, q)
    np.testing.assert_allclose(T[:3, :3], by_formula(q), atol=1e-12)
    assert T[:3, 3].tolist() == t.tolist()
    assert T[3].tolist() == [0, 0, 0, 1]
    back_t, back_q = translation_quaternion(T)
    assert back_t.tolist() == t.tolist()
    assert back_q[3] >= 0
    np.testing.assert_allclose(np.abs(back_q @ (q / np.linalg.norm(q))), 1, atol=1e-9)
    np.testing.assert_allclose(inverse(T) @ T, np.eye(4), atol=1e-10)
    many = transform(np.stack([t, t]), np.stack([q, q]))
    assert many.tolist() == [T.tolist(), T.tolist()]
    assert inverse(many).tolist() == [inverse(T).tolist()] * 2
    assert translation_quaternion(many)[1].shape == (2, 4)


def test_a_quarter_turn_by_hand() -> None:
    T = transform(np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.0, 2.0, 2.0]))  # 90 degrees about z
    np.testing.assert_allclose(
        apply(T, np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 5.0]])), [[1, 3, 3], [0, 2, 8]], atol=1e-15
    )
    np.testing.assert_allclose(T, yaw_transform(np.pi / 2, (1.0, 2.0, 3.0)), atol=1e-15)
    assert apply(T, np.zeros((0, 3), np.float32)).shape == (0, 3)
    assert rotation_angle(T[:3, :3]) == pytest.approx(np.pi / 2)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, np.pi - 1e-6])
def test_angles_are_exact_near_zero_and_near_a_half_turn(angle: float) -> None:
    T = exp_se3(np.array([1.0, 2.0, 3.0]), angle * np.array([0.6, 0.0, 0.8]))
    assert rotation_angle(T[:3, :3]) == pytest.approx(angle, rel=1e-6, abs=1e-15)
    assert T[:3, 3].tolist() == [1, 2, 3]


@given(direction, direction)
def test_the_rotation_between_two_directions(a: F64, b: F64) -> None:
    R = rotation_between(a, b)
    a = a / np.linalg.norm(a)
    b = b / np.linalg.norm(b)
    np.testing.assert_allclose(R @ a, b, atol=1e-7)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) > 0
    # and no more than that
    assert rotation_angle(R) == pytest.approx(
        np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b), abs=1e-6
    )


@pytest.mark.parametrize("axis", np.eye(3).tolist())
def test_the_rotation_between_opposite_directions(axis: list[float]) -> None:
    a = np.array(axis)
    np.testing.assert_allclose(rotation_between(a, -a) @ a, -a, atol=1e-12)
    assert rotation_between(a, a).tolist() == np.eye(3).tolist()


def test_interpolation_of_stamps_since_1970() -> None:
    start = 1_700_000_000_123_456_789
    stamps = start + np.array([0, 1_000_000_000, 3_000_000_000])
    poses = np.array(
        [
            yaw_transform(0.0),
            yaw_transform(0.4, (1.0, 0.0, 0.0)),
            yaw_transform(0.4, (1.0, 4.0, 0.0)),
        ]
    )
    queried = start + np.array(
        [
            -5,
            0,
            250_000_000,
            250_000_001,
            1_000_000_000,
            2_000_000_000,
            3_000_000_000,
            9_000_000_000,
        ]
    )
    interpolated = interpolate(stamps, poses, queried)
    np.testing.assert_allclose(
        interpolated[:, 0, 3], [0, 0, 0.25, 0.250000001, 1, 1, 1, 1], atol=1e-12
    )
    np.testing.assert_allclose(interpolated[:, 1, 3], [0, 0, 0, 0, 0, 2, 4, 4], atol=1e-12)
    yaw = np.arctan2(interpolated[:, 1, 0], interpolated[:, 0, 0])
    np.testing.assert_allclose(yaw, [0, 0, 0.1, 0.1000000004, 0.4, 0.4, 0.4, 0.4], atol=1e-12)
    np.testing.assert_allclose(
        interpolate(stamps[:1], poses[1:2], queried), np.repeat(poses[1:2], len(queried), 0)
    )


def test_a_pose_of_a_long_track_is_the_same_alone_and_beside_others() -> None:
    rng = np.random.default_rng(0)
    stamps = 1_760_000_000_000_000_000 + np.cumsum(rng.integers(1, 1_000_000_000, 1000))
    poses = np.tile(np.eye(4), (1000, 1, 1))
    poses[:, :3, :3] = Rotation.random(1000, random_state=0).as_matrix()
    poses[:, :3, 3] = rng.normal(0, 100, (1000, 3))
    wanted = np.r_[rng.integers(stamps[0], stamps[-1], 50), stamps[[0, 1, 500, 999]]]
    alone = np.concatenate([interpolate(stamps, poses, wanted[k : k + 1]) for k in range(54)])
    np.testing.assert_array_equal(alone, interpolate(stamps, poses, wanted))
    assert interpolate(stamps, poses, wanted[:0]).shape == (0, 4, 4)
