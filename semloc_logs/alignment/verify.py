"""Verification and alignment of hypotheses (paper 3.5, and beyond): coarse to fine over the voxel pyramid, then on the points.

The paper's ratio tau is reported; acceptance looks at stricter evidence, because ground lies on ground everywhere: *structure* is
what is neither ground nor able to drive away.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from semloc_logs.alignment.hypotheses import Hypothesis
from semloc_logs.alignment.icp import Fit, Surface, align
from semloc_logs.alignment.pyramid import (
    ANY_BIT,
    FREE_BIT,
    Evidence,
    Level,
    build_pyramid,
    class_bits,
    look_up,
    pose_matrix,
    search,
    yaw_between,
)
from semloc_logs.geometry import apply
from semloc_logs.labels.shape import shape
from semloc_logs.labels.space import GROUND, cityscapes
from semloc_logs.voxels.grid import BlockMap
from semloc_logs.voxels.selection import thin

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
MOST_VOXELS = 3000  # of a query that are looked up in a search
MOST_POINTS = 6000  # of a query that are fitted


def structure_mask(label: U8) -> NDArray[np.bool_]:
    """Which voxels are structure: neither ground nor of a class that moves."""
    dynamic = np.zeros(256, bool)
    dynamic[: len(cityscapes().dynamic)] = cityscapes().dynamic
    dynamic[list(GROUND)] = True
    return ~dynamic[label]


def surface_of(points: NDArray[np.floating]) -> Surface:
    """Tangent planes of ``points`` (n, 3), for ICP."""
    s = shape(points, 14)
    planar = np.where((s.scattered < 0.3) & (s.linear < 0.9), 1.0, 0.0)
    p = np.asarray(points, float)
    return Surface(p, s.normal.astype(float), planar, cKDTree(p))


@dataclass(eq=False)
class Target:
    """A database submap as verification needs it; the parts are built when they are first asked for."""

    blocks: BlockMap
    voxel_size: float

    @cached_property
    def pyramid(self) -> list[Level]:
        """Bit masks at 1, 2 and 4 voxels."""
        return build_pyramid(self.blocks, self.voxel_size, cityscapes().coarse)


@dataclass(eq=False)
class Query:
    """A query map in its own level frame: fused ``blocks`` and the ``points`` (n, 3) of its keyframes."""

    blocks: BlockMap
    points: F64
    voxel_size: float

    @cached_property
    def reach(self) -> int:
        """Voxels from the origin to the farthest occupied voxel, over the ground."""
        ijk, _ = self.blocks.occupied()
        return int(np.ceil(np.linalg.norm(ijk[:, :2] + 0.5, axis=1).max(initial=0.0)))

    @cached_property
    def evidence(self) -> Evidence:
        """Voxels to look up while searching: structure, and ground with a third of its weight to hold the height."""
        ijk, label = self.blocks.occupied()
        structure = structure_mask(label)
        rng = np.random.default_rng(0)
        picked, weights = [], []
        for mask, share in ((structure, 0.75), (~structure, 0.25)):
            index = np.flatnonzero(mask)
            if len(index) > int(share * MOST_VOXELS):
                index = np.sort(rng.choice(index, int(share * MOST_VOXELS), replace=False))
            picked.append(index)
            weights.append(np.full(len(index), share / max(len(index), 1)))
        index = np.concatenate(picked)
        bits = class_bits(label, cityscapes().coarse)[index]
        bits = np.where(bits & (ANY_BIT - 1), bits & (ANY_BIT - 1), bits)  # of a known class: that class, else anything occupied
        return Evidence((ijk[index].astype(float) + 0.5) * self.voxel_size, bits, np.concatenate(weights).astype(float))

    @cached_property
    def structure(self) -> tuple[F64, U8]:
        """Centres (n, 3) in metres and class bits (n,) of all structure voxels."""
        ijk, label = self.blocks.occupied()
        keep = structure_mask(label)
        bits = class_bits(label[keep], cityscapes().coarse)
        centres: F64 = (ijk[keep].astype(float) + 0.5) * self.voxel_size
        return centres, np.where(bits & (ANY_BIT - 1), bits & (ANY_BIT - 1), bits).astype(np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A hypothesis after the search: ``score`` in [0, 1] and the pose that has it."""

    group: int
    target_T_query: F64
    score: float
    votes: int


