"""The plan of the simulated drives, without simulating them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from semloc_logs.experiments.paper import FULL
from semloc_logs.experiments.scenarios import NEAR_M, heading_scenario, time_scenario
from semloc_logs.experiments.simulated_drives import (
    AGAIN,
    BACK,
    MAP,
    TIMES,
    SimulatedDrive,
    Town,
    full_town,
    quick_town,
    time_session,
)
from semloc_logs.experiments.views import ViewStore

Make = Callable[..., ViewStore]


def places(town: Town, drive: SimulatedDrive) -> list[tuple[float, float, float]]:
    """Where views are taken along a drive at its usual speed."""
    step = round(2 * town.speed / town.rate_hz)
    ahead = np.gradient(drive.line, axis=0)
    heading = np.degrees(np.arctan2(ahead[:, 1], ahead[:, 0]))
    return [(*xy, h) for xy, h in zip(drive.line[::step].tolist(), heading[::step], strict=True)]


def store_of(town: Town, make_store: Make) -> ViewStore:
    return make_store(**{d.name: places(town, d) for d in town.drives})


@pytest.mark.parametrize("heading", [0.0, 90.0, 180.0])
def test_the_full_town_has_a_hundred_queries_at_every_heading(
    make_store: Make, heading: float
) -> None:
    store = store_of(full_town(), make_store)
    scenario = heading_scenario(store, heading, [MAP], [AGAIN, BACK], FULL)
    assert len(scenario.queries) >= 100
    assert len({q.passage for q in scenario.queries}) >= 6
    # every query has a view of its database nearby that it could be localised with
    place = store.world_T_base[:, :3, 3]
    for trial in scenario.trials:
        for query in trial.queries:
            away = np.linalg.norm(place[trial.database] - place[query.view], axis=1)
            # two metres more where the window of the others leaves out the nearest one
            assert away.min() <= 2 * NEAR_M + 2.0


def test_the_full_matrix_has_every_two_conditions(make_store: Make) -> None:
    town = full_town()
    store = store_of(town, make_store)
    assert len(town.pairs) == 16
    for one, other in town.pairs:
        sessions = (time_session(one, is_query=False), time_session(other, is_query=True))
        scenario = time_scenario(store, f"{one.name}>{other.name}", *sessions, FULL)
        assert len(scenario.queries) >= 100


def test_the_quick_town_has_queries_in_every_scenario(make_store: Make) -> None:
    town = quick_town()
    store = store_of(town, make_store)
    for heading in (0.0, 90.0, 180.0):
        scenario = heading_scenario(store, heading, [MAP], [AGAIN, BACK])
        assert len(scenario.queries) >= 2
        # straight streets: a database for each direction, and across one for both
        assert len(scenario.trials) <= (2 if heading == 180 else 1)
    assert [(one.name, other.name) for one, other in town.pairs] == [
        ("summer", "summer"),
        ("summer", "snow"),
    ]
    assert sum(len(places(town, d)) for d in town.drives) < 150


def test_the_drive_back_is_in_the_other_lane_and_direction() -> None:
    there, _, back = quick_town().drives[:3]
    street = there.line[:100]
    away = np.linalg.norm(street[:, None] - back.line[None], axis=2).min(axis=0)
    assert away == pytest.approx(np.full(len(back.line), 3.5), abs=0.1)
    ahead = np.diff(there.line[30:32], axis=0)[0]
    behind = np.diff(back.line[30:32], axis=0)[0]
    assert ahead @ behind / np.linalg.norm(ahead) / np.linalg.norm(behind) < -0.99


def test_houses_change_in_all_conditions_but_the_first() -> None:
    drives = {d.name: d.condition for d in full_town().drives}
    assert drives["summer_map"].rebuilt == drives["summer_query"].rebuilt == 0.0
    assert drives["snow_map"].rebuilt > 0
    assert drives["snow_query"].season == "snow"
    assert len({d.number for d in drives.values()}) == 3 + 2 * len(TIMES)
