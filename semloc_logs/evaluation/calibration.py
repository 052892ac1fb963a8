"""How probable is it that an alignment is right? Learnt from queries in simulated towns, of which
many have never been visited.

Every town is judged against its truth into a table of its own; the three logistic models of the
acceptance are fitted on all of them. The report on each town is by models that never saw
it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from semloc_logs.closures.acceptance.calibration import (
    NEIGHBOUR_EVIDENCE,
    Calibration,
    Model,
    NeighbourEvidence,
    fit_logistic,
    has_far,
    is_plausible,
    position_confidence,
    probability_ignoring_rivals,
)
from semloc_logs.closures.acceptance.consistency import count_votes, mode_shares
from semloc_logs.closures.acceptance.placements import Placed, contradicts_odometry
from semloc_logs.closures.closure import FEATURES, Agreement, Features
from semloc_logs.closures.closure_tables import keyframe_at
from semloc_logs.evaluation.truth import CORRECT_DEG, CORRECT_M, judge_closure, read_truth
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.tables.table import read_metadata, read_table, write_table
from semloc_logs.voxels.store import poses_of
from semloc_logs.workspace import Workspace

F64 = NDArray[np.float64]
Bools = NDArray[np.bool_]

# The sign with which evidence may count. The plane distances of fitting points (rmse) say more
# about the sensor than about the place.
SIGNS = {
    "structure": 1,
    "coverage": 1,
    "contradiction": -1,
    "fit": 1,
    "rmse": 0,
    "distinct": -1,
    "support": 1,
    "stiffness": 1,
}
# of ``NEIGHBOUR_EVIDENCE``
TOGETHER_SIGNS = (1, 1, 1, -1, 1, -1)
NEAR_SIGNS = (0, 1, 1, -1, 0, 0)
# how towns of copied blocks begin, and how much they count for an alignment by itself
COPIES, COPIES_COUNT = "repeating", 0.01
SURE = 0.99  # what would be accepted
# how much streets look like others by chance, in however few towns it was not seen
BY_CHANCE = 0.05
EXTREMES = 0.05  # of a town's lookalikes count as outliers
FEWEST = 0.002  # of the right alignments have less support than any that is accepted
EDGES = (0.0, 0.01, 0.1, 0.3, 0.5, 0.7, 0.9, 0.97, 0.99, 0.999, 1.0)
THRESHOLDS = (0.5, 0.9, 0.95, 0.98, 0.99, 0.995, 0.999)


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """Alignments (n) of several towns: ``features`` (n,), where they lie (the caller sets the
    probabilities there), whether they are ``right`` (n,), and their errors (n,) in metres and
    degrees.
    """

    town: NDArray[np.object_]
    features: Features[F64]
    placed: Placed
    right: Bools
    error_m: F64
    error_deg: F64
    voxel_size: float

    @property
    def clear(self) -> Bools:
        """Right, or wrong by three times the bounds (n,): cases in between teach neither side."""
        return np.asarray(
            self.right | (self.error_m > 3 * CORRECT_M) | (self.error_deg > 3 * CORRECT_DEG)
        )

    @property
    def copies(self) -> Bools:
        """Which lie in towns of copied blocks (n,)."""
        return np.array([town.startswith(COPIES) for town in self.town], bool)

    @property
    def counts(self) -> F64:
        """How much each counts (n,) for the model of an alignment by itself."""
        return np.where(self.copies, COPIES_COUNT, 1.0)

    def __len__(self) -> int:
        return len(self.town)

    def part(self, rows: Bools) -> Judged:
        """Some of them."""
        columns = {n: getattr(self, n)[rows] for n in ("town", "right", "error_m", "error_deg")}
        return replace(
            self, features=self.features.part(rows), placed=self.placed.part(rows), **columns
        )


def judge_town(work: Workspace, truth: Path, town: str, output: Path) -> None:
    """All alignments of a workspace whose closures were made with ``closures.min_probability=1``,
    judged, as the table ``output``.

    Columns: as in rejected.parquet, without the neighbours, and town, query, road, target_road,
    own_* and at_* (the query in its own map by odometry, in the target's by alignment), error_m,
    error_deg, right.
    """
    maps = {f.name: SessionMap(f) for f in work.sessions()}
    tracks = read_truth(truth, maps)
    table = read_table(work.rejected)
    rows = table.to_pylist()
    judged = [judge_closure(row, tracks) for row in rows]
    ends = [
        (q, keyframe_at(q, row["query_stamp_ns"]), t, keyframe_at(t, row["target_stamp_ns"]))
        for row, q, t in (
            (row, maps[row["query_session"]], maps[row["target_session"]]) for row in rows
        )
    ]
    found = poses_of(table)
    own = np.array([q.map_T_base[k] for q, k, _, _ in ends]).reshape(-1, 4, 4)
    at = np.array(
        [t.map_T_base[k] @ T for (_, _, t, k), T in zip(ends, found, strict=True)]
    ).reshape(-1, 4, 4)
    columns: dict[str, Any] = {
        "town": [town] * len(rows),
        "query": [k for _, k, _, _ in ends],
        "road": [float(q.distance[k]) for q, k, _, _ in ends],
        "target_road": [float(t.distance[k]) for _, _, t, k in ends],
        "error_m": [j.error_m for j in judged],
        "error_deg": [j.error_deg for j in judged],
        "right": [j.correct for j in judged],
    }
    columns |= {f"own_{i}{j}": own[:, i, j] for i in range(3) for j in range(4)} | {
        f"at_{i}{j}": at[:, i, j] for i in range(3) for j in range(4)
    }
    kept = [
        "query_session",
        "target_session",
        "query_stamp_ns",
        "target_stamp_ns",
        "probability",
        "reason",
        "sigma",
        *FEATURES,
    ]
    metadata = {k: read_metadata(work.rejected).get(k) for k in ("voxel_size", "queries")} | {
        "town": town
    }
    write_table(output, pa.table({n: table[n] for n in kept} | columns), metadata)


def read_judged(paths: Sequence[Path]) -> Judged:
    """The tables of several towns."""
    table = pa.concat_tables([read_table(path) for path in paths])
    table = table.filter(table["right"].is_valid())
    column = {
        name: table[name].to_numpy()
        for name in table.column_names
        if name not in ("town", "query_session", "target_session")
    }

    def poses(prefix: str) -> F64:
        out = np.tile(np.eye(4), (len(table), 1, 1))
        for i in range(3):
            for j in range(4):
                out[:, i, j] = column[f"{prefix}_{i}{j}"]
        return out

    names = {
        name: np.array(table[name].to_pylist(), object)
        for name in ("town", "query_session", "target_session")
    }
    placed = Placed(
        names["query_session"],
        names["target_session"],
        column["query"],
        column["road"],
        column["target_road"],
        poses("own"),
        poses("at"),
        column["sigma"],
        column["probability"],
        np.full(len(table), np.nan),
        np.ones(len(table), bool),
    )
    right = column["right"].astype(bool)
    features = Features(*(column[n] for n in FEATURES))
    return Judged(
        names["town"],
        features,
        placed,
        right,
        column["error_m"],
        column["error_deg"],
        float(read_metadata(paths[0])["voxel_size"]),
    )


# -- fitting


def fit_signed(
    x: F64,
    right: Bools,
    signs: Sequence[int],
    counts: F64,
    ridge: float = 0.3,
    offset: F64 | float = 0.0,
) -> Calibration:
    """A logistic model of ``right`` (n,) on ``x`` (n, d), whose rows count ``counts`` (n,) times,
    with weights that have the ``signs``.

    ``offset`` (n,) are log-odds that are known already.

    Features whose weight would have the wrong sign are left out one by one: in few towns they stand
    for something else.
    """
    finite = np.where(np.isfinite(x), x, np.nan)
    low = np.nanquantile(finite, 0.005, axis=0)
    high = np.nanquantile(finite, 0.999, axis=0)
    clipped = np.clip(x, low, high)
    sign = np.array(signs)
    used = np.flatnonzero(sign)
    weights = np.zeros(x.shape[1])
    bias = 0.0
    while len(used):
        fitted, bias = fit_logistic(clipped[:, used], right, ridge, counts, offset)
        strength = fitted * sign[used] * clipped[:, used].std(0)
        if strength.min() >= 0:
            weights[used] = fitted
            break
        used = np.delete(used, int(np.argmin(strength)))
    return Calibration(tuple(weights.tolist()), tuple(low.tolist()), tuple(high.tolist()), bias)


def fit_alone(judged: Judged, rows: Bools) -> Calibration:
    """The model of an alignment's own features, from the clear ones among ``rows`` (n,).

    An alignment looks the same in each copy of a block, so nothing of its own can tell them apart;
    as many copies as these towns have would only teach to doubt every place that a single sweep
    finds. Where there are neighbours, they tell.
    """
    rows = rows & judged.clear
    return fit_signed(
        judged.features.part(rows).vector(),
        judged.right[rows],
        [SIGNS[n] for n in FEATURES],
        judged.counts[rows],
    )


def fit_agreement(
    judged: Judged, agreement: Agreement[F64], rows: Bools, alone: Calibration
) -> Model:
    """The models of the ``agreement`` (n,), from the clear ones that have neighbours among ``rows``
    (n,), beside ``alone``.

    Neighbours in the same copy of a block agree about any copy. So the models are of streets
    that look like no others. How much like others is too much: the geometric mean of the right ones
    of the ordinary town that has the most of it and the wrong ones that would be accepted of the
    city of copies that has the least: as many times the one as the other is it.
    """
    rows = rows & judged.clear & (agreement.neighbours > 0)
    ordinary = _agreement_model(judged, agreement, rows & ~judged.copies, alone, 1.0)
    taken = rows & (ordinary.agreed(agreement) >= SURE)
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
    # an ordinary town whose streets look like others as much as copies do is given up where they do
    most_alike = (
        float(np.sqrt(max([BY_CHANCE, *(m for m in most if m < min(least))]) * min(least)))
        if least
        else 1.0
    )
    rows = rows & (agreement.ambiguity <= most_alike)
    return _agreement_model(judged, agreement, rows, alone, most_alike)


def _agreement_model(
    judged: Judged, agreement: Agreement[F64], rows: Bools, alone: Calibration, most_alike: float
) -> Model:
    """Near neighbours add to an alignment's log-odds: they are so often right together that they
    would outweigh what it looks like.
    """
    values = NeighbourEvidence.of(agreement).vector()[rows]
    right = judged.right[rows]
    counts = np.ones(rows.sum())
    near = fit_signed(
        values, right, NEAR_SIGNS, counts, offset=_log_odds(agreement.own_probability[rows])
    )
    near = replace(
        near,
        weights=(1.0, *near.weights[1:]),
        low=(-30.0, *near.low[1:]),
        high=(30.0, *near.high[1:]),
    )
    together = fit_signed(values, right, TOGETHER_SIGNS, counts)
    return Model(
        alone,
        near,
        together,
        float(np.quantile(judged.features.support[judged.right], FEWEST)),
        most_alike,
    )


def agreement_of(judged: Judged, alone: F64, without_rivals: F64) -> Agreement[F64]:
    """The agreement (n,) within each town, when alignments have the probabilities ``alone`` (n,) by
    themselves.
    """
    out = Agreement(*np.zeros((7, len(judged))))
    for town in sorted(set(judged.town)):
        mine = np.flatnonzero(judged.town == town)
        part = replace(
            judged.placed.part(mine),
            own_probability=alone[mine],
            probability_ignoring_rivals=without_rivals[mine],
        )
        votes = count_votes(part, judged.voxel_size)
        for name in (f.name for f in fields(Agreement)):
            getattr(out, name)[mine] = getattr(votes, name)
    return out


def decided_by(model: Model, judged: Judged) -> F64:
    """The probabilities (n,) that the acceptance gives with ``model``."""
    alone = model.own(judged.features)
    without_rivals = probability_ignoring_rivals(model.own, judged.features)
    p = model.decided(agreement_of(judged, alone, without_rivals))
    return np.where(possible(judged), p * where_right(judged, alone), 0.0)


def where_right(judged: Judged, alone: F64) -> F64:
    """Probability (n,) that an alignment has the right pose of its place, by the probabilities
    ``alone`` (n,) of the poses there.
    """
    share = np.ones(len(judged))
    for mine in (np.flatnonzero(judged.town == town) for town in sorted(set(judged.town))):
        share[mine] = mode_shares(
            replace(judged.placed.part(mine), own_probability=alone[mine]), judged.voxel_size
        )
    return position_confidence(judged.placed.sigma, judged.voxel_size) * share


def possible(judged: Judged) -> Bools:
    """Which alignments (n,) acceptance considers at all."""
    return np.asarray(
        ~contradicts_odometry(judged.placed, judged.voxel_size) & is_plausible(judged.features)
    )


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """The model of all towns; and the results of models that had not seen a town: ``alone`` and
    ``probability`` (n,).
    """

    model: Model
    alone: F64
    probability: F64


def fit(judged: Judged) -> Fitted:
    """Fit all models, and each of them without each town in turn.

    The models of neighbours learn from results of the model alone on towns it had not seen.
    Where the held-out log-odds turn out too sure (Platt, Probabilistic outputs for support vector
    machines, 1999), the first and the last are tempered.
    """
    towns = sorted(set(judged.town))
    kept = possible(judged)
    held = {town: judged.town == town for town in towns}
    alone = np.zeros(len(judged))
    without_rivals = np.zeros(len(judged))
    for mine in held.values():
        own = _by_features(fit_alone(judged, ~mine & kept))
        features = judged.features.part(mine)
        alone[mine] = own(features)
        without_rivals[mine] = probability_ignoring_rivals(own, features)
    whole = fit_alone(judged, kept)
    tempered = _temper(whole, alone, judged, kept, judged.counts)
    alone = _tempered(alone, whole, tempered)
    without_rivals = np.where(without_rivals > 0, _tempered(without_rivals, whole, tempered), 0.0)
    agreement = agreement_of(judged, alone, without_rivals)
    probability = np.zeros(len(judged))
    alike = np.zeros(len(judged), bool)
    for mine in held.values():
        model = fit_agreement(judged, agreement, ~mine & kept, tempered)
        probability[mine] = model.agreed(agreement.part(mine))
        alike[mine] = model.is_ambiguous(agreement.part(mine))
    model = fit_agreement(judged, agreement, kept, tempered)
    far = (agreement.neighbours > 0) & has_far(agreement)
    together = _temper(
        model.together, probability, judged, kept & far & ~alike, np.ones(len(judged))
    )
    probability = np.where(far, _tempered(probability, model.together, together), probability)
    probability = np.where(
        kept, np.where(alike, probability / 2, probability) * where_right(judged, alone), 0.0
    )
    return Fitted(replace(model, together=together), alone, probability)


def _by_features(model: Calibration) -> Callable[[Features[F64]], F64]:
    return lambda features: model.probability(features.vector())


def _log_odds(p: F64) -> F64:
    p = np.clip(p, 1e-9, 1 - 1e-9)
    return np.asarray(np.log(p / (1 - p)))


def _temper(
    model: Calibration, held_out: F64, judged: Judged, rows: Bools, counts: F64
) -> Calibration:
    """``model`` with its log-odds scaled by at most one and moved, so that the ``held_out``
    probabilities (n,) of ``rows`` would fit.
    """
    rows = rows & judged.clear
    scale, shift = fit_logistic(
        _log_odds(held_out[rows])[:, None], judged.right[rows], 1e-3, counts[rows]
    )
    if scale[0] >= 1:
        return model
    factor = max(float(scale[0]), 0.3)
    return replace(
        model, weights=tuple(factor * w for w in model.weights), bias=factor * model.bias + shift
    )


def _tempered(p: F64, before: Calibration, after: Calibration) -> F64:
    """Probabilities of models like ``before``, tempered as ``after`` is."""
    k = int(np.argmax(np.abs(before.weights)))
    if before == after or before.weights[k] == 0:
        return p
    factor = after.weights[k] / before.weights[k]
    return np.asarray(
        1 / (1 + np.exp(-(factor * _log_odds(p) + after.bias - factor * before.bias)))
    )


# -- reports


def reliability(p: F64, right: Bools, edges: Sequence[float] = EDGES) -> list[dict[str, float]]:
    """How often alignments of each range of probability ``p`` (n,) are right."""
    out = []
    for a, b in pairwise(edges):
        mine = (p >= a) & ((p < b) | (b == edges[-1]))
        if mine.any():
            out.append(
                {
                    "from": a,
                    "to": b,
                    "alignments": int(mine.sum()),
                    "said": float(p[mine].mean()),
                    "right": float(right[mine].mean()),
                }
            )
    return out


def answers(judged: Judged, p: F64) -> NDArray[np.int64]:
    """The most probable alignment of each query with each target, which alone can be accepted,
    ascending.
    """
    best: dict[tuple[Any, ...], int] = {}
    for k, key in enumerate(_query_keys(judged)):
        if key not in best or p[k] > p[best[key]]:
            best[key] = k
    return np.array(sorted(best.values()), np.int64)


def _query_keys(judged: Judged) -> Iterator[tuple[Any, ...]]:
    placed = judged.placed
    return zip(
        judged.town, placed.query_session, placed.query.tolist(), placed.target_session, strict=True
    )


def recall_at(
    judged: Judged, p: F64, thresholds: Sequence[float] = THRESHOLDS
) -> list[dict[str, float]]:
    """For each threshold: accepted and false closures, and the share accepted of the queries that
    have a right alignment with a target.
    """
    chosen = answers(judged, p)
    able = len({key for key, right in zip(_query_keys(judged), judged.right, strict=True) if right})
    out = []
    for least in thresholds:
        accepted = chosen[p[chosen] >= least]
        right = int(judged.right[accepted].sum())
        row = {
            "threshold": least,
            "accepted": len(accepted),
            "false": len(accepted) - right,
            "possible": able,
        }
        out.append(row | {"recall": right / max(able, 1)})
    return out


def calibration_json(judged: Judged, fitted: Fitted) -> dict[str, Any]:
    """The content of calibration.json: three logistic models of named features clipped to low ..
    high, and what they are made from.
    """
    return {
        "note": "made by benchmarks/calibrate.py; log-odds = bias + sum of weight * feature;"
        " 'near' where a query has neighbours, "
        "'together' where it has far ones too; at most a half where lookalike exceeds most_alike",
        "alone": fitted.model.own_features.to_json(FEATURES),
        "least_support": round(fitted.model.min_support, 4),
        "most_alike": round(fitted.model.max_ambiguity, 4),
        "near": fitted.model.near.to_json(NEIGHBOUR_EVIDENCE),
        "together": fitted.model.together.to_json(NEIGHBOUR_EVIDENCE),
        "towns": len(set(judged.town)),
        "alignments": int(judged.clear.sum()),
        "right": int((judged.right & judged.clear).sum()),
    }
