"""Least squares over poses: errors, their derivatives, and the sparse normal equations.

A step of a pose is x y z in its own axes and then a rotation vector: X (I + step). All factors of a
kind are computed at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_array
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64, I64
from semloc_logs.numerics.transforms import inverse
from semloc_logs.pose_graph.graph import NO_POSITIONS, Positions
from semloc_logs.pose_graph.problem import Directions, Edges

UP_HUBER = 1.345  # Huber's constant for 95 % efficiency: gravity may be wrong in places
FIX_CAUCHY = 3.0  # standard deviations at which a satellite fix counts half
SMALL_TURN = 1e-4  # radians, below which series replace quotients


@dataclass(frozen=True, slots=True, eq=False)
class PosePriors:
    """Poses (p, 4, 4) of some ``vertices`` (p,), with square roots ``root`` (p, 6, 6)."""

    vertices: I64
    poses: F64
    root: F64


@dataclass(frozen=True, slots=True, eq=False)
class Holds:
    """What single poses are held by: directions of ``up``, ``priors``, and satellite ``fixes``."""

    up: Directions
    priors: PosePriors
    fixes: Positions = NO_POSITIONS


@dataclass(frozen=True, slots=True, eq=False)
class Linearised:
    """``hessian`` (6 v, 6 v) and ``gradient`` (6 v,) of half the sum of squares ``cost``."""

    hessian: bsr_array
    gradient: F64
    cost: float


class Blocks:
    """Sums of 6 x 6 blocks at given places of a sparse matrix; the places are sorted once."""

    def __init__(self, rows: I64, columns: I64, size: int) -> None:
        key = rows * size + columns
        self._order = np.argsort(key, kind="stable")
        self._keys, self._starts = np.unique(key[self._order], return_index=True)
        self._size = size
        counts = np.bincount(self._keys // size, minlength=size)
        self._indptr = np.concatenate([[0], np.cumsum(counts)])

    def summed(self, blocks: F64) -> bsr_array:
        """The matrix of ``blocks`` (k, 6, 6), in the order of the places."""
        data = np.add.reduceat(blocks[self._order], self._starts, axis=0)
        shape = (6 * self._size, 6 * self._size)
        return bsr_array((data, self._keys % self._size, self._indptr), shape=shape)


class NormalEquations:
    """Of poses that ``edges`` connect, and that ``holds`` hold.

    ``fix_scale`` is the constant of the Cauchy weights of fixes.
    """

    def __init__(self, vertices: int, edges: Edges, holds: Holds) -> None:
        self._vertices = vertices
        self._edges = edges
        self._up = up = holds.up
        self._priors = priors = holds.priors
        self._fixes = fixes = holds.fixes
        self.fix_scale = FIX_CAUCHY
        every = np.arange(vertices)
        a = edges.a
        b = edges.b
        single = (up.vertices, priors.vertices, fixes.vertices)
        rows = np.concatenate([every, a, b, a, b, *single])
        columns = np.concatenate([every, a, b, b, a, *single])
        self._blocks = Blocks(rows, columns, vertices)

    def cost(self, poses: F64, weight: F64) -> float:
        """Half the weighted sum of squares; ``weight`` (m,) is of the edges."""
        edges = (_edge_errors(self._edges, poses) ** 2).sum(1) @ weight
        priors = (_prior_errors(self._priors, poses) ** 2).sum()
        tilt = np.linalg.norm(_up_errors(self._up, poses), axis=1)
        linear = tilt > UP_HUBER
        gravity = np.where(linear, UP_HUBER * (2.0 * tilt - UP_HUBER), tilt**2).sum()
        away = (fix_errors(self._fixes, poses) ** 2).sum(1)
        fixes = self.fix_scale**2 * np.log1p(away / self.fix_scale**2).sum()
        return float(0.5 * (edges + priors + gravity + fixes))

    def linearised(self, poses: F64, weight: F64) -> Linearised:
        """At ``poses`` (v, 4, 4)."""
        gradient = np.zeros((self._vertices, 6))
        by_a, by_b, errors = _edge_derivatives(self._edges, poses)
        scale = np.sqrt(weight)[:, None]
        by_a *= scale[..., None]
        by_b *= scale[..., None]
        errors *= scale
        transposed_a = np.swapaxes(by_a, 1, 2)
        transposed_b = np.swapaxes(by_b, 1, 2)
        _add(gradient, self._edges.a, transposed_a, errors)
        _add(gradient, self._edges.b, transposed_b, errors)
        across = transposed_a @ by_b

        by_up, tilts = _up_derivatives(self._up, poses)
        tilt = np.linalg.norm(tilts, axis=1)
        share = np.sqrt(np.minimum(1.0, UP_HUBER / np.maximum(tilt, 1e-12)))
        by_up *= share[:, None, None]
        tilts *= share[:, None]
        transposed_up = np.swapaxes(by_up, 1, 2)
        _add(gradient, self._up.vertices, transposed_up, tilts)

        by_prior, offsets = _prior_derivatives(self._priors, poses)
        transposed_prior = np.swapaxes(by_prior, 1, 2)
        _add(gradient, self._priors.vertices, transposed_prior, offsets)

        by_fix, away = _fix_derivatives(self._fixes, poses)
        share = 1.0 / np.sqrt(1.0 + (away**2).sum(1) / self.fix_scale**2)
        by_fix *= share[:, None, None]
        away *= share[:, None]
        transposed_fix = np.swapaxes(by_fix, 1, 2)
        _add(gradient, self._fixes.vertices, transposed_fix, away)

        blocks = [
            np.zeros((self._vertices, 6, 6)),
            transposed_a @ by_a,
            transposed_b @ by_b,
            across,
            np.swapaxes(across, 1, 2),
            transposed_up @ by_up,
            transposed_prior @ by_prior,
            transposed_fix @ by_fix,
        ]
        hessian = self._blocks.summed(np.concatenate(blocks))
        return Linearised(hessian, gradient.ravel(), self.cost(poses, weight))


def moved(poses: F64, step: F64) -> F64:
    """Poses (v, 4, 4) after a ``step`` (6 v,)."""
    steps = step.reshape(-1, 6)
    out = poses.copy()
    out[:, :3, 3] += np.einsum("vij,vj->vi", poses[:, :3, :3], steps[:, :3])
    out[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(steps[:, 3:]).as_matrix()
    return out


def crossed(vectors: F64) -> F64:
    """The matrices (n, 3, 3) of the cross products with ``vectors`` (n, 3)."""
    out = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -z, y, -x
    out[:, 1, 0], out[:, 2, 0], out[:, 2, 1] = z, -y, x
    return out


def _add(gradient: F64, vertices: I64, transposed: F64, errors: F64) -> None:
    np.add.at(gradient, vertices, np.einsum("nij,nj->ni", transposed, errors))


def _rotvec(rotation: F64) -> F64:
    turns = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_rotvec()
    return np.asarray(turns.reshape(-1, 3))


def _vectors(error: F64) -> F64:
    """x y z and rotation vectors (n, 6) of transforms (n, 4, 4)."""
    return np.concatenate([error[:, :3, 3], _rotvec(error[:, :3, :3])], axis=1)


def _edge_errors(edges: Edges, poses: F64) -> F64:
    error = inverse(edges.a_T_b) @ inverse(poses[edges.a]) @ poses[edges.b]
    return np.asarray(np.einsum("mij,mj->mi", edges.root, _vectors(error)))


def _edge_derivatives(edges: Edges, poses: F64) -> tuple[F64, F64, F64]:
    """By the steps of both ends (m, 6, 6), and the errors (m, 6); all whitened."""
    relative = inverse(poses[edges.a]) @ poses[edges.b]
    error = inverse(edges.a_T_b) @ relative
    vectors = _vectors(error)
    turn = _inverse_right_jacobian(vectors[:, 3:])
    b_R_a = np.swapaxes(edges.a_T_b[:, :3, :3], 1, 2)
    by_a = np.zeros((len(edges), 6, 6))
    by_a[:, :3, :3] = -b_R_a
    by_a[:, :3, 3:] = b_R_a @ crossed(relative[:, :3, 3])
    by_a[:, 3:, 3:] = -turn @ np.swapaxes(relative[:, :3, :3], 1, 2)
    by_b = np.zeros((len(edges), 6, 6))
    by_b[:, :3, :3] = error[:, :3, :3]
    by_b[:, 3:, 3:] = turn
    whitened = np.einsum("mij,mj->mi", edges.root, vectors)
    return edges.root @ by_a, edges.root @ by_b, whitened


def _prior_errors(priors: PosePriors, poses: F64) -> F64:
    vectors = _vectors(inverse(priors.poses) @ poses[priors.vertices])
    return np.asarray(np.einsum("mij,mj->mi", priors.root, vectors))


def _prior_derivatives(priors: PosePriors, poses: F64) -> tuple[F64, F64]:
    error = inverse(priors.poses) @ poses[priors.vertices]
    vectors = _vectors(error)
    by_pose = np.zeros((len(vectors), 6, 6))
    by_pose[:, :3, :3] = error[:, :3, :3]
    by_pose[:, 3:, 3:] = _inverse_right_jacobian(vectors[:, 3:])
    return priors.root @ by_pose, np.einsum("mij,mj->mi", priors.root, vectors)


def _up_errors(up: Directions, poses: F64) -> F64:
    """Errors (g, 2) of where up lies in the frame, whitened."""
    rows = poses[up.vertices, :2, :3]
    return np.asarray(np.einsum("gij,gj->gi", rows, up.up) / up.sigma)


def _up_derivatives(up: Directions, poses: F64) -> tuple[F64, F64]:
    rows = poses[up.vertices, :2, :3]
    by_pose = np.zeros((len(rows), 2, 6))
    by_pose[:, :, 3:] = -(rows @ crossed(up.up)) / up.sigma
    return by_pose, _up_errors(up, poses)


def fix_errors(fixes: Positions, poses: F64) -> F64:
    """How far fixes are off (f, 3), whitened."""
    placed = poses[fixes.vertices]
    here = np.einsum("nij,nj->ni", placed[:, :3, :3], fixes.antenna) + placed[:, :3, 3]
    return np.asarray((here - fixes.position) / fixes.sigma)


def _fix_derivatives(fixes: Positions, poses: F64) -> tuple[F64, F64]:
    turn = poses[fixes.vertices, :3, :3]
    by_pose = np.concatenate([turn, -turn @ crossed(fixes.antenna)], axis=2)
    return by_pose / fixes.sigma[:, :, None], fix_errors(fixes, poses)


def _inverse_right_jacobian(rotvec: F64) -> F64:
    """Derivatives (n, 3, 3) of log(R exp(step)) for rotation vectors (n, 3) of R."""
    angle = np.linalg.norm(rotvec, axis=1)
    safe = np.where(angle > SMALL_TURN, angle, 1.0)
    quotient = 1.0 / safe**2 - (1.0 + np.cos(safe)) / (2.0 * safe * np.sin(safe))
    factor = np.where(angle > SMALL_TURN, quotient, 1.0 / 12.0)
    cross = crossed(rotvec)
    return np.asarray(np.eye(3) + 0.5 * cross + factor[:, None, None] * (cross @ cross))
