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
    Bools,
    Placed,
    contradicts_odometry,
    features_of,
    place,
    query_roads,
)
from semloc_logs.closures.closure import (
    Alignment,
    Closure,
    Decision,
    Features,
    Reason,
    Rejected,
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
) -> list[Closure | Rejected]:
    """What becomes of the alignments of all queries, best first for each query.

    For each target session at most one alignment of a query is accepted. ``queries`` are keyframes
    of all queries by session, by default of those that have alignments.
    """
    placed = place(alignments, maps)
    plausible = is_plausible(features_of(alignments))
    refuted = contradicts_odometry(placed, settings.fusion.voxel_size)
    roads = query_roads(placed)
    for name, keyframes in (queries or {}).items():
        roads[name] = maps[name].distance[np.asarray(keyframes, int)]
    decisions = _decisions(placed, roads, plausible, refuted, settings)
    order = sorted(
        range(len(alignments)), key=lambda k: _order(alignments[k], decisions[k].probability)
    )

    answered: set[tuple[str, int, str]] = set()
    outcomes: list[Closure | Rejected] = []
    for k in order:
        a = alignments[k]
        decision = decisions[k]
        query = (a.query_session, a.query_keyframe, a.target_session)
        reason = None
        if refuted[k]:
            reason = Reason.CONTRADICTS_ODOMETRY
        elif not decision.probability >= decision.min_probability:  # nor a NaN
            weakest = weakest_evidence(a.features)
            reason = weakest if not plausible[k] else low_probability(weakest, decision)
        elif query in answered:
            reason = Reason.SECOND_CHOICE
        answered.add(query)
        outcomes.append(Closure(a, decision) if reason is None else Rejected(a, decision, reason))
    return outcomes


def _decisions(
    placed: Placed,
    roads: Mapping[str, F64],
    plausible: Bools,
    refuted: Bools,
    settings: Resolved,
) -> list[Decision]:
    """The probability of each alignment (n,): 0 if it is not ``plausible`` or is ``refuted``."""
    voxel_size = settings.fusion.voxel_size
    votes = count_votes(placed, voxel_size, roads)
    of_place = np.where(plausible, shipped().decided(votes), 0.0)
    of_position = position_confidence(placed.sigma, voxel_size)
    of_mode = mode_shares(placed, voxel_size)
    probability = np.where(refuted | ~plausible, 0.0, of_place * of_position * of_mode)
    return [
        Decision(
            probability=float(probability[k]),
            agreement=votes.row(k),
            place_probability=float(of_place[k]),
            position_confidence=float(of_position[k]),
            mode_share=float(of_mode[k]),
            min_probability=settings.closures.min_probability,
        )
        for k in range(len(placed))
    ]


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


def _order(a: Alignment, probability: float) -> tuple[str, int, float, float, str, int]:
    """By query, then the most probable first."""
    return (
        a.query_session,
        a.query_stamp_ns,
        -probability,
        -a.features.structure,
        a.target_session,
        a.target_stamp_ns,
    )
