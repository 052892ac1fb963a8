"""The localisation benchmark: its queries, how it judges, what it compares with."""

from __future__ import annotations

import json
import subprocess
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from semloc_logs.benchmarks.localisation.city import (
    CROSSING,
    OPPOSITE,
    SEED,
    UNSEEN,
    WorldDrive,
    world_path,
)
from semloc_logs.benchmarks.localisation.judged_answers import (
    Answer,
    World,
    figures_of,
    recall_at_full_precision,
)
from semloc_logs.benchmarks.localisation.our_method import (
    OURS,
    grid_hypotheses,
    link_workspace,
    settings_of,
    sweep_words,
)
from semloc_logs.benchmarks.localisation.peer_methods import cloud_frame, database_keyframes
from semloc_logs.benchmarks.peers import peer_process
from semloc_logs.benchmarks.peers.scan_context import nearest_contexts, scan_context
from semloc_logs.closures.matching import QueryContext, find_hypotheses
from semloc_logs.errors import SemlocError, SettingsError
from semloc_logs.numerics.transforms import apply, yaw_transform
from semloc_logs.settings import load
from semloc_logs.subvolumes.cut import turned_map
from semloc_logs.subvolumes.describe import Windows, describe_map, load_encoder
from semloc_logs.words.index import Allowed, Matches
from semloc_logs.workspace import Workspace


