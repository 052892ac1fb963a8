"""What each part of the acceptance does: closures where one of them is left out.

Evidence is left out of the fit, and the models are fitted again; votes, factors and vetoes are not
applied. All figures are by models that had not seen a town.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.closures.acceptance.calibration import (
    EVIDENCE,
    position_confidence,
    probability_of,
)
from semloc_logs.closures.closure import Veto
from semloc_logs.evaluation.acceptance_report import SURE, closures_at, kinds_of
from semloc_logs.evaluation.calibration_fit import SIGNS, Factors, fit
from semloc_logs.evaluation.judged_alignments import Judged

NAMES_OF_VETOES = {
    Veto.CONTRADICTS_ODOMETRY: "the veto of odometry",
    Veto.AMBIGUOUS_PLACE: "the veto of ambiguous places",
    Veto.LOOSE_FIT: "the veto of loose fits",
}


def without_parts(judged: Judged) -> Iterator[tuple[str, Judged, F64]]:
    """The part that is left out, the alignments with their poses, and their probabilities (n,).

    The first is without nothing.
    """
    fitted = fit(judged)
    factors = fitted.factors
    yield "nothing", fitted.judged, fitted.probability
    for number, name in enumerate(EVIDENCE):
        signs = [0 if k == number else sign for k, sign in enumerate(SIGNS)]
        other = fit(judged, signs)
        yield f"`{name}`", other.judged, other.probability

    alone = Factors.of(judged, fitted.own, fitted.own)
    lonely = position_confidence(judged.placed.sigma, judged.voxel_size)
    one = np.ones(len(judged))
    changed = {
        "votes of neighbours": alone,
        "rivals": replace(factors, place=probability_of(fitted.with_votes)),
        "pose modes": replace(factors, mode_share=one),
        "the position": replace(factors, position=one),
    }
    for name, others in changed.items():
        poses = judged.with_poses(others.poses)
        yield name, poses, np.where(fitted.vetoed, 0.0, others.probability)
    by_itself = replace(factors, position=lonely).probability
    yield "poses of neighbours", judged, np.where(fitted.vetoed, 0.0, by_itself)
    for veto, name in NAMES_OF_VETOES.items():
        rest = [rows for other, rows in fitted.vetoes.items() if other is not veto]
        yield name, fitted.judged, np.where(np.any(rest, axis=0), 0.0, factors.probability)


def parts_markdown(judged: Judged) -> str:
    """A table: right closures of those that are possible, and false ones, by kind of town."""
    kinds = kinds_of(judged)
    columns = sorted(set(kinds))
    lines = ["| left out | " + " | ".join(columns) + " |", "| --- " * (1 + len(columns)) + "|"]
    for name, decided, p in without_parts(judged):
        cells = [name]
        for kind in columns:
            rows = kinds == kind
            [counts] = closures_at(decided.part(rows), p[rows], (SURE,))
            cells.append(f"{counts.accepted - counts.false} of {counts.possible}, {counts.false}")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"
