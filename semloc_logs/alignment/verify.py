"""Verification and alignment of hypotheses (paper 3.5, and beyond): a search over voxels, then on
the points.

The paper's ratio tau is reported; acceptance looks at stricter evidence, because ground lies on
ground everywhere: *structure* is what is neither ground nor able to drive away.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semloc_logs.alignment.hypotheses import Hypothesis, first_apart
from semloc_logs.alignment.icp import Fit, Step, align
from semloc_logs.alignment.overlap import (
    ANY_BIT,
    FREE_BIT,
    STRUCTURE_SHARE,
    Evidence,
    Level,
    build_level,
    class_bits,
    look_up,
    pose_matrix,
    search,
    yaw_between,
)
from semloc_logs.alignment.surface import Surface, flattened_surface, surface_of
from semloc_logs.labels.space import GROUND, cityscapes
from semloc_logs.mapping.selection import thin
from semloc_logs.numerics.transforms import apply
from semloc_logs.voxels.grid import BlockMap

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
FIRST_VOXELS, SECOND_VOXELS = 200, 1200  # of a query that are looked up in a search
FIRST_KEPT = 16  # hypotheses after the first search
MOST_POINTS = 6000  # of a query that are fitted
SOME_POINTS = 1000  # of them coarsely
RIVAL_STRIDE = 3  # of the points that a rival is measured by, which stand for all
# of correspondences, voxels
COARSE_RADII = (3.0, 1.5)
FINE_RADII = (0.7, 0.4)
UNCERTAIN_RADII = (3.0, 2.0)  # of correspondences of uncertain points, voxels
AHEAD = 20.0  # voxels between a sensor and the mean of its points, above which it looks one way
UNCERTAIN = 0.25  # voxels: the standard deviation above which points are
NOISE = 1 / 6  # voxels: of planes that are certain
HOLD = 10.0  # points on planes that a start weighs as much as


def structure_mask(label: U8) -> NDArray[np.bool_]:
    """Which voxels are structure: neither ground nor of a class that moves."""
    dynamic = np.zeros(256, bool)
    dynamic[: len(cityscapes().dynamic)] = cityscapes().dynamic
    dynamic[list(GROUND)] = True
    return ~dynamic[label]


@dataclass(eq=False)
class Target:
    """A database submap as verification needs it; the parts are built when they are first asked
    for.
    """

    blocks: BlockMap
    voxel_size: float

    @cached_property
    def level(self) -> Level:
        """Bit masks to look voxels up in."""
        return build_level(self.blocks, self.voxel_size, cityscapes().coarse)

    @cached_property
    def surface(self) -> Surface:
        """The centres of the occupied voxels, to align with to a fraction of a voxel."""
        ijk, _ = self.blocks.occupied()
        return surface_of((ijk + 0.5) * self.voxel_size, COARSE_RADII[0] * self.voxel_size)


@dataclass(eq=False)
class Query:
    """A query map in its own level frame: fused ``blocks`` and the ``points`` (n, 3) of its
    keyframes.

    ``spread`` (n, 3) is one standard deviation of each point along its ray, metres; zeros, or None,
    where they are certain.
    """

    blocks: BlockMap
    points: F64
    voxel_size: float
    spread: F64 | None = None

    @cached_property
    def occupied(self) -> tuple[NDArray[np.int32], U8]:
        """Coordinates (n, 3) and classes (n,) of the occupied voxels."""
        return self.blocks.occupied()

    @cached_property
    def reach(self) -> int:
        """Voxels from the origin to the farthest occupied voxel, over the ground."""
        ijk, _ = self.occupied
        return int(np.ceil(np.linalg.norm(ijk[:, :2] + 0.5, axis=1).max(initial=0.0)))

    @cached_property
    def sigma(self) -> float:
        """Median standard deviation of the points along their rays, metres."""
        return (
            0.0
            if self.spread is None or not len(self.spread)
            else float(np.median(np.linalg.norm(self.spread, axis=1)))
        )

    @cached_property
    def middle(self) -> F64:
        """Where it looks (3,): the mean of its points, from its origin."""
        return np.asarray(
            looked_at(np.zeros((1, 3)), self.points.mean(0)[None], self.voxel_size)[0]
        )

    @cached_property
    def evidence(self) -> Evidence:
        """Voxels to look up while searching: structure, and ground with a third of its weight to
        hold the height.
        """
        ijk, label = self.occupied
        structure = structure_mask(label)
        rng = np.random.default_rng(0)
        picked = []
        for mask, share in ((structure, STRUCTURE_SHARE), (~structure, 1 - STRUCTURE_SHARE)):
            # in no order, so that the first of them stand for all
            picked.append(rng.permutation(np.flatnonzero(mask))[: int(share * SECOND_VOXELS)])
        index = np.concatenate(picked)
        bits = class_bits(label, cityscapes().coarse)[index]
        # of a known class: that class, else anything occupied
        bits = np.where(bits & (ANY_BIT - 1), bits & (ANY_BIT - 1), bits)
        return Evidence((ijk[index].astype(float) + 0.5) * self.voxel_size, bits, len(picked[0]))

    @cached_property
    def structure(self) -> tuple[F64, U8]:
        """Centres (n, 3) in metres and class bits (n,) of all structure voxels."""
        ijk, label = self.occupied
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
    hypotheses: Sequence[Hypothesis],
    targets: dict[int, Target],
    query: Query,
    headings: int,
    most: int,
) -> list[Candidate]:
    """The ``most`` best candidates, best first, after two searches around each hypothesis: in steps
    of two voxels with few of the query's voxels, then, for the best, of one with more.
    """
    v = query.voxel_size
    turn = np.pi / headings
    found = _apart([(h, np.array(h.pose), 0.0) for h in hypotheses], 2 * v, len(hypotheses))
    for yaws, step, share, keep in (
        (turn * np.linspace(-0.8, 0.8, 5), 2, FIRST_VOXELS, FIRST_KEPT),
        (turn * np.linspace(-0.3, 0.3, 5), 1, SECOND_VOXELS, most),
    ):
        some = query.evidence.first(share)
        moved = []
        for h, pose, _ in found:
            score, better = search(targets[h.group].level, some, pose, yaws, step)
            moved.append((h, better, score))
        moved.sort(key=lambda m: (-m[2], m[0].group, tuple(m[1])))
        found = _apart(moved, 3.3 * v if step == 1 else 2 * v, keep)
    return [Candidate(h.group, pose_matrix(pose), score, h.votes) for h, pose, score in found]


Found = tuple[Hypothesis, F64, float]


def _apart(found: Sequence[Found], distance: float, most: int) -> list[Found]:
    """The first ``most`` of ``found`` that are not beside an earlier one: hypotheses that have met
    are one.
    """
    groups = np.array([f[0].group for f in found], np.int64)
    poses = np.array([f[1] for f in found]).reshape(-1, 4)
    return [found[i] for i in first_apart(groups, poses, distance, most).tolist()]


def rank(structure: F64 | float, coverage: F64 | float, contradiction: F64 | float) -> F64:
    """Aligned structure, less what contradicts free space: what alignments are ranked by."""
    return np.asarray(structure * np.minimum(1.0, np.divide(coverage, 0.5)) - contradiction)


class Scores(NamedTuple):
    """Shares of a query's structure that lies on structure of its class within a voxel (of what
    falls into observed space), that falls into observed space, and that falls into free space; and
    the number of aligned structure voxels.
    """

    structure: float
    coverage: float
    contradiction: float
    aligned: int

    @property
    def rank(self) -> float:
        """What alignments of one query are ranked by."""
        return float(rank(self.structure, self.coverage, self.contradiction))


def structure_scores(query: Query, target: Target, target_T_query: F64) -> Scores:
    """The scores of an alignment."""
    centres, bits = query.structure
    if not len(centres):
        return Scores(0.0, 0.0, 0.0, 0)
    mask = look_up(target.level, apply(target_T_query, centres))
    seen = mask != 0
    aligned = (mask & bits) != 0
    free = (mask & FREE_BIT) != 0
    return Scores(
        float(aligned.sum() / max(seen.sum(), 1)),
        float(seen.mean()),
        float(free.mean()),
        int(aligned.sum()),
    )


def looked_at(position: F64, mean: F64, voxel_size: float) -> F64:
    """What keyframes at ``position`` (n, 3) whose points have a ``mean`` (n, 3) look at: that, or
    themselves where they look all around.
    """
    ahead = np.linalg.norm(mean - position, axis=1) > AHEAD * voxel_size
    return np.where(ahead[:, None], mean, position)


def is_uncertain(sigma: float, voxel_size: float) -> bool:
    """Whether points of a median standard deviation ``sigma`` along their rays, metres, lie in
    slabs rather than on surfaces.
    """
    return sigma > UNCERTAIN * voxel_size


def _fit(
    start: F64, surface: Surface, query: Query, steps: tuple[Step, ...], hold: float = 0.0
) -> Fit:
    return align(query.points, surface, start, steps, query.spread, NOISE * query.voxel_size, hold)


def coarse_fit(candidate: Candidate, target: Target, query: Query) -> Fit:
    """Align a candidate with the target's voxels on some of the points, from three voxels down to
    one and a half.
    """
    v = query.voxel_size
    stride = max(1, len(query.points) // SOME_POINTS)
    return _fit(
        candidate.target_T_query,
        target.surface,
        query,
        tuple(Step(r * v, 4, stride) for r in COARSE_RADII),
    )


def escaped(fit: Fit, candidate: Candidate, target: Target, query: Query, headings: int) -> Fit:
    """The coarse ``fit`` of a candidate, or that of another start within four voxels of it that
    more of the query's voxels agree with.

    Planes that few points meet hold a fit where it began; voxels of all structure tell more.
    """
    T = fit.target_T_query
    turn = np.pi / headings
    pose = np.array([np.arctan2(T[1, 0], T[0, 0]), *T[:3, 3]])
    _, better = search(target.level, query.evidence, pose, turn * np.linspace(-0.6, 0.6, 5), 2)
    if np.abs(better[1:] - pose[1:]).max() < query.voxel_size:
        return fit
    other = coarse_fit(replace(candidate, target_T_query=pose_matrix(better)), target, query)
    ranks = [structure_scores(query, target, f.target_T_query).rank for f in (fit, other)]
    return fit if ranks[0] >= ranks[1] else other


def fine_fit(start: F64, surface: Surface, query: Query) -> Fit:
    """Align to centimetres with a bounded number of the points; the ``surface`` has a point every
    0.4 voxels.

    Of uncertain points, on either side, those farther off belong to a surface too; where few of
    them say anything, the start holds.
    """
    v = query.voxel_size
    stride = max(1, len(query.points) // MOST_POINTS)
    if is_uncertain(max(surface.sigma, query.sigma), v):
        middle, last = (r * v for r in UNCERTAIN_RADII)
        return _fit(
            start,
            surface,
            query,
            (Step(middle, 10, 3 * stride), Step(last, 20, 2 * stride), Step(last, 1, stride)),
            HOLD,
        )
    middle, last = (r * v for r in FINE_RADII)
    return _fit(
        start,
        surface,
        query,
        (Step(middle, 6, 3 * stride), Step(last, 10, 2 * stride), Step(last, 1, stride)),
    )


def measured(start: F64, surface: Surface, query: Query) -> Fit:
    """The fit of an alignment as it is, by the measure of a fine one."""
    v = query.voxel_size
    stride = RIVAL_STRIDE * max(1, len(query.points) // MOST_POINTS)
    radii = UNCERTAIN_RADII if is_uncertain(max(surface.sigma, query.sigma), v) else FINE_RADII
    fit = _fit(start, surface, query, (Step(radii[1] * v, 0, stride),))
    return replace(fit, information=RIVAL_STRIDE * fit.information, pull=RIVAL_STRIDE * fit.pull)


def thin_points(points: F64, cell: float, spread: F64) -> NDArray[np.int64]:
    """Numbers of one point a cell: that of the least ``spread`` (n, 3), of equal ones the first."""
    if not spread.any():
        return thin(points.astype(np.float32), cell)
    order = np.argsort(np.einsum("ij,ij->i", spread, spread), kind="stable")
    return order[thin(points[order].astype(np.float32), cell)]


def points_surface(points: F64, spread: F64, voxel_size: float) -> Surface:
    """The surface of a target's ``points`` (n, 3) that a fine fit aligns with; ``spread`` (n, 3) as
    that of a query.
    """
    v = voxel_size
    kept = thin_points(points, v / 2.5, spread)
    sigma = np.linalg.norm(spread[kept], axis=1)
    if len(kept) and is_uncertain(float(np.median(sigma)), v):
        p = points[kept]
        return flattened_surface(
            p, spread[kept], thin(p.astype(np.float32), v), UNCERTAIN_RADII[1] * v, NOISE * v
        )
    return surface_of(points[kept], 2 * v)


def same_place(a: F64, b: F64, voxel_size: float) -> bool:
    """Whether two alignments of a query with one target agree to within 3 voxels and 5 degrees."""
    return bool(
        np.linalg.norm(a[:3, 3] - b[:3, 3]) < 3.3 * voxel_size and yaw_between(a, b) < np.radians(5)
    )
