"""Our pipeline, its ablations and the plain method localise in a small street whose truth is
known.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from semloc_logs.alignment.cell_masks import overlap_map
from semloc_logs.alignment.mask_grid import FREE_BIT, MaskGrid
from semloc_logs.alignment.overlaps import overlap, query_voxels
from semloc_logs.errors import SettingsError
from semloc_logs.experiments.answers import Learner, Run, answer_scenario
from semloc_logs.experiments.scenarios import time_scenario
from semloc_logs.experiments.system import Query, RankedPose, View
from semloc_logs.experiments.systems import catalogue, plain
from semloc_logs.experiments.systems.ablations import (
    ABLATIONS,
    ablated,
    described_alone,
    without_free_space,
)
from semloc_logs.experiments.systems.ours import Ours
from semloc_logs.experiments.systems.plain import Plain, refined, rigid_fit
from semloc_logs.experiments.views import ViewStore
from semloc_logs.numerics.transforms import inverse, rotation_angle, yaw_transform
from semloc_logs.settings import Resolved, load
from semloc_logs.simulation.meshes.world import (
    BUILDING,
    POLE,
    ROAD,
    VEGETATION,
    MeshBuilder,
    Scene,
    box,
    ellipsoid,
    place,
)
from semloc_logs.simulation.sensors.lidar import SweepOptions, full_sweep
from semloc_logs.simulation.sensors.lidar_models import MODELS
from semloc_logs.subvolumes.describe import Described, Windows, describe_map, load_encoder
from semloc_logs.subvolumes.network import Completion, Encoder
from semloc_logs.subvolumes.plain_describe import describe_blocks
from semloc_logs.subvolumes.plain_network import PlainEncoder
from semloc_logs.subvolumes.weight_files import save_weights
from semloc_logs.voxels.grid import UNOBSERVED_STATE, BlockMap, Fuser
from semloc_logs.voxels.keys import BLOCK, pack
from semloc_logs.words.plain_vocabulary import train_plain_vocabulary
from semloc_logs.words.vocabulary import save_vocabulary, train_vocabulary

ODOM_T_WORLD = yaw_transform(np.radians(70), (200.0, -30.0, 4.0))
SETTINGS = {
    "fusion.voxel_size": "0.5",
    "fusion.max_range": "25",
    "descriptor.reach": "15",
    "descriptor.headings": "8",
    "closures.hypotheses": "64",
}


def settings() -> Resolved:
    return load(assignments=SETTINGS).resolved()


@pytest.fixture(scope="module")
def street() -> Scene:
    """Houses, trees and poles, different on both sides."""
    rng = np.random.default_rng(4)
    builder = MeshBuilder(lambda x, y: 0 * x)
    builder.add(box(120.0, 120.0, 1.0, z=-1.0), ROAD, ground="none")
    for side in (-1, 1):
        for x in np.cumsum(rng.uniform(6, 16, 8)) - 44:
            length, width, height = rng.uniform(3, 9, 3)
            house = box(length, width, height, x=x, y=side * (10 + width / 2))
            builder.add(house, BUILDING, ground="none")
            tree = ellipsoid((1.2, 1.2, rng.uniform(1.5, 2.5)), z=rng.uniform(2.5, 4))
            builder.add(
                place(tree, x + rng.uniform(4, 6), side * rng.uniform(5, 8)),
                VEGETATION,
                ground="none",
            )
            pole = box(0.3, 0.3, rng.uniform(3, 7), x=x - rng.uniform(2, 5), y=side * 4.5)
            builder.add(pole, POLE, ground="none")
    return Scene(builder.build())


def view(scene: Scene, session: str, number: int, world_T_base: np.ndarray) -> View:
    """A sweep from ``world_T_base``."""
    base_T_lidar = np.eye(4)
    base_T_lidar[2, 3] = 1.9
    rng = np.random.default_rng([number, len(session)])
    options = SweepOptions(300, 40.0)
    turn = full_sweep(scene, world_T_base @ base_T_lidar, rng, MODELS["hdl32"], options)
    origin = base_T_lidar[:3, 3].astype(np.float32)
    points = (turn.points + origin).astype(np.float32)
    stamp_ns = 1_000_000_000 * number
    odom = ODOM_T_WORLD @ world_T_base
    return View(session, stamp_ns, points, turn.labels, origin, odom, world_T_base)


@pytest.fixture(scope="module")
def database(street: Scene) -> list[View]:
    """Two drives east: the first west of x = 0, the second east of it."""
    return [
        view(street, "west" if x < 0 else "east", i, yaw_transform(0.0, (float(x), -1.8, 0.0)))
        for i, x in enumerate(range(-24, 25, 3))
    ]


@pytest.fixture(scope="module")
def queries(street: Scene) -> list[Query]:
    """One view that looks west in the other lane, and three that look north."""
    opposite = view(street, "q", 100, yaw_transform(np.pi, (-9.3, 1.8, 0.0)))
    north = [
        view(street, "q", 200 + i, yaw_transform(np.pi / 2, (11.0, -3.0 + 1.5 * i, 0.0)))
        for i in range(3)
    ]
    return [Query("opposite", (opposite,)), Query("north", tuple(north))]


def errors(pose: RankedPose, query: Query) -> tuple[float, float]:
    """Metres and degrees."""
    off = inverse(query.views[-1].world_T_base) @ pose.world_T_base
    return float(np.linalg.norm(off[:3, 3])), float(np.degrees(rotation_angle(off[:3, :3])))


def blocks_with(ijk: np.ndarray, label: np.ndarray) -> BlockMap:
    """A map of occupied voxels and nothing else."""
    keys, row = np.unique(pack(ijk // BLOCK), return_inverse=True)
    state = np.full((len(keys), BLOCK**3), UNOBSERVED_STATE, np.uint8)
    x, y, z = (ijk % BLOCK).T
    state[row.ravel(), (x * BLOCK + y) * BLOCK + z] = label
    nothing = np.zeros(0, np.int64)
    return BlockMap(keys, np.zeros(state.shape, np.int8), state, nothing, nothing)


def hidden(query: Query) -> Query:
    """The query without its truth, which no system may read."""
    nowhere = np.full((4, 4), np.nan)
    return replace(query, views=tuple(replace(v, world_T_base=nowhere) for v in query.views))


def test_ours_finds_both_queries_to_centimetres(
    database: list[View], queries: list[Query], tmp_path: Path
) -> None:
    system = Ours(settings=settings(), work=tmp_path)
    system.fit(database)
    assert {p.name for p in (tmp_path / "sessions").iterdir()} == {"west", "east"}
    for query in queries:
        poses = system.localise(hidden(query))
        metres, degrees = errors(poses[0], query)
        assert metres < 0.25
        assert degrees < 1.0
        assert len(poses) > 3
        scores = [pose.score for pose in poses]
        assert scores == sorted(scores, reverse=True)


PLAIN = {
    "fusion.max_range": "20",
    "query.radius": "15",
    "plain.headings": "6",
    "plain.refined": "10",
}


def plain_settings(**changes: str) -> Resolved:
    """The paper's settings with fewer headings, near points and large voxels."""
    given = {key.replace("__", "."): value for key, value in changes.items()}
    return load(assignments={**SETTINGS, **PLAIN, **given}, method="paper").resolved()


