"""Which queries of a block are searched in a target, and what a survey gets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from semloc_logs.closures import search_tasks
from semloc_logs.closures.closure import Features
from semloc_logs.closures.search_tasks import (
    LEAST_AGREEMENT,
    SearchTask,
    _search_block,
    block_size,
)
from semloc_logs.settings import load
from semloc_logs.words.survey import Votes

BLOCK = (10, 12, 14, 16)
MIN_VOTES = 3.0


def alignment(keyframe: int, contradiction: float) -> Any:
    features = Features(0.9, 1.0, contradiction, 0.9, 3.0, 1.0, 0.0)
    return SimpleNamespace(query_keyframe=keyframe, features=features)


def searched(
    votes: Mapping[int, Votes],
    alignments: Mapping[int, Any],
    least: float,
    *,
    is_other: bool = True,
) -> list[int]:
    """The queries that are searched, in turn; all that is found is returned."""
    order: list[int] = []

    def search(keyframe: int, least_agreement: float = 0.0) -> list[Any]:
        order.append(keyframe)
        return [alignments[keyframe]] if keyframe in alignments else []

    out = _search_block(BLOCK, votes, least, search, is_other=is_other)
    assert out == [alignments[keyframe] for keyframe in order if keyframe in alignments]
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
    alignments = {14: alignment(14, contradiction)}
    assert searched(votes(0.5, 4.0, 5.0, 5.0), alignments, MIN_VOTES) == expected


def test_a_block_without_votes_is_not_searched() -> None:
    assert searched(votes(2.9, 1.0, 0.0, 0.0), {}, MIN_VOTES) == []
    assert searched(votes(0.0, 0.0, 0.0, 0.0, everywhere=0.0), {}, MIN_VOTES) == []
    assert searched(votes(3.0, 1.0, 0.0, 0.0), {}, MIN_VOTES) == [10]


def test_in_a_small_map_fewer_votes_are_enough() -> None:
    assert searched(votes(1.4, 0.0, 0.0, 0.0, everywhere=5.0), {}, MIN_VOTES) == [10]


def test_votes_by_chance_by_hand() -> None:
    assert Votes(9.0, 400.0, 12).by_chance == 6.0
    assert Votes(9.0, 400.0, 3).by_chance == 6.0  # a short map
    assert Votes(9.0, 400.0, 48).by_chance == 3.0  # four kilometres
    assert Votes(0.0, 0.0, 0).by_chance == 0.0


def test_in_another_session_votes_are_more_than_chance_brings() -> None:
    few, more = (votes(v, 0.0, 0.0, 0.0, everywhere=400.0) for v in (5.9, 6.0))
    assert searched(few, {}, MIN_VOTES) == []
    assert searched(more, {}, MIN_VOTES) == [10]
    assert searched(few, {}, MIN_VOTES, is_other=False) == [10]


@pytest.mark.parametrize("is_other", [True, False])
def test_the_first_query_alone_has_to_agree_about_a_place_of_another_session(
    is_other: bool,
) -> None:
    searches: list[tuple[int, float]] = []

    def search(keyframe: int, least_agreement: float = 0.0) -> list[Any]:
        searches.append((keyframe, least_agreement))
        return [alignment(keyframe, 0.03)]

    least = LEAST_AGREEMENT if is_other else 0.0
    _search_block(BLOCK, votes(9.0, 4.0, 5.0, 5.0), MIN_VOTES, search, is_other=is_other)
    assert searches == [(10, least), (12, 0.0), (14, 0.0), (16, 0.0)]
    searches.clear()
    _search_block(BLOCK, votes(0.0, 0.0, 0.0, 0.0), 0.0, search, is_other=is_other)
    assert searches == [(keyframe, 0.0) for keyframe in BLOCK]


def test_all_are_searched_without_a_bound() -> None:
    assert searched(votes(0.0, 0.0, 0.0, 0.0), {}, 0.0) == list(BLOCK)


@pytest.mark.parametrize(("queries", "least"), [([4], 0.0), ([4, 8], MIN_VOTES)])
def test_a_single_query_is_searched_whatever_its_votes(
    queries: list[int], least: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(search_tasks, "query_keyframes", lambda session, settings: queries)
    settings = load(assignments={"closures.min_votes": str(MIN_VOTES)}).resolved()
    assert search_tasks.min_votes(cast(Any, None), settings) == least


# -- tasks, with a search and a survey that take no time


def task_of(
    folder: Path, keyframes: tuple[int, ...], targets: Sequence[str], **given: str
) -> SearchTask:
    """Queries of the session "own" in ``targets``; ``given`` are settings with ``__`` for a dot."""
    assignments = {key.replace("__", "."): value for key, value in given.items()}
    return SearchTask(
        folder,
        "own",
        keyframes,
        {name: f"pair with {name}" for name in targets},
        {name: f"words of {name}" for name in targets},
        load(assignments=assignments).resolved(),
        folder / "part.parquet",
    )


def searches_of(
    task: SearchTask,
    monkeypatch: pytest.MonkeyPatch,
    surveyed: Mapping[int, Mapping[str, Votes]] | None,
) -> list[tuple[str, int]]:
    """The alignments that are written, by target and keyframe: one of each search.

    ``surveyed`` None: there must be no survey.
    """
    written: list[Any] = []

    def survey(task: SearchTask, session: Any, queries: Any) -> Any:
        assert surveyed is not None
        return surveyed

    def search(
        database: tuple[str, str],
        session: Any,
        keyframe: int,
        query: str,
        *,
        least_agreement: float,
    ) -> list[Any]:
        target, words = database
        assert words == task.words[target]
        assert query == f"query {keyframe}"
        # too contradicting to be worth the vote of a neighbour
        return [SimpleNamespace(**vars(alignment(keyframe, 0.4)), target_session=target)]

    def write(output: Path, keyframes: Any, targets: Any, alignments: list[Any]) -> None:
        assert (output, keyframes, targets) == (task.output, task.keyframes, task.targets)
        written.extend(alignments)

    stand_ins = {
        "SessionMap": lambda folder: folder.name,
        "query_keyframes": lambda session, settings: task.keyframes,
        "build_query": lambda session, keyframe, settings: f"query {keyframe}",
        "survey_queries": survey,
        "open_database": lambda work, target, words, settings: (target, words),
        "search_query": search,
        "write_part": write,
    }
    for name, stand_in in stand_ins.items():
        monkeypatch.setattr(search_tasks, name, stand_in)
    assert search_tasks.search_queries(task) == len(written)
    return [(a.target_session, a.query_keyframe) for a in written]


def test_alignments_are_written_by_query_and_then_by_target(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = task_of(tmp_path, (4, 8), ["b", "a"], closures__every="4", query__every="4")
    many = Votes(50.0, 100.0, 12)
    written = searches_of(task, monkeypatch, {k: {"a": many, "b": many} for k in (4, 8)})
    assert written == [("a", 4), ("b", 4), ("a", 8), ("b", 8)]


def test_chance_counts_in_another_session_and_not_in_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = task_of(tmp_path, (4, 8), ["own", "b"], closures__min_votes="3")
    few = Votes(4.9, 400.0, 12)  # chance brings 5
    surveyed = {4: {"own": few, "b": few}, 8: {"own": few, "b": few}}
    assert searches_of(task, monkeypatch, surveyed) == [("own", 4)]


def test_a_session_that_the_survey_does_not_name_has_no_votes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = task_of(tmp_path, (4, 8), ["b"])
    assert searches_of(task, monkeypatch, {4: {}, 8: {}}) == []


def test_a_single_query_needs_no_survey(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert searches_of(task_of(tmp_path, (4,), ["b"]), monkeypatch, None) == [("b", 4)]


def test_each_block_is_judged_by_its_own_votes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three queries 4 m apart in blocks of 8 m: two and one."""
    task = task_of(tmp_path, (4, 8, 12), ["b"], closures__every="8", query__every="4")
    weights = {4: 10.0, 8: 50.0, 12: 50.0}
    surveyed = {k: {"b": Votes(weight, 100.0, 12)} for k, weight in weights.items()}
    assert searches_of(task, monkeypatch, surveyed) == [("b", 8), ("b", 12)]


