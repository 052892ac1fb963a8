from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from semloc_logs.alignment.hypotheses import Hypothesis
from semloc_logs.alignment.query_map import view_centres
from semloc_logs.closures import matching
from semloc_logs.closures import target_surface as target_surface_module
from semloc_logs.closures.database import Database
from semloc_logs.closures.matching import (
    QueryContext,
    allowed_words,
    close_query,
    search_query,
)
from semloc_logs.closures.query import build_query
from semloc_logs.closures.target_surface import target_surface
from semloc_logs.closures.visibility import everything, visible_to
from semloc_logs.mapping.selection import road_distance
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import yaw_transform
from semloc_logs.settings import Settings
from semloc_logs.tables import contracts
from semloc_logs.tables.table import read_json, read_table, write_json, write_table
from semloc_logs.voxels.store import Keyframe, keep_keyframes, pose_columns
from semloc_logs.workspace import Workspace

VIEW = (8.0, 0.0, 1.0)  # where a camera looks, in the base frame


def drive_session(
    work: Workspace,
    name: str,
    road: NDArray[np.float64],
    submaps: list[tuple[int, int]],
    words: list[NDArray[np.float64]],
    saw: tuple[tuple[float, float], ...] = ((0.0, 5.0),),
    *,
    topics: tuple[str, ...] = ("/points",),
    sigma: float | None = None,
) -> SessionMap:
    """A session along ``road`` (n, 2), a keyframe every second, with words at ``words`` (m, 3)
    of each submap of keyframes.

    Each keyframe ``saw`` points ahead and to its left, metres, at the height of its number in
    decimetres, their ranges known to ``sigma``. The ``topics`` take turns.
    """
    folder = work.session(name)
    n = len(road)
    folder.keyframes.mkdir(parents=True)
    folder.words.mkdir()
    poses = np.array([yaw_transform(0.0, (x, y, 0.0)) for x, y in road])
    columns: dict[str, Any] = {
        "keyframe": np.arange(n),
        "stamp_ns": (np.arange(n) * 1e9).astype(np.int64),
        "log_time_ns": np.arange(n),
        "topic": [topics[i % len(topics)] for i in range(n)],
        "posed": [True] * n,
        "distance": road_distance(poses),
        "ground_z": np.zeros(n),
        "points": np.ones(n, np.int64),
        **{f"origin_{c}": np.zeros(n) for c in "xyz"},
        **{f"view_{c}": np.full(n, value) for c, value in zip("xyz", VIEW, strict=True)},
        **pose_columns(poses),
    }
    write_table(folder.frames, contracts.table("frames", columns), {})
    label = np.full(len(saw), 2, np.uint8)
    sigmas = None if sigma is None else np.full(len(saw), sigma, np.float32)
    clouds = [
        Keyframe(np.array([[*p, 0.1 * i] for p in saw], np.float32), label, sigmas)
        for i in range(n)
    ]
    list(keep_keyframes(folder.keyframes, range(n), clouds, {}))
    for i, centre in enumerate(words):
        rows = {
            "submap": np.full(len(centre), i),
            **{c: centre[:, k] for k, c in enumerate("xyz")},
            "yaw": np.zeros(len(centre)),
            "word": np.zeros(len(centre)),
            "code": np.zeros(len(centre)),
            "variant": ["semantic"] * len(centre),
        }
        write_table(folder.words / f"submap-{i:05d}.parquet", contracts.table("words", rows), {})
    json = [
        {"id": i, "first": a, "last": b - 1, "ground_z": 0.0, "blocks": 1}
        for i, (a, b) in enumerate(submaps)
    ]
    write_json(folder.session_json, {"posed": True, "label_source": "log", "submaps": json})
    return SessionMap(folder)


@pytest.fixture
def out_and_back(tmp_path: Path) -> tuple[Database, SessionMap]:
    """30 keyframes out, and back beside them 4 m to the left, one every 4 m and second; one submap
    holds both ways.
    """
    x = np.r_[np.arange(30) * 4.0, np.arange(30)[::-1] * 4.0]
    road = np.stack([x, np.repeat([0.0, 4.0], 30)], 1)
    words = np.array([[4.0, 2.0, 1.0], [60.0, 2.0, 1.0], [112.0, 2.0, 1.0]])
    session = drive_session(Workspace(tmp_path), "a", road, [(0, 60)], [words])
    return Database(Workspace(tmp_path), ("a",), Settings().resolved()), session


