"""From maps to alignments: a query whose pose in a small map is known is localised in it, and what
the alignment reports is checked.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from semloc_logs.alignment.covariance import stiffness
from semloc_logs.alignment.icp import Fit
from semloc_logs.alignment.scores import MutualScores, Scores
from semloc_logs.alignment.search import Candidate
from semloc_logs.arrays import F64, U8
from semloc_logs.closures.acceptance.calibration import log_odds, shipped
from semloc_logs.closures.acceptance.decide import decide
from semloc_logs.closures.closure import Alignment
from semloc_logs.closures.database import Database
from semloc_logs.closures.matching import (
    Fitted,
    QueryContext,
    _each_place_once,
    allowed_words,
    close_query,
    find_hypotheses,
    match_words,
)
from semloc_logs.closures.query import build_query
from semloc_logs.closures.visibility import everything
from semloc_logs.engines import make_engine
from semloc_logs.labels.space import cityscapes
from semloc_logs.mapping.selection import road_distance
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import apply, inverse, rotation_angle, yaw_transform
from semloc_logs.settings import Resolved, Settings
from semloc_logs.stages.describe import describe
from semloc_logs.tables import contracts
from semloc_logs.tables.table import write_json, write_table
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE, Fuser
from semloc_logs.voxels.store import (
    Keyframe,
    blocks_path,
    keep_keyframes,
    pose_columns,
    read_blocks,
    write_blocks,
)
from semloc_logs.words.index import Matches
from semloc_logs.words.vocabulary import load_vocabulary
from semloc_logs.workspace import Workspace

Scene = tuple[F64, U8]
V = 0.3
ROAD, BUILDING, WALL, POLE, VEGETATION = 0, 2, 3, 5, 8
SENSOR = np.array([0.0, 0.0, 1.8])  # in the base frame
SETTINGS = Settings().resolved()
pytestmark = pytest.mark.timeout(300)  # much is compiled when this runs first


def side(a: tuple[float, float], b: tuple[float, float], height: float, label: int) -> Scene:
    """An upright wall from ``a`` to ``b``, a point every 12 cm."""
    start = np.array(a)
    way = np.subtract(b, a)
    along, up = np.meshgrid(np.arange(0, np.linalg.norm(way), 0.12), np.arange(0.05, height, 0.12))
    xy = start + along.reshape(-1, 1) / np.linalg.norm(way) * way
    return np.c_[xy, up.reshape(-1)], np.full(up.size, label, np.uint8)


def joined(*parts: Scene) -> Scene:
    return np.concatenate([p for p, _ in parts]), np.concatenate([label for _, label in parts])


def courtyard(more: float = 0.0, front: int = BUILDING) -> Scene:
    """A court of 34 m x 26 m without any symmetry, which is seen as a whole from its middle. Its
    fronts are ``more`` metres higher.
    """
    x, y = (
        g.reshape(-1) for g in np.meshgrid(np.arange(-16.9, 17, 0.2), np.arange(-12.9, 13, 0.2))
    )
    ground = np.c_[x, y, np.zeros(len(x))], np.full(len(x), ROAD, np.uint8)
    poles = [
        side((px - 0.1, py), (px + 0.1, py + 0.1), 4.0, POLE)
        for px, py in ((-11.0, 7.0), (-4.0, 9.0), (9.0, -8.0), (13.0, 4.0))
    ]
    return joined(
        ground,
        side((-17, -13), (17, -13), 3.0 + more, front),
        side((-17, 13), (2, 13), 4.5 + more, front),
        side((2, 13), (17, 10), 2.0, VEGETATION),
        side((17, -13), (17, 10), 3.5 + more, front),
        side((-17, -13), (-17, 2), 2.5, VEGETATION),
        side((-17, 2), (-17, 13), 3.0 + more, front),
        *poles,
    )


def write_session(
    work: Workspace,
    name: str,
    scene: Scene,
    poses: F64,
    map_T_scene: F64,
    source: str = "log",
    seed: int = 0,
    submaps: int = 1,
) -> SessionMap:
    """A fused session whose keyframes at ``poses`` (n, 4, 4), in the scene's frame, saw a third of
    the points within 24 m of each.
    """
    folder = work.session(name)
    n = len(poses)
    rng = np.random.default_rng(seed)
    folder.keyframes.mkdir(parents=True)
    folder.blocks.mkdir()
    in_map, (points, label) = map_T_scene @ poses, scene
    clouds = []
    for pose in poses:
        some = rng.random(len(points)) < 1 / 3
        seen = apply(inverse(pose), points[some] + rng.normal(0, 0.01, (int(some.sum()), 3)))
        is_near = np.linalg.norm(seen - SENSOR, axis=1) < 24
        clouds.append(Keyframe(seen[is_near].astype(np.float32), label[some][is_near]))
    columns: dict[str, Any] = {
        "keyframe": np.arange(n),
        "stamp_ns": np.arange(n) * 10**9,
        "log_time_ns": np.arange(n) * 10**9,
        "topic": ["/points"] * n,
        "posed": [True] * n,
        "distance": road_distance(in_map),
        "ground_z": in_map[:, 2, 3],
        "points": [len(c.points) for c in clouds],
        **{f"origin_{c}": np.full(n, value) for c, value in zip("xyz", SENSOR, strict=True)},
        **{f"view_{c}": np.zeros(n) for c in "xyz"},
        **pose_columns(in_map),
    }
    write_table(folder.frames, contracts.table("frames", columns), {})
    clouds = list(keep_keyframes(folder.keyframes, range(n), clouds, {}))
    rows = []
    for i, members in enumerate(np.array_split(np.arange(n), submaps)):
        fuser = Fuser(SETTINGS.fusion)
        for k in members:
            fuser.add(clouds[k].points, clouds[k].label, SENSOR, None, in_map[k])
        write_blocks(blocks_path(folder.blocks, i), fuser.finish(), {})
        rows.append(
            {
                "id": i,
                "first": int(members[0]),
                "last": int(members[-1]),
                "ground_z": float(in_map[members[0], 2, 3]),
                "blocks": 1,
            }
        )
    content = {
        "posed": True,
        "label_source": source,
        "submaps": rows,
        "settings": {"fusion": {"voxel_size": V}},
        "fingerprint": name,
    }
    content |= {
        "schema_version": 1,
        "voxel_size": V,
        "session_T_map": np.eye(4).tolist(),
        "label_space": "cityscapes",
        "version": "0",
    }
    write_json(folder.session_json, content)
    return SessionMap(folder)


def drive(n: int = 5, heading: float = 0.0, y: float = 0.0) -> F64:
    """Poses (n, 4, 4), 1.5 m apart along the court's x through its middle; the vehicle looks along
    ``heading``.
    """
    return np.array([yaw_transform(heading, (1.5 * (i - n // 2), y, 0.0)) for i in range(n)])


TARGET_T_SCENE = yaw_transform(0.4, (120.0, -60.0, 7.0))


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """Maps of the court: as it is, from a vehicle that looks left, and twice in one drive."""
    work = Workspace(tmp_path_factory.mktemp("courts"))
    court = courtyard()
    write_session(work, "court", court, drive(), TARGET_T_SCENE)
    write_session(work, "turned", court, drive(heading=np.pi / 2), TARGET_T_SCENE)
    away = np.array([300.0, 0.0, 0.0])
    twice = np.concatenate([court[0], court[0] + away]), np.tile(court[1], 2)
    poses = np.concatenate([drive(), yaw_transform(0.0, tuple(away)) @ drive()])
    write_session(work, "twice", twice, poses, TARGET_T_SCENE, submaps=2)
    describe(work, ["court", "turned", "twice"], SETTINGS, make_engine("serial"))
    return work


Ask = Callable[..., list[Alignment]]


@pytest.fixture
def ask(work: Workspace, request: pytest.FixtureRequest) -> Ask:
    """Alignments of a query at the court's middle; its own map lies in the scene as ``map_T_scene``
    has it.
    """
    names = (f"query-{request.node.name}-{i}" for i in range(100))

    def asked(
        map_T_scene: F64,
        target: str = "court",
        scene: Scene | None = None,
        settings: Resolved = SETTINGS,
        source: str = "log",
    ) -> list[Alignment]:
        name = next(names)
        write_session(
            work, name, scene or courtyard(), drive(3, 0.3, 1.0), map_T_scene, source, seed=7
        )
        return close_query(Database(work, (target,), settings), SessionMap(work.session(name)), 1)

    return asked


def placed(work: Workspace, a: Alignment) -> F64:
    """Where an alignment puts the query's base in the scene."""
    target = SessionMap(work.session(a.target_session))
    return np.asarray(
        inverse(TARGET_T_SCENE) @ target.map_T_base[a.target_keyframe] @ a.target_T_query
    )


