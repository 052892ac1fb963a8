from __future__ import annotations

import sys
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from semloc_logs.benchmarks.descriptors import held_out as module
from semloc_logs.benchmarks.descriptors import retrieval as benchmark
from semloc_logs.benchmarks.descriptors.held_out import SCENARIOS, Extent, HeldOut, Size, held_out
from semloc_logs.benchmarks.descriptors.open3d_fpfh import fpfh_describes
from semloc_logs.benchmarks.descriptors.places import Place, Street, read_street, write_street
from semloc_logs.benchmarks.descriptors.recall import (
    DATABASES,
    NoEncoder,
    Words,
    count_subvolumes,
    found_again,
    network_describes,
    recalls,
    retrieval_recall,
    true_radius,
)
from semloc_logs.benchmarks.descriptors.retrieval import (
    RetrievalChoice,
    densely,
    retrieval_benchmark,
)
from semloc_logs.errors import SemlocError, SettingsError, WorkspaceError
from semloc_logs.numerics.transforms import apply, yaw_transform
from semloc_logs.settings import Settings
from semloc_logs.simulation.drives.traffic import Traffic
from semloc_logs.simulation.meshes.world import MeshBuilder, Scene, box
from semloc_logs.simulation.town.road_network import RoadNetwork, path_network
from semloc_logs.subvolumes.describe import Described

SETTINGS = densely(Settings().resolved()).resolved()
V = SETTINGS.fusion.voxel_size


def test_found_again_as_the_slow_reference_says() -> None:
    rng = np.random.default_rng(0)
    database = Words(rng.uniform(0, 20, (700, 3)), rng.normal(size=(700, 4)).astype(np.float32))
    asked = Words(rng.uniform(0, 20, (300, 3)), rng.normal(size=(300, 4)).astype(np.float32))
    is_recalled = found_again(asked, database, 6.0)
    for i in range(300):
        distance = [
            float(np.linalg.norm(asked.descriptor[i].astype(float) - d))
            for d in database.descriptor
        ]
        best = sorted(range(700), key=distance.__getitem__)[:5]
        assert is_recalled[i] == any(
            np.linalg.norm(asked.centre[i] - database.centre[j]) < 6.0 for j in best
        )
    assert 0.05 < is_recalled.mean() < 0.95


def test_the_radius_is_at_least_half_a_cell() -> None:
    for stride, radius in ((4, 1.5), (8, 0.3 * np.sqrt(8**2 * 3) / 2)):
        settings = SETTINGS.model_copy(
            update={"descriptor": SETTINGS.descriptor.model_copy(update={"stride": stride})}
        )
        assert true_radius(settings) == pytest.approx(radius)


def place(rng: np.random.Generator, x: float) -> Place:
    """Nothing but its position counts here."""
    pose = np.eye(4)
    pose[0, 3] = x
    return Place(
        np.full((4, 4, 4), 253, np.uint8), np.zeros(3, np.int64), 0.0, rng.normal(size=(3, 3)), pose
    )


class Fake(HeldOut):
    """Streets without content, 200 m apart, at 0, 200, ..."""

    def streets(self):  # type: ignore[no-untyped-def]
        rng = np.random.default_rng(5)
        for k in range(6):
            queries = {name: [place(rng, 200.0 * k)] for name in SCENARIOS}
            yield Street([(kind, place(rng, 200.0 * k)) for kind in ("camera", "lidar")], queries)


def lattice(place: Place, is_query: bool) -> np.ndarray:
    """Centres in voxels: the database every 4, queries every 8 and a little beside."""
    x, y = np.meshgrid(*(np.arange(0, 200, 8 if is_query else 4),) * 2)
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 16)]) + (0.7 if is_query else 0.0)


