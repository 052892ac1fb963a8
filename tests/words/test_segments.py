"""Segments of the index: they find the words that a fresh index finds, whatever was added, removed,
merged, damaged or done at once.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from semloc_logs.errors import WorkspaceError
from semloc_logs.tables.table import write_json
from semloc_logs.voxels.store import blocks_path
from semloc_logs.words import segment_catalogue
from semloc_logs.words.index import SHORTLIST, Allowed, Index, Part
from semloc_logs.words.segment import (
    WORDS,
    Held,
    Segment,
    open_segment,
    segment_in_memory,
    write_segment,
)
from semloc_logs.words.segment_catalogue import Change, merged_blocks, segments, update
from semloc_logs.words.submap_words import write_words
from semloc_logs.words.vocabulary import BITS, Vocabulary
from semloc_logs.workspace import Workspace

VARIANT = "geometric"


def small_vocabulary() -> Vocabulary:
    """Four cells of 256 words in 64 dimensions, multiples of what vocabularies are multiples of."""
    rng = np.random.default_rng(1)
    cells = rng.standard_normal((4, BITS))
    cells = np.round(cells / np.linalg.norm(cells, axis=1, keepdims=True) * 2048) / 2048
    children = (
        np.round(
            (cells[:, None] + 0.05 * rng.standard_normal((4, 256, BITS))).clip(-0.49, 0.49) * 256
        )
        / 256
    )
    return Vocabulary(*(np.asarray(a, np.float32) for a in (cells, np.eye(BITS), cells, children)))


V = small_vocabulary()


@pytest.fixture(autouse=True, scope="module")
def _unsynced() -> Iterator[None]:
    """No test here pulls the plug, and hundreds of small files would wait for the disk."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield


def near_cells(seed: int, n: int) -> NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    d = V.cells[rng.integers(0, 4, n)] + 0.06 * rng.standard_normal((n, BITS))
    return np.asarray(d / np.linalg.norm(d, axis=1, keepdims=True), np.float32)


def make_session(work: Workspace, name: str, seed: int, counts: tuple[int, ...] = (40, 25)) -> None:
    """A described session with a submap of so many words each, and one of another variant."""
    folder = work.session(name)
    write_json(folder.session_json, {"submaps": [{"id": i} for i in range(len(counts))]})
    for submap, n in enumerate(counts):
        d = near_cells(100 * seed + submap, n)
        centre = np.random.default_rng(seed).uniform(-50, 50, (n, 3))
        parts = [
            ("semantic", 0.5, centre[:3], *V.words(d[:3])),
            (VARIANT, 0.25, centre, *V.words(d)),
        ]
        write_words(blocks_path(folder.words, submap), submap, parts, {})
    write_json(folder.words_json, {"variants": [VARIANT, "semantic"], "fingerprint": seed})


def groups(work: Workspace, names: list[str]) -> dict[tuple[str, int], int]:
    listed = [
        (n, s["id"])
        for n in names
        for s in json.loads(work.session(n).session_json.read_text())["submaps"]
    ]
    return {place: g for g, place in enumerate(listed)}


def index(work: Workspace, names: list[str], budget: int = 10**6) -> Index:
    numbers = groups(work, names)
    parts = [
        Part(s, np.array([numbers[p] if p[0] in served else -1 for p in s.places], np.int64))
        for s, served in segments(work, VARIANT, names)
    ]
    return Index(V, parts, budget)


def searched(index: Index, places: int, k: int = 5) -> list[Any]:
    m = index.search(near_cells(7, 30), k, 3, Allowed(np.ones(places, bool)))
    return [a.tolist() for a in (m.query, m.group, m.entry, m.distance, m.centre, m.yaw)]


def fresh(work: Workspace, names: list[str], tmp: Path, budget: int = 10**6) -> list[Any]:
    """What an index built at once, elsewhere, finds."""
    other = Workspace(tmp)
    shutil.rmtree(tmp, ignore_errors=True)
    for n in names:
        shutil.copytree(work.session(n).path, other.session(n).path)
    return searched(index(other, names, budget), len(groups(work, names)))


def files(work: Workspace) -> list[Path]:
    return sorted((work.path / "index" / VARIANT).glob("*.segment"))


