"""Our pipeline, its ablations and the plain method localise in a small street whose truth is
known.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from semloc_logs.experiments.system import Query, RankedPose, View
from semloc_logs.experiments.systems.ours import Ours
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

ODOM_T_WORLD = yaw_transform(np.radians(70), (200.0, -30.0, 4.0))
SETTINGS = {
    "fusion.voxel_size": "0.5",
    "fusion.max_range": "25",
    "descriptor.reach": "15",
    "descriptor.headings": "8",
    "closures.hypotheses": "16",
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
        found = system.localise(hidden(query))
        metres, degrees = errors(found[0], query)
        assert metres < 0.25
        assert degrees < 1.0
        assert len(found) > 3
        scores = [pose.score for pose in found]
        assert scores == sorted(scores, reverse=True)