def test_a_query_sees_its_own_drive_but_for_what_is_near_in_time_and_road(
    out_and_back: tuple[Database, SessionMap],
) -> None:
    database, session = out_and_back
    seen = visible_to(database, session, 59).keyframes(0)
    # 30 s: keyframes 30 to 59; 50 m of road are fewer; what else lies in the same stretch of 16
    # voxels goes with them
    assert seen[0] == 0
    assert 28 <= seen[-1] <= 29
    assert np.array_equal(seen, np.arange(seen[-1] + 1))
    middle = visible_to(database, session, 5).keyframes(0)
    assert 35 <= middle[0] <= 36
    assert middle[-1] == 59
    assert len(everything(database).keyframes(0)) == 60


@pytest.mark.parametrize(
    ("seconds", "distance", "first_hidden"),
    [
        (10.0, 0.0, 50),  # a keyframe a second: 50 to 59 are nearer in time than 10 s
        (0.0, 60.0, 45),  # a keyframe every 4 m: 45 to 59 are nearer along the road than 60 m
        (10.0, 60.0, 45),
        (20.0, 60.0, 40),
        (0.0, 0.0, 59),  # itself
    ],
)
def test_time_and_road_each_hide_what_is_nearer_than_their_setting(
    out_and_back: tuple[Database, SessionMap],
    tmp_path: Path,
    seconds: float,
    distance: float,
    first_hidden: int,
) -> None:
    _, session = out_and_back
    settings = Settings.model_validate(
        {"closures": {"exclude_seconds": seconds, "exclude_distance": distance}}
    ).resolved()
    database = Database(Workspace(tmp_path), ("a",), settings)
    seen = visible_to(database, session, 59).keyframes(0)
    # a stretch of 4.8 m is hidden as a whole, and with it one keyframe more at most
    assert seen.tolist() in (list(range(first_hidden)), list(range(first_hidden - 1)))
    middle = visible_to(database, session, 30).keyframes(0)
    reach = 59 - first_hidden
    assert {30 - reach, 30, 30 + reach}.isdisjoint(middle.tolist())
    assert {30 - reach - 2, 30 + reach + 2} <= set(middle.tolist())


def test_submaps_of_which_nothing_may_be_seen_are_left_out(tmp_path: Path) -> None:
    road = np.stack([np.arange(60) * 4.0, np.zeros(60)], 1)
    none = np.zeros((0, 3))
    session = drive_session(Workspace(tmp_path), "a", road, [(0, 30), (30, 60)], [none, none])
    drive_session(Workspace(tmp_path), "b", road, [(0, 60)], [none])
    database = Database(Workspace(tmp_path), ("a", "b"), Settings().resolved())
    assert everything(database).submaps().tolist() == [True, True, True]
    assert visible_to(database, session, 0).submaps().tolist() == [False, True, True]


def test_a_target_keyframe_is_never_near_the_query_in_time(
    out_and_back: tuple[Database, SessionMap],
) -> None:
    database, session = out_and_back
    for keyframe in range(60):
        view = visible_to(database, session, keyframe)
        if len(view.keyframes(0)):
            nearest = view.nearest_keyframe(0, session.map_T_base[keyframe, :3, 3])
            assert abs(nearest - keyframe) >= 30


def test_of_two_passes_the_one_that_looks_at_a_place_is_found(
    out_and_back: tuple[Database, SessionMap],
) -> None:
    database, session = out_and_back
    position = session.map_T_base[20, :3, 3]
    viewing = everything(database).viewing_keyframe(0, position + VIEW)
    np.testing.assert_allclose(session.map_T_base[viewing, :3, 3], position)
    assert everything(database).viewing_keyframe(0, position + VIEW) != everything(
        database
    ).nearest_keyframe(0, position + VIEW)


