"""How probable is it that an alignment is right? Learnt from queries in simulated towns, of which
many have never been visited.

The two logistic models of the acceptance are fitted on the judged alignments of all towns. What is
reported on each town is by models that never saw it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64, Bools
from semloc_logs.closures.acceptance.calibration import (
    EVIDENCE,
    VOTES,
    Calibration,
    Evidence,
    Model,
    Votes,
    fit_additions,
    fit_logistic,
    is_loose,
    position_confidence,
    probability_of,
)
from semloc_logs.closures.acceptance.consistency import count_votes, place_odds
from semloc_logs.closures.acceptance.joint_poses import JointPoses, joint_poses
from semloc_logs.closures.acceptance.placements import contradicts_odometry, pairs_of
from semloc_logs.closures.closure import Agreement, Veto
from semloc_logs.evaluation.acceptance_report import SURE
from semloc_logs.evaluation.judged_alignments import Judged

# the sign with which evidence may count
SIGNS = (-1, 1, -1)  # of ``EVIDENCE``
VOTE_SIGNS = (1, -1, 1, -1)  # of ``VOTES``
# weight of far opposing votes beside agreeing ones: copies of a street agree with each other as
# right alignments do, and where two groups contradict each other one of them is wrong
AGAINST = 2.0
# how much streets look like others by chance, in however few towns it was not seen
BY_CHANCE = 0.01
EXTREMES = 0.05  # of a town's lookalikes count as outliers
# more is never allowed: a city of copies that no fit has seen had wrong alignments at 0.023
MOST_AMBIGUOUS = 0.02


def fit_signed(
    x: F64,
    right: Bools,
    signs: Sequence[int],
    ridge: float = 0.3,
    offset: F64 | None = None,
) -> Calibration:
    """A logistic model of ``right`` (n,) on ``x`` (n, d) with weights that have the ``signs``.

    ``offset`` (n,) are log-odds that are known already: the model adds to them, and adds nothing
    where ``x`` is 0.

    Features whose weight would have the wrong sign are left out one by one: in few towns they stand
    for something else.
    """
    finite = np.where(np.isfinite(x), x, np.nan)
    low = np.zeros(x.shape[1]) if offset is not None else np.nanquantile(finite, 0.005, axis=0)
    high = np.nanquantile(finite, 0.999, axis=0)
    clipped = np.clip(x, low, high)
    sign = np.array(signs)
    used = np.flatnonzero(sign)
    weights = np.zeros(x.shape[1])
    bias = 0.0
    while len(used):
        if offset is None:
            fitted, bias = fit_logistic(clipped[:, used], right, ridge)
        else:
            fitted = fit_additions(clipped[:, used], right, ridge, offset)
        strength = fitted * sign[used] * clipped[:, used].std(0)
        if strength.min() >= 0:
            weights[used] = fitted
            break
        used = np.delete(used, int(np.argmin(strength)))
    typical = np.median(x[right], axis=0)
    columns = [tuple(column.tolist()) for column in (weights, low, high, typical)]
    return Calibration(columns[0], columns[1], columns[2], columns[3], bias)


def fit_alone(judged: Judged, rows: Bools, signs: Sequence[int] = SIGNS) -> Calibration:
    """The model of an alignment's own features, from the clear ones among ``rows`` (n,).

    An alignment looks the same in each copy of a block, so nothing of its own can tell them apart:
    it is of ordinary towns.
    """
    rows = rows & judged.clear & ~judged.copies
    values = Evidence.of(judged.features.part(rows)).vector()
    return fit_signed(values, judged.right[rows], signs)


def fit_votes(judged: Judged, agreement: Agreement[F64], rows: Bools, own: F64) -> Calibration:
    """The model of what the ``agreement`` (n,) adds to log-odds ``own`` (n,), from clear ``rows``.

    Neighbours in the same copy of a block agree about any copy, so it is of ordinary towns. There,
    far ones hardly ever oppose, so their votes weigh at least :data:`AGAINST` times as much as
    agreeing ones.
    """
    rows = rows & judged.clear & (agreement.neighbours > 0) & ~judged.copies
    values = Votes.of(agreement).vector()[rows]
    fitted = fit_signed(values, judged.right[rows], VOTE_SIGNS, offset=own[rows])
    for_votes, against, far, far_against = fitted.weights
    return replace(fitted, weights=(for_votes, against, far, min(far_against, -AGAINST * far)))


def max_ambiguity(judged: Judged, agreement: Agreement[F64], p: F64) -> float:
    """How ambiguous is too much, of what probabilities ``p`` (n,) would accept without rivals.

    The geometric mean of right ones of the ordinary town that has the most of it, and of wrong ones
    of the city of copies that has the least: as many times the one as the other is it. An ordinary
    town whose streets look like others as much as copies do is given up where they do. It is
    :data:`MOST_AMBIGUOUS` at most.
    """
    taken = (p >= SURE) & (agreement.neighbours > 0)
    right = taken & judged.right & ~judged.copies
    fooled = taken & ~judged.right & judged.copies
    most = [
        np.quantile(agreement.ambiguity[right & (judged.town == town)], 1 - EXTREMES)
        for town in sorted(set(judged.town[right]))
    ]
    least = [
        np.quantile(agreement.ambiguity[fooled & (judged.town == town)], EXTREMES)
        for town in sorted(set(judged.town[fooled]))
    ]
    least = [share for share in least if share > 0]  # else nothing there could show it
    if not least:
        return MOST_AMBIGUOUS
    between = np.sqrt(max([BY_CHANCE, *(m for m in most if m < min(least))]) * min(least))
    return min(float(between), MOST_AMBIGUOUS)


def agreement_of(judged: Judged, own: F64) -> Agreement[F64]:
    """The agreement (n,) within each town of alignments with log-odds ``own`` (n,)."""
    out = Agreement(*np.zeros((7, len(judged))))
    for of_town in _towns(judged):
        placed = replace(judged.placed.part(of_town), log_odds=own[of_town])
        pairs = pairs_of(placed)
        own_odds = place_odds(placed, pairs, placed.log_odds, judged.voxel_size)
        votes = count_votes(placed, pairs, own_odds.share, judged.voxel_size)
        for name in (f.name for f in fields(Agreement)):
            getattr(out, name)[of_town] = getattr(votes, name)
    return out


def _towns(judged: Judged) -> list[NDArray[np.int64]]:
    return [np.flatnonzero(judged.town == town) for town in sorted(set(judged.town))]


def _held_out(judged: Judged) -> Iterator[tuple[NDArray[np.int64], Bools]]:
    """The rows of each town, and which (n,) are of the others."""
    for of_town in _towns(judged):
        others = np.ones(len(judged), bool)
        others[of_town] = False
        yield of_town, others


@dataclass(frozen=True, slots=True, eq=False)
class Factors:
    """The factors of the probability of alignments (n,), and the poses that they are of."""

    place: F64
    mode_share: F64
    position: F64
    poses: JointPoses

    @property
    def probability(self) -> F64:
        """Their product (n,)."""
        return self.place * self.mode_share * self.position

    @classmethod
    def of(cls, judged: Judged, own: F64, with_votes: F64) -> Factors:
        """Of log-odds ``own`` and ``with_votes`` (n,)."""
        place, mode_share = np.zeros((2, len(judged)))
        poses = JointPoses(np.zeros_like(judged.error), judged.uncertain.covariance.copy())
        for of_town in _towns(judged):
            placed = judged.placed.part(of_town)
            uncertain = judged.uncertain.part(of_town)
            pairs = pairs_of(placed)
            size = judged.voxel_size
            odds = place_odds(placed, pairs, with_votes[of_town], size)
            place[of_town] = odds.place_probability
            mode_share[of_town] = place_odds(placed, pairs, own[of_town], size).mode_share
            probability = (place * mode_share)[of_town]
            joint = joint_poses(placed, pairs, uncertain, probability, size)
            poses.increment[of_town] = joint.increment
            poses.covariance[of_town] = joint.covariance
        position = position_confidence(poses.sigma, judged.voxel_size)
        return cls(place, mode_share, position, poses)


def vetoes_of(judged: Judged, model: Model, agreement: Agreement[F64]) -> dict[Veto, Bools]:
    """Which alignments (n,) have each veto."""
    return {
        Veto.CONTRADICTS_ODOMETRY: contradicts_odometry(judged.placed, judged.voxel_size),
        Veto.AMBIGUOUS_PLACE: model.is_ambiguous(agreement),
        Veto.LOOSE_FIT: is_loose(judged.features),
    }


def decided_by(model: Model, judged: Judged) -> tuple[Judged, F64]:
    """The alignments with the poses that the acceptance gives them with ``model``, and their
    probabilities (n,), 0 where there is a veto.
    """
    own = model.own_log_odds(judged.features)
    agreement = agreement_of(judged, own)
    factors = Factors.of(judged, own, model.log_odds(own, agreement))
    vetoed = np.any([*vetoes_of(judged, model, agreement).values()], axis=0)
    return judged.with_poses(factors.poses), np.where(vetoed, 0.0, factors.probability)


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """The model of all towns; and the results of models that had not seen a town: log-odds ``own``
    and ``with_votes`` (n,), the factors and vetoes that follow, and the alignments ``judged`` with
    the poses that these give them.
    """

    model: Model
    judged: Judged
    own: F64
    with_votes: F64
    factors: Factors
    vetoes: dict[Veto, Bools]

    @property
    def alone(self) -> F64:
        """The probability (n,) of an alignment by itself."""
        return probability_of(self.own)

    @property
    def vetoed(self) -> Bools:
        """Which have a veto (n,)."""
        return np.asarray(np.any([*self.vetoes.values()], axis=0))

    @property
    def probability(self) -> F64:
        """What the acceptance gives (n,)."""
        return np.where(self.vetoed, 0.0, self.factors.probability)


def fit(judged: Judged, signs: Sequence[int] = SIGNS) -> Fitted:
    """Fit all models, and each of them without each town in turn.

    ``signs`` are the ones with which evidence may count, 0 where it is left out. The model of the
    votes learns from log-odds on towns that the model alone had not seen. Where held-out log-odds
    turn out too sure (Platt, Probabilistic outputs for support vector machines, 1999), the first is
    tempered.
    """
    kept = ~contradicts_odometry(judged.placed, judged.voxel_size) & ~is_loose(judged.features)
    own = np.zeros(len(judged))
    for of_town, others in _held_out(judged):
        unseen = Evidence.of(judged.features.part(of_town)).vector()
        own[of_town] = fit_alone(judged, others & kept, signs).log_odds(unseen)
    whole = fit_alone(judged, kept, signs)
    scale, shift = _temper(own, judged, kept)
    most = float(np.log(judged.clear.sum()))
    own = np.minimum(scale * own + shift, most)
    model = replace(
        whole, weights=tuple(scale * w for w in whole.weights), bias=scale * whole.bias + shift
    )

    agreement = agreement_of(judged, own)
    total = np.zeros(len(judged))
    for of_town, others in _held_out(judged):
        votes = fit_votes(judged, agreement, others & kept, own)
        total[of_town] = own[of_town] + votes.log_odds(Votes.of(agreement.part(of_town)).vector())
    total = np.minimum(total, most)
    most_alike = max_ambiguity(judged, agreement, np.where(kept, probability_of(total), 0.0))
    fitted = Model(model, fit_votes(judged, agreement, kept, own), most, most_alike)
    factors = Factors.of(judged, own, total)
    vetoes = vetoes_of(judged, fitted, agreement)
    return Fitted(fitted, judged.with_poses(factors.poses), own, total, factors, vetoes)


def _temper(held_out: F64, judged: Judged, rows: Bools) -> tuple[float, float]:
    """Scale, at most one, and shift of the ``held_out`` log-odds (n,) so that they fit ``rows``."""
    rows = rows & judged.clear & ~judged.copies
    scale, shift = fit_logistic(held_out[rows][:, None], judged.right[rows], 1e-3)
    return (1.0, 0.0) if scale[0] >= 1 else (max(float(scale[0]), 0.3), float(shift))


def calibration_json(judged: Judged, fitted: Fitted) -> dict[str, Any]:
    """The content of calibration.json: the models and what they are made from."""
    return {
        "note": "made by benchmarks/calibrate.py; log-odds = bias + sum of weight * feature,"
        " clipped to low .. high; 'votes' add to 'own'; where lookalike exceeds most_alike"
        " nothing is accepted",
        "own": fitted.model.own.to_json(EVIDENCE),
        "votes": fitted.model.votes.to_json(VOTES),
        "most_alike": round(fitted.model.max_ambiguity, 4),
        "towns": len(set(judged.town)),
        "alignments": int(judged.clear.sum()),
        "right": int((judged.right & judged.clear).sum()),
    }