def test_a_descriptor_that_knows_its_place_is_always_right_and_a_constant_one_never() -> None:
    world = Fake((), SETTINGS, 4000, 50)
    seen: list[int] = []

    def knows(place: Place, is_query: bool) -> Described:
        centre = lattice(place, is_query)
        seen.append(len(centre))
        return Described(
            centre.astype(np.float32), apply(place.common_T_map, centre * V).astype(np.float32)
        )

    assert recalls(world, knows) == dict.fromkeys(DATABASES, 1.0)
    assert sum(seen) > 4000

    def constant(place: Place, is_query: bool) -> Described:
        centre = lattice(place, is_query)
        return Described(centre.astype(np.float32), np.ones((len(centre), 3), np.float32))

    assert max(recalls(world, constant).values()) < 0.1


def test_a_chance_descriptor_finds_five_of_all() -> None:
    """Each of 5 draws of 4000 is one of the about 5 within 1.5 m of the true place."""
    world = Fake((), SETTINGS, 4000, 10**6)
    rng = np.random.default_rng(0)

    def chance(place: Place, is_query: bool) -> Described:
        centre = lattice(place, is_query)
        return Described(
            centre.astype(np.float32), rng.normal(size=(len(centre), 8)).astype(np.float32)
        )

    recall = recalls(world, chance)
    assert max(recall.values()) < 0.15


def test_the_database_is_cut_to_size_but_keeps_what_is_asked_for() -> None:
    """With no more room than the true places take, every answer is a true one or a neighbour."""

    def knows(place: Place, is_query: bool) -> Described:
        centre = lattice(place, is_query)
        return Described(
            centre.astype(np.float32), apply(place.common_T_map, centre * V).astype(np.float32)
        )

    assert recalls(Fake((), SETTINGS, 1, 5), knows) == dict.fromkeys(DATABASES, 1.0)


class Flat:
    """A ground at zero."""

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.zeros_like(x)

    slope_height = height


@pytest.fixture
def little_town(monkeypatch: pytest.MonkeyPatch) -> None:
    """One straight road of 60 m between boxes of random heights; no traffic; coarse sensors."""
    rng = np.random.default_rng(3)
    builder = MeshBuilder(Flat().height)
    builder.add(box(140.0, 60.0, 0.1, 30.0, 0.0, -0.1), 0)
    for x in range(-30, 90, 6):
        for side in (-1, 1):
            builder.add(
                box(5.0, 4.0, float(rng.uniform(1, 7)), float(x), side * float(rng.uniform(7, 9))),
                2,
            )
    scene = Scene(builder.build())
    network = path_network(
        np.random.default_rng(0), np.column_stack([np.arange(0.0, 61.0), np.zeros(61)])
    )
    monkeypatch.setattr(module, "_scene", lru_cache(lambda *_: scene))
    monkeypatch.setattr(
        module,
        "_network",
        lambda town, _: network if town == 0 else RoadNetwork(np.zeros((0, 2)), ()),
    )
    monkeypatch.setattr(module, "_ground", lambda *_: Flat())
    monkeypatch.setattr(
        module, "random_traffic", lambda rng, ground, lines, density: Traffic(ground, ())
    )
    monkeypatch.setattr(module, "SPACING", 6.0)
    monkeypatch.setattr(module, "COLUMNS", 240)


