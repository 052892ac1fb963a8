"""Several poses of a query in one target: each has its share, and one at most is accepted."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from semloc_logs.arrays import F64
from semloc_logs.closures.acceptance.consistency import place_odds
from semloc_logs.closures.acceptance.decide import decide
from semloc_logs.closures.acceptance.placements import pairs_of, place
from semloc_logs.closures.closure import Alignment
from semloc_logs.mapping.drift import UNMEASURED
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import inverse, yaw_transform
from tests.closures.acceptance.known_alignments import (
    MAP,
    MAPS,
    MODEL,
    ROAD,
    SETTINGS,
    accepted,
    alignment,
    decided,
    sentence,
    session,
)


def test_two_places_that_fit_alike_leave_each_other_no_certainty() -> None:
    outcomes = decided([alignment(25, 0.9999), alignment(25, 0.9999, target_keyframe=50)])
    for target_keyframe in (25, 50):  # odds of 9999, twice, and 1
        assert outcomes[25, target_keyframe].decision.probability == pytest.approx(9999 / 19999)
        assert "other places fit too: by itself this one has a probability of 0.50" in sentence(
            outcomes[25, target_keyframe]
        )
    outcomes = decided([alignment(25, 0.9999), alignment(25, 0.6, target_keyframe=50)])
    assert accepted(outcomes[25, 25])
    assert not accepted(outcomes[25, 50])


def test_of_a_street_that_the_target_drove_twice_one_place_is_accepted() -> None:
    """500 m of road lie between both, after which odometry may be 5 m off: they are not rivals."""
    twice = SimpleNamespace(
        map_T_base=np.tile(MAPS["b"].map_T_base, (2, 1, 1)),
        distance=np.r_[MAPS["b"].distance, 500.0 + MAPS["b"].distance],
        posed=True,
        drift=UNMEASURED,
    )
    maps = {**MAPS, "b": cast(SessionMap, twice)}
    again = dataclasses.replace(
        alignment(25, 0.998),
        target_keyframe=60 + 25,
        target_T_query=yaw_transform(0.0, (3.0, 0.0, 0.0)),
    )
    outcomes = decided([alignment(25, 0.999), again], maps)
    assert accepted(outcomes[25, 25])
    assert sentence(outcomes[25, 85]) == "another place of the same session fits better"


def shares(rows: list[Alignment], maps: dict[str, SessionMap] = MAPS) -> F64:
    """Mode shares (n,)."""
    placed = place(rows, maps, MODEL)
    return place_odds(placed, pairs_of(placed), placed.log_odds, 0.3).mode_share


@pytest.mark.parametrize(
    ("beside", "share"),  # odds of 3 : 2 and 1 : 4
    [
        (yaw_transform(0.0, (1.0, 0.0, 0.0)), 6 / 7),
        (yaw_transform(0.0, (1.9, 0.0, 0.0)), 6 / 7),
        # neighbours that agree with both are 1 m from either
        (yaw_transform(0.0, (2.1, 0.0, 0.0)), 1.0),
    ],
)
def test_of_two_poses_in_a_place_each_has_its_share(beside: F64, share: float) -> None:
    two = [alignment(25, 0.6), alignment(25, 0.2, beside)]
    assert shares(two, MAPS) == pytest.approx([share, 1 - share if share < 1 else 1])
    turned = dataclasses.replace(alignment(25, 0.2), target_T_query=yaw_transform(np.radians(9.0)))
    assert shares([two[0], turned], MAPS).tolist() == [1, 1]
    others = [alignment(25, 0.6), alignment(26, 0.2), alignment(25, 0.2, query="b", target="a")]
    assert shares(others, MAPS).tolist() == [1, 1, 1]


@pytest.mark.parametrize(
    "rotation", [np.diag([1.0, -1, -1]), np.eye(3)[[1, 2, 0]], np.eye(3)[[2, 0, 1]]]
)
def test_the_yaw_between_two_poses_does_not_rest_on_the_axes_of_the_base(rotation: F64) -> None:
    """The base is upside down, or one of its axes points up; the poses differ by 9 degrees of yaw,
    or by 1 degree.
    """
    axes = np.eye(4)
    axes[:3, :3] = rotation
    maps = {name: session(m.map_T_base @ axes) for name, m in MAPS.items()}
    for degrees, share in ((9.0, 1.0), (1.0, 6 / 7)):
        rows = [alignment(25, 0.6), alignment(25, 0.2)]
        turned = MAP @ ROAD[25] @ yaw_transform(np.radians(degrees))
        rows[1] = dataclasses.replace(rows[1], target_T_query=inverse(MAP @ ROAD[25]) @ turned)
        rows = [
            dataclasses.replace(a, target_T_query=inverse(axes) @ a.target_T_query @ axes)
            for a in rows
        ]
        assert shares(rows, maps)[0] == pytest.approx(share)


def test_neighbours_do_not_choose_among_the_poses_of_a_place() -> None:
    """Seen from opposite sides a street fits as well a metre further on, and neighbours agree with
    both.
    """
    sure = [alignment(k, 0.999) for k in range(20, 31) if k != 25]
    alone = decide([*sure, alignment(25, 0.96)], MAPS, SETTINGS, model=MODEL)
    assert [accepted(o) for o in alone if o.alignment.query_keyframe == 25] == [True]
    both = decide(
        [
            *sure,
            alignment(25, 0.96),
            alignment(25, 0.8, yaw_transform(0.0, (1.0, 0.0, 0.0))),  # odds of 6 : 1
        ],
        MAPS,
        SETTINGS,
        model=MODEL,
    )
    reasons = [sentence(o) for o in both if o.alignment.query_keyframe == 25]
    assert len(reasons) == 2
    assert "other poses fit this place too: this one has 86 % of the odds" in reasons[0]
    assert all(accepted(o) for o in both if o.alignment.query_keyframe != 25)