def test_the_keyframe_nearest_to_a_place_may_lie_in_the_next_submap_but_is_never_hidden(
    tmp_path: Path,
) -> None:
    road = np.stack([np.arange(60) * 4.0, np.zeros(60)], 1)
    none = np.zeros((0, 3))
    session = drive_session(Workspace(tmp_path), "a", road, [(0, 30), (30, 60)], [none, none])
    database = Database(Workspace(tmp_path), ("a",), Settings().resolved())
    assert everything(database).nearest_keyframe(0, np.array([128.0, 0.0, 0.0])) == 32
    assert everything(database).nearest_keyframe(1, np.array([108.0, 0.0, 0.0])) == 27
    # 28.8 m of road beyond the last one
    assert everything(database).nearest_keyframe(0, np.array([200.0, 0.0, 0.0])) == 36
    # hides 30 to 59 and what shares a stretch of 4.8 m with them
    view = visible_to(database, session, 59)
    assert 28 <= view.nearest_keyframe(0, np.array([128.0, 0.0, 0.0])) < 30


def test_beyond_the_end_of_a_drive_a_surface_has_what_was_seen_from_afar(tmp_path: Path) -> None:
    road = np.stack([np.arange(10) * 4.0, np.zeros(10)], 1)
    drive_session(
        Workspace(tmp_path), "a", road, [(0, 10)], [np.zeros((0, 3))], saw=((0.0, 5.0), (45.0, 5.0))
    )
    database = Database(Workspace(tmp_path), ("a",), Settings().resolved())
    at_the_end, beyond = (
        target_surface(everything(database), 0, np.array([x, 0.0, 0.0])).surface.points[:, 0].max()
        for x in (36.0, 70.0)
    )
    assert at_the_end == 36.0  # of each keyframe what lies within 28.8 m of it
    assert beyond == 36.0 + 45.0


def test_a_surface_is_made_from_so_many_keyframes(tmp_path: Path) -> None:
    """Keyframe i saw a point at a height of i decimetres; the nearest ones are about number 5."""
    road = np.stack([np.arange(10) * 4.0, np.zeros(10)], 1)
    drive_session(Workspace(tmp_path), "a", road, [(0, 10)], [np.zeros((0, 3))])

    def heights(count: int) -> list[int]:
        settings = Settings.model_validate({"closures": {"surface_keyframes": count}}).resolved()
        database = Database(Workspace(tmp_path), ("a",), settings)
        surface = target_surface(everything(database), 0, np.array([20.0, 0.0, 0.0]) + VIEW).surface
        return sorted(np.rint(surface.points[:, 2] * 10).astype(int).tolist())

    assert heights(1) == [5]
    assert heights(3) == [4, 5, 6]
    assert heights(100) == list(range(10))


def test_a_surface_of_a_long_query_has_so_many_keyframes_for_each_radius(tmp_path: Path) -> None:
    """About number 5 lie 5 keyframes within half of 16 m, 9 within half of 36 m."""
    road = np.stack([np.arange(11) * 4.0, np.zeros(11)], 1)
    drive_session(Workspace(tmp_path), "a", road, [(0, 11)], [np.zeros((0, 3))])

    def heights(length: float) -> list[int]:
        given = {"closures": {"surface_keyframes": 3}, "query": {"length": length}}
        database = Database(Workspace(tmp_path), ("a",), Settings.model_validate(given).resolved())
        surface = target_surface(everything(database), 0, np.array([20.0, 0.0, 0.0]) + VIEW).surface
        return sorted(np.rint(surface.points[:, 2] * 10).astype(int).tolist())

    assert heights(16.0) == [3, 5, 7]  # three of five: less than a radius, 24 m
    assert heights(36.0) == [1, 3, 5, 7, 9]  # one and a half radii: 4.5, so five of nine


@pytest.mark.parametrize(
    ("sigma", "topics", "chosen"),
    [
        (None, ("/points",), [4, 5, 6]),
        (0.02, ("/points",), [4, 5, 6]),
        (0.2, ("/points",), [2, 4, 6]),  # of the six nearest, 2 to 7
        (0.2, ("/left", "/right"), [2, 3, 6, 7]),  # of 2, 4 and 6, and of 3, 5 and 7
    ],
)
def test_of_uncertain_ranges_every_second_keyframe_of_a_longer_stretch_makes_the_surface(
    tmp_path: Path, sigma: float | None, topics: tuple[str, ...], chosen: list[int]
) -> None:
    road = np.stack([np.arange(10) * 4.0, np.zeros(10)], 1)
    none = np.zeros((0, 3))
    drive_session(Workspace(tmp_path), "a", road, [(0, 10)], [none], topics=topics, sigma=sigma)
    settings = Settings.model_validate({"closures": {"surface_keyframes": 3}}).resolved()
    database = Database(Workspace(tmp_path), ("a",), settings)
    surface = target_surface(everything(database), 0, np.array([20.0, 0.0, 0.0]) + VIEW)
    assert surface.keyframes.tolist() == chosen


