from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from semloc_logs.alignment.hypotheses import ODOMETRY_DRIFT
from semloc_logs.closures.acceptance.calibration import (
    Calibration,
    Model,
    log_odds,
)
from semloc_logs.closures.acceptance.consistency import (
    MIN_VOTE,
    MOST_SLACK,
    NEAR,
    SLACK,
    TURN,
    TURN_DRIFT,
    _sums,
    count_votes,
    place_odds,
)
from semloc_logs.closures.acceptance.decide import decide
from semloc_logs.closures.acceptance.placements import (
    ARM,
    FAR,
    Placed,
    contradicts_odometry,
    pairs_of,
    place,
    posed_pairs,
    query_roads,
)
from semloc_logs.closures.closure import (
    Agreement,
    Alignment,
    Closure,
    Features,
    Rejected,
    Veto,
)
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import inverse, yaw_transform
from semloc_logs.settings import STREET_VOXEL, Settings

F64 = NDArray[np.float64]
Outcome = Closure | Rejected
SETTINGS = Settings().resolved()
MAP = yaw_transform(0.7, (40.0, -20.0, 1.0))  # target map from query map
GOOD = Features(0.9, 0.9, 0.0, 0.9, 3.5, 3.0, 0.0)
ANYTHING = (-50.0,) * 3, (50.0,) * 3, (0.0,) * 3
# the stiffness of an alignment is its log-odds
MODEL = Model(
    Calibration((0.0, 1.0, 0.0), *ANYTHING, 0.0),
    Calibration((2.0, -3.0, 1.0, -1.0), (0.0,) * 4, (3.0,) * 4, (0.0,) * 4, 0.0),
    50.0,
    0.125,
)


def bend(n: int, step: float = 2.0) -> F64:
    """A bent road (n, 4, 4), a keyframe every ``step`` metres."""
    poses = [np.eye(4)]
    for _ in range(n - 1):
        poses.append(poses[-1] @ yaw_transform(0.02, (step, 0.0, 0.0)))
    return np.array(poses)


def session(poses: F64, posed: bool = True) -> SessionMap:
    return cast(
        SessionMap,
        SimpleNamespace(map_T_base=poses, distance=2.0 * np.arange(len(poses)), posed=posed),
    )


ROAD = bend(60)
MAPS = {"a": session(ROAD), "b": session(MAP @ ROAD)}


def alignment(
    k: int,
    alone: float,
    error: F64 | None = None,
    query: str = "a",
    target: str = "b",
    target_keyframe: int | None = None,
) -> Alignment:
    """Query ``k`` aligned at the true place, or moved by ``error`` in the target's map; or at
    ``target_keyframe``.
    """
    target_keyframe = k if target_keyframe is None else target_keyframe
    moved = (np.eye(4) if error is None else error) @ MAPS[target].map_T_base[target_keyframe]
    return Alignment(
        query,
        target,
        k,
        target_keyframe,
        k,
        target_keyframe,
        inverse(MAPS[target].map_T_base[target_keyframe]) @ moved,
        np.eye(6) * 1e-4,
        0.8,
        900,
        5,
        dataclasses.replace(GOOD, stiffness=float(log_odds(np.array(alone)))),
    )


def decided(
    rows: list[Alignment], maps: dict[str, SessionMap] | None = None
) -> dict[tuple[int, int], Outcome]:
    out = decide(rows, maps or MAPS, SETTINGS, model=MODEL)
    assert len(out) == len(rows)
    return {(o.alignment.query_keyframe, o.alignment.target_keyframe): o for o in out}


def accepted(outcome: Outcome) -> bool:
    return isinstance(outcome, Closure)


def sentence(outcome: Outcome) -> str:
    assert isinstance(outcome, Rejected)
    return outcome.sentence


def test_neighbours_of_one_transform_agree_and_are_counted_by_hand() -> None:
    outcomes = decided([alignment(k, 0.5) for k in range(20, 31)])
    middle = outcomes[25, 25].decision.agreement
    assert (middle.neighbours, round(middle.support, 9), middle.conflict) == (10, 5.0, 0.0)
    assert outcomes[20, 20].decision.agreement.neighbours == 10  # all within 25 m of road
    far = decided([alignment(k, 0.5) for k in (10, 30, 50)])[30, 30].decision.agreement
    assert (far.neighbours, far.support, round(far.far_support, 9)) == (0, 0.0, 1.0)


