"""Eigen-decomposition of many symmetric 3x3 matrices, without the call of a library for each."""

from __future__ import annotations

import numpy as np
from numba import njit

from semloc_logs.arrays import F64

# of Jacobi rotations; four are enough for double precision, more cost nothing once it has converged
SWEEPS = 12


@njit(cache=True, nogil=True, inline="never")
def eigen(a: F64, values: F64, vectors: F64) -> None:
    """Eigenvalues (3,), ascending, and unit eigenvectors (3, 3), in columns, of a symmetric matrix.

    ``a`` (3, 3) is overwritten. Cyclic Jacobi rotations (Golub and Van Loan, Matrix Computations,
    8.5): as accurate for nearly equal eigenvalues as for others.
    """
    vectors[:] = 0.0
    for i in range(3):
        vectors[i, i] = 1.0
    for _ in range(SWEEPS):
        if abs(a[0, 1]) + abs(a[0, 2]) + abs(a[1, 2]) <= 1e-15 * (
            abs(a[0, 0]) + abs(a[1, 1]) + abs(a[2, 2])
        ):
            break
        for p in range(2):
            for q in range(p + 1, 3):
                if a[p, q] == 0.0:
                    continue
                theta = 0.5 * (a[q, q] - a[p, p]) / a[p, q]
                t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
                if theta < 0:
                    t = -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(3):
                    x = a[k, p]
                    y = a[k, q]
                    a[k, p], a[k, q] = c * x - s * y, s * x + c * y
                for k in range(3):
                    x = a[p, k]
                    y = a[q, k]
                    a[p, k], a[q, k] = c * x - s * y, s * x + c * y
                for k in range(3):
                    x = vectors[k, p]
                    y = vectors[k, q]
                    vectors[k, p], vectors[k, q] = c * x - s * y, s * x + c * y
    for k in range(3):
        values[k] = a[k, k]
    for i, j in ((0, 1), (1, 2), (0, 1)):
        if values[i] > values[j]:
            values[i], values[j] = values[j], values[i]
            for k in range(3):
                vectors[k, i], vectors[k, j] = vectors[k, j], vectors[k, i]
