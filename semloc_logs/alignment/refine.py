"""Refinement of candidates on the query's points: a coarse fit, then one to centimetres."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from semloc_logs.alignment.hypotheses import pose_matrix
from semloc_logs.alignment.icp import Fit, Step, Weighting, align
from semloc_logs.alignment.level_ground import ground_bias
from semloc_logs.alignment.query_map import Query
from semloc_logs.alignment.scores import structure_scores
from semloc_logs.alignment.search import Candidate, search
from semloc_logs.alignment.surface import Surface
from semloc_logs.alignment.target_map import (
    COARSE_RADII,
    FINE_RADII,
    PLANE_NOISE,
    UNCERTAIN_RADII,
    Target,
    is_uncertain,
)
from semloc_logs.arrays import F64

FINE_POINTS = 6000  # of a query in a fine fit; the acceptance's stiffness counts them
COARSE_POINTS = 1000
COARSE_ITERATIONS = 4
# every so manyth point, in the first two steps of a fine fit; the last takes all of them
FINE_STRIDES = (3, 2)
FINE_ITERATIONS = (6, 10)
UNCERTAIN_ITERATIONS = (10, 20)
RIVAL_STRIDE = 3  # of the points that a rival is measured by, which stand for all
GROUND_REACH = 1.5  # voxels: snow lifts the ground by as much
HOLD = 10.0  # points on planes that a start weighs as much as, where points are uncertain
ESCAPE_REACH = 0.6  # of half the heading step: how far a second start may be turned


def _fit(
    start: F64, surface: Surface, query: Query, steps: tuple[Step, ...], hold: float = 0.0
) -> Fit:
    weighting = Weighting(PLANE_NOISE * query.voxel_size, hold)
    return align(query.points, surface, start, steps, query.spread, weighting)


def coarse_fit(candidate: Candidate, target: Target, query: Query) -> Fit:
    """Align a candidate with the target's voxels on some of the points.

    Correspondences are within three voxels, then one and a half.
    """
    stride = max(1, len(query.points) // COARSE_POINTS)
    steps = tuple(Step(r * query.voxel_size, COARSE_ITERATIONS, stride) for r in COARSE_RADII)
    return _fit(candidate.target_T_query, target.surface, query, steps)


def escaped(fit: Fit, candidate: Candidate, target: Target, query: Query, headings: int) -> Fit:
    """The coarse ``fit``, or one from a start within four voxels of it that scores higher.

    Planes that few points meet hold a fit where it began; voxels of all structure tell more.
    """
    T = fit.target_T_query
    turn = np.pi / headings
    pose = np.array([np.arctan2(T[1, 0], T[0, 0]), *T[:3, 3]])
    yaws = turn * np.linspace(-ESCAPE_REACH, ESCAPE_REACH, 5)
    _, better = search(target.mask_grid, query.evidence, pose, yaws, 2)
    if np.abs(better[1:] - pose[1:]).max() < query.voxel_size:
        return fit

    other = coarse_fit(replace(candidate, target_T_query=pose_matrix(better)), target, query)
    score, other_score = (
        structure_scores(query, target, f.target_T_query).score for f in (fit, other)
    )
    return fit if score >= other_score else other


def fine_fit(start: F64, surface: Surface, query: Query) -> Fit:
    """Align to centimetres with a bounded number of the points; ``surface`` is a point surface.

    Of uncertain points, on either side, those farther off belong to a surface too; where few of
    them tell anything, the start holds.
    """
    v = query.voxel_size
    stride = max(1, len(query.points) // FINE_POINTS)
    uncertain = is_uncertain(max(surface.sigma, query.sigma), v)
    middle, last = (r * v for r in (UNCERTAIN_RADII if uncertain else FINE_RADII))
    first_count, second_count = UNCERTAIN_ITERATIONS if uncertain else FINE_ITERATIONS
    steps = (
        Step(middle, first_count, FINE_STRIDES[0] * stride),
        Step(last, second_count, FINE_STRIDES[1] * stride),
        Step(last, 1, stride),
    )
    fit = _fit(start, surface, query, steps, HOLD if uncertain else 0.0)
    if uncertain:
        return fit
    bias = ground_bias(
        query.points[::stride], surface, fit.target_T_query, fit.centre, GROUND_REACH * v, last
    )
    return replace(fit, ground_bias=bias)


def measured(start: F64, surface: Surface, query: Query) -> Fit:
    """The fit of an alignment as it is, by the measure of a fine one."""
    v = query.voxel_size
    stride = RIVAL_STRIDE * max(1, len(query.points) // FINE_POINTS)
    radii = UNCERTAIN_RADII if is_uncertain(max(surface.sigma, query.sigma), v) else FINE_RADII
    fit = _fit(start, surface, query, (Step(radii[1] * v, 0, stride),))
    return replace(
        fit,
        information=RIVAL_STRIDE * fit.information,
        range_bias=RIVAL_STRIDE * fit.range_bias,
    )