def search_hypotheses(
    hypotheses: Sequence[Hypothesis], targets: dict[int, Target], query: Query, headings: int, most: int
) -> list[Candidate]:
    """The ``most`` best candidates, best first, after a search at 4, 2 and 1 voxels around each hypothesis."""
    v = query.voxel_size
    turn = np.pi / headings
    state = [(h, np.array(h.pose), 0.0) for h in hypotheses]
    plan = (
        (2, (-0.67 * turn, 0.0, 0.67 * turn), (-4 * v, 0.0, 4 * v), (-4 * v, 0.0, 4 * v), 3 * most),
        (
            1,
            tuple(turn * np.linspace(-0.4, 0.4, 5)),
            tuple(v * np.array([-4.0, -2.0, 0.0, 2.0, 4.0])),
            (-2 * v, 0.0, 2 * v),
            2 * most,
        ),
        (0, tuple(turn * np.linspace(-0.12, 0.12, 5)), tuple(v * np.array([-2.0, -1.0, 0.0, 1.0, 2.0])), (-v, 0.0, v), most),
    )
    full = query.evidence
    some = Evidence(full.centres[::3].copy(), full.bits[::3].copy(), 3 * full.weights[::3])  # enough for what is a metre off anyway
    for level, yaws, steps, lifts, keep in plan:
        moved = []
        for h, pose, _ in state:
            score, better = search(targets[h.group].pyramid[level], some if level else full, pose, yaws, steps, lifts)
            moved.append((h, better, score))
        moved.sort(key=lambda m: (-m[2], m[0].group, tuple(m[1])))
        state = []
        for m in moved:  # hypotheses that have met are one
            if not any(
                o[0].group == m[0].group and np.abs(o[1][1:] - m[1][1:]).max() < 2 * v and abs(np.sin(o[1][0] - m[1][0])) < 0.05
                for o in state
            ):
                state.append(m)
            if len(state) == keep:
                break
    return [Candidate(h.group, pose_matrix(pose), score, h.votes) for h, pose, score in state]


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """What acceptance looks at; see ``schemas/parquet/rejected.json``."""

    structure: float
    coverage: float
    contradiction: float
    fit: float
    rmse: float
    distinct: float
    support: float
    stiffness: float


FEATURES = ("structure", "coverage", "contradiction", "fit", "rmse", "distinct", "support", "stiffness")


def structure_scores(query: Query, target: Target, target_T_query: F64) -> tuple[float, float, float, int]:
    """Shares of the query's structure that lies on structure of its class within a voxel (of what falls into observed space), that falls
    into observed space, and that falls into free space; and the number of aligned structure voxels."""
    centres, bits = query.structure
    if not len(centres):
        return 0.0, 0.0, 0.0, 0
    mask = look_up(target.pyramid[0], apply(target_T_query, centres))
    seen, aligned, free = mask != 0, (mask & bits) != 0, (mask & FREE_BIT) != 0
    return float(aligned.sum() / max(seen.sum(), 1)), float(seen.mean()), float(free.mean()), int(aligned.sum())


def coarse_fit(candidate: Candidate, surface: Surface, query: Query) -> Fit:
    """Align a candidate on the points, from two voxels down to one."""
    v = query.voxel_size
    points = query.points[:: max(1, len(query.points) // (MOST_POINTS // 3))]
    return align(points, surface, candidate.target_T_query, (3 * v, 1.5 * v), 8)


def fine_fit(start: F64, surface: Surface, points: F64, voxel_size: float) -> Fit:
    """Align to centimetres with all of (a bounded number of) ``points``."""
    some = points[:: max(1, len(points) // MOST_POINTS)]
    return align(some, surface, start, (1.5 * voxel_size, 0.7 * voxel_size, 0.4 * voxel_size), 10)


def thin_points(points: F64, cell: float) -> F64:
    """One point a cell."""
    return points[thin(points.astype(np.float32), cell)]


def same_place(a: F64, b: F64, voxel_size: float) -> bool:
    """Whether two alignments of a query with one target agree to within 3 voxels and 5 degrees."""
    return bool(np.linalg.norm(a[:3, 3] - b[:3, 3]) < 3.3 * voxel_size and yaw_between(a, b) < np.radians(5))
