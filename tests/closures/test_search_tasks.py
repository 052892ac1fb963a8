"""Which queries of a block are searched in a target."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any, cast

import pytest

from semloc_logs.closures import search_tasks
from semloc_logs.closures.closure import Features
from semloc_logs.closures.search_tasks import _search_block
from semloc_logs.settings import load
from semloc_logs.words.survey import Votes

BLOCK = (10, 12, 14, 16)
MIN_VOTES = 3.0


def alignment(keyframe: int, contradiction: float) -> Any:
    features = Features(0.9, 1.0, contradiction, 0.9, 3.0, 1.0, 0.0)
    return SimpleNamespace(query_keyframe=keyframe, features=features)


def searched(
    votes: Mapping[int, Votes],
    found: Mapping[int, Any],
    least: float,
    *,
    is_other: bool = True,
) -> list[int]:
    """The queries that are searched, in turn; all that is found is returned."""
    order: list[int] = []

    def search(keyframe: int) -> list[Any]:
        order.append(keyframe)
        return [found[keyframe]] if keyframe in found else []

    out = _search_block(BLOCK, votes, least, search, is_other=is_other)
    assert out == [found[keyframe] for keyframe in order if keyframe in found]
    return order


def votes(*places: float, everywhere: float = 100.0, submaps: int = 12) -> dict[int, Votes]:
    return {k: Votes(place, everywhere, submaps) for k, place in zip(BLOCK, places, strict=True)}


@pytest.mark.parametrize(
    ("contradiction", "expected"),
    [(0.03, [14, 10, 12, 16]), (0.4, [14])],
    ids=["may be right", "improbable"],
)
def test_the_others_are_searched_where_the_best_one_finds_a_place(
    contradiction: float, expected: list[int]
) -> None:
    found = {14: alignment(14, contradiction)}
    assert searched(votes(0.5, 4.0, 5.0, 5.0), found, MIN_VOTES) == expected


def test_a_block_without_votes_is_not_searched() -> None:
    assert searched(votes(2.9, 1.0, 0.0, 0.0), {}, MIN_VOTES) == []
    assert searched(votes(0.0, 0.0, 0.0, 0.0, everywhere=0.0), {}, MIN_VOTES) == []
    assert searched(votes(3.0, 1.0, 0.0, 0.0), {}, MIN_VOTES) == [10]


def test_in_a_small_map_fewer_votes_are_enough() -> None:
    assert searched(votes(1.4, 0.0, 0.0, 0.0, everywhere=5.0), {}, MIN_VOTES) == [10]


def test_votes_by_chance_by_hand() -> None:
    assert Votes(9.0, 400.0, 12).by_chance == 5.0
    assert Votes(9.0, 400.0, 3).by_chance == 5.0  # a short map
    assert Votes(9.0, 400.0, 48).by_chance == 2.5  # four kilometres
    assert Votes(0.0, 0.0, 0).by_chance == 0.0


def test_in_another_session_votes_are_more_than_chance_brings() -> None:
    few, more = (votes(v, 0.0, 0.0, 0.0, everywhere=400.0) for v in (4.9, 5.0))
    assert searched(few, {}, MIN_VOTES) == []
    assert searched(more, {}, MIN_VOTES) == [10]
    assert searched(few, {}, MIN_VOTES, is_other=False) == [10]


def test_all_are_searched_without_a_bound() -> None:
    assert searched(votes(0.0, 0.0, 0.0, 0.0), {}, 0.0) == list(BLOCK)


@pytest.mark.parametrize(("queries", "least"), [([4], 0.0), ([4, 8], MIN_VOTES)])
def test_a_single_query_is_searched_whatever_its_votes(
    queries: list[int], least: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(search_tasks, "query_keyframes", lambda session, settings: queries)
    settings = load(assignments={"closures.min_votes": str(MIN_VOTES)}).resolved()
    assert search_tasks.min_votes(cast(Any, None), settings) == least