@pytest.mark.parametrize("degrees", [0, 90, 180, 270, 37])
def test_a_query_turned_and_moved_by_a_known_transform_is_found_where_it_is(
    work: Workspace, ask: Ask, degrees: int
) -> None:
    """The query's map is turned by ``degrees`` against the court: every quarter turn has to be
    undone with the right sign.
    """
    best = ask(yaw_transform(0.4 + np.radians(degrees), (-35.0, 12.0, 2.0)))[0]
    off = inverse(drive(3, 0.3, 1.0)[1]) @ placed(work, best)
    assert np.linalg.norm(off[:3, 3]) < 0.05
    assert rotation_angle(off[:3, :3]) < np.radians(0.3)
    assert shipped().own_log_odds(best.features) > log_odds(np.array(0.99))
    assert best.features.structure > 0.9


def states(session: SessionMap) -> tuple[F64, U8]:
    """Centres (n, 3) in the map frame and states (n,) of the observed voxels of a session's only
    submap.
    """
    blocks = read_blocks(blocks_path(session.folder.blocks, 0), states_only=True)
    low, high = blocks.bounds()
    dense = blocks.dense(low, tuple((high - low).tolist()))
    ijk = np.argwhere(dense != UNOBSERVED_STATE)
    return np.asarray((ijk + low + 0.5) * V, float), dense[tuple(ijk.T)]