@pytest.mark.parametrize(
    ("topics", "middles"),
    [
        (("/points",), [2, 2, 7]),  # of stretches of 4.8 m: numbers 0 to 4, and 5 to 9
        (("/left", "/right"), [2, 3, 7]),  # of 0, 2 and 4; of 1 and 3; of 5, 7 and 9
    ],
)
def test_queries_at_one_stretch_and_sensor_share_its_middle_keyframe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, topics: tuple[str, ...], middles: list[int]
) -> None:
    road = np.stack([np.arange(10.0), np.zeros(10)], 1)
    none = np.zeros((0, 3))
    drive_session(Workspace(tmp_path), "a", road, [(0, 10)], [none], topics=topics)
    seen: list[Any] = []
    monkeypatch.setattr(target_surface_module, "_surface", lambda surface: seen.append(surface))
    for number in (0, 1, 9):
        database = Database(Workspace(tmp_path), ("a",), Settings().resolved())
        target_surface(everything(database), 0, np.array([number, 0.0, 0.0]) + VIEW)
    assert [surface.middle for surface in seen] == middles


def test_places_of_one_square_share_what_was_seen_from_afar_about_its_centre(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    road = np.stack([np.arange(10) * 4.0, np.zeros(10)], 1)
    drive_session(Workspace(tmp_path), "a", road, [(0, 10)], [np.zeros((0, 3))])
    seen: list[Any] = []
    monkeypatch.setattr(target_surface_module, "_surface", lambda surface: seen.append(surface))
    for x in (72.1, 76.7, 76.9):  # squares of 4.8 m: 72 to 76.8, and the next
        database = Database(Workspace(tmp_path), ("a",), Settings().resolved())
        target_surface(everything(database), 0, np.array([x, 1.0, -1.0]))
    np.testing.assert_allclose(
        [surface.afar for surface in seen],
        [[74.4, 2.4, -2.4], [74.4, 2.4, -2.4], [79.2, 2.4, -2.4]],
    )
    # half a radius from the last view, 12 m, is not afar
    target_surface(everything(database), 0, np.array([36.0 + 12.0, 0.0, 0.0]) + VIEW)
    assert seen[-1].afar is None


def test_what_looks_all_around_looks_where_it_is() -> None:
    """At 0.30 m voxels a mean of the points 6 m ahead is a view, one of 5 m is not."""
    centres = view_centres(np.zeros((2, 3)), np.array([[5.9, 0.0, 0.0], [6.1, 0.0, 0.0]]), 0.3)
    np.testing.assert_allclose(centres, [[0.0, 0.0, 0.0], [6.1, 0.0, 0.0]])


def test_words_answer_where_the_drive_came_by_at_another_time(
    out_and_back: tuple[Database, SessionMap],
) -> None:
    database, session = out_and_back

    def answering(keyframe: int) -> list[float]:
        view = visible_to(database, session, keyframe)
        rows = allowed_words(view, session)["semantic"].rows[0]
        return sorted(
            read_table(session.folder.words / "submap-00000.parquet")["x"].to_numpy()[rows].tolist()
        )

    # back at the start: all of the way out is older than 30 s
    assert answering(59) == [4.0, 60.0, 112.0]
    # half-way back: the turn is recent, and the way out before it is not
    assert answering(45) == [4.0, 60.0]


def test_the_map_of_a_submap_that_comes_near_the_query_is_made_without_what_it_may_not_see(
    out_and_back: tuple[Database, SessionMap],
) -> None:
    database, session = out_and_back
    view = visible_to(database, session, 59)
    ijk, _ = view.target(0).blocks.occupied()
    newest = view.keyframes(0)[-1]
    assert set(ijk[:, 2].tolist()) == {int(0.1 * i / 0.3 + 1e-6) for i in range(newest + 1)}


def test_a_drive_without_revisits_does_not_answer_itself(tmp_path: Path) -> None:
    road = np.stack([np.arange(20) * 4.0, np.zeros(20)], 1)
    session = drive_session(
        Workspace(tmp_path), "a", road, [(0, 20)], [np.array([[40.0, 2.0, 1.0]])]
    )
    view = visible_to(Database(Workspace(tmp_path), ("a",), Settings().resolved()), session, 10)
    assert allowed_words(view, session) == {}


def test_other_sessions_answer_whatever_their_time(tmp_path: Path) -> None:
    work = Workspace(tmp_path)
    road = np.stack([np.arange(20) * 4.0, np.zeros(20)], 1)
    word = np.array([[40.0, 2.0, 1.0]])
    sessions = {name: drive_session(work, name, road, [(0, 20)], [word]) for name in "ab"}
    view = visible_to(Database(work, ("a", "b"), Settings().resolved()), sessions["a"], 10)
    allowed = allowed_words(view, sessions["a"])["semantic"]
    assert (allowed.groups.tolist(), allowed.rows) == ([False, True], {})
    assert len(view.keyframes(1)) == 20


def test_a_drive_without_poses_does_not_answer_itself(tmp_path: Path) -> None:
    work = Workspace(tmp_path)
    session = drive_session(
        work, "a", np.zeros((100, 2)), [(0, 100)], [np.array([[0.0, 2.0, 1.0]])]
    )
    write_json(
        session.folder.session_json, read_json(session.folder.session_json) | {"posed": False}
    )
    database = Database(work, ("a",), Settings().resolved())
    view = visible_to(database, SessionMap(session.folder), 99)
    assert allowed_words(view, session) == {}


@pytest.mark.parametrize(
    ("query", "targets", "semantic", "geometric"),
    [
        ("log", ("log", "geometry"), [True, False], [False, True]),
        ("onnx", ("log", "onnx"), [True, True], None),
        ("geometry", ("log", "geometry"), None, [True, True]),
    ],
)
def test_classes_are_compared_where_both_sides_know_them(
    tmp_path: Path,
    query: str,
    targets: tuple[str, str],
    semantic: list[bool] | None,
    geometric: list[bool] | None,
) -> None:
    work = Workspace(tmp_path)
    road = np.stack([np.arange(20) * 4.0, np.zeros(20)], 1)
    for name, source in zip("qab", (query, *targets), strict=True):
        folder = drive_session(work, name, road, [(0, 20)], [np.zeros((0, 3))]).folder
        write_json(folder.session_json, read_json(folder.session_json) | {"label_source": source})
    database = Database(work, ("a", "b"), Settings().resolved())
    by_variant = allowed_words(everything(database), SessionMap(work.session("q")))
    expected = {"semantic": semantic, "geometric": geometric}
    assert {variant: allowed.groups.tolist() for variant, allowed in by_variant.items()} == {
        k: x for k, x in expected.items() if x
    }


def test_a_query_searches_where_it_is_told(out_and_back: tuple[Database, SessionMap]) -> None:
    database, session = out_and_back
    searched = []

    def find(context: QueryContext) -> list[Hypothesis]:
        sees_less = len(context.visible.keyframes(0)) < 60
        has_structure = len(context.query.structure[0]) > 0
        searched.append((context.session, context.keyframe, sees_less, has_structure))
        return []

    assert close_query(database, session, 5, find) == []
    assert searched == [(session, 5, True, True)]


@pytest.mark.parametrize(("least", "verified"), [(1.8, 1), (1.9, 0)])
def test_a_query_is_not_verified_where_no_hypothesis_agrees_enough(
    out_and_back: tuple[Database, SessionMap],
    least: float,
    verified: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    database, session = out_and_back
    pose = (0.0, 0.0, 0.0, 0.0)
    hypotheses = [Hypothesis(0, pose, 1, 1.0, 25.0), Hypothesis(0, pose, 9, 9.0, 25.0)]
    calls: list[list[Hypothesis]] = []

    def verify(context: QueryContext, hypotheses: list[Hypothesis]) -> list[Any]:
        calls.append(hypotheses)
        return []

    monkeypatch.setattr(matching, "verify_hypotheses", verify)
    built = build_query(session, 5, database.settings)
    search_query(database, session, 5, built, lambda _: hypotheses, least_agreement=least)
    assert calls == [hypotheses] * verified
