"""The search around hypotheses: how well query voxels lie on a target's mask grid (paper 3.5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from semloc_logs.alignment.hypotheses import (
    SAME_PLACE_VOXELS,
    Hypothesis,
    non_maximum_suppression,
    pose_matrix,
)
from semloc_logs.alignment.mask_grid import FREE_BIT, REACH, Arrays, MaskGrid
from semloc_logs.alignment.query_map import SEARCH_VOXELS, STRUCTURE_SHARE, Evidence, Query
from semloc_logs.alignment.scores import mutual_scores
from semloc_logs.alignment.target_map import Target
from semloc_logs.arrays import F64, I64, U8

Voxels = tuple[F64, U8, int]  # of Evidence, in the order of its fields
Cells = tuple[I64, U8]  # flat cells of the grid that voxels lie in, and the voxels' bits
CHUNK = 128  # voxels counted between two checks whether the shift can be the best
# a cell or radian: among equals the pose nearest the start wins, so that ties do not drift
TIE = 1e-6
NONE = -2.0  # less than any score


@dataclass(frozen=True, slots=True)
class SearchStep:
    """A search of ``reach`` times half the heading step to both sides, in steps of ``step`` cells.

    ``voxels`` of the query are looked up; poses within ``distance`` voxels are one.
    """

    reach: float
    step: int
    voxels: int
    distance: float

    def yaws(self, headings: int) -> F64:
        """Turns (5,) about the start, radians."""
        return np.pi / headings * np.linspace(-self.reach, self.reach, 5)


BEGUN = 2.0  # voxels between hypotheses that are one before and after the first search
FIRST = SearchStep(0.8, 2, 200, BEGUN)
KEPT = 16  # hypotheses after a search
SECOND = SearchStep(0.3, 1, SEARCH_VOXELS, SAME_PLACE_VOXELS)
BY_SEARCH = 2  # candidates by their score in the search; the others by what both sides observed
MIN_SEARCH_SCORE = 0.2  # of the best candidate, unless one is consistent with what both sides saw


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A hypothesis after the search: ``score`` in [0, 1] and the pose that has it."""

    group: int
    target_T_query: F64
    score: float
    votes: int


@dataclass(frozen=True, slots=True, eq=False)
class _Searched:
    """A hypothesis with the best pose (4,) near it so far, (yaw, x, y, z), and its score."""

    hypothesis: Hypothesis
    pose: F64
    score: float


def search_hypotheses(
    hypotheses: Sequence[Hypothesis],
    targets: dict[int, Target],
    query: Query,
    headings: int,
    most: int,
) -> list[Candidate]:
    """The ``most`` best candidates after two searches around each hypothesis.

    The first is in steps of two voxels with few of the query's voxels; the second, for the best, in
    steps of one with more. None if no fit can make a good alignment of any of them.
    """
    searched = [_Searched(h, np.array(h.pose), 0.0) for h in hypotheses]
    searched = _suppressed(searched, BEGUN * query.voxel_size, len(searched))
    for step in (FIRST, SECOND):
        evidence = query.evidence.first(step.voxels)
        yaws = step.yaws(headings)
        better = []
        for s in searched:
            grid = targets[s.hypothesis.group].mask_grid
            score, pose = search(grid, evidence, s.pose, yaws, step.step)
            better.append(_Searched(s.hypothesis, pose, score))
        better.sort(key=lambda s: (-s.score, s.hypothesis.group, tuple(s.pose)))
        searched = _suppressed(better, step.distance * query.voxel_size, KEPT)
    candidates = [
        Candidate(s.hypothesis.group, pose_matrix(s.pose), s.score, s.hypothesis.votes)
        for s in searched
    ]
    return _chosen(candidates, targets, query, most)


def _chosen(
    candidates: list[Candidate], targets: dict[int, Target], query: Query, most: int
) -> list[Candidate]:
    """The first of ``candidates``, best first, and then those whose structure fits best where both
    sides saw.

    The search counts whatever lies outside the target's view against a pose. So it prefers poses
    from which both sensors saw the same part of the road to a right one 30 m away.
    """
    scores = [mutual_scores(query, targets[c.group], c.target_T_query) for c in candidates]
    best_score = max((c.score for c in candidates), default=0.0)
    if best_score < MIN_SEARCH_SCORE and not any(s.is_consistent for s in scores):
        return []
    order = sorted(range(len(candidates)), key=lambda k: -scores[k].score)
    first = list(range(min(BY_SEARCH, most, len(candidates))))
    chosen = [*first, *(k for k in order if k not in first)][:most]
    return [candidates[k] for k in chosen]


def _suppressed(searched: Sequence[_Searched], distance: float, most: int) -> list[_Searched]:
    """The first ``most`` that are not beside an earlier one, with which they have become one."""
    groups = np.array([s.hypothesis.group for s in searched], np.int64)
    poses = np.array([s.pose for s in searched]).reshape(-1, 4)
    return [searched[i] for i in non_maximum_suppression(groups, poses, distance, most).tolist()]


