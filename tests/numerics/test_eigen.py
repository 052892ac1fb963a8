from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semloc_logs.arrays import F64
from semloc_logs.numerics.eigen import eigen


def eigen_all(matrices: F64) -> tuple[F64, F64]:
    values = np.empty(matrices.shape[:2])
    vectors = np.empty(matrices.shape)
    for a, w, v in zip(matrices.copy(), values, vectors, strict=True):
        eigen(a, w, v)
    return values, vectors


def random_symmetric(seed: int, n: int) -> F64:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(n, 3, 3)) * 10.0 ** rng.uniform(-6, 6, (n, 1, 1))
    return np.asarray(a + a.transpose(0, 2, 1))


def test_as_numpy_says() -> None:
    a = random_symmetric(0, 2000)
    values, vectors = eigen_all(a)
    expected = np.linalg.eigh(a)[0]
    size = np.abs(expected).max(1, keepdims=True)
    np.testing.assert_allclose(values / size, expected / size, atol=1e-13)
    np.testing.assert_allclose(
        a @ vectors / size[..., None], vectors * values[:, None] / size[..., None], atol=1e-12
    )
    np.testing.assert_allclose(
        vectors.transpose(0, 2, 1) @ vectors, np.tile(np.eye(3), (2000, 1, 1)), atol=1e-13
    )


@pytest.mark.parametrize(
    "a",
    [
        np.zeros((3, 3)),
        np.eye(3),
        np.diag([3.0, 1.0, 1.0]),
        np.ones((3, 3)),
        np.diag([0.0, 0.0, 1e-30]),
    ],
)
def test_equal_eigenvalues(a: F64) -> None:
    values, vectors = eigen_all(a[None])
    np.testing.assert_allclose(values[0], np.linalg.eigvalsh(a), atol=1e-15)
    np.testing.assert_allclose(vectors[0].T @ vectors[0], np.eye(3), atol=1e-14)


@settings(max_examples=60)
@given(st.lists(st.floats(-1e3, 1e3), min_size=6, max_size=6))
def test_any_matrix_is_put_together_again(upper: list[float]) -> None:
    a = np.zeros((3, 3))
    a[np.triu_indices(3)] = upper
    a = a + np.triu(a, 1).T
    values, vectors = eigen_all(a[None])
    assert values[0].tolist() == sorted(values[0])
    np.testing.assert_allclose(
        vectors[0] @ np.diag(values[0]) @ vectors[0].T, a, atol=1e-9 * (1 + np.abs(a).max())
    )