@pytest.mark.timeout(300)  # the first search is compiled
@given(
    st.lists(
        st.tuples(
            st.sampled_from("abcdef"),
            st.sampled_from(["add", "add", "again", "remove"]),
            st.integers(0, 60),
        ),
        max_size=7,
    )
)
@settings(max_examples=8)
def test_adding_and_removing_is_a_fresh_index(
    tmp_path_factory: pytest.TempPathFactory, steps: list[tuple[str, str, int]]
) -> None:
    tmp = tmp_path_factory.mktemp("work")
    work = Workspace(tmp / "work")
    names: set[str] = set()
    for number, (name, what, size) in enumerate(steps):
        if what == "remove":
            shutil.rmtree(work.session(name).path, ignore_errors=True)
            names.discard(name)
        elif what == "again" or name not in names:
            shutil.rmtree(work.session(name).path, ignore_errors=True)
            make_session(work, name, number, (size, 3))
            names.add(name)
        now = sorted(names)
        built = index(work, now)
        assert len(built) == sum(len(s) for s, _ in segments(work, VARIANT, now)) - dead(work, now)
        if number + 1 == len(steps):
            for budget in (10**6, 60):
                assert searched(index(work, now, budget), len(groups(work, now))) == fresh(
                    work, now, tmp / "fresh", budget
                )
        sizes = sorted((len(open_segment(p, VARIANT)) for p in files(work)), reverse=True)
        assert len(sizes) <= 2 + np.log2(max(1, sum(sizes)) + 1)
    shutil.rmtree(tmp)


def dead(work: Workspace, names: list[str]) -> int:
    held = segments(work, VARIANT, names)
    return sum(h.entries for s, served in held for h in s.sessions if h.name not in served)


def test_some_sessions_can_be_asked_for_and_the_others_stay(tmp_path: Path) -> None:
    work = Workspace(tmp_path / "work")
    for i, name in enumerate("abc"):
        make_session(work, name, i)
    segments(work, VARIANT, ["a", "b", "c"])
    before = files(work)
    change = Change()
    assert [served for _, served in segments(work, VARIANT, ["b"], change)] == [{"b"}]
    assert (str(change), files(work)) == ("", before)
    assert searched(index(work, ["b"]), 2) == fresh(work, ["b"], tmp_path / "fresh")
    assert searched(index(work, ["b"], 20), 2) == fresh(work, ["b"], tmp_path / "fresh", 20)


def test_rows_are_those_of_the_variant_with_their_places(tmp_path: Path) -> None:
    work = Workspace(tmp_path)
    make_session(work, "a", 3, (5, 4))
    ((segment, served),) = segments(work, VARIANT, ["a"])
    assert served == {"a"}
    assert segment.places == [("a", 0), ("a", 1)]
    assert sorted(zip(segment.place.tolist(), segment.row.tolist(), strict=True)) == [
        (0, r) for r in range(5)
    ] + [(1, r) for r in range(4)]
    word, code = V.words(near_cells(301, 4))
    entries = [int(np.flatnonzero((segment.place == 1) & (segment.row == r))[0]) for r in range(4)]
    assert segment.code[entries].tolist() == code.tolist()
    for r, w in zip(entries, word.tolist(), strict=True):
        assert segment.starts[w] <= r < segment.starts[w + 1]
    np.testing.assert_array_equal(
        segment.centre[entries],
        np.random.default_rng(3).uniform(-50, 50, (4, 3)).astype(np.float32),
    )
    assert segment.yaw.tolist() == [0.25] * 9


def test_of_some_submaps_certain_rows_may_answer(tmp_path: Path) -> None:
    work = Workspace(tmp_path)
    for i, name in enumerate("ab"):
        make_session(work, name, i)
    built = index(work, ["a", "b"])
    rows = {1: np.arange(25) % 3 == 0, 2: np.zeros(40, bool), 0: np.ones(40, bool)}
    m = built.search(near_cells(7, 30), 200, 4, Allowed(np.array([True, True, True, False]), rows))
    expected = [(0, e) for e in range(40)] + [(1, e) for e in range(0, 25, 3)]
    for q in range(30):
        assert (
            sorted(zip(m.group[m.query == q].tolist(), m.entry[m.query == q].tolist(), strict=True))
            == expected
        )


def columns(seed: int, n: int, places: int) -> dict[str, NDArray[Any]]:
    rng = np.random.default_rng(seed)
    word = rng.integers(0, 40, n) ** 2
    place = rng.integers(0, places, n)
    rest = {"code": rng.integers(0, 2**63, n).astype(np.uint64), "row": rng.permutation(n)}
    return {
        "word": word,
        "place": place,
        "centre": rng.normal(size=(n, 3)),
        "yaw": rng.normal(size=n),
    } | rest


