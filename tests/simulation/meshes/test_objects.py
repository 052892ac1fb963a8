"""The things of a town: of plausible sizes and classes, standing on the ground in one piece, the
same for the same seed.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from semloc_logs.simulation.meshes import landmarks, objects
from semloc_logs.simulation.meshes.buildings import building
from semloc_logs.simulation.meshes.fences import FENCES
from semloc_logs.simulation.meshes.furniture import CLUTTER
from semloc_logs.simulation.meshes.shapes import Parts, Rng, boxes, loft, snow_cover, tubes
from semloc_logs.simulation.meshes.trees import SPECIES
from semloc_logs.simulation.meshes.world import (
    BICYCLE,
    BUILDING,
    BUS,
    CAR,
    FENCE,
    MOTORCYCLE,
    PERSON,
    POLE,
    RIDER,
    TRAFFIC_LIGHT,
    TRAFFIC_SIGN,
    TRAIN,
    TRUCK,
    UNLABELLED,
    VEGETATION,
    WALL,
    Mesh,
    box,
)
from semloc_logs.simulation.town.road_network import grid_network
from semloc_logs.simulation.town.street import build_street

SEEDS = range(8)
Span = tuple[float, float]
Make = Callable[[Rng], Parts]

# least and greatest length (x), width (y) and height in metres, and the classes that may occur
SIZES: dict[str, tuple[Make, Span, Span, Span, set[int]]] = {
    "car": (objects.car, (2.6, 5.2), (1.6, 2.35), (1.2, 2.3), {CAR}),
    "van": (objects.van, (4.3, 6.7), (1.75, 2.2), (1.6, 2.9), {CAR}),
    "camper": (objects.camper, (5.7, 7.3), (1.9, 2.5), (2.6, 3.3), {CAR}),
    "trailer": (objects.trailer, (2.5, 8.5), (1.4, 2.4), (0.9, 2.8), {UNLABELLED}),
    "truck": (objects.truck, (5.5, 16.6), (2.2, 2.7), (2.3, 4.2), {TRUCK}),
    "bus": (objects.bus, (8.8, 18.5), (2.3, 2.7), (2.8, 4.7), {BUS}),
    "tram": (objects.tram, (12.5, 34.5), (2.2, 2.7), (3.9, 5.4), {TRAIN}),
    "railway_wagon": (objects.railway_wagon, (10.0, 26.0), (2.5, 3.0), (2.2, 4.3), {TRAIN}),
    "bicycle": (
        partial(objects.two_wheeler, motor=False),
        (1.5, 2.1),
        (0.4, 0.9),
        (0.9, 1.3),
        {BICYCLE},
    ),
    "motorcycle": (
        partial(objects.two_wheeler, motor=True),
        (1.7, 2.4),
        (0.6, 1.0),
        (0.9, 1.3),
        {MOTORCYCLE},
    ),
    "rider": (objects.rider, (1.5, 2.4), (0.5, 0.9), (1.4, 2.1), {RIDER, BICYCLE, MOTORCYCLE}),
    "person": (objects.person, (0.2, 1.6), (0.3, 0.8), (1.0, 2.0), {PERSON, UNLABELLED}),
    "shelter": (
        objects.shelter,
        (2.8, 7.0),
        (1.2, 2.3),
        (2.4, 3.0),
        {BUILDING, POLE, TRAFFIC_SIGN, UNLABELLED},
    ),
    "shed": (
        lambda rng: landmarks.shed(rng, 4.0, 3.0, 2.5),
        (3.9, 5.9),
        (2.9, 4.9),
        (3.5, 8.5),
        {BUILDING},
    ),
    "church": (
        lambda rng: landmarks.church(rng, 13.0, 16.0),
        (12.9, 16.0),
        (16.0, 28.0),
        (14.0, 34.0),
        {BUILDING},
    ),
    "petrol": (
        lambda rng: landmarks.petrol_station(rng, 20.0, 12.0),
        (18.0, 21.5),
        (12.0, 15.0),
        (5.0, 9.0),
        {BUILDING, UNLABELLED, POLE, TRAFFIC_SIGN},
    ),
    "house": (
        lambda rng: building(rng, 10.0, 9.0, 6.0, "gable"),
        (9.9, 12.0),
        (8.9, 18.0),
        (7.0, 22.0),
        {BUILDING, VEGETATION},
    ),
    "flats": (
        lambda rng: building(rng, 18.0, 12.0, 17.0, "flat"),
        (17.9, 20.5),
        (11.9, 20.0),
        (17.0, 24.0),
        {BUILDING, VEGETATION},
    ),
}
POLES = [
    "lamp",
    "double",
    "park",
    "sign",
    "signals",
    "bollard",
    "mast",
    "flag",
    "gantry",
    "crossing",
    "parking",
    "street",
]
STANDING: dict[str, Make] = {
    **{name: row[0] for name, row in SIZES.items()},
    **{kind: partial(objects.pole, kind=kind) for kind in POLES},
    **{kind: partial(objects.street_clutter, kind=kind) for kind in CLUTTER},
    "bicycle_stand": objects.bicycle_stand,
}
LINE = np.column_stack([np.arange(0.0, 9.0), np.zeros(9)])


def corners(parts: Parts) -> Any:
    return np.concatenate([mesh.vertices[mesh.triangles].reshape(-1, 9) for mesh, _ in parts])


def same(a: Parts, b: Parts) -> bool:
    return len(a) == len(b) and all(
        x.vertices.tobytes() == y.vertices.tobytes()
        and x.triangles.tobytes() == y.triangles.tobytes()
        and i == j
        for (x, i), (y, j) in zip(a, b, strict=True)
    )


def floating(parts: Parts, gap: float = 0.15) -> int:
    """Connected pieces that reach neither the ground nor, box to box, a piece that does."""
    low: list[Any] = []
    high: list[Any] = []
    for mesh, _ in parts:
        pairs = np.concatenate([mesh.triangles[:, (0, 1)], mesh.triangles[:, (1, 2)]])
        n = len(mesh.vertices)
        count, piece = connected_components(
            coo_matrix((np.ones(len(pairs)), tuple(pairs.T)), (n, n)), directed=False
        )
        used = np.unique(piece[mesh.triangles.ravel()])
        for bounds, pick in ((low, np.minimum), (high, np.maximum)):
            extreme = np.full((count, 3), np.inf if pick is np.minimum else -np.inf)
            pick.at(extreme, piece, mesh.vertices)
            bounds.append(extreme[used])
    a = np.concatenate(low) - gap / 2
    b = np.concatenate(high) + gap / 2
    touch = ((a[:, None] <= b[None]) & (b[:, None] >= a[None])).all(2)
    _, group = connected_components(touch, directed=False)
    grounded = np.unique(group[a[:, 2] < 0.1])
    return int((~np.isin(group, grounded)).sum())


@pytest.mark.parametrize("name", SIZES)
def test_things_are_as_big_as_real_ones(name: str) -> None:
    make, *spans, classes = SIZES[name]
    for seed in SEEDS:
        parts = make(np.random.default_rng(seed))
        points = np.concatenate([mesh.vertices for mesh, _ in parts])
        size = points.max(0) - points.min(0)
        assert all(span[0] <= s <= span[1] for s, span in zip(size, spans, strict=True)), (
            seed,
            size,
        )
        assert {label for _, label in parts} <= classes


@pytest.mark.parametrize("name", STANDING)
def test_things_stand_on_the_ground_in_one_piece(name: str) -> None:
    for seed in SEEDS:
        parts = STANDING[name](np.random.default_rng(seed))
        for mesh, _ in parts:
            assert np.isfinite(mesh.vertices).all()
            assert 0 <= mesh.triangles.min() <= mesh.triangles.max() < len(mesh.vertices)
        assert floating(parts) == 0, seed
        assert same(parts, STANDING[name](np.random.default_rng(seed)))


@pytest.mark.parametrize(
    "make",
    [
        objects.garden_wall,
        objects.retaining_wall,
        objects.guard_rail,
        objects.pedestrian_rail,
        *FENCES,
    ],
)
def test_fences_follow_their_line(make: Any) -> None:
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        parts = objects.fence(rng, LINE, make) if isinstance(make, str) else make(rng, LINE)
        points = np.concatenate([mesh.vertices for mesh, _ in parts])
        assert {label for _, label in parts} <= {WALL, FENCE}
        assert np.abs(points[:, 1]).max() < 0.5
        assert points[:, 0].min() == pytest.approx(0.0, abs=0.4)
        assert points[:, 0].max() == pytest.approx(8.0, abs=0.4)
        assert 0.5 < points[:, 2].max() < 4.5
        assert floating(parts) == 0


@pytest.mark.parametrize("kind", SPECIES)
def test_a_bare_tree_has_the_same_trunk_and_less_crown(kind: str) -> None:
    cells = []
    for seed in SEEDS:
        first = np.random.default_rng(seed)
        second = np.random.default_rng(seed)
        summer = objects.tree(first, 1.0, kind)
        winter = objects.tree(second, 1.0, kind, bare=True)
        assert first.random() == second.random()  # later draws are the same, too
        if SPECIES[kind].evergreen:
            assert same(summer, winter)
            continue
        leafy, bare = ({row.tobytes() for row in corners(parts)} for parts in (summer, winter))
        trunk = corners(winter)[corners(winter)[:, 2::3].min(1) < 0.0]
        assert len(trunk) >= 14
        assert {row.tobytes() for row in trunk} <= leafy
        assert len(leafy & bare) > 120  # limbs and branches
        upper = [
            points[points[:, 2] > 0.3 * points[:, 2].max()]
            for points in (samples(summer), samples(winter))
        ]
        cells.append([len(np.unique(np.floor(p / 0.3), axis=0)) for p in upper])
    if cells:
        leafy_cells, bare_cells = np.sum(cells, axis=0)
        assert 0.1 * leafy_cells < bare_cells < 0.9 * leafy_cells


def samples(parts: Parts, step: float = 0.1) -> Any:
    """Points about ``step`` metres apart on every triangle."""
    triangles = corners(parts).reshape(-1, 3, 3)
    area = (
        np.linalg.norm(
            np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1
        )
        / 2
    )
    pick = np.repeat(np.arange(len(triangles)), np.ceil(area / step**2).astype(int))
    u, v = np.random.default_rng(0).uniform(size=(2, len(pick), 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    a, b, c = (triangles[pick, k] for k in range(3))
    return a + u * (b - a) + v * (c - a)


def test_bare_bushes_and_hedges_use_as_much_of_the_stream() -> None:
    for make in (objects.bush, partial(objects.hedge, path=LINE)):
        sizes = []
        for seed in SEEDS:
            first = np.random.default_rng(seed)
            second = np.random.default_rng(seed)
            summer = make(first)
            winter = make(second, bare=True)
            assert first.random() == second.random()
            sizes.append(len(samples(winter)) / len(samples(summer)))
        assert max(sizes) == 1.0  # evergreens
        assert min(sizes) < 0.6


def test_rays_pass_partly_through_a_crown() -> None:
    from semloc_logs.simulation.meshes.world import MeshBuilder, Scene

    passed = []
    for seed in SEEDS:
        parts = objects.tree(np.random.default_rng(seed), 1.0, "round")
        builder = MeshBuilder(lambda x, y: 0 * x)
        for mesh, label in parts:
            builder.add(mesh, label, ground="none")
        world = builder.build()
        middle = 0.6 * world.vertices[:, 2].max()
        z, y = (
            g.ravel()
            for g in np.meshgrid(
                np.linspace(middle - 1, middle + 1, 30), np.linspace(-1.2, 1.2, 30)
            )
        )
        origins = np.column_stack([np.full(900, -20.0), y, z]).astype(np.float32)
        distance, _, _ = Scene(world).cast(
            origins, np.broadcast_to(np.array([1, 0, 0], np.float32), origins.shape)
        )
        passed.append(float(np.isinf(distance).mean()))
    assert 0.05 < np.median(passed) < 0.6


def test_snow_lies_on_level_faces_of_buildings_and_vehicles() -> None:
    house = [(box(4.0, 3.0, 2.0), BUILDING), (box(1.0, 1.0, 1.0), VEGETATION)]
    covered = snow_cover(house, 0.25)
    assert [label for _, label in covered] == [BUILDING, BUILDING, VEGETATION]
    heights = np.unique(covered[1][0].vertices[:, 2])
    np.testing.assert_allclose(heights, [0.25, 2.25])


def test_shapes_have_their_volume() -> None:
    def volume(mesh: Mesh) -> float:
        a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
        return abs(float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6))

    assert volume(boxes(np.array([[1.0, 2, 3, 0, 0, 0], [2, 2, 2, 9, 9, 9]]))) == pytest.approx(
        14.0
    )
    square = np.array([[0.0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]])
    assert volume(loft(np.stack([square, np.add(square, [5.0, 0, 0])]))) == pytest.approx(20.0)
    tube = tubes(np.zeros((1, 3)), np.array([[0.0, 0, 2.0]]), 0.5, 0.5, 12)
    np.testing.assert_allclose(np.hypot(*tube.vertices[:, :2].T), 0.5)
    assert np.ptp(tube.vertices[:, 2]) == 2.0


def test_every_class_occurs_in_a_few_towns() -> None:
    seen: set[int] = {
        int(label)
        for seed in range(40)
        for _, label in objects.moving_vehicle(np.random.default_rng(seed))
    }
    for seed in range(3):
        network = grid_network(np.random.default_rng(seed), 2, 2, 45.0)
        seen |= set(np.unique(build_street(network, seed).labels).tolist())
    assert seen >= set(range(19)) - {10}
    assert {TRAFFIC_LIGHT, TRAIN, RIDER} <= seen
