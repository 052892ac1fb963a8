"""Hypotheses and candidates of a query, by hand: how many, which is a rival, which one place."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from semloc_logs.alignment.hypotheses import Hypothesis
from semloc_logs.alignment.icp import Fit
from semloc_logs.alignment.scores import MutualScores, Scores
from semloc_logs.alignment.search import Candidate
from semloc_logs.closures import matching
from semloc_logs.closures.matching import (
    Fitted,
    QueryContext,
    _each_place_once,
    find_hypotheses,
    prepare,
    verify_hypotheses,
)
from semloc_logs.numerics.transforms import yaw_transform
from semloc_logs.settings import Resolved, Settings


def settings(**closures: Any) -> Resolved:
    return Settings.model_validate({"closures": closures}).resolved()


def context(made: Resolved, road: tuple[float, ...] = (0.0, 2000.0)) -> QueryContext:
    """A query in the sessions a, submap 0, and b, submap 1; its targets' drives have this road."""
    places = [SimpleNamespace(session="a"), SimpleNamespace(session="b")]
    database = SimpleNamespace(
        sessions={"a": None, "b": None},
        places=places,
        settings=made,
        session=lambda group: SimpleNamespace(distance=np.array(road)),
    )
    visible = SimpleNamespace(database=database, target=lambda group: f"map {group}")
    return QueryContext(cast(Any, visible), cast(Any, None), 0, cast(Any, "query"), np.eye(4))


def fitted(x: float, score: float) -> Fitted:
    """A fit at ``x`` metres that aligns so much structure, all of it observed by both sides."""
    none = np.zeros((6, 6))
    fit = Fit(yaw_transform(0.0, (x, 0, 0)), 1.0, 100, 0.1, none, np.zeros(3), np.zeros((2, 6)))
    scores = Scores(100, 100, round(100 * score), 0)
    both = MutualScores(scores, scores)
    return Fitted(Candidate(0, np.eye(4), 0.5, 3), 0, np.zeros(3), np.zeros(1, int), fit, both, 0.0)


def test_the_best_fit_of_each_place_is_kept() -> None:
    rows = [fitted(0.5, 0.4), fitted(0.0, 0.6), fitted(9.0, 0.5)]
    assert [f.scores.forward.aligned for f in _each_place_once(rows, 0.3)] == [60, 50]


def test_the_words_of_a_query_are_made_once_for_what_they_depend_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: list[tuple[str, float]] = []

    def describe(query: Any, variant: str, ground_z: float, settings: Resolved) -> Any:
        made.append((variant, ground_z))
        return SimpleNamespace(descriptor=np.zeros((0, 8), np.float32))

    monkeypatch.setattr(matching, "_describe", describe)
    monkeypatch.setattr(matching, "quarter_turns", lambda descriptors, turns: descriptors)
    monkeypatch.setattr(matching, "load_vocabulary", lambda variant, path: None)
    monkeypatch.setattr(matching, "look_ups", lambda vocabulary, descriptors, probes: [probes])
    few, many = settings(probes=1), settings(probes=3)

    class Query:
        pass

    query = cast(Any, Query())
    with_few = prepare(query, "semantic", 0.5, few)
    with_many = prepare(query, "semantic", 0.5, many)
    assert prepare(query, "semantic", 0.5, few) is with_few
    assert (cast(Any, with_few[1]), cast(Any, with_many[1])) == ([[1]] * 4, [[3]] * 4)
    prepare(query, "semantic", 0.7, few)
    prepare(query, "geometric", 0.5, few)
    assert made == [("semantic", 0.5)] * 2 + [("semantic", 0.7), ("geometric", 0.5)]


def test_candidates_of_each_session_are_as_many_as_the_settings_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls: list[tuple[list[int], dict[int, str], int]] = []

    def search(
        hypotheses: list[Hypothesis], targets: dict[int, str], query: str, headings: int, most: int
    ) -> list[Candidate]:
        calls.append(([h.group for h in hypotheses], targets, most))
        return []

    monkeypatch.setattr(matching, "search_hypotheses", search)
    rows = [Hypothesis(group, (0.0, 0.0, 0.0, 0.0), 1, 1.0) for group in (1, 0, 1)]
    assert verify_hypotheses(context(settings(candidates=7)), rows) == [[], []]
    assert calls == [([0], {0: "map 0"}, 7), ([1, 1], {1: "map 1"}, 7)]


@pytest.mark.parametrize("most", [32, 20])
def test_each_session_has_its_share_whatever_the_others_have(
    most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    group = np.array([0, 1, 1])
    votes = (group, np.zeros(3), np.zeros((3, 3)), np.ones(3))
    monkeypatch.setattr(matching, "allowed_words", lambda visible, session: {"semantic": None})
    monkeypatch.setattr(matching, "_votes", lambda context, variant, allowed, match: votes)
    calls: list[tuple[list[int], float, int]] = []

    def pool(group: Any, yaw: Any, translation: Any, weight: Any, cell: float, most: int) -> Any:
        calls.append((group.tolist(), cell, most))
        return [Hypothesis(int(g), (0.0, 0.0, 0.0, 0.0), 1, 1.0) for g in group[:1]]

    monkeypatch.setattr(matching, "pool", pool)
    hypotheses = find_hypotheses(context(settings(hypotheses=most, places=1)))
    assert [(groups, n) for groups, _, n in calls] == [([0], most), ([1, 1], most)]
    assert [cell for _, cell, _ in calls] == pytest.approx([2.4, 2.4])
    assert [h.group for h in hypotheses] == [0, 1], "one place in each session"