@pytest.mark.parametrize(
    ("front", "kappa", "source", "overlap"),
    [
        (BUILDING, 10.0, "log", 0.940),
        (BUILDING, 1.0, "log", 0.872),
        (WALL, 10.0, "log", 0.683),
        (WALL, 10.0, "onnx", 0.940),
    ],
)
def test_the_overlap_is_that_of_the_nearest_observed_voxels(
    work: Workspace, ask: Ask, front: int, kappa: float, source: str, overlap: float
) -> None:
    """The query has the fronts 1.5 m higher than the map, and perhaps as walls instead of
    buildings: one coarse class, which counts where the labels of the two are not of one source.
    """
    settings = Settings.model_validate({"closures": {"kappa": kappa}}).resolved()
    best = ask(
        yaw_transform(1.0, (5.0, 2.0, 0.0)),
        scene=courtyard(1.5, front),
        settings=settings,
        source=source,
    )[0]
    target = SessionMap(work.session("court"))
    query, query_T_base = build_query(SessionMap(work.session(best.query_session)), 1, settings)
    map_T_query = (
        target.map_T_base[best.target_keyframe] @ best.target_T_query @ inverse(query_T_base)
    )
    centres, state = states(target)
    ijk, label = query.occupied
    away, nearest = cKDTree(centres).query(apply(map_T_query, (ijk + 0.5) * V))
    group = np.arange(256) if source == "log" else cityscapes().coarse
    aligned = (
        (away < kappa * V)
        & (state[nearest] != FREE_STATE)
        & (group[state[nearest]] == group[label])
    )
    # of two voxels that are equally near either may be taken
    assert best.inliers == pytest.approx(aligned.sum(), rel=0.002)
    assert best.overlap == pytest.approx(aligned.mean(), rel=0.002)
    assert best.overlap == pytest.approx(overlap, abs=0.005)  # the four cases differ


def test_the_covariance_lies_in_the_axes_of_the_targets_vehicle(ask: Ask) -> None:
    """Two drives through one map, of which one vehicle looks to the other's left: its x is the
    other's y.
    """
    here = yaw_transform(1.0, (5.0, 2.0, 0.0))
    there = np.zeros((6, 6))
    one, other = (ask(here, target)[0].covariance for target in ("court", "turned"))
    R = yaw_transform(np.pi / 2)[:3, :3]
    there[:3, :3] = there[3:, 3:] = R
    np.testing.assert_allclose(other, there.T @ one @ there, rtol=0.01, atol=2e-9)
    assert np.abs(other - one).max() > 1e-7
    assert np.abs(other - there @ one @ there.T).max() > 1e-8  # nor turned to the other side