def plain_system(variant: str, database: list[View], chosen: Resolved) -> Plain:
    """The plain method with an untrained network: the same cloud has the same descriptors."""
    torch.manual_seed(0)
    encoder = PlainEncoder(variant).eval()
    fuser = Fuser(chosen.fusion)
    for v in database:
        fuser.add(v.points, v.label, v.origin, None, v.world_T_base)
    described = describe_blocks(fuser.finish(), 8, 1, encoder)
    assert variant in ("semantic", "geometric")
    words = train_plain_vocabulary(described.descriptor)
    return Plain("semantic" if variant == "semantic" else "geometric", chosen, encoder, words)


@pytest.mark.parametrize("variant", ["semantic", "geometric"])
def test_the_plain_method_finds_a_cloud_again_that_was_turned(
    database: list[View], variant: str
) -> None:
    # four places that share nothing, a multiple of the stride of eight voxels apart
    places = [
        replace(v, world_T_base=yaw_transform(0.0, (96.0 * i, 8.0 * i, 0.0)))
        for i, v in enumerate(database[::5])
    ]
    system = plain_system(variant, places, plain_settings())
    assert system.name == f"paper ({variant})"
    system.fit(places)
    turned = yaw_transform(np.pi, (50.3, 7.1, -2.0))
    query = Query("again", (replace(places[2], odom_T_base=turned),))
    poses = system.localise(hidden(query))
    assert len(poses) == 10
    metres, degrees = errors(poses[0], query)
    assert metres < 0.2
    assert degrees < 1.0
    scores = [pose.score for pose in poses]
    assert scores == sorted(scores, reverse=True)
    assert scores[-1] >= 0.3
    assert scores[0] <= 1.0