def test_the_second_streets_cross_the_first_ones_at_about_right_angles() -> None:
    path, first = world_path(SEED)
    away = np.linalg.norm(path[:first, None, :2] - path[None, first:, :2], axis=2)
    tangent = np.gradient(path[:, :2], axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    places = []
    for i, j in np.argwhere(away < 1.0):
        if abs(tangent[i] @ tangent[first + j]) < np.cos(np.radians(60)):
            places.append(path[i, :2])
    crossings: list[np.ndarray] = []
    for place in places:
        if not any(np.linalg.norm(place - c) < 20 for c in crossings):
            crossings.append(place)
    assert len(crossings) >= 6  # of nine, some are slanting
    assert np.abs(np.linalg.norm(np.diff(path, axis=0), axis=1) - 1).max() < 0.7


def straight(heading_deg: float, condition: str) -> World:
    """A database along x with keyframes every metre, and a query at (10, 2) of some heading; the
    database's map is moved by 5 m.
    """
    road = np.tile(np.eye(4), (30, 1, 1))
    road[:, 0, 3] = np.arange(30)
    moved = road.copy()
    moved[:, 1, 3] += 5.0
    world = World(Workspace(Path("none")), WorldDrive(Path("none"), "q", "lidar", condition))
    world.__dict__["true_database"] = road
    world.__dict__["true_query"] = yaw_transform(np.radians(heading_deg), (10.0, 2.0, 0.0))[None]
    world.__dict__["database"] = SimpleNamespace(map_T_base=moved)
    return world


@pytest.mark.parametrize(
    ("heading", "condition", "is_query"),
    [
        (10, "0", True),
        (50, "0", False),
        (170, OPPOSITE, True),
        (100, OPPOSITE, False),
        (-95, CROSSING, True),
        (0, CROSSING, False),
    ],
)
def test_queries_have_the_heading_of_their_condition(
    heading: float, condition: str, is_query: bool
) -> None:
    assert straight(heading, condition)._meets_condition(0) is is_query


def test_errors_are_those_against_the_nearest_keyframe_of_a_map_that_lies_elsewhere() -> None:
    world = straight(20, "0")
    right = yaw_transform(np.radians(20), (10.0, 7.0, 0.0))
    assert world.errors(0, right) == pytest.approx((0.0, 0.0), abs=1e-5)
    off = yaw_transform(np.radians(23), (13.0, 7.0, 4.0))
    assert world.errors(0, off) == pytest.approx((5.0, 3.0), abs=1e-5)
    assert world.nearest(0, 2)[0] == 10
    assert straight(20, UNSEEN).errors(0, right)[0] == np.inf


def answer(score: float, error: float) -> Answer:
    return Answer(0, 1.0, score, error, 0.0, True, error, 0.0)


def test_full_precision_ends_at_the_best_wrong_answer() -> None:
    answers = [
        answer(0.9, 0.5),
        answer(0.8, 3.0),
        answer(0.7, 40.0),
        answer(0.6, 0.1),
        Answer(0, 1.0),
    ]
    assert recall_at_full_precision(answers, []) == pytest.approx(0.4)
    assert recall_at_full_precision(answers, [answer(0.85, np.inf)]) == pytest.approx(0.2)
    assert recall_at_full_precision(answers, [answer(0.9, np.inf)]) == 0.0  # a tie counts as wrong
    figures = figures_of(answers, [answer(0.1, np.inf)])
    assert figures["recall 1 m"] == pytest.approx(0.4)
    assert figures["recall 5 m"] == pytest.approx(0.6)
    assert figures["median error"] == pytest.approx(0.3)
    assert figures["accepted and wrong"] == 3  # 3 m off, 40 m off, and elsewhere
    assert figures["accepted and right"] == pytest.approx(0.4)
    # its neighbours told it the right one
    promoted = Answer(0, 1.0, 0.9, 40.0, 0.0, True, 0.2, 0.0)
    assert figures_of([promoted], []) == pytest.approx(
        {
            "recall 1 m": 0,
            "recall 5 m": 0,
            "recall at 100 % precision": 0,
            "time": 1,
            "accepted and right": 1,
            "accepted and wrong": 0,
        }
    )
    # a peer does not decide
    assert "accepted and right" not in figures_of([Answer(0, 1.0, 0.9, 0.1, 0.0)], [])


def test_scan_context_knows_the_turn_and_the_place() -> None:
    rng = np.random.default_rng(3)
    places = [
        np.column_stack([rng.uniform(-40, 40, (400, 2)), rng.uniform(0, 8, 400)]) for _ in range(4)
    ]
    contexts = [scan_context(p.astype(np.float32)) for p in places]
    yaw = 2 * np.pi * 17 / 60
    asked = apply(yaw_transform(-yaw), places[2])  # database_T_query turns by yaw
    number, turn = nearest_contexts(scan_context(asked.astype(np.float32)), contexts, 3)[0]
    assert number == 2
    assert turn == pytest.approx(yaw)
    assert len(nearest_contexts(contexts[0], contexts, 3)) == 3


def test_a_grid_has_every_heading_along_and_beside_the_road() -> None:
    settings = load().resolved()
    road = np.tile(np.eye(4), (9, 1, 1))
    road[:, 0, 3] = 2.0 * np.arange(9)
    session = SimpleNamespace(
        submaps=[{"first": 0, "last": 8}], distance=2.0 * np.arange(9), map_T_base=road
    )
    database = SimpleNamespace(
        settings=settings, places=[SimpleNamespace(session="a", submap=0)], sessions={"a": session}
    )
    context = cast(
        QueryContext, SimpleNamespace(visible=SimpleNamespace(database=database), keyframe=0)
    )
    hypotheses = grid_hypotheses(context)
    assert len(hypotheses) == 5 * 3 * settings.descriptor.headings
    assert {h.pose[1] for h in hypotheses if h.pose[0] < 3} == {0.0, 4.0, 8.0, 12.0, 16.0}
    assert {h.pose[1] for h in hypotheses if h.pose[0] > 3.2} == {2.0, 6.0, 10.0, 14.0, 18.0}
    assert len({h.pose[0] for h in hypotheses}) == settings.descriptor.headings
    assert {h.pose[2] for h in hypotheses} == {-4.0, 0.0, 4.0}
    some = grid_hypotheses(context, count=10)
    assert len(some) == 10
    assert set(some) <= set(hypotheses)


def test_a_sweep_finds_a_map_that_was_described_at_another_heading() -> None:
    settings = load().resolved()
    rng = np.random.default_rng(0)
    step = 2 * np.pi / settings.descriptor.headings
    state = np.full((64, 48, 48), 253, np.uint8)
    state[rng.random(state.shape) < 0.02] = 2
    blocks = SimpleNamespace(
        bounds=lambda: (np.array([-32, -16, -3]), np.array([32, 32, 45])),
        dense=lambda low, shape: state,
    )
    turned = turned_map(state, np.array([-32, -16, -3]), 3 * step)
    encoder = load_encoder("semantic", None)
    known = describe_map(
        turned.state,
        turned.low,
        0.0,
        encoder,
        Windows(0.3, settings.descriptor.query_stride, settings.descriptor.min_occupied),
    )
    centre = turned.to_map(known.centre) * 0.3

    def search(asked: np.ndarray, k: int, probes: int, allowed: Allowed) -> Matches:
        away = np.linalg.norm(asked[:, None] - known.descriptor[None], axis=2)
        best = away.argmin(1)
        n = np.arange(len(asked), dtype=np.int32)
        return Matches(
            n,
            0 * best,
            best,
            centre[best].astype(float),
            np.full(len(asked), 3 * step),
            (1000 * away.min(1)).astype(np.int32),
        )

    database = SimpleNamespace(
        settings=settings, words=lambda variant: SimpleNamespace(search=search)
    )
    allowed = Allowed(np.ones(1, bool))
    query = SimpleNamespace(blocks=blocks)
    described, matches = sweep_words(database, "semantic", allowed, query, 0.0)  # type: ignore[arg-type]
    assert len(described.centre) > 15 * len(known.centre)
    same = matches.distance == 0
    assert same.sum() >= len(known.centre) > 0
    assert set(matches.yaw[same]) == {0.0}  # the very map: not turned
    np.testing.assert_allclose(
        described.centre[matches.query[same]] * 0.3, matches.centre[same], atol=1e-4
    )


def test_systems_differ_in_where_their_hypotheses_come_from() -> None:
    settings = load().resolved()
    searches = {s.name: s.search(settings) for s in OURS}
    assert searches["ours"] is searches["random weights"] is find_hypotheses
    assert called(searches["ours, every heading described"]) == (
        find_hypotheses,
        {"match": sweep_words},
    )
    most = settings.closures.hypotheses
    assert called(searches["grid, as many"]) == (grid_hypotheses, {"count": most})
    assert called(searches["grid, exhaustive"]) == (grid_hypotheses, {"count": None})


def called(search: object) -> tuple[object, dict[str, object]]:
    """The function and the arguments of a partial call."""
    assert isinstance(search, partial)
    return search.func, search.keywords


def test_systems_differ_only_in_their_options() -> None:
    settings = load().resolved()
    by_name = {s.name: settings_of(s, settings, Path("random")) for s in OURS}
    assert by_name["ours"].query.length == 20
    assert by_name["ours, one frame"].query.length is None
    assert by_name["ours, one frame"].query.frames == 1
    assert by_name["ours, no labels"].labels.source == "geometry"
    assert by_name["random weights"].descriptor.weights == Path("random/random-weights.safetensors")
    assert by_name["ours"].fingerprint("fusion") == by_name["random weights"].fingerprint("fusion")


def test_links_share_the_maps_and_not_the_words(tmp_path: Path) -> None:
    source = Workspace(tmp_path / "a")
    target = Workspace(tmp_path / "b")
    folder = source.session("s")
    (folder.words).mkdir(parents=True)
    (folder.words / "w").write_text("words")
    folder.keyframes.mkdir()
    (folder.keyframes / "k").write_text("frame")
    folder.session_json.write_text("{}")
    link_workspace(source, target)
    linked = target.session("s")
    assert (linked.keyframes / "k").samefile(folder.keyframes / "k")
    assert linked.session_json.exists()
    assert not linked.words.exists()
    link_workspace(source, target)  # again: nothing to do


def test_cloud_frames_are_level_and_spaced() -> None:
    tilted = yaw_transform(0.4, (3.0, 4.0, 5.0)) @ np.array(
        [[1.0, 0, 0, 0], [0, 0.995, -0.0998, 0], [0, 0.0998, 0.995, 0], [0, 0, 0, 1]]
    )
    session = SimpleNamespace(map_T_base=tilted[None], distance=np.arange(20.0))
    assert cloud_frame(session, 0) == pytest.approx(yaw_transform(0.4, (3.0, 4.0, 5.0)), abs=1e-3)  # type: ignore[arg-type]
    assert database_keyframes(session, 5.0) == [0, 5, 10, 15]  # type: ignore[arg-type]


def test_a_peer_that_fails_or_is_not_there_is_an_error_of_ours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = tmp_path / "x_runner.py"
    monkeypatch.setattr(peer_process, "runner", lambda name: script)
    script.write_text("import sys; print(sys.argv[1])")
    assert peer_process.run_peer("x", sys.executable, ["said"], 60) == "said\n"
    script.write_text("raise ValueError('broken')")
    with pytest.raises(SemlocError, match="broken"):
        peer_process.run_peer("x", sys.executable, [], 60)
    with pytest.raises(SettingsError, match="x=PYTHON"):
        peer_process.run_peer("x", str(tmp_path / "none"), [], 60)


def test_local_maps_ranks_and_warms_up(tmp_path: Path) -> None:
    """The runners' shared part, with a peer whose score is the number of points."""
    folder = peer_process.runner("scan_context").parent
    rng = np.random.default_rng(0)
    for name, n in (("a", 5), ("b", 9), ("q", 3)):
        np.save(tmp_path / f"{name}.npy", rng.normal(size=(n, 3)).astype(np.float32))
    job = {
        "folder": str(tmp_path),
        "database": ["a", "b"],
        "queries": [{"cloud": "q", "candidates": [[0, 0.0], [1, 0.5]]}],
    }
    (tmp_path / "job.json").write_text(json.dumps(job))
    script = tmp_path / "runner.py"
    script.write_text(
        f"import sys; sys.path.insert(0, {str(folder)!r})\n"
        "from local_maps import run_pairs, turned\n"
        "run_pairs(lambda c: c, lambda d, q, yaw: (len(d), turned(yaw)))\n"
    )
    output = subprocess.run(
        [sys.executable, str(script), str(tmp_path / "job.json")],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    (query,) = json.loads(output)["queries"]
    assert [f[:2] for f in query["found"]] == [[1, 9.0], [0, 5.0]]
    assert np.reshape(query["found"][0][2], (4, 4)) == pytest.approx(yaw_transform(0.5))
