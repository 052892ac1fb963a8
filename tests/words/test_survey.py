"""A survey of many sessions: what a count by hand gives for each, whatever the others are."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from semloc_logs.words.index import Allowed, LookUp, Part
from semloc_logs.words.segment import Held, Segment, segment_in_memory
from semloc_logs.words.survey import FAR_CODE, NEAR_CODE, Survey, Votes, votes_in_session

HEADINGS = 20
CELL = 4.0
WORDS = 50  # few, so that many are shared


def segment(*sessions: tuple[str, int, int]) -> Segment:
    """Sessions of a name, a seed and a number of words in two submaps each."""
    columns: dict[str, list[NDArray[Any]]] = {}
    for number, (_, seed, n) in enumerate(sessions):
        rng = np.random.default_rng(seed)
        of_session: dict[str, NDArray[Any]] = {
            "word": rng.integers(0, WORDS, n),
            "code": codes(rng, n),
            "place": 2 * number + rng.integers(0, 2, n),
            "row": np.arange(n),
            "centre": rng.uniform(-10, 10, (n, 3)).astype(np.float32),
            "yaw": (rng.integers(0, HEADINGS // 4, n) * 2 * np.pi / HEADINGS).astype(np.float32),
        }
        for name, values in of_session.items():
            columns.setdefault(name, []).append(values)
    held = tuple(Held(name, "", (0, 1), n) for name, _, n in sessions)
    return segment_in_memory(held, {k: np.concatenate(v) for k, v in columns.items()})


def codes(rng: np.random.Generator, n: int) -> NDArray[np.uint64]:
    """Codes that differ in a few of the lowest 32 bits."""
    some, others = rng.integers(0, 2**32, (2, n), np.uint64)
    return np.asarray(some & others)


def query(seed: int, n: int) -> tuple[list[list[LookUp]], NDArray[np.float64]]:
    """Look-ups of ``n`` words in four quarter turns, and their centres."""
    rng = np.random.default_rng(seed)
    turned = []
    for _ in range(4):
        word = np.stack([rng.permutation(WORDS)[:3] for _ in range(n)]).astype(np.int32)
        nothing: Any = None
        code = np.stack([codes(rng, 3) for _ in range(n)])
        turned.append([LookUp(nothing, nothing, nothing, nothing, word, code)])
    return turned, rng.uniform(-8, 8, (n, 3))


def by_hand(
    turned: list[list[LookUp]],
    centre: NDArray[np.float64],
    held: Segment,
    name: str,
    hidden: frozenset[tuple[int, int]] = frozenset(),
) -> tuple[float, float]:
    """Weights of the best cell and of all votes, from every pair of words.

    Words at ``hidden`` places and rows do not vote.
    """
    cells: Counter[tuple[int, ...]] = Counter()
    everywhere = 0.0
    for turns, (batch,) in enumerate(turned):
        for q, i in np.ndindex(len(centre), len(held)):
            word = int(np.searchsorted(held.starts, i, "right")) - 1
            if (int(held.place[i]), int(held.row[i])) in hidden:
                continue
            for query_word, code in zip(batch.word[q], batch.word_codes[q], strict=True):
                bits = int(code ^ held.code[i]).bit_count()
                if held.places[held.place[i]][0] != name or query_word != word:
                    continue
                if bits > NEAR_CODE:
                    continue
                heading = round(float(held.yaw[i]) * HEADINGS / (2 * np.pi)) + turns * HEADINGS // 4
                yaw = heading * 2 * np.pi / HEADINGS
                turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
                x, y = (held.centre[i, :2] - turn @ centre[q, :2]) / CELL
                weight = (1 - bits / FAR_CODE) ** 2
                everywhere += weight
                for offset in (0.0, 0.5):
                    cell = (math.floor(x + offset), math.floor(y + offset))
                    place = (int(held.place[i]), heading % HEADINGS)
                    cells[(*place, *cell, int(2 * offset))] += weight  # type: ignore[assignment]
    return max(cells.values(), default=0.0), everywhere


def test_votes_are_counted_as_by_hand() -> None:
    held = segment(("a", 1, 60), ("b", 2, 40))
    turned, centre = query(3, 25)
    votes = Survey([(held, frozenset("ab"))], "ab", HEADINGS, CELL).votes(turned, centre)
    for name in "ab":
        place, everywhere = by_hand(turned, centre, held, name)
        assert 0 < place < everywhere
        assert votes[name][:2] == pytest.approx((place, everywhere), rel=5e-3)
        assert votes[name].submaps == 2


def test_the_votes_in_a_session_do_not_depend_on_the_others() -> None:
    turned, centre = query(3, 25)
    alone = Survey([(segment(("b", 2, 40)), frozenset("b"))], "b", HEADINGS, CELL)
    expected = alone.votes(turned, centre)["b"]
    assert expected.place > 0
    many = segment(("a", 1, 60), ("b", 2, 40), ("c", 4, 80))
    served = frozenset("abc")
    assert Survey([(many, served)], "cba", HEADINGS, CELL).votes(turned, centre)["b"] == expected
    apart = [(segment(("a", 1, 60)), frozenset("a")), (segment(("b", 2, 40)), frozenset("b"))]
    assert Survey(apart, "ab", HEADINGS, CELL).votes(turned, centre)["b"] == expected


def test_sessions_that_a_segment_does_not_serve_get_no_votes() -> None:
    held = segment(("a", 1, 60), ("b", 2, 40))
    turned, centre = query(3, 25)
    votes = Survey([(held, frozenset("a"))], "ab", HEADINGS, CELL).votes(turned, centre)
    assert votes["a"].everywhere > 0
    assert votes["b"] == (0, 0, 0)


def test_a_query_without_words_gets_no_votes() -> None:
    held = segment(("a", 1, 60))
    survey = Survey([(held, frozenset("a"))], "a", HEADINGS, CELL)
    assert survey.votes([[], [], [], []], np.zeros((0, 3)))["a"][:2] == (0, 0)


def own_votes(allowed: Allowed, held: Segment) -> Votes:
    turned, centre = query(3, 25)
    parts = [Part(held, np.arange(2))]
    return votes_in_session(parts, allowed, turned, centre, headings=HEADINGS, cell=CELL)


def test_only_words_that_may_match_vote_in_the_own_session() -> None:
    held = segment(("a", 1, 60))
    rows = np.arange(60) % 3 > 0
    hidden = frozenset((1, int(row)) for row in np.flatnonzero(~rows))
    turned, centre = query(3, 25)
    expected = by_hand(turned, centre, held, "a", hidden)
    everything = by_hand(turned, centre, held, "a")
    votes = own_votes(Allowed(np.array([True, True]), {1: rows}), held)
    assert votes[:2] == pytest.approx(expected, rel=5e-3)
    assert votes.everywhere < everything[1]


def test_hidden_submaps_have_no_votes() -> None:
    held = segment(("a", 1, 60))
    assert own_votes(Allowed(np.array([False, False])), held)[:2] == (0, 0)
    whole = own_votes(Allowed(np.array([True, True])), held)
    turned, centre = query(3, 25)
    assert whole == Survey([(held, frozenset("a"))], "a", HEADINGS, CELL).votes(turned, centre)["a"]