def test_poses_below_the_least_tau_are_left_out(database: list[View]) -> None:
    system = plain_system("semantic", database, plain_settings(plain__min_tau="1.0"))
    system.fit(database)
    changed = replace(database[10], label=np.full_like(database[10].label, 8))
    assert system.localise(Query("vegetation", (changed,))) == []


def test_the_plain_method_names_a_file_that_is_missing(database: list[View]) -> None:
    missing = plain_settings(descriptor__weights="missing.safetensors")
    with pytest.raises(SettingsError, match=r"missing\.safetensors"):
        Plain(settings=missing).fit(database)


def test_a_store_is_described_once_for_all_scenarios(
    database: list[View],
    make_store: Callable[..., ViewStore],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    places = [(*v.world_T_base[:2, 3].tolist(), 0.0) for v in database[:4]]
    store = make_store(map=places, drive=places[:1])
    for session in store.sessions:
        monkeypatch.setattr(session, "view", lambda number: database[number])
    described: list[int] = []

    def counted(*given: Any) -> Described:
        described.append(1)
        return describe_blocks(*given)

    monkeypatch.setattr(plain, "describe_blocks", counted)
    base = plain_system("semantic", database[:4], plain_settings())
    for name in ("paper-semantic", "paper-acc"):
        system = replace(base, kept=tmp_path / "kept")
        learner = Learner(store, partial(replace, system))
        for scenario in ("day", "night"):
            planned = time_scenario(store, scenario, "map", "drive")
            run = Run(name, "lidar", 1, "v1")
            assert answer_scenario(run, planned, learner, tmp_path) == 1
    assert described == [1]
    # a map of other views is another map
    system.fit(database[:2])
    assert described == [1, 1]


def test_iterative_closest_points_move_a_wall_onto_a_wall() -> None:
    wall = np.array([[x, 0, z] for x in range(12) for z in range(12)], np.int32)
    floor = np.array([[x, y, 0] for x in range(12) for y in range(1, 12)], np.int32)
    ijk = np.concatenate([wall, floor])
    label = np.r_[np.full(len(wall), 2), np.zeros(len(floor))].astype(np.uint8)
    blocks = blocks_with(ijk, label)
    start = yaw_transform(0.02, (0.3, 2.2, 0.4))
    target = overlap_map(blocks, 5.0)
    query = query_voxels((ijk, label))
    pose, tau = refined(target, query, start, 30)
    # from 2.2 voxels to less than one: within a voxel all closest voxels stay the same
    assert overlap(target, query, start) < 0.91 < 0.95 < tau
    assert np.abs(pose[:3, 3]).max() < 0.7
    assert abs(pose[0, 1]) < 1e-6  # the turn about the vertical, 0.02 at first, is gone
    assert np.abs(pose[:3, :3] - np.eye(3)).max() < 0.06


def test_a_rigid_fit_is_exact_on_exact_points() -> None:
    source = np.random.default_rng(0).normal(size=(9, 3))
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.3, -0.2, 2.0]).as_matrix()
    pose[:3, 3] = 1.0, -2.0, 0.5
    np.testing.assert_allclose(
        rigid_fit(source, source @ pose[:3, :3].T + pose[:3, 3]), pose, atol=1e-12
    )


