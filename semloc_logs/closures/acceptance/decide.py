"""The decision about every alignment, once the alignments of all queries are known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from semloc_logs.closures.acceptance.calibration import (
    EVIDENCE,
    Evidence,
    Model,
    is_loose,
    position_confidence,
    probability_of,
    shipped,
)
from semloc_logs.closures.acceptance.consistency import count_votes, place_odds
from semloc_logs.closures.acceptance.placements import (
    contradicts_odometry,
    features_of,
    place,
)
from semloc_logs.closures.closure import (
    Alignment,
    Closure,
    Decision,
    Features,
    Reason,
    Rejected,
    Veto,
)
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.settings import Resolved

REASON_OF_VETO = {
    Veto.CONTRADICTS_ODOMETRY: Reason.CONTRADICTS_ODOMETRY,
    Veto.AMBIGUOUS_PLACE: Reason.AMBIGUOUS_PLACE,
    Veto.LOOSE_FIT: Reason.LOOSE_FIT,
}
REASON_OF_EVIDENCE = {
    "log_contradiction": Reason.FREE_SPACE,
    "stiffness": Reason.LOOSE_FIT,
    "range_sigma": Reason.UNCERTAIN_RANGES,
}


def decide(
    alignments: Sequence[Alignment],
    maps: Mapping[str, SessionMap],
    settings: Resolved,
    model: Model | None = None,
) -> list[Closure | Rejected]:
    """What becomes of the alignments of all queries, best first for each query.

    For each target session at most one alignment of a query is accepted. Without a ``model``
    the one of the package decides.
    """
    model = model or shipped()
    decisions = _decisions(alignments, maps, settings, model)
    order = sorted(
        range(len(alignments)), key=lambda k: _order(alignments[k], decisions[k].probability)
    )

    answered: set[tuple[str, int, str]] = set()
    outcomes: list[Closure | Rejected] = []
    for k in order:
        a = alignments[k]
        decision = decisions[k]
        query = (a.query_session, a.query_keyframe, a.target_session)
        reason = why_rejected(decision, a.features, model)
        if reason is None and query in answered:
            reason = Reason.SECOND_CHOICE
        answered.add(query)
        outcomes.append(Closure(a, decision) if reason is None else Rejected(a, decision, reason))
    return outcomes


def _decisions(
    alignments: Sequence[Alignment],
    maps: Mapping[str, SessionMap],
    settings: Resolved,
    model: Model,
) -> list[Decision]:
    """The decision about each alignment (n,)."""
    placed = place(alignments, maps, model)
    voxel_size = settings.fusion.voxel_size
    votes = count_votes(placed, voxel_size)
    with_votes = model.log_odds(placed.log_odds, votes)
    of_place = place_odds(placed, with_votes, voxel_size).place_probability
    # neighbours tell which place is right, and share its errors: not which pose in it
    of_mode = place_odds(placed, placed.log_odds, voxel_size).mode_share
    of_position = position_confidence(placed.sigma, voxel_size)
    vetoes = {
        Veto.CONTRADICTS_ODOMETRY: contradicts_odometry(placed, voxel_size),
        Veto.AMBIGUOUS_PLACE: model.is_ambiguous(votes),
        Veto.LOOSE_FIT: is_loose(features_of(alignments)),
    }
    return [
        Decision(
            vetoes=frozenset(veto for veto, which in vetoes.items() if which[k]),
            place_probability=float(of_place[k]),
            mode_share=float(of_mode[k]),
            position_confidence=float(of_position[k]),
            agreement=votes.row(k),
            min_probability=settings.closures.min_probability,
        )
        for k in range(len(placed))
    ]


def why_rejected(decision: Decision, features: Features[float], model: Model) -> Reason | None:
    """The veto or the factor that rejects an alignment, None where it is accepted."""
    required = decision.min_probability
    if Veto.CONTRADICTS_ODOMETRY in decision.vetoes:
        return Reason.CONTRADICTS_ODOMETRY
    if decision.probability >= required:
        return next((REASON_OF_VETO[veto] for veto in Veto if veto in decision.vetoes), None)
    if decision.place_probability >= required:
        uncertain = decision.position_confidence <= decision.mode_share
        return Reason.UNCERTAIN_POSITION if uncertain else Reason.POSE_MODES

    own = decision.agreement.own_probability
    if own >= required:
        return Reason.NEIGHBOURS_CONFLICT
    ignoring_rivals = probability_of(model.own_log_odds(features))
    return Reason.RIVAL_PLACE if ignoring_rivals >= required else weakest(features, model)


def weakest(features: Features[float], model: Model) -> Reason:
    """The evidence that takes most from the log-odds, compared with typical right alignments."""
    own = model.own
    terms = np.array(own.weights) * (Evidence.of(features).vector() - np.array(own.typical))
    return REASON_OF_EVIDENCE[EVIDENCE[int(np.argmin(terms))]]


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