def test_a_merge_is_the_file_of_a_fresh_segment(tmp_path: Path) -> None:
    a = columns(0, 50, 3)
    b = columns(1, 31, 2)
    held = (Held("a", "x", (0, 4, 5), 50), Held("b", "y", (0, 1), 31))
    parts = [segment_in_memory((held[1],), b), segment_in_memory((held[0],), a)]
    both = {
        name: np.concatenate([a[name], b[name] + 3 if name == "place" else b[name]]) for name in a
    }
    for most in (1, 7, 10**6):
        blocks = list(merged_blocks(parts, [np.array([3, 4]), np.array([0, 1, 2])], most))
        assert most > 40 or len(blocks) > 5
        write_segment(tmp_path / "merged", VARIANT, held, blocks)
        write_segment(
            tmp_path / "fresh", VARIANT, held, [segment_in_memory(held, both).block(0, WORDS)]
        )
        assert (tmp_path / "merged").read_bytes() == (tmp_path / "fresh").read_bytes()
    back = open_segment(tmp_path / "fresh", VARIANT, check=True)
    assert back.sessions == held
    assert len(back) == 81


def test_a_damaged_file_is_seen_and_built_again(tmp_path: Path) -> None:
    work = Workspace(tmp_path / "work")
    make_session(work, "a", 1)
    good = searched(index(work, ["a"]), 2)
    (path,) = files(work)
    content = path.read_bytes()
    length = int.from_bytes(content[12:16], "little")
    starts = -(-(44 + length) // 64) * 64
    spoiled = {
        "empty": b"",
        "cut": content[:-1],
        "short": content[:30],
        "long": content + b"\0",
        "magic": b"X" + content[1:],
        "version": content[:8] + b"\2" + content[9:],
        "header": content[:50] + b"?" + content[51:],
        "huge": content[:12] + b"\xff\xff\xff\xff" + content[16:],
        "starts": content[: starts + 40] + b"\xff\xff\xff\xff" + content[starts + 44 :],
    }
    for name, bad in spoiled.items():
        path.write_bytes(bad)
        with pytest.raises(WorkspaceError, match="built again from the words"):
            open_segment(path, VARIANT)
        change = Change()
        segments(work, VARIANT, ["a"], change)
        assert change.added == 1, name
        assert path.read_bytes() == content
    with pytest.raises(WorkspaceError):
        open_segment(path, "semantic")
    assert searched(index(work, ["a"]), 2) == good


def test_damage_within_the_arrays_is_not_merged(tmp_path: Path) -> None:
    work = Workspace(tmp_path / "work")
    make_session(work, "a", 1)
    index(work, ["a"])
    (path,) = files(work)
    content = bytearray(path.read_bytes())
    content[-3] ^= 1  # of the last entry's yaw
    content[-60 * 4] ^= 0xFF
    path.write_bytes(content)
    open_segment(path, VARIANT)
    with pytest.raises(WorkspaceError, match="checksum"):
        open_segment(path, VARIANT, check=True)
    for seed, name in enumerate("bc", 2):  # the third makes them merge
        make_session(work, name, seed)
        index(work, [name])
    assert searched(index(work, ["a", "b", "c"]), 6) == fresh(
        work, ["a", "b", "c"], tmp_path / "fresh"
    )
    for p in files(work):
        open_segment(p, VARIANT, check=True)


def test_updating_checks_everything_and_says_what_there_is(tmp_path: Path) -> None:
    work = Workspace(tmp_path)
    with pytest.raises(WorkspaceError, match="no described session"):
        update(work)
    for i, name in enumerate("ab"):
        make_session(work, name, i)
    held = update(work)
    assert sorted(held) == [VARIANT, "semantic"]
    assert held[VARIANT]["changed"] == "2 sessions added"
    (one,) = held[VARIANT]["segments"]
    assert (one["words"], one["sessions"]) == (130, ["a", "b"])
    path = work.path / one["file"]
    assert path.stat().st_size == one["bytes"]
    assert update(work)[VARIANT] == {"changed": "", "segments": [one]}
    content = path.read_bytes()
    path.write_bytes(content[:-2] + b"xy")
    assert update(work)[VARIANT]["changed"] == "2 sessions added"
    assert path.read_bytes() == content


def test_places_beyond_the_list_are_never_found() -> None:
    """A bit of an array that was lost leads nowhere."""
    c = columns(2, 30, 1)
    c["word"][:] = 0
    c["place"][::2] = 77
    segment = segment_in_memory((Held("a", "", (0,), 30),), c)
    m = Index(V, [Part(segment, np.array([0]))]).search(
        V.cells[:1], 50, 1, Allowed(np.array([True]))
    )
    assert sorted(m.entry.tolist()) == sorted(c["row"][1::2].tolist())


def test_what_a_killed_process_leaves_is_cleared_and_another_session_is_no_hindrance(
    tmp_path: Path,
) -> None:
    work = Workspace(tmp_path)
    make_session(work, "a", 1)
    folder = work.path / "index" / VARIANT
    folder.mkdir(parents=True)
    left = folder / ".0123.segment.abcd.tmp"
    left.write_bytes(b"half")
    segments(work, VARIANT, ["a"])
    assert not left.exists()
    with pytest.raises(WorkspaceError, match="Session b has no words"):
        segments(work, VARIANT, ["a", "b"])
    make_session(work, "b", 2)
    write_json(work.session("b").words_json, {"variants": ["semantic"]})
    # described in the other variant
    assert [served for _, served in segments(work, VARIANT, ["a", "b"])] == [{"a"}]


def test_sessions_without_words_are_remembered(tmp_path: Path) -> None:
    work = Workspace(tmp_path)
    make_session(work, "a", 1, (0, 0))
    make_session(work, "b", 1, ())
    assert searched(index(work, ["a", "b"]), 2)[0] == []
    change = Change()
    segments(work, VARIANT, ["a", "b"], change)
    assert str(change) == ""


def test_a_workspace_that_cannot_be_written_is_searched_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = Workspace(tmp_path / "work")
    make_session(work, "a", 1)
    make_session(work, "b", 2)

    def full(*_: object) -> None:
        raise OSError("No space left on device")

    expected = fresh(work, ["a", "b"], tmp_path / "fresh")
    monkeypatch.setattr(segment_catalogue, "write_segment", full)
    change = Change()
    segments(work, VARIANT, ["a"], change)
    assert "No space left" in str(change)
    assert searched(index(work, ["a", "b"]), 4) == expected
    assert files(work) == []


def _build(path: Path) -> list[Any]:
    work = Workspace(path)
    names = [f.name for f in work.sessions()]
    return searched(index(work, names), len(groups(work, names)))


def test_processes_that_build_at_once_find_the_same(tmp_path: Path) -> None:
    work = Workspace(tmp_path / "work")
    for i in range(6):
        make_session(work, f"s{i}", i)
    with multiprocessing.get_context("fork").Pool(3) as pool:
        all_found = pool.map(_build, [work.path] * 6, chunksize=1)
    assert all(f == all_found[0] for f in all_found)
    assert sum(len(open_segment(p, VARIANT, check=True)) for p in files(work)) == 6 * 65
    assert os.listdir(work.path / "index" / VARIANT) != []


def test_an_open_index_outlives_its_files(tmp_path: Path) -> None:
    work = Workspace(tmp_path)
    make_session(work, "a", 1)
    opened = index(work, ["a"])
    before = searched(opened, 2)
    shutil.rmtree(work.path / "index")
    assert searched(opened, 2) == before


# -- the budget
# ------------------------------------------------------------------------------------------------


def slow_candidates(
    segment: Segment, d: NDArray[np.float32], probes: int, budget: int
) -> list[int]:
    """Positions of the entries that one descriptor is compared with."""
    cells = V.nearest_cells(d[None], probes)[0].tolist()
    words = [c * 256 + k for c in cells for k in range(256)]
    count = np.diff(segment.starts.astype(int))
    if sum(count[w] for w in words) > budget:
        p = np.round(V.projected(d[None])[0].astype(float) * 2048) / 2048
        distance = {
            w: ((p - V.children[w // 256, w % 256].astype(float)) ** 2).sum() for w in words
        }
        farthest = next(
            x
            for x in sorted(distance.values())
            if sum(count[w] for w in words if distance[w] <= x) >= budget
        )
        words = [w for w in words if distance[w] <= farthest]
    return [i for w in words for i in range(segment.starts[w], segment.starts[w + 1])]


@given(st.integers(0, 100), st.integers(1, 400), st.integers(1, 4))
@settings(max_examples=10)
def test_a_budget_takes_the_nearest_words(seed: int, budget: int, probes: int) -> None:
    d = near_cells(seed, 500)
    queries = near_cells(seed + 1, 6)
    index = Index.of_words(V, *V.words(d), np.zeros(500, int))
    index.budget = budget
    segment = index.parts[0].segment
    m = index.search(queries, 500, probes, Allowed(np.ones(1, bool)))
    for q in range(6):
        expected = slow_candidates(segment, queries[q], probes, budget)
        assert sorted(m.entry[m.query == q].tolist()) == sorted(segment.row[expected].tolist())
    assert SHORTLIST < 500