@pytest.mark.parametrize("name", [n for n, row in ABLATIONS.items() if not row.training])
def test_every_ablation_finds_the_view_of_the_opposite_lane(
    name: str, database: list[View], queries: list[Query]
) -> None:
    system = ablated(name, settings())
    assert system.name == name
    system.fit(database)
    query = queries[0]
    poses = system.localise(hidden(query))
    metres, degrees = errors(poses[0], query)
    # a pose that was not refined is as good as the steps of the search
    assert metres < (1.0 if name == "ours-not-refined" else 0.25)
    assert degrees < (5.0 if name == "ours-not-refined" else 1.0)


def test_every_row_of_an_ablation_has_its_parts() -> None:
    assert [entry.name for entry in catalogue.ABLATIONS] == list(ABLATIONS)


def test_ablations_change_what_they_name(database: list[View], queries: list[Query]) -> None:
    assert ablated("ours-one-neighbour").settings.closures.neighbours == 1
    four = ablated("ours-stride-4").settings.descriptor
    assert (four.stride, four.query_stride) == (4, 4)
    with pytest.raises(SettingsError, match="there are ours-no-classes"):
        ablated("ours-no-words")


def test_a_network_trained_otherwise_is_named_with_its_command(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"training\.contrastive_weight=0"):
        ablated("ours-no-contrast", weights=tmp_path)
    # any network with 64 numbers in place of a trained one
    torch.manual_seed(0)
    save_weights(tmp_path / "semantic.safetensors", Completion("semantic", 64), {})
    random = np.random.default_rng(0).normal(size=(300, 64))
    random /= np.linalg.norm(random, axis=1, keepdims=True)
    save_vocabulary(tmp_path / "words.safetensors", train_vocabulary(random), {})
    system = ablated("ours-64", settings(), tmp_path)
    chosen = system.settings.descriptor
    assert chosen.weights == tmp_path / "semantic.safetensors"
    assert load_encoder("semantic", chosen.weights).latent == 64


def test_masks_without_free_space_keep_their_classes() -> None:
    grid = MaskGrid(np.array([[[FREE_BIT, 0b1000001, 0]]], np.uint8), np.zeros(3), 0.3)
    np.testing.assert_array_equal(without_free_space(grid).mask, [[[0, 0b1000001, 0]]])


def test_a_subvolume_alone_is_described_as_a_map_that_holds_nothing_else() -> None:
    torch.manual_seed(0)
    encoder = Encoder("geometric").eval()
    state = np.full((32, 32, 32), UNOBSERVED_STATE, np.uint8)
    state[:, 4:20, 3] = 0
    state[11, :, 3:9] = 2
    low = np.array([8, -16, 0])
    together = describe_map(state, low, 1.2, encoder, Windows(0.3, 8, 40))
    whole = (together.centre[:, :2] == [24.0, 0.0]).all(1)
    assert whole.sum() == 1
    alone = described_alone(state, low, together.centre[whole], encoder)
    np.testing.assert_allclose(alone, together.descriptor[whole], atol=2e-2)
    # beside it others see a part of the map alone, and more of it together
    others = described_alone(state, low, together.centre[~whole], encoder)
    assert np.abs(others - together.descriptor[~whole]).max() > 2e-2