def test_one_that_lies_elsewhere_opposes_and_is_opposed() -> None:
    moved = yaw_transform(0.0, (8.0, 0.0, 0.0))
    rows = [alignment(k, 0.9, moved if k == 25 else None) for k in range(20, 31)]
    outcomes = decided(rows)
    assert outcomes[25, 25].decision.agreement.conflict == pytest.approx(9.0)
    assert outcomes[25, 25].decision.agreement.support == 0.0
    assert outcomes[24, 24].decision.agreement.conflict == pytest.approx(0.9)
    assert outcomes[24, 24].decision.agreement.support == pytest.approx(0.9 * 9)
    assert outcomes[25, 25].decision.probability < outcomes[24, 24].decision.probability


@pytest.mark.parametrize(("off", "agrees"), [(0.3, True), (3.0, False)])
def test_what_odometry_may_drift_is_no_contradiction(off: float, agrees: bool) -> None:
    rows = [alignment(20, 0.9), alignment(24, 0.9, yaw_transform(0.0, (off, 0.0, 0.0)))]
    a = decided(rows)[20, 20].decision.agreement
    assert (a.support > 0) == agrees
    assert (a.conflict > 0) == (not agrees)


def test_a_turned_neighbour_does_not_agree() -> None:
    here = MAP @ ROAD[24]
    turned = here @ yaw_transform(0.4) @ inverse(here)
    assert decided([alignment(20, 0.9), alignment(24, 0.9, turned)])[
        20, 20
    ].decision.agreement.conflict == pytest.approx(0.9)


def test_neighbours_rescue_a_right_one_and_a_second_choice_that_agrees_is_promoted() -> None:
    rows = [alignment(k, 0.995) for k in range(20, 31) if k != 25] + [
        alignment(25, 0.9),
        alignment(25, 0.95, target_keyframe=50),
    ]
    first, second = (
        o for o in decide(rows, MAPS, SETTINGS, model=MODEL) if o.alignment.query_keyframe == 25
    )
    # odds of 9 and 19 and 1 for neither
    assert first.alignment.target_keyframe == 25
    assert first.decision.agreement.own_probability == pytest.approx(9 / 29)
    assert second.alignment.target_keyframe == 50
    assert second.decision.agreement.own_probability == pytest.approx(19 / 29)
    assert accepted(first)
    assert "neighbouring queries conflict" not in sentence(second)
    assert second.decision.probability < 0.01


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


def test_sessions_that_overlap_each_other_do_not_contradict() -> None:
    maps = {**MAPS, "c": session(yaw_transform(2.0, (500.0, 0.0, 0.0)) @ MAP @ ROAD)}
    rows = [alignment(k, 0.99) for k in range(20, 31)]
    both = rows + [dataclasses.replace(a, target_session="c") for a in rows]
    for a in decide(both, maps, SETTINGS, model=MODEL):
        assert (a.decision.agreement.neighbours, a.decision.agreement.conflict) == (10, 0.0)


@given(st.integers(0, 10_000), st.integers(1, 4))
@settings(max_examples=25, deadline=None)
def test_sessions_that_do_not_meet_a_pair_change_nothing_of_it(seed: int, others: int) -> None:
    """Sessions elsewhere, and improbable alignments of the pair's queries in them."""
    rng = np.random.default_rng(seed)
    rows = [alignment(k, float(rng.uniform(0.5, 0.9999))) for k in range(10, 40)]
    names = [f"other_{n}" for n in range(others)]
    maps = MAPS | {name: session(ROAD) for name in names}
    more = [
        dataclasses.replace(
            alignment(k, float(rng.uniform(1e-6, 1e-3)), target_keyframe=int(rng.integers(60))),
            target_session=name,
        )
        for name in names
        for k in range(10, 40)
    ]
    among_themselves = [
        dataclasses.replace(alignment(k, 0.999), query_session=name, target_session=names[0])
        for name in names[1:]
        for k in range(50)
    ]

    def of_pair(outcomes: Sequence[Outcome]) -> list[tuple[int, Any, bool]]:
        pair = [o for o in outcomes if o.alignment.target_session == "b"]
        return [(o.alignment.query_keyframe, o.decision, accepted(o)) for o in pair]

    queries = {"a": range(10, 40)}
    alone, together = (
        decide(some, maps, SETTINGS, queries, MODEL)
        for some in (rows, rows + more + among_themselves)
    )
    assert of_pair(together) == of_pair(alone)