@pytest.mark.parametrize(("every", "expected"), [("1", 1), ("8", 2), ("13", 3)])
def test_blocks_have_at_least_one_query(tmp_path: Path, every: str, expected: int) -> None:
    task = task_of(tmp_path, (), [], closures__every=every, query__every="4")
    assert block_size(task.settings) == expected


# -- surveys


@pytest.mark.parametrize("with_own", [True, False])
def test_a_survey_gets_words_in_metres_of_queries_with_structure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, with_own: bool
) -> None:
    """The own session is not in the survey: its words are chosen by what a query may have seen."""
    targets = ["own", "b"] if with_own else ["b"]
    task = task_of(tmp_path, (4, 8), targets, fusion__voxel_size="0.05")
    of_b = Votes(7.0, 70.0, 1)
    of_own = Votes(9.0, 90.0, 1)

    def words(query: Any, variant: str, ground: float, settings: Any) -> tuple[Any, Any]:
        assert ground == -4.0
        return SimpleNamespace(centre=np.array([[20, 40, -60]])), f"{variant} words"

    def of_survey(turned: Any, centre: Any) -> dict[str, Votes]:
        assert turned == "geometric words"
        np.testing.assert_allclose(centre, [[1.0, 2.0, -3.0]])
        return {"b": of_b}

    def surveys(work: Path, others: Any, has_classes: bool, settings: Any) -> dict[str, Any]:
        assert (others, has_classes) == ((("b", "words of b"),), True)
        return {"geometric": SimpleNamespace(votes=of_survey)}

    def in_session(parts: Any, allowed: Any, turned: Any, centre: Any, **options: Any) -> Votes:
        assert (parts, allowed, turned) == ("semantic parts", "allowed", "semantic words")
        np.testing.assert_allclose(centre, [[1.0, 2.0, -3.0]])
        assert options == {"headings": 20, "cell": pytest.approx(0.8)}  # 16 voxels
        return of_own

    def database(work: Path, name: str, fingerprint: str, settings: Any) -> Any:
        assert (name, fingerprint) == ("own", "words of own")
        return SimpleNamespace(words=lambda v: SimpleNamespace(parts=f"{v} parts"))

    stand_ins = {
        "prepare": words,
        "ground_below": lambda session, keyframe: -float(keyframe),
        "_surveys": surveys,
        "open_database": database,
        "visible_to": lambda database, session, keyframe: keyframe,
        "allowed_words": lambda visible, session: {"semantic": "allowed"},
        "votes_in_session": in_session,
    }
    for name, stand_in in stand_ins.items():
        monkeypatch.setattr(search_tasks, name, stand_in)
    queries: Any = {
        keyframe: (SimpleNamespace(structure=[np.zeros(voxels)]), None)
        for keyframe, voxels in ((4, 2), (8, 0))
    }
    session: Any = SimpleNamespace(has_classes=True)
    words_of_queries = search_tasks.survey_queries(task, session, queries)
    assert words_of_queries == {4: {"b": of_b} | ({"own": of_own} if with_own else {}), 8: {}}


