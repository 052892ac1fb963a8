"""Problems: counts of skipped messages, order, and which of them lose input."""

from __future__ import annotations

from semloc_logs.logs.problems import (
    NoCloud,
    Problem,
    ProblemKind,
    Problems,
    lost,
    sentences,
    sorted_problems,
    without_loss_of,
)


def problem(text: str, *, topic: str = "", is_lost: bool = True) -> Problem:
    return Problem(topic, ProblemKind.MESSAGE, text, is_lost)


def test_skipped_messages_are_counted_by_topic_and_named_once() -> None:
    problems = Problems()
    problems.skip("/a", "it is cut off")
    assert sentences(problems) == ["/a: 1 message skipped; it is cut off."]
    problems.skip("/a", "another reason")
    problems.skip("/b", "it is empty")
    problems.skip("/a", "the file is damaged", file="x.db3")
    assert list(problems) == [
        problem("/a: 2 messages skipped; the first because it is cut off.", topic="/a"),
        problem("/b: 1 message skipped; it is empty.", topic="/b"),
        problem("/a: 1 message skipped; the file is damaged.", topic="/a"),
    ]


def test_counts_start_anew_for_topics_that_are_read_again() -> None:
    problems = Problems()
    for topic in ("/a", "/b"):
        problems.skip(topic, "it is cut off")
        problems.skip(topic, "the file is damaged", file="x.db3")
    problems.forget_skipped(["/a"])
    assert [p.topic for p in problems] == ["/a", "/b", "/b"]
    problems.forget_skipped(None, file="x.db3")
    assert sentences(problems) == ["/b: 1 message skipped; it is cut off."]


def test_a_problem_is_added_once() -> None:
    problems = Problems()
    problems.add("bag_0.db3: the file is damaged.")
    problems.add("bag_0.db3: the file is damaged.")
    assert list(problems) == [
        Problem("", ProblemKind.FILE, "bag_0.db3: the file is damaged.", lost=True)
    ]


def test_lost_input_comes_first_and_each_text_once() -> None:
    assumed = problem("assumed", is_lost=False)
    first = problem("first")
    second = problem("second")
    also_assumed = problem("first", is_lost=False)
    assert sorted_problems([assumed, also_assumed, first, second, assumed]) == [
        first,
        second,
        assumed,
    ]


def test_topics_that_play_no_role_lose_nothing() -> None:
    used = problem("/a: 1 message skipped.", topic="/a")
    unused = problem("/b: 1 message skipped.", topic="/b")
    whole_log = problem("the file is cut off")
    relaxed = without_loss_of({"/b"}, [used, unused, whole_log])
    assert sentences(relaxed) == sentences([used, unused, whole_log])
    assert lost(relaxed) == [used, whole_log]


def test_the_log_is_named_unless_the_text_names_its_file() -> None:
    assert problem("/a: 1 message skipped.").of_log("x.bag").text == "x.bag: /a: 1 message skipped."
    cut_off = Problem("", ProblemKind.FILE, "x.bag: the file is cut off.", lost=True)
    assert cut_off.of_log("x.bag") == cut_off


def test_reasons_have_a_key_each_and_a_sentence_unless_nothing_is_lost() -> None:
    assert len({reason.key for reason in NoCloud}) == len(NoCloud)
    assert [reason for reason in NoCloud if not reason.because] == [NoCloud.DUPLICATE]
