"""The decision about every alignment, once the alignments of all queries are known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from semloc_logs.arrays import F64, I64, Bools
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
from semloc_logs.closures.acceptance.joint_poses import JointPoses, Uncertainty, joint_poses
from semloc_logs.closures.acceptance.placements import (
    Placed,
    contradicts_odometry,
    pairs_of,
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
    queries: Mapping[str, Sequence[int]] | None = None,
    model: Model | None = None,
) -> Outcomes:
    """What becomes of the alignments of all queries, best first for each query.

    For each target session at most one alignment of a query is accepted. ``queries`` are keyframes
    of all queries by session, by default of those that have alignments. Without a ``model`` the one
    of the package decides.
    """
    model = model or shipped()
    rows = Alignments.of(alignments)
    placed = place(rows, maps, model)
    roads = query_roads(placed)
    for name, keyframes in (queries or {}).items():
        roads[name] = maps[name].distance[np.asarray(keyframes, int)]
    uncertainty = Uncertainty.of(rows, maps)
    agreement, decisions, joint = _decisions(
        rows, placed, uncertainty, roads, model, settings.fusion.voxel_size
    )
    outcomes = Outcomes(
        joint.of(rows),
        decisions,
        agreement,
        settings.closures.min_probability,
        _order(rows, decisions.probability),
        np.full(len(rows), ACCEPTED, np.int8),
    )
    reason = outcomes.reason
    good = (decisions.probability >= outcomes.min_probability) & ~decisions.vetoes.any(axis=1)
    reason[good & ~_is_first(rows, outcomes.order)] = REASONS.index(Reason.SECOND_CHOICE)
    for k in np.flatnonzero(~good).tolist():  # a NaN is not good
        why = why_rejected(outcomes.decision(k), rows[k].features, model)
        reason[k] = REASONS.index(why)
    return outcomes


def _is_first(rows: Alignments, order: I64) -> Bools:
    """Which alignments (n,) are the first of their query in their target session."""
    query = rows.pair * (rows.query_keyframe.max(initial=0) + 1) + rows.query_keyframe
    out = np.zeros(len(rows), bool)
    out[order[np.unique(query[order], return_index=True)[1]]] = True
    return out


def _decisions(
    rows: Alignments,
    placed: Placed,
    uncertainty: Uncertainty,
    roads: Mapping[str, F64],
    model: Model,
    voxel_size: float,
) -> tuple[Agreement[F64], Decisions, JointPoses]:
    """The votes on each alignment (n,), its factors and its vetoes, and its pose."""
    pairs = pairs_of(placed)
    own = place_odds(placed, pairs, placed.log_odds, voxel_size)
    agreement = count_votes(placed, pairs, own.share, voxel_size, roads)
    with_votes = place_odds(placed, pairs, model.log_odds(placed.log_odds, agreement), voxel_size)
    # neighbours tell which place is right, and share its errors: not which pose in it
    mode_share = own.mode_share
    place_probability = with_votes.place_probability
    joint = joint_poses(placed, pairs, uncertainty, place_probability * mode_share, voxel_size)
    vetoes = {
        Veto.CONTRADICTS_ODOMETRY: contradicts_odometry(placed, voxel_size),
        Veto.AMBIGUOUS_PLACE: model.is_ambiguous(agreement),
        Veto.LOOSE_FIT: is_loose(rows.features),
    }
    decisions = Decisions(
        place_probability,
        mode_share,
        position_confidence(joint.sigma, voxel_size),
        np.stack([vetoes[veto] for veto in Veto], axis=1),
    )
    return agreement, decisions, joint


def why_rejected(decision: Decision, features: Features[float], model: Model) -> Reason:
    """The veto or the factor that rejects an alignment."""
    required = decision.min_probability
    if Veto.CONTRADICTS_ODOMETRY in decision.vetoes:
        return Reason.CONTRADICTS_ODOMETRY
    if decision.probability >= required:
        return next(REASON_OF_VETO[veto] for veto in Veto if veto in decision.vetoes)
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