def test_a_second_place_that_fits_as_well_is_a_rival(work: Workspace, ask: Ask) -> None:
    """In a drive through two equal courts each is the other's rival; in one court there are only
    places that fit worse.
    """
    here = yaw_transform(1.0, (5.0, 2.0, 0.0))

    def probabilities(alignments: list[Alignment]) -> list[float]:
        names = {a.query_session for a in alignments} | {a.target_session for a in alignments}
        maps = {name: SessionMap(work.session(name)) for name in names}
        return [o.decision.probability for o in decide(alignments, maps, SETTINGS)]

    alone = probabilities(ask(here))
    first, second = ask(here, "twice")[:2]
    assert {first.target_keyframe // 5, second.target_keyframe // 5} == {0, 1}
    assert second.features.contradiction == pytest.approx(first.features.contradiction, rel=0.1)
    assert max(probabilities(ask(here, "twice"))) < 0.9 < alone[0]


def test_a_query_of_little_structure_is_never_certain(ask: Ask) -> None:
    """What lies within 10.5 m has a few hundred voxels of structure, too few to tell one place from
    another.
    """
    few, many = (
        ask(
            yaw_transform(1.0),
            settings=Settings.model_validate({"query": {"radius": radius}}).resolved(),
        )[0]
        for radius in (10.5, 24.0)
    )
    assert few.features.support < 3.0 < many.features.support
    less, more = (float(shipped().own_log_odds(a.features)) for a in (few, many))
    assert less < more - 1.0
    assert less < log_odds(np.array(0.99))


def test_a_near_word_outweighs_several_far_ones(
    work: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A word that differs in no bit weighs 1.001; three that differ in 28 of 64 bits weigh (4 /
    32)^2 + 0.001 each.
    """
    settings = SETTINGS
    session = SessionMap(work.session("court"))
    query, query_T_base = build_query(session, 2, settings)
    one = np.array([90.0, -40.0, 7.0])
    several = np.array([150.0, -40.0, 7.0])

    class Words:
        vocabulary = load_vocabulary("semantic", None)

        def find(self, *_: Any) -> Matches:
            rows = np.zeros(4, np.int32)
            centre = np.stack([one, several, several, several])
            return Matches(
                rows,
                rows.astype(np.int64),
                rows.astype(np.int64),
                centre,
                np.full(4, 0.25),
                np.array([0, 28, 28, 28], np.int32),
            )

    monkeypatch.setattr(Database, "words", lambda *_: Words())
    database = Database(work, ("turned",), settings)
    visible = everything(database)
    allowed = allowed_words(visible, session)["semantic"]
    described, _ = match_words(database, "semantic", allowed, query, 0.0)
    hypotheses = find_hypotheses(QueryContext(visible, session, 2, query, query_T_base))
    assert [round(h.weight, 6) for h in hypotheses] == [1.001] * 4 + [
        round(3 * (1 / 64 + 0.001), 6)
    ] * 4
    assert [h.votes for h in hypotheses] == [1] * 4 + [3] * 4
    assert sorted(h.pose[0] for h in hypotheses[:4]) == pytest.approx(
        [0.25 + k * np.pi / 2 for k in range(4)]
    )
    for h in hypotheses:  # the query word lies on the map word
        centre_in_map = apply(
            yaw_transform(h.pose[0], np.array(h.pose[1:])), described.centre[:1].astype(float) * V
        )[0]
        np.testing.assert_allclose(centre_in_map, one if h.votes == 1 else several, atol=1e-6)


def fitted(score: float, x: float = 0.0, degrees: float = 0.0) -> Fitted:
    """A fit ``x`` metres along the map and turned by ``degrees``, of this score."""
    T = yaw_transform(np.radians(degrees), (x, 0.0, 0.0))
    fit = Fit(T, 1.0, 1000, 0.1, np.eye(6), np.zeros(3), np.zeros((2, 6)))
    scores = Scores(1000, 1000, round(1000 * score), 0)
    both = MutualScores(scores, scores)
    return Fitted(Candidate(0, T, score, 1), 0, np.zeros(3), np.zeros(1, int), fit, both, 0.0)


def test_each_place_is_kept_once_and_the_best_first() -> None:
    """Within 3.3 voxels = 0.99 m and 5 degrees it is the same place."""
    every = [
        fitted(0.5),
        fitted(0.9, 0.9),
        fitted(0.6, 1.9),
        fitted(0.7, 0.9, 6.0),
        fitted(0.8, 0.5, 4.0),
    ]
    assert [f.scores.forward.aligned for f in _each_place_once(every, V)] == [900, 700, 600]


def test_stiffness_is_what_holds_the_weakest_direction_while_the_rotation_is_free() -> None:
    def of(information: F64) -> float:
        return stiffness(Fit(np.eye(4), 1.0, 1000, 0.1, information, np.zeros(3), np.zeros((2, 6))))

    H = np.diag([900.0, 400.0, 1600.0, 50.0, 60.0, 70.0])
    assert of(H) == pytest.approx(400.0)
    H[0, 3] = H[3, 0] = 200.0  # a turn about x takes up 200^2 / 50 of what holds x
    assert of(H) == pytest.approx(100.0)
    assert of(np.diag([900.0, 0.0, 1600.0, 50.0, 60.0, 70.0])) == 0.0
    assert of(np.diag([900.0, 400.0, 1600.0, 50.0, 60.0, np.nan])) == 0.0