def test_a_small_held_out_town(tmp_path: Path, little_town: None) -> None:
    extent = Extent(queries=1)
    count = count_subvolumes(SETTINGS)
    world = held_out(tmp_path, SETTINGS, count, Size(300, 40, extent))
    made = {p: p.stat().st_mtime_ns for p in world.paths}
    street = next(world.streets())
    assert set(street.queries) == set(SCENARIOS)
    assert [len(q) for q in street.queries.values()] == [2] * 4
    for name in ("0", "180", "season"):
        asked = street.queries[name][0]
        true = asked.common_T_map
        # the rest of the heading is at most half a step of 20 degrees
        assert abs(np.degrees(np.arctan2(true[1, 0], true[0, 0]))) <= 10
        occupied = np.argwhere(asked.state < 20) + asked.low + 0.5
        level = occupied[:, 2] * V
        assert np.percentile(level, 5) < 1.0  # the ground is at zero
        assert np.abs(occupied[:, :2] * V).max() < 25
        # the same surfaces are in the map where the query claims to be, and not where it does not
        there = dict(street.database)[SCENARIOS[name]]
        mapped = cKDTree((np.argwhere(there.state < 20) + there.low + 0.5) * V)
        # beyond, the street may end
        occupied = occupied[np.linalg.norm(occupied[:, :2] * V, axis=1) < 9.0]
        moved = (true, true @ yaw_transform(0.6, (3, 3, 0)))
        away, elsewhere = (
            np.minimum(mapped.query(apply(pose, occupied * V))[0], 1.0).mean() for pose in moved
        )
        assert away < 0.8 * elsewhere, (name, away, elsewhere)
    recall = retrieval_recall(world, NoEncoder())
    assert set(recall) == set(DATABASES)
    assert all(0 <= v <= 1 for v in recall.values())
    again = held_out(tmp_path, SETTINGS, count, Size(300, 40, extent))
    assert {p: p.stat().st_mtime_ns for p in again.paths} == made  # not simulated twice
    with pytest.raises(SettingsError, match="The held-out towns have"):
        held_out(tmp_path, SETTINGS, count, Size(10**6, 40, extent))
    _comes_back(street, tmp_path / "again.parquet")


def _comes_back(street: Street, path: Path) -> None:
    write_street(path, street, {})
    read = read_street(path)
    pairs = zip([p for _, p in street.database], [p for _, p in read.database], strict=True)
    for a, b in [*pairs, *zip(street.queries["90"], read.queries["90"], strict=True)]:
        for name in ("state", "low", "track", "common_T_map"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
        assert a.ground_z == b.ground_z
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(WorkspaceError):
        read_street(path)


def test_everything_alike_has_one_descriptor_for_each_subvolume() -> None:
    windows = np.argwhere(np.ones((3, 2)))
    descriptors = NoEncoder().describe(np.zeros((64, 56, 32), np.uint8), windows)
    assert descriptors.shape == (6, 256)
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1.0, rtol=1e-6)
    assert (descriptors == descriptors[0, 0]).all()


def test_the_benchmark_names_its_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benchmark, "held_out", lambda *_, **__: Fake((), SETTINGS, 100, 50))
    monkeypatch.setattr(
        benchmark, "retrieval_recall", lambda world, encoder: {"0": 0.5, "season": 0.25}
    )
    asked: list[str] = []
    figures = retrieval_benchmark(
        RetrievalChoice(("semantic", "geometric"), work=tmp_path), {}, SETTINGS, note=asked.append
    )
    assert list(figures) == ["0", "season", "geometric_0", "geometric_season"]
    assert figures["geometric_0"] == {"trained": 0.5, "random": 0.5, "unit": "recall at 5"}
    with pytest.raises(SettingsError, match="octomap"):
        retrieval_benchmark(RetrievalChoice(), {"octomap": "python"}, SETTINGS)
    with pytest.raises(SettingsError, match="one variant"):
        retrieval_benchmark(
            RetrievalChoice(("semantic", "geometric"), weights=tmp_path), {}, SETTINGS
        )


def test_a_peer_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    state = np.full((40, 40, 40), 253, np.uint8)
    state[:, :, 10] = 0
    place = Place(state, np.zeros(3, np.int64), 3.0, np.array([[6.0, 6.0, 4.0]]), np.eye(4))
    same = network_describes(NoEncoder(), SETTINGS)
    for python, error in ((str(tmp_path / "none"), SettingsError), (sys.executable, SemlocError)):
        with pytest.raises(error, match=r"fpfh|FPFH"):  # this Python has no open3d
            fpfh_describes(python, tmp_path / "features", [(place, False)], same, V)
