"""The orderings that the paper reports (section 4.5), as hypotheses that a run supports or not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import Bools
from semloc_logs.experiments.answers import Answers
from semloc_logs.experiments.measures import (
    FEWEST_PASSAGES,
    Bounded,
    difference,
    difference_of_ratios,
    localised,
    ratio,
)
from semloc_logs.experiments.system import MOST_POSES

THRESHOLD_M = 5.0  # within which a query is localised
NEAR_ZERO = 0.05  # share of queries that the paper calls "not able to localize any"
Key = tuple[str, str, str]  # system, sensor, scenario
Known = Mapping[Key, Answers]
Rows = NDArray[np.int64]

FPFH, SIFT = "fpfh", "sift"
CROSS_TIME = "cross-time"


@dataclass(frozen=True, slots=True)
class Family:
    """A method in the variants of section 4.4: with classes, with one label, and with five frames;
    names of systems. ``classes`` has as many frames as ``geometric``.
    """

    title: str
    semantic: str
    accumulated: str
    geometric: str
    classes: str


FAMILIES = (
    Family(
        "the paper's method", "paper-semantic", "paper-acc", "paper-geometric", "paper-semantic"
    ),
    Family("our pipeline", "ours", "ours-acc", "ours-no-classes", "ours-acc"),
)


class Verdict(StrEnum):
    """What a run tells about a hypothesis."""

    HOLDS = "holds"
    FAILS = "does not hold"
    UNDECIDED = "undecided: the bounds include both"
    UNKNOWN = "not measured"


@dataclass(frozen=True, slots=True)
class Finding:
    """A hypothesis of the paper about a ``method``, where it was tested, the figure with its
    bounds, and the verdict.

    ``figure`` is a difference of shares that the paper expects above 0, or below ``NEAR_ZERO``.
    """

    hypothesis: str
    method: str
    sensor: str
    scenario: str
    figure: Bounded | None
    verdict: Verdict


def findings(known: Known, rivals: list[str]) -> list[Finding]:
    """Every hypothesis on every sensor; ``rivals``: the systems that are not ours."""
    sensors = list(dict.fromkeys(sensor for _, sensor, _ in known))
    out: list[Finding] = []
    for sensor in sensors:
        for family in FAMILIES:
            out += _of_family(known, sensor, family, rivals)
        out += [_near_zero(known, sensor, scenario) for scenario in ("90", "180")]
    return out


def _of_family(known: Known, sensor: str, family: Family, rivals: list[str]) -> list[Finding]:
    out = []
    for scenario in ("90", "180"):
        pairs = (
            ("semantic above geometric", family.classes, family.geometric),
            ("geometric above FPFH", family.geometric, FPFH),
        )
        out += [_above(known, sensor, scenario, family, pair) for pair in pairs]
    pair = ("acc. above single", family.accumulated, family.semantic)
    out += [_above(known, sensor, scenario, family, pair) for scenario in ("0", "90", "180")]
    out.append(_easier(known, sensor, family))
    out.append(_best_at_high_ranks(known, sensor, family))
    out.append(_ours_falls_least(known, sensor, family, rivals))
    return out


def _right(answers: Answers, ranks: int = 1) -> Bools:
    return localised(answers.errors_m, THRESHOLD_M, ranks)


def _verdict(figure: Bounded) -> Verdict:
    """For a figure that is expected above 0."""
    if figure.low > 0:
        return Verdict.HOLDS
    return Verdict.FAILS if figure.high < 0 else Verdict.UNDECIDED


def _common(one: Answers, other: Answers) -> tuple[Rows, Rows]:
    """The rows of the queries that both have answered."""
    both = sorted(set(one.queries) & set(other.queries))
    rows = [np.array([a.queries.index(q) for q in both], np.int64) for a in (one, other)]
    return rows[0], rows[1]


def _paired(one: Answers, other: Answers, ranks: int = 1) -> Bounded:
    """How much larger a share of their common queries ``one`` localises."""
    here, there = _common(one, other)
    return difference(_right(one, ranks)[here], _right(other, ranks)[there], one.passage[here])


def _above(
    known: Known, sensor: str, scenario: str, family: Family, pair: tuple[str, str, str]
) -> Finding:
    """``pair``: the hypothesis, and the systems of which the first is expected above the other."""
    text, one, other = pair
    first = known.get((one, sensor, scenario))
    second = known.get((other, sensor, scenario))
    if first is None or second is None or not len(first) or not len(second):
        return Finding(text, family.title, sensor, scenario, None, Verdict.UNKNOWN)
    figure = _paired(first, second)
    return Finding(text, family.title, sensor, scenario, figure, _verdict(figure))


def _easier(known: Known, sensor: str, family: Family) -> Finding:
    text = "180 easier than 90"
    straight = known.get((family.semantic, sensor, "180"))
    across = known.get((family.semantic, sensor, "90"))
    if straight is None or across is None or not len(straight) or not len(across):
        return Finding(text, family.title, sensor, "180, 90", None, Verdict.UNKNOWN)
    figure = difference_of_ratios(
        ratio(_right(straight), straight.passage), ratio(_right(across), across.passage)
    )
    return Finding(text, family.title, sensor, "180, 90", figure, _verdict(figure))


def _near_zero(known: Known, sensor: str, scenario: str) -> Finding:
    text = f"SIFT localises less than {NEAR_ZERO:.0%}"
    answers = known.get((SIFT, sensor, scenario))
    if answers is None or not len(answers):
        return Finding(text, "SIFT", sensor, scenario, None, Verdict.UNKNOWN)
    figure = ratio(_right(answers), answers.passage)
    verdict = Verdict.UNDECIDED
    if figure.high < NEAR_ZERO:
        verdict = Verdict.HOLDS
    elif figure.low > NEAR_ZERO and figure.n >= FEWEST_PASSAGES:
        verdict = Verdict.FAILS
    return Finding(text, "SIFT", sensor, scenario, figure, verdict)


def _best_at_high_ranks(known: Known, sensor: str, family: Family) -> Finding:
    """SIFT beside ours where every pose of an answer counts."""
    text = f"SIFT above it within the first {MOST_POSES} poses"
    sift = known.get((SIFT, sensor, "0"))
    ours = known.get((family.semantic, sensor, "0"))
    if sift is None or ours is None or not len(sift) or not len(ours):
        return Finding(text, family.title, sensor, "0", None, Verdict.UNKNOWN)
    figure = _paired(sift, ours, MOST_POSES)
    return Finding(text, family.title, sensor, "0", figure, _verdict(figure))


def _ours_falls_least(known: Known, sensor: str, family: Family, rivals: list[str]) -> Finding:
    """The fall from the diagonal of the cross-time matrix to the rest of it: of the rival that
    falls least, less our own.
    """
    text = "from one time to another it falls least"
    falls = {name: _fall(known, sensor, name) for name in (family.semantic, *rivals)}
    own = falls.pop(family.semantic)
    others = [fall for fall in falls.values() if fall is not None]
    if own is None or not others:
        return Finding(text, family.title, sensor, CROSS_TIME, None, Verdict.UNKNOWN)
    least = min(others, key=lambda fall: fall.value)
    figure = difference_of_ratios(least, own)
    return Finding(text, family.title, sensor, CROSS_TIME, figure, _verdict(figure))


def _fall(known: Known, sensor: str, system: str) -> Bounded | None:
    """By how much the share falls from one time to another; None where a part is not measured, or
    nothing is localised at the same time.
    """
    same: list[Answers] = []
    other: list[Answers] = []
    for (name, of, scenario), answers in known.items():
        if name == system and of == sensor and ">" in scenario:
            database, _, query = scenario.partition(">")
            (same if database == query else other).append(answers)
    if not same or not other:
        return None
    first = _pooled(same)
    return None if first.value == 0 else difference_of_ratios(first, _pooled(other))


def _pooled(parts: list[Answers]) -> Bounded:
    """The share of all queries together; passages of different scenarios differ."""
    right = np.concatenate([_right(a) for a in parts])
    passage = np.concatenate([1000 * k + a.passage for k, a in enumerate(parts)])
    return ratio(right, passage)