STRAIGHT = np.array([yaw_transform(0.0, (2.0 * i, 0.0, 0.0)) for i in range(100)])
STREETS = {"a": session(STRAIGHT), "b": session(STRAIGHT), "c": session(STRAIGHT)}
COPIED = range(20, 40)


def in_street(k: int, target_keyframe: int, query: str = "a", target: str = "b") -> Alignment:
    here = {
        "query_session": query,
        "target_session": target,
        "target_keyframe": target_keyframe,
        "target_stamp_ns": target_keyframe,
        "target_T_query": np.eye(4),
    }
    return dataclasses.replace(alignment(k, 0.999), **here)  # type: ignore[arg-type]


def test_its_own_odometry_refutes_a_closure_of_a_session_with_itself() -> None:
    refuted, right = sorted(
        decide([in_street(5, 50, target="a"), in_street(5, 5)], STREETS, SETTINGS, model=MODEL),
        key=lambda o: o.alignment.target_session,
    )
    assert refuted.decision.vetoes == {Veto.CONTRADICTS_ODOMETRY}
    assert "contradicts the session's own odometry" in sentence(refuted)
    assert right.decision.probability > 0.9


@pytest.mark.parametrize(
    ("off", "way", "refuted"),  # 10 voxels = 3 m, and 5 % of the way
    [
        (2.9, 0.0, False),
        (3.1, 0.0, True),
        (7.9, 100.0, False),
        (8.1, 100.0, True),
        (7.9, -100.0, False),
    ],
)
def test_how_far_off_its_own_odometry_a_session_may_be(
    off: float, way: float, refuted: bool
) -> None:
    def placed(query: str, target: str, posed: bool = True) -> Placed:
        target_T_query = yaw_transform(0.0, (0.0, off, 0.0))[None]
        half = np.full(1, 0.5)
        return Placed(
            np.array([query], object),
            np.array([target], object),
            np.zeros(1, np.int64),
            np.array([150.0]),
            np.array([150.0 + way]),
            np.eye(4)[None],
            target_T_query,
            half,
            half,
            np.array([posed]),
        )

    assert contradicts_odometry(placed("a", "a"), 0.3).tolist() == [refuted]
    assert contradicts_odometry(placed("a", "b"), 0.3).tolist() == [False]
    assert contradicts_odometry(placed("a", "a", posed=False), 0.3).tolist() == [False]


def test_roads_of_queries_are_counted_once_whatever_answers() -> None:
    rows = [
        alignment(30, 0.5),
        alignment(20, 0.5),
        alignment(20, 0.5, target_keyframe=50),
        alignment(40, 0.5, query="b", target="a"),
    ]
    roads = query_roads(place(rows, MAPS, MODEL))
    assert {name: road.tolist() for name, road in roads.items()} == {"a": [40.0, 60.0], "b": [80.0]}


def test_alignments_of_one_pair_of_sessions_belong_together() -> None:
    rows = [
        alignment(30, 0.5),
        alignment(20, 0.5),
        alignment(40, 0.5, query="b", target="a"),
        alignment(25, 0.5),
    ]
    both = {("a", "b"): [1, 3, 0], ("b", "a"): [2]}
    placed = place(rows, MAPS, MODEL)
    assert {pair: r.tolist() for pair, r in pairs_of(placed).items()} == both
    assert {pair: r.tolist() for pair, r in posed_pairs(placed, pairs_of(placed)).items()} == both
    placed = place(rows, {"a": session(ROAD, posed=False), "b": MAPS["b"]}, MODEL)
    pairs = pairs_of(placed)
    assert {pair: r.tolist() for pair, r in pairs.items()} == both
    assert {pair: r.tolist() for pair, r in posed_pairs(placed, pairs).items()} == {("b", "a"): [2]}


