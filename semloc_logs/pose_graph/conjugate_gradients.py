"""Normal equations of many sessions of the same roads, solved without filling a matrix.

A direct solution couples all sessions of a road with each other. Conjugate gradients need only
products with the sparse matrix. Two preconditioners are added: each session on its own, which is a
chain, so its Cholesky factor is a narrow band; and the motion that all sessions share, which is
smooth over space: poses move with nodes on the roads. This is an additive Schwarz method with a
coarse space; Toselli, Widlund: Domain Decomposition Methods, 2005, chapter 3.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded
from scipy.sparse import bsr_array
from scipy.spatial import cKDTree

from semloc_logs.arrays import F64, I64
from semloc_logs.pose_graph.normal_equations import NormalEquations, crossed, moved

LOGGER = logging.getLogger(__name__)
BAND = 11  # entries below the diagonal of blocks of 6 next to each other
NODES_OF_POSE = 3
MOST_NODES = 300  # their matrix is dense
REGULAR = 1e-9  # share of the diagonal that is added where nodes depend on each other
COMPONENTS_APART_M = 1e7
MOST_ITERATIONS = 400
DAMPING = 1e-6  # of the first attempt, as a share of the diagonal
DAMPING_FACTOR = 10.0
ATTEMPTS = 8


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """``chain`` (v,) and ``component`` (v,) of each vertex, and metres between nodes."""

    chain: I64
    component: I64
    node_spacing: float


@dataclass(frozen=True, slots=True)
class Limits:
    """Of steps, of the relative decrease that ends them, and of the residual of a step."""

    iterations: int
    tolerance: float
    residual: float


class _Preconditioner:
    """Sessions one by one, and the smooth motion of all."""

    def __init__(self, hessian: bsr_array, poses: F64, layout: Layout) -> None:
        self._factor = cholesky_banded(_bands(hessian, layout.chain), lower=True)
        spread = _spread(poses, layout)
        coarse = (spread.T @ (hessian @ spread)).toarray()
        self._spread = spread.tocsr()
        self._gathered = self._spread.T.tocsr()
        np.fill_diagonal(coarse, coarse.diagonal() * (1.0 + REGULAR) + REGULAR)
        self._coarse = cho_factor(coarse, lower=True, overwrite_a=True)

    def __call__(self, residual: F64) -> F64:
        chains = cho_solve_banded((self._factor, True), residual)
        smooth = self._spread @ cho_solve(self._coarse, self._gathered @ residual)
        return np.asarray(chains + smooth)


def minimised(
    equations: NormalEquations, initial: F64, weight: F64, layout: Layout, limits: Limits
) -> F64:
    """Poses (v, 4, 4) by Levenberg-Marquardt from ``initial``; ``weight`` is of the edges."""
    poses = initial
    damping = DAMPING
    for _ in range(limits.iterations):
        system = equations.linearised(poses, weight)
        diagonal = system.hessian.diagonal()
        for _ in range(ATTEMPTS):
            hessian = _with_diagonal(system.hessian, damping * diagonal)
            precondition = _Preconditioner(hessian, poses, layout)
            step = solved(hessian, -system.gradient, precondition, limits.residual)
            tried = moved(poses, step)
            cost = equations.cost(tried, weight)
            if cost <= system.cost:
                break
            damping *= DAMPING_FACTOR
        else:
            return poses
        poses = tried
        damping = max(damping / DAMPING_FACTOR, DAMPING)
        if system.cost - cost <= limits.tolerance * system.cost:
            break
    return poses


def solved(hessian: bsr_array, right: F64, precondition: _Preconditioner, residual: float) -> F64:
    """The solution of the linear system by preconditioned conjugate gradients."""
    x = np.zeros_like(right)
    rest = right.copy()
    along = precondition(rest)
    energy = float(rest @ along)
    stop = residual**2 * energy
    direction = along
    for count in range(MOST_ITERATIONS):
        product = hessian @ direction
        length = energy / float(direction @ product)
        x += length * direction
        rest -= length * product
        along = precondition(rest)
        before = energy
        energy = float(rest @ along)
        if energy <= stop:
            LOGGER.debug("Conjugate gradients: %d iterations.", count + 1)
            break
        direction = along + (energy / before) * direction
    return x


def _with_diagonal(hessian: bsr_array, added: F64) -> bsr_array:
    """``hessian`` with ``added`` (6 v,) on its diagonal."""
    data = hessian.data.copy()
    rows = np.repeat(np.arange(len(hessian.indptr) - 1), np.diff(hessian.indptr))
    own = np.flatnonzero(hessian.indices == rows)
    axis = np.arange(6)
    data[own[:, None], axis, axis] += added.reshape(-1, 6)
    return bsr_array((data, hessian.indices, hessian.indptr), shape=hessian.shape)


def _bands(hessian: bsr_array, chain: I64) -> F64:
    """The lower band (12, 6 v) of the blocks of each vertex and of its next one in the chain."""
    vertices = len(chain)
    rows = np.repeat(np.arange(vertices), np.diff(hessian.indptr))
    columns = hessian.indices
    same = chain[rows] == chain[columns]
    bands = np.zeros((BAND + 1, 6 * vertices))
    for offset in (0, 1):
        blocks = np.flatnonzero((rows - columns == offset) & same)
        for i in range(6):
            for j in range(6):
                below = 6 * offset + i - j
                if 0 <= below <= BAND:
                    bands[below, 6 * columns[blocks] + j] = hessian.data[blocks, i, j]
    return bands


def _spread(poses: F64, layout: Layout) -> bsr_array:
    """Steps of all poses (6 v, 6 n) by motions of nodes: velocity and turn about the node."""
    places = np.column_stack([poses[:, :3, 3], COMPONENTS_APART_M * layout.component])
    spacing = layout.node_spacing
    nodes = _nodes(places, spacing)
    while len(nodes) > MOST_NODES:
        spacing *= 1.5
        nodes = _nodes(places, spacing)

    nearest = min(NODES_OF_POSE, len(nodes))
    away, node = cKDTree(nodes).query(places, nearest)
    away, node = away.reshape(-1, nearest), node.reshape(-1, nearest)
    share = np.maximum(1.0 - away / (2.0 * spacing), 0.0) ** 2
    share[:, 0] = np.maximum(share[:, 0], 1e-3)
    share /= share.sum(1, keepdims=True)

    base_R_common = np.swapaxes(poses[:, :3, :3], 1, 2)[:, None]
    lever = (places[:, None, :3] - nodes[node, :3]).reshape(-1, 3)
    blocks = np.zeros((len(poses), nearest, 6, 6))
    blocks[..., :3, :3] = base_R_common
    blocks[..., :3, 3:] = -base_R_common @ crossed(lever).reshape(-1, nearest, 3, 3)
    blocks[..., 3:, 3:] = base_R_common
    blocks *= share[..., None, None]
    starts = nearest * np.arange(len(poses) + 1)
    shape = (6 * len(poses), 6 * len(nodes))
    return bsr_array((blocks.reshape(-1, 6, 6), node.ravel(), starts), shape=shape)


def _nodes(places: F64, spacing: float) -> F64:
    """The middle of the places in each cell of a grid."""
    _, cell = np.unique(np.floor(places / spacing), axis=0, return_inverse=True)
    counts = np.bincount(cell.ravel())
    return np.stack([np.bincount(cell.ravel(), c) / counts for c in places.T], axis=1)