def test_a_session_without_others_needs_no_survey(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(search_tasks, "_surveys", None)
    monkeypatch.setattr(search_tasks, "open_database", lambda *_: None)
    session: Any = SimpleNamespace(has_classes=True)
    queries: Any = {4: (SimpleNamespace(structure=[np.zeros(0)]), None)}
    task = task_of(tmp_path, (4,), ["own"])
    assert search_tasks.survey_queries(task, session, queries) == {4: {}}


@pytest.mark.parametrize(
    ("variant", "has_classes", "expected"),
    [
        ("auto", True, {"semantic": ["a", "c"], "geometric": ["b"]}),
        ("auto", False, {"geometric": ["a", "b", "c"]}),
        ("semantic", False, {"semantic": ["a", "b", "c"]}),
        ("geometric", True, {"geometric": ["a", "b", "c"]}),
    ],
)
def test_sessions_are_surveyed_by_the_words_that_both_have(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    variant: str,
    has_classes: bool,
    expected: dict[str, list[str]],
) -> None:
    monkeypatch.setattr(
        search_tasks, "SessionMap", lambda folder: SimpleNamespace(has_classes=folder.name != "b")
    )
    monkeypatch.setattr(search_tasks, "segments", lambda work, variant, names: (variant, [*names]))
    monkeypatch.setattr(search_tasks, "Survey", lambda *arguments: arguments)
    settings = load(
        assignments={"descriptor.variant": variant, "fusion.voxel_size": "0.15"}
    ).resolved()
    targets = (("a", "words a"), ("b", "words b"), ("c", "words c"))
    surveys: Any = search_tasks._surveys(tmp_path, targets, has_classes, settings)
    assert set(surveys) == set(expected)
    for words, (segments, names, headings, cell) in surveys.items():
        assert segments == (words, expected[words])
        assert names == expected[words]
        assert headings == settings.descriptor.headings
        assert cell == pytest.approx(2.4)  # 16 voxels
