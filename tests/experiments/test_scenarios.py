"""Scenarios on streets of a few poses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from semloc_logs.evaluation.headings import heading_difference, in_window
from semloc_logs.experiments.scenarios import (
    EXCLUDED_VIEWS,
    Extent,
    heading_scenario,
    query_views,
    time_scenario,
)
from semloc_logs.experiments.view_pictures import PictureFolder
from semloc_logs.experiments.views import ViewStore

Make = Callable[..., ViewStore]

EAST = [(float(x), 0.0, 0.0) for x in range(-50, 51)]
NORTH = [(0.0, float(y), 90.0) for y in range(-50, 51)]
WEST = [(float(x), 3.5, 180.0) for x in range(50, -51, -1)]


def test_headings_differ_by_the_shorter_way_around() -> None:
    assert heading_difference(350.0, 10.0) == 20.0
    assert heading_difference(10.0, 190.0) == 180.0
    assert bool(in_window(5.0, 275.0, 90.0))
    assert bool(in_window(0.0, 110.0, 90.0))
    assert not bool(in_window(0.0, 110.5, 90.0))
    assert bool(in_window(0.0, 200.0, 180.0))


def test_the_database_of_90_degrees_has_crossing_streets_only(make_store: Make) -> None:
    store = make_store(map=[*EAST, *NORTH], drive=EAST)
    scenario = heading_scenario(store, 90.0, ["map"], ["drive"])
    (trial,) = scenario.trials
    assert set(store.headings_deg[trial.database].round().tolist()) == {90.0}
    assert len(trial.database) == len(NORTH)
    # twenty queries about the crossing at x = 0
    x = store.world_T_base[[q.view for q in trial.queries], 0, 3]
    assert (len(x), x.min(), x.max()) == (20, -10.0, 9.0)
    assert len({q.passage for q in trial.queries}) == 1


def test_the_opposite_lane_is_180_degrees_and_cut_into_passages(make_store: Make) -> None:
    store = make_store(map=[*EAST, *NORTH], drive=WEST)
    scenario = heading_scenario(store, 180.0, ["map"], ["drive"])
    (trial,) = scenario.trials
    assert set(store.headings_deg[trial.database].round().tolist()) == {0.0}
    assert len(trial.queries) == 100
    assert len({q.passage for q in trial.queries}) == 5


def test_0_degrees_keeps_the_views_of_all_headings(make_store: Make) -> None:
    store = make_store(map=[*EAST, *NORTH], drive=EAST)
    (trial,) = heading_scenario(store, 0.0, ["map"], ["drive"]).trials
    assert len(trial.database) == len(EAST) + len(NORTH)


def test_no_view_outside_of_the_window_meets_any_query_of_a_bend(make_store: Make) -> None:
    angles = np.arange(0.0, 60.0, 1.0)
    bend = [(40 * np.sin(np.radians(a)), 40 - 40 * np.cos(np.radians(a)), a) for a in angles]
    crossing = [(20.0, float(y), h) for y in range(-5, 20) for h in (75.0, 90.0, 105.0, 135.0)]
    store = make_store(map=crossing, drive=bend)
    scenario = heading_scenario(store, 90.0, ["map"], ["drive"])
    assert len(scenario.queries) == 20
    assert len(scenario.trials) > 1
    for trial in scenario.trials:
        for query in trial.queries:
            window = in_window(
                store.headings_deg[trial.database], store.headings_deg[query.view], 90.0
            )
            assert window.all()


def test_a_session_is_localised_in_itself_without_the_frames_about_the_query(
    make_store: Make,
) -> None:
    loop = [*EAST, *[(60.0, float(y), 90.0) for y in range(60)], *NORTH]
    store = make_store(drive=loop)
    scenario = heading_scenario(store, 90.0, ["drive"], ["drive"])
    assert scenario.queries
    for trial in scenario.trials:
        for query in trial.queries:
            assert (np.abs(trial.database - query.view) > EXCLUDED_VIEWS).all()


def test_queries_are_thinned_evenly_over_passages(make_store: Make) -> None:
    store = make_store(map=EAST, drive=WEST)
    scenario = heading_scenario(store, 180.0, ["map"], ["drive"], Extent(per_passage=4, most=8))
    passages = [q.passage for q in scenario.queries]
    assert len(passages) == 8
    assert sorted(set(passages)) == [0, 4]


def test_a_street_that_nobody_drove_at_the_heading_has_no_trials(make_store: Make) -> None:
    store = make_store(map=EAST, drive=EAST)
    assert heading_scenario(store, 90.0, ["map"], ["drive"]).trials == ()


def test_the_matrix_of_times_queries_the_mapped_road_only(make_store: Make) -> None:
    store = make_store(summer=EAST, snow=[(float(x), 2.0, 0.0) for x in range(201)])
    scenario = time_scenario(store, "summer>snow", "summer", "snow", Extent(most=15))
    (trial,) = scenario.trials
    x = store.world_T_base[[q.view for q in trial.queries], 0, 3]
    assert len(trial.queries) == 15
    # 10 m from (x, 2) to the map's end at (50, 0)
    assert x.max() == pytest.approx(59.0)
    assert scenario.name == "summer>snow"


def test_accumulated_queries_are_the_views_before_in_the_same_session(make_store: Make) -> None:
    store = make_store(map=EAST, drive=EAST)
    assert query_views(store, 120, 5) == [116, 117, 118, 119, 120]
    assert query_views(store, 102, 5) == [101, 102]
    assert query_views(store, 120, 1) == [120]


def test_a_store_without_pictures_leaves_the_other_alone(make_store: Make) -> None:
    store = make_store(map=[(0.0, 0.0, 0.0)])
    store.sessions[0].pictures = PictureFolder(Path("pictures"))
    assert not store.without_pictures().has_pictures
    assert store.has_pictures
    assert store.without_pictures()[0].picture is None
