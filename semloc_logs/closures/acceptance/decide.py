"""The decision about every alignment, once the alignments of all queries are known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from semloc_logs.closures.acceptance.calibration import (
    is_plausible,
    position_confidence,
    shipped,
)
from semloc_logs.closures.acceptance.consistency import count_votes, mode_shares
from semloc_logs.closures.acceptance.placements import (
    F64,
    I64,
    Bools,
    Placed,
    contradicts_odometry,
    place,
    query_roads,
)
from semloc_logs.closures.closure import (
    ACCEPTED,
    REASONS,
    Agreement,
    Alignment,
    Alignments,
    Decision,
    Decisions,
    Features,
    Outcomes,
    Reason,
)
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.settings import Resolved

# the weakest evidence of an improbable alignment is named, in this order, if it is beyond its bound
LOW_COVERAGE = 0.2
LOW_STRUCTURE = 0.5
NEAR_RIVAL = 0.85
LOW_FIT = 0.5


def decide(
    alignments: Sequence[Alignment],
    maps: Mapping[str, SessionMap],
    settings: Resolved,
    queries: Mapping[str, Sequence[int]] | None = None,
) -> Outcomes:
    """What becomes of the alignments of all queries, best first for each query.

    For each target session at most one alignment of a query is accepted. ``queries`` are keyframes
    of all queries by session, by default of those that have alignments.
    """
    rows = Alignments.of(alignments)
    placed = place(rows, maps)
    plausible = is_plausible(rows.features)
    refuted = contradicts_odometry(placed, settings.fusion.voxel_size)
    roads = query_roads(placed)
    for name, keyframes in (queries or {}).items():
        roads[name] = maps[name].distance[np.asarray(keyframes, int)]
    agreement = count_votes(placed, settings.fusion.voxel_size, roads)
    decisions = _decisions(placed, agreement, plausible, refuted, settings)
    outcomes = Outcomes(
        rows,
        decisions,
        agreement,
        settings.closures.min_probability,
        _order(rows, decisions.probability),
        np.full(len(rows), ACCEPTED, np.int8),
    )
    reason = outcomes.reason
    probable = decisions.probability >= outcomes.min_probability  # a NaN is not
    reason[probable & ~_is_first(rows, outcomes.order)] = REASONS.index(Reason.SECOND_CHOICE)
    for k in np.flatnonzero(~probable).tolist():
        weakest = weakest_evidence(rows[k].features)
        if plausible[k]:
            weakest = low_probability(weakest, outcomes.decision(k))
        reason[k] = REASONS.index(weakest)
    reason[refuted] = REASONS.index(Reason.CONTRADICTS_ODOMETRY)
    return outcomes


def _is_first(rows: Alignments, order: I64) -> Bools:
    """Which alignments (n,) are the first of their query in their target session."""
    query = rows.pair * (rows.query_keyframe.max(initial=0) + 1) + rows.query_keyframe
    out = np.zeros(len(rows), bool)
    out[order[np.unique(query[order], return_index=True)[1]]] = True
    return out


def _decisions(
    placed: Placed, agreement: Agreement[F64], plausible: Bools, refuted: Bools, settings: Resolved
) -> Decisions:
    """The probability of each alignment (n,): 0 if it is not ``plausible`` or is ``refuted``."""
    voxel_size = settings.fusion.voxel_size
    of_place = np.where(plausible, shipped().decided(agreement), 0.0)
    of_position = position_confidence(placed.sigma, voxel_size)
    of_mode = mode_shares(placed, voxel_size)
    probability = np.where(refuted | ~plausible, 0.0, of_place * of_position * of_mode)
    return Decisions(probability, of_place, of_position, of_mode)


def low_probability(weakest: Reason, decision: Decision) -> Reason:
    """Which factor makes the probability of a plausible alignment too low, else the ``weakest``."""
    required = decision.min_probability
    if decision.place_probability >= required:
        if decision.mode_share < decision.position_confidence:
            return Reason.POSE_MODES
        return Reason.UNCERTAIN_POSITION

    agreement = decision.agreement
    halved = agreement.ambiguity > shipped().max_ambiguity
    if halved and 2 * decision.place_probability >= required:  # ambiguity alone rejects it
        return Reason.AMBIGUOUS_PLACE
    if agreement.own_probability >= required and agreement.neighbours:
        return Reason.NEIGHBOURS_CONFLICT
    return weakest


def weakest_evidence(features: Features[float]) -> Reason:
    """The first feature that is worse than in right alignments."""
    if features.coverage < LOW_COVERAGE:
        return Reason.UNOBSERVED
    if features.structure < LOW_STRUCTURE:
        return Reason.STRUCTURE_MISMATCH
    if features.distinct > 1.0:
        return Reason.BETTER_RIVAL
    if features.distinct > NEAR_RIVAL:
        return Reason.RIVAL_PLACE
    if features.fit < LOW_FIT:
        return Reason.LOOSE_FIT
    return Reason.WEAK_EVIDENCE


def _order(rows: Alignments, probability: F64) -> I64:
    """Numbers (n,) by query, then the most probable first."""
    names = sorted({name for pair in rows.pairs for name in pair})
    rank = {name: number for number, name in enumerate(names)}
    ranks = np.array([[rank[name] for name in pair] for pair in rows.pairs], np.int64)
    query_session, target_session = ranks.reshape(-1, 2)[rows.pair].T
    return np.lexsort(
        (
            rows.target_stamp_ns,
            target_session,
            -rows.features.structure,
            -probability,
            rows.query_stamp_ns,
            query_session,
        )
    )