def test_streets_that_a_target_has_twice_are_not_accepted_there_nor_anywhere_else() -> None:
    once = [in_street(k, k, target="c") for k in COPIED]
    assert all(
        accepted(a) and a.decision.agreement.ambiguity == 0
        for a in decide(once, STREETS, SETTINGS, model=MODEL)
    )
    # the second place of each fits less well, so the veto alone rejects them
    twice = [
        dataclasses.replace(
            in_street(k, k + off), features=dataclasses.replace(GOOD, stiffness=fits)
        )
        for k in COPIED
        for off, fits in ((0, 12.0), (30, 4.0))
    ]
    there = [in_street(k, k, "c", "a") for k in COPIED]
    back = [in_street(k, k, "b", "c") for k in COPIED]
    outcomes = decide(once + twice + there + back, STREETS, SETTINGS, model=MODEL)
    assert all(a.decision.agreement.ambiguity > 0.9 for a in outcomes)
    assert not any(accepted(a) for a in outcomes)
    assert sum("ambiguous place" in sentence(a) for a in outcomes) == len(outcomes) - len(COPIED)


def test_two_queries_of_a_street_do_not_make_all_of_it_look_like_others() -> None:
    right = [in_street(k, k, target="c") for k in range(2, 60)]
    twice = [
        in_street(k, target_keyframe) for k in (30, 31) for target_keyframe in (k - 25, k + 15)
    ]
    outcomes = [
        a
        for a in decide(right + twice, STREETS, SETTINGS, model=MODEL)
        if a.alignment.target_session == "c"
    ]
    assert all(accepted(a) and a.decision.agreement.ambiguity < 0.05 for a in outcomes)


@pytest.mark.parametrize(("road", "alike"), [(0.0, True), (2000.0, False)])
def test_a_second_place_as_far_off_as_the_target_may_have_drifted_is_the_same(
    road: float, alike: bool
) -> None:
    """The target drove the street twice; the second time it lies 24 m on, after ``road`` metres."""
    twice = SimpleNamespace(
        map_T_base=np.tile(STRAIGHT, (2, 1, 1)),
        distance=np.r_[STREETS["b"].distance, road + STREETS["b"].distance],
    )
    rows = [in_street(k, target_keyframe) for k in COPIED for target_keyframe in (k, 100 + k + 12)]
    outcomes = decide(rows, {**STREETS, "b": cast(SessionMap, twice)}, SETTINGS, model=MODEL)
    assert all((a.decision.agreement.ambiguity > 0.9) == alike for a in outcomes)


def test_three_sessions_that_contradict_each_other_look_like_others() -> None:
    """Of b and c, which lie on each other, a is in b where it is, and in c one block on."""
    rows = [in_street(k, k) for k in COPIED] + [in_street(k, k, "b", "c") for k in COPIED]
    consistent = decide(
        rows + [in_street(k, k, target="c") for k in COPIED], STREETS, SETTINGS, model=MODEL
    )
    assert all(accepted(a) and a.decision.agreement.ambiguity == 0 for a in consistent)
    for a in decide(
        rows + [in_street(k, k + 40, target="c") for k in COPIED], STREETS, SETTINGS, model=MODEL
    ):
        if "a" in (a.alignment.query_session, a.alignment.target_session):
            assert a.decision.agreement.ambiguity > 0.9
            assert not accepted(a)


@pytest.mark.parametrize(
    ("weakest", "copies"),
    [(0.75, False), (0.98, True)],  # chance explains one of four, but not one of fifty
)
def test_three_single_sweeps_that_contradict_each_other(weakest: float, copies: bool) -> None:
    """Of sweeps a in b and c, and b in c, the least probable one is 40 m off."""

    def sweep(query: str, target: str, target_keyframe: int, alone: float) -> Alignment:
        features = dataclasses.replace(GOOD, stiffness=float(np.log(alone / (1 - alone))))
        return dataclasses.replace(in_street(30, target_keyframe, query, target), features=features)

    a_in_b = sweep("a", "b", 30, 0.999)
    b_in_c = sweep("b", "c", 30, 0.999)
    consistent = [a_in_b, b_in_c, sweep("a", "c", 30, weakest)]
    for outcome in decide(consistent, STREETS, SETTINGS, model=MODEL):
        assert outcome.decision.agreement.ambiguity == 0
    contradicting = [a_in_b, b_in_c, sweep("a", "c", 50, weakest)]
    for outcome in decide(contradicting, STREETS, SETTINGS, model=MODEL):
        assert outcome.decision.agreement.ambiguity == (1.0 if copies else 0.0)