def search(
    grid: MaskGrid, evidence: Evidence, start: F64, yaws: Sequence[float] | F64, step: int
) -> tuple[float, F64]:
    """Best weighted share of aligned query voxels, less those in free space, near ``start``.

    Returned with the pose that has it. Tried are turns by ``yaws`` (rad), shifts of two ``step``
    cells (1 or 2) to both sides along x and y and of one up and down. Poses are (yaw, x, y, z) of
    ``target_T_query``.
    """
    shares = np.array([STRUCTURE_SHARE, 1 - STRUCTURE_SHARE])
    value, pose = _search(
        grid.arrays,
        evidence.arrays,
        shares,
        np.asarray(start, float),
        np.asarray(yaws, float),
        step,
    )
    return float(value), pose


@njit(cache=True, nogil=True)
def _search(
    grid: Arrays, voxels: Voxels, shares: F64, start: F64, yaws: F64, step: int
) -> tuple[float, F64]:
    level, _, cell = grid
    centres, bits, structure = voxels
    mask = level.ravel()
    n = len(centres)
    ny = level.shape[1]
    nz = level.shape[2]
    weight = shares / np.array([max(structure, 1), max(n - structure, 1)])
    base = np.empty(n, np.int64)
    kept = np.empty(n, np.uint8)
    cells = (base, kept)
    hits = np.empty(3, np.int64)
    best = NONE
    best_pose = start.copy()
    pose = start.copy()
    for dyaw in yaws:
        pose[0] = start[0] + dyaw
        solid = _rotated(grid, centres[:structure], bits[:structure], pose, base, kept)
        ground = _rotated(
            grid, centres[structure:], bits[structure:], pose, base[solid:], kept[solid:]
        )
        end = solid + ground
        for dx in range(-2 * step, 2 * step + 1, step):
            for dy in range(-2 * step, 2 * step + 1, step):
                shift = (dx * ny + dy) * nz
                bound = (weight[0], ground * weight[1], best)
                if not _may_be_best(mask, cells, solid, (shift, step), bound, hits):
                    continue
                upright = hits * weight[0]
                hits[:] = 0
                _add_hits(mask, cells, (solid, end), (shift, step), hits)
                for dz in range(-1, 2):
                    value = (
                        upright[dz + 1]
                        + hits[dz + 1] * weight[1]
                        - TIE * (abs(dx) + abs(dy) + abs(dz) + abs(dyaw))
                    )
                    if value > best:
                        best = value
                        best_pose[0] = pose[0]
                        best_pose[1] = start[1] + dx * cell
                        best_pose[2] = start[2] + dy * cell
                        best_pose[3] = start[3] + dz * step * cell
    return best, best_pose


@njit(cache=True, nogil=True)
def _rotated(grid: Arrays, centres: F64, bits: U8, pose: F64, base: I64, kept: U8) -> int:
    """The number of voxels that stay in the grid under ``pose``, whatever the shift.

    Their flat cells go into ``base``, their bits into ``kept``.
    """
    level, corner, cell = grid
    nx, ny, nz = level.shape
    c = np.cos(pose[0])
    s = np.sin(pose[0])
    count = 0
    for n in range(len(centres)):
        x = int(np.floor((c * centres[n, 0] - s * centres[n, 1] + pose[1] - corner[0]) / cell))
        y = int(np.floor((s * centres[n, 0] + c * centres[n, 1] + pose[2] - corner[1]) / cell))
        z = int(np.floor((centres[n, 2] + pose[3] - corner[2]) / cell))
        if REACH <= x < nx - REACH and REACH <= y < ny - REACH and REACH <= z < nz - REACH:
            base[count] = (x * ny + y) * nz + z
            kept[count] = bits[n]
            count += 1
    return count


@njit(cache=True, nogil=True)
def _may_be_best(
    mask: U8,
    cells: Cells,
    solid: int,
    shift: tuple[int, int],
    bound: tuple[float, float, float],
    hits: I64,
) -> bool:
    """Count the ``hits`` (3,) of the structure; False once the shift cannot be the best any more.

    The first ``solid`` cells are of the structure. ``bound``: weight of a structure voxel, the most
    that the ground can add, the best score so far.
    """
    weight, ground, best = bound
    hits[:] = 0
    done = 0
    while done < solid:
        end = min(done + CHUNK, solid)
        _add_hits(mask, cells, (done, end), shift, hits)
        done = end
        if (hits.max() + solid - done) * weight + ground <= best:
            return False
    return True


@njit(cache=True, nogil=True)
def _add_hits(
    mask: U8, cells: Cells, rows: tuple[int, int], shift: tuple[int, int], hits: I64
) -> None:
    """Aligned voxels less those in free space, added to ``hits`` (3,).

    They are the ones from ``rows[0]`` to before ``rows[1]``, moved by ``shift[0]`` cells and
    ``shift[1]`` down, not at all, and up. Slices of the cells would take a tenth longer.
    """
    base, bits = cells
    down = same = up = 0
    a = shift[0] - shift[1]
    b = shift[0]
    c = shift[0] + shift[1]
    # unsigned: numba would make sure of every index that it is not counted from the end
    for n in range(np.uint64(rows[0]), np.uint64(rows[1])):
        flat = base[n]
        bit = bits[n]
        below = mask[np.uint64(flat + a)]
        level = mask[np.uint64(flat + b)]
        above = mask[np.uint64(flat + c)]
        down += int((below & bit) != 0) - int(below >= FREE_BIT)
        same += int((level & bit) != 0) - int(level >= FREE_BIT)
        up += int((above & bit) != 0) - int(above >= FREE_BIT)
    hits[0] += down
    hits[1] += same
    hits[2] += up
