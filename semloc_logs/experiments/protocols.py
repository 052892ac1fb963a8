"""The protocols of the literature on the same answers: loops of KITTI, pairs of SSC, registration
of LCDNet, and pair lists of the LiDAR-Registration-Benchmark.

Systems answer with poses; a loop detector answers with a frame. The frame of a pose is the view of
the database nearest to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from semloc_logs.arrays import F64, I64, Bools
from semloc_logs.experiments.measures import Bounded, precision_recall, ratio

LOOP_M = 4.0  # between the frames of a loop (LCDNet, T-RO 2022; KITTI)
PAIR_POSITIVE_M, PAIR_NEGATIVE_M = 3.0, 20.0  # SSC, IROS 2021
NEGATIVES = 100  # of a positive pair (SSC)
SUCCESS_M, SUCCESS_DEG = 2.0, 5.0  # of a registration (LCDNet)


@dataclass(frozen=True, eq=False)
class Retrieval:
    """Answers as frames of one database: the true places of queries (q, 3) and of the database's
    views (d, 3); ``frame`` (q, r), the view of the database at each rank, -1 where there is none;
    ``score`` (q, r).

    The database has no view that a query may not find, as the 50 frames about it.
    """

    queries: F64
    database: F64
    frame: I64
    score: F64

    def distances(self) -> F64:
        """Metres (q, d) between queries and views."""
        return np.asarray(np.linalg.norm(self.queries[:, None] - self.database[None], axis=2))


def nearest_frames(positions: F64, database: F64) -> I64:
    """The view of the ``database`` (d, 3) nearest to each of the ``positions`` (q, r, 3); -1 where
    the position is not finite.
    """
    known = np.isfinite(positions).all(axis=2)
    out = np.full(known.shape, -1, np.int64)
    if len(database) and known.any():
        out[known] = cKDTree(database).query(positions[known])[1]
    return out


class LoopFigures(NamedTuple):
    """``loops``: queries that have one; average precision and best F1 of the first answers."""

    loops: int
    average_precision: float
    best_f1: float
    recall_at_full_precision: float


class Decisions(NamedTuple):
    """Scores (n,) of first frames, which of them are right (n,), and which queries have a loop."""

    score: F64
    right: Bools
    has_loop: Bools


def loop_decisions(answers: Retrieval) -> Decisions:
    """The first frame of each query. A query has a loop when a view lies within ``LOOP_M`` of it;
    its first frame is right when it does (protocol 1 of LCDNet).
    """
    away = answers.distances()
    first = answers.frame[:, 0]
    rows = np.arange(len(first))
    right = (first >= 0) & (away[rows, np.maximum(first, 0)] <= LOOP_M)
    has_loop = away.min(axis=1, initial=np.inf) <= LOOP_M
    return Decisions(answers.score[:, 0], np.asarray(right), np.asarray(has_loop))


def loop_figures(retrievals: Sequence[Retrieval]) -> LoopFigures:
    """The figures of all decisions together."""
    decisions = [loop_decisions(r) for r in retrievals]
    if not decisions:
        return LoopFigures(0, float("nan"), float("nan"), float("nan"))
    score, right, has_loop = (np.concatenate(part) for part in zip(*decisions, strict=True))
    loops = int(has_loop.sum())
    curve = precision_recall(score, right, loops)
    return LoopFigures(
        loops, curve.average_precision, curve.best_f1, curve.recall_at_full_precision
    )


class PairFigures(NamedTuple):
    """Best F1 and extended precision of pairs (SSC, IROS 2021)."""

    positives: int
    negatives: int
    best_f1: float
    extended_precision: float


def pair_figures(retrievals: Sequence[Retrieval], seed: int = 0) -> PairFigures:
    """All pairs within ``PAIR_POSITIVE_M`` and ``NEGATIVES`` for each beyond ``PAIR_NEGATIVE_M``,
    drawn at random.

    The score of a pair is the best one among the ranks of the query that lead to the view; a pair
    that no rank leads to is never accepted.
    """
    positive: list[F64] = [np.zeros(0)]
    negative: list[F64] = [np.zeros(0)]
    for answers in retrievals:
        away = answers.distances()
        score = np.full(away.shape, -np.inf)
        rows, ranks = np.nonzero(answers.frame >= 0)
        np.maximum.at(score, (rows, answers.frame[rows, ranks]), answers.score[rows, ranks])
        positive.append(score[away < PAIR_POSITIVE_M])
        negative.append(score[away > PAIR_NEGATIVE_M])
    positive_rows = np.concatenate(positive)
    far = np.concatenate(negative)
    most = min(len(far), NEGATIVES * len(positive_rows))
    rng = np.random.default_rng([seed, 92])
    far = far[np.sort(rng.choice(len(far), most, replace=False))]
    right = np.arange(len(positive_rows) + len(far)) < len(positive_rows)
    curve = precision_recall(np.concatenate([positive_rows, far]), right, len(positive_rows))
    return PairFigures(len(positive_rows), len(far), curve.best_f1, curve.extended_precision)


class RegistrationFigures(NamedTuple):
    """Share of registrations within 2 m and 5 degrees; mean errors of these (TE, RE)."""

    success: Bounded
    translation_m: float
    rotation_deg: float


def registration_figures(error_m: F64, error_deg: F64, passage: I64) -> RegistrationFigures:
    """The figures of poses with these errors (n,): infinite where it is missing."""
    right = (error_m < SUCCESS_M) & (error_deg < SUCCESS_DEG)
    mean = float(error_m[right].mean()) if right.any() else float("nan")
    turn = float(error_deg[right].mean()) if right.any() else float("nan")
    return RegistrationFigures(ratio(right, passage), mean, turn)