def test_streets_that_a_session_itself_has_twice_are_ambiguous() -> None:
    rows = [in_street(k, k) for k in COPIED] + [in_street(k, k + 40, target="a") for k in COPIED]
    for a in decide(rows, STREETS, SETTINGS, model=MODEL):
        assert a.decision.agreement.ambiguity > 0.9
        assert not accepted(a)


@pytest.mark.parametrize("second_place", [lambda k: (7 * k) % 100, lambda k: k + 9])
def test_second_places_that_do_not_agree_or_lie_in_the_same_view_are_no_copies(
    second_place: Any,
) -> None:
    rows = [in_street(k, where) for k in COPIED for where in (k, second_place(k))]
    assert all(
        a.decision.agreement.ambiguity < 0.02 for a in decide(rows, STREETS, SETTINGS, model=MODEL)
    )


def test_a_second_place_that_fits_much_worse_is_no_copy() -> None:
    worse = dataclasses.replace(GOOD, stiffness=-5.0)
    rows = [in_street(k, k) for k in COPIED] + [
        dataclasses.replace(in_street(k, k + 30), features=worse) for k in COPIED
    ]
    assert all(
        a.decision.agreement.ambiguity < 0.01 for a in decide(rows, STREETS, SETTINGS, model=MODEL)
    )


def test_without_other_alignments_all_votes_are_zero() -> None:
    placed = place([alignment(20, 0.5)], MAPS, MODEL)
    pairs = pairs_of(placed)
    own = place_odds(placed, pairs, placed.log_odds, 0.3).share
    votes = count_votes(placed, pairs, own, 0.3)
    assert dataclasses.astuple(votes.row(0)) == (0.5, 0, 0.0, 0.0, 0.0, 0.0, 0.0)


def test_without_odometry_nobody_is_a_neighbour() -> None:
    maps = {"a": session(ROAD, posed=False), "b": MAPS["b"]}
    for a in decide([alignment(k, 0.992) for k in range(20, 24)], maps, SETTINGS, model=MODEL):
        assert a.decision.agreement == Agreement(0.992, 0, 0, 0, 0, 0, 0)
        assert accepted(a)


@pytest.mark.parametrize("seed", [1, 2])
def test_the_order_of_the_alignments_does_not_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = [
        alignment(k, float(rng.uniform(0.01, 1)), target_keyframe=int(rng.integers(60)))
        for k in range(40)
        for _ in range(2)
    ]
    rows += [
        dataclasses.replace(in_street(k, target_keyframe), query_session="c")
        for k in COPIED
        for target_keyframe in (k, k + 30)
    ]
    shuffled = [rows[k] for k in rng.permutation(len(rows))]

    def keys(outcomes: Sequence[Outcome]) -> list[Any]:
        return [
            (
                o.alignment.query_keyframe,
                o.alignment.target_keyframe,
                o.decision,
                accepted(o) or sentence(o),
            )
            for o in outcomes
        ]

    maps = {**STREETS, **MAPS, "b": STREETS["b"]}
    assert keys(decide(rows, maps, SETTINGS, model=MODEL)) == keys(
        decide(shuffled, maps, SETTINGS, model=MODEL)
    )


@pytest.mark.parametrize(("alone", "expected"), [(0.9901, True), (0.9899, False), (np.nan, False)])
def test_what_is_as_probable_as_the_settings_require_is_accepted(
    alone: float, expected: bool
) -> None:
    assert accepted(decided([alignment(25, alone)])[25, 25]) is expected


def test_of_none() -> None:
    assert list(decide([], MAPS, SETTINGS, model=MODEL)) == []
    nothing = place([], {}, MODEL)
    assert len(count_votes(nothing, pairs_of(nothing), np.zeros(0), 0.3)) == 0
    assert not contradicts_odometry(nothing, 0.3).any()


def slow_sums(group: Placed, probabilities: Sequence[F64], voxel_size: float) -> list[F64]:
    """For each of the ``probabilities`` (n,) the sums over other queries' alignments, agreeing
    ones and others, near it and far from it (4, n).

    Of each query the most probable alignment of either kind counts, and as opposing only if it is
    more probable than an agreeing one.
    """
    scale = voxel_size / STREET_VOXEL
    voting = np.max(probabilities, axis=0) >= MIN_VOTE
    voters = group.part(voting)
    votes = [np.where(p >= MIN_VOTE, p, 0.0)[voting] for p in probabilities]
    out = [np.zeros((4, len(group))) for _ in probabilities]
    for k in range(len(group)):
        along = np.abs(voters.road - group.road[k])
        there = np.flatnonzero((along <= FAR * scale) & (voters.query != group.query[k]))
        if not len(there):
            continue
        others_there = voters.part(there)
        along = along[there]
        agrees = slow_agrees(group.part(np.array([k])), others_there, along, voxel_size)
        _, first, number = np.unique(others_there.query, return_index=True, return_inverse=True)
        is_near = along[first] <= NEAR * scale
        for sums, p in zip(out, votes, strict=True):
            support = np.zeros(len(first))
            conflict = np.zeros(len(first))
            np.maximum.at(support, number, np.where(agrees, p[there], 0.0))
            np.maximum.at(conflict, number, np.where(agrees, 0.0, p[there]))
            conflict[conflict <= support] = 0.0
            sums[:, k] = [
                support[is_near].sum(),
                conflict[is_near].sum(),
                support[~is_near].sum(),
                conflict[~is_near].sum(),
            ]
    return out


def slow_agrees(one: Placed, others: Placed, along: F64, voxel_size: float) -> NDArray[np.bool_]:
    """Whether ``one`` and the odometry predict ``others`` (m), which lie ``along`` metres of road
    away.
    """
    predicted = one.target_T_query[0] @ inverse(one.map_T_query[0]) @ others.map_T_query
    off = np.linalg.norm(predicted[:, :3, 3] - others.target_T_query[:, :3, 3], axis=1)
    trace = np.einsum("nij,nij->n", predicted[:, :3, :3], others.target_T_query[:, :3, :3])
    turn = np.arccos(np.clip((trace - 1) / 2, -1, 1))
    sigma = np.hypot(one.sigma[0], others.sigma)
    allowed = np.minimum(SLACK * voxel_size + 2 * sigma, MOST_SLACK * voxel_size)
    drift = ODOMETRY_DRIFT * (along + np.abs(others.target_road - one.target_road[0])) + ARM * along
    return np.asarray(
        (off <= allowed + drift) & (turn <= TURN + TURN_DRIFT * along * STREET_VOXEL / voxel_size)
    )


@given(st.integers(0, 10_000), st.sampled_from([0.3, 0.05]))
@settings(max_examples=40, deadline=None)
def test_voters_are_counted_as_one_by_one(seed: int, voxel_size: float) -> None:
    """Alignments of a bent road, right, moved, turned or in other places, as many as three of a
    query, against the slow count.
    """
    rng = np.random.default_rng(seed)
    scale = voxel_size / 0.3
    road = bend(60)
    road[:, :3, 3] *= scale
    query = np.sort(rng.integers(0, 60, 50))
    error = np.array(
        [
            yaw_transform(
                rng.normal(0, 0.05), rng.normal(0, rng.choice([0.1, 1.0, 10.0]) * scale, 3)
            )
            for _ in query
        ]
    )
    placed = Placed(
        np.full(50, "a", object),
        np.full(50, "b", object),
        query,
        np.asarray(2.0 * scale * query, float),
        2.0 * scale * query + rng.normal(0, 3 * scale, 50),
        road[query],
        error @ MAP @ road[query],
        rng.uniform(0.01, 0.5, 50) * scale,
        rng.normal(-2, 3, 50),
        np.ones(50, bool),
    )
    own = place_odds(placed, pairs_of(placed), placed.log_odds, voxel_size).share
    probabilities = own, placed.probability_ignoring_rivals
    for sums, expected in zip(
        _sums(placed, probabilities, voxel_size),
        slow_sums(placed, probabilities, voxel_size),
        strict=True,
    ):
        np.testing.assert_allclose(sums, expected, atol=1e-12)
