"""Streets: the road is where the network says, and a seed is a world."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from semloc_logs.errors import SettingsError
from semloc_logs.simulation.conditions import Condition
from semloc_logs.simulation.drives.traffic import pavement, random_traffic
from semloc_logs.simulation.drives.trajectory import (
    drifting_odometry,
    drive,
    poses_along,
    smooth_line,
)
from semloc_logs.simulation.meshes.world import (
    BUILDING,
    CAR,
    FENCE,
    PERSON,
    POLE,
    ROAD,
    SIDEWALK,
    TERRAIN,
    TRAFFIC_SIGN,
    VEGETATION,
    Scene,
    World,
)
from semloc_logs.simulation.town.hall import build_hall, hall_walk
from semloc_logs.simulation.town.road_network import (
    RoadNetwork,
    grid_network,
    lane_path,
    path_network,
    random_route,
    repeating_network,
)
from semloc_logs.simulation.town.street import build_street, street_ground


@pytest.fixture(scope="module")
def network() -> RoadNetwork:
    return grid_network(np.random.default_rng(4), 2, 2, 50.0)


@pytest.fixture(scope="module")
def world(network: RoadNetwork) -> World:
    return build_street(network, 4)


def same(a: World, b: World) -> bool:
    return all(
        x.tobytes() == y.tobytes()
        for x, y in ((a.vertices, b.vertices), (a.triangles, b.triangles), (a.labels, b.labels))
    )


def faces(world: World) -> set[bytes]:
    """Every triangle with its label, whatever the numbers of its vertices."""
    corners = world.vertices[world.triangles].reshape(-1, 9)
    return {
        c.tobytes() + bytes([label])
        for c, label in zip(corners, world.labels.tolist(), strict=True)
    }


def test_a_seed_is_a_world(network: RoadNetwork, world: World) -> None:
    assert same(world, build_street(network, 4))
    assert not same(world, build_street(network, 5))


def test_a_condition_changes_some_of_it(network: RoadNetwork, world: World) -> None:
    other = build_street(network, 4, condition=1)
    first = faces(world)
    second = faces(other)
    common = len(first & second)
    assert common < len(first)
    assert common > 0.8 * max(len(first), len(second))


def test_a_season_changes_the_trees_and_nothing_else(network: RoadNetwork, world: World) -> None:
    summer = faces(world)
    for season, least in (("autumn", 0.3), ("winter", 0.0)):
        other = faces(build_street(network, 4, Condition(0, season)))
        assert {face[-1] for face in summer ^ other} == {VEGETATION}
        assert (other < summer) == (season == "autumn")  # in winter there are twigs
        assert (
            least
            < sum(f[-1] == VEGETATION for f in other) / sum(f[-1] == VEGETATION for f in summer)
            < 0.95
        )


@pytest.mark.parametrize(
    "wrong",
    [
        {"season": "spring"},
        {"daytime": "night"},
        {"roadworks": -1.0},
        {"roadworks": float("nan")},
        {"rebuilt": 1.5},
    ],
)
def test_conditions_that_cannot_be_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(SettingsError):
        Condition(**wrong)


def test_labels_are_train_ids_and_triangles_are_in_range(world: World) -> None:
    assert (
        {ROAD, SIDEWALK, 2, 5, 8, TERRAIN}
        <= set(np.unique(world.labels).tolist())
        <= ({*range(19), 255} - {10})
    )
    assert world.triangles.min() == 0
    assert world.triangles.max() == len(world.vertices) - 1
    assert np.isfinite(world.vertices).all()


def test_the_driven_lane_is_road_at_the_height_of_the_poses(
    network: RoadNetwork, world: World
) -> None:
    route = random_route(np.random.default_rng(0), network, 150)
    line = smooth_line(lane_path(network, route))
    ground = street_ground(network, 4)
    poses = poses_along(line, np.arange(3.0, 140.0), ground.slope_height, np.random.default_rng(0))
    origins = poses[:, :3, 3] + [0, 0, 0.25]
    down = np.tile(np.array([0, 0, -1], np.float32), (len(origins), 1))
    distance, triangle, _ = Scene(world).cast(origins.astype(np.float32), down)
    assert (world.labels[triangle] == ROAD).all()
    assert np.abs(distance - 0.25).max() < 0.03


def test_kerbs_are_12_centimetres(network: RoadNetwork) -> None:
    ground = street_ground(network, 4)
    road, walk = (np.argwhere(ground.kind == kind)[::50] for kind in (ROAD, SIDEWALK))
    for cells, step in ((road, 0.0), (walk, 0.12)):
        x, y = (ground.corner + 0.5 * (cells + 0.5)).T
        np.testing.assert_allclose(
            ground.height(x, y) - ground.slope_height(x, y), step, atol=1e-12
        )


def test_grids_have_no_dead_ends() -> None:
    for seed in range(20):
        network = grid_network(np.random.default_rng(seed), 4, 3, 80.0)
        degree = np.bincount([c for road in network.roads for c in (road.a, road.b)], minlength=12)
        assert degree.min() >= 2


def test_routes_are_connected_and_never_turn_back() -> None:
    network = grid_network(np.random.default_rng(1), 3, 3, 80.0)
    route = random_route(np.random.default_rng(2), network, 1500)
    ends = [
        (r.a, r.b) if forwards else (r.b, r.a)
        for r, forwards in ((network.roads[k], f) for k, f in route)
    ]
    assert all(before[1] == after[0] for before, after in pairwise(ends))
    assert all(a[0] != b[0] for a, b in pairwise(route))


def test_traffic_keeps_to_the_right() -> None:
    network = path_network(
        np.random.default_rng(0), np.column_stack([np.arange(100.0), np.zeros(100)])
    )
    lane, back = (lane_path(network, [(0, forwards)]) for forwards in (True, False))
    expected = network.roads[0].lane
    np.testing.assert_allclose(lane[:, 1], -expected)
    np.testing.assert_allclose(back[:, 1], expected)


def test_a_path_that_is_driven_twice_is_one_road() -> None:
    there = np.column_stack([np.arange(0.0, 120.0), np.zeros(120)])
    network = path_network(
        np.random.default_rng(0), np.concatenate([there, there[::-1] + np.array([0.0, 2.0])])
    )
    assert sum(len(road.path) for road in network.roads) < 160


def test_a_long_path_can_be_driven_from_end_to_end() -> None:
    network = path_network(
        np.random.default_rng(0),
        np.column_stack([np.arange(0.0, 400.0), 20 * np.sin(np.arange(400) / 60)]),
    )
    assert len(network.roads) == 3
    assert [(road.a, road.b) for road in network.roads] == [(0, 1), (1, 2), (2, 3)]


def test_poses_point_along_the_line_and_up_the_slope() -> None:
    line = np.column_stack([np.linspace(0, 50, 101), np.linspace(0, 50, 101)])
    pose = poses_along(
        line, np.array([20.0]), lambda x, y: 0.1 * x, np.random.default_rng(0), shake=0.0
    )[0]
    slope = 0.1 / np.sqrt(2)
    np.testing.assert_allclose(
        pose[:3, 0],
        np.array([1 / np.sqrt(2), 1 / np.sqrt(2), slope]) / np.hypot(1, slope),
        atol=1e-6,
    )
    np.testing.assert_allclose(
        pose[:3, 3], [20 / np.sqrt(2), 20 / np.sqrt(2), 2 / np.sqrt(2)], atol=1e-6
    )


def test_odometry_drifts_by_about_a_hundredth() -> None:
    line = smooth_line(np.array([[0.0, 0], [200, 0], [200, 150], [0, 150]]))
    share = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        trajectory = drive(line, lambda x, y: 0 * x, rng, start_ns=10**18)
        np.testing.assert_array_equal(trajectory.odom_T_base[0], np.eye(4))
        np.testing.assert_allclose(np.linalg.det(trajectory.odom_T_base[-1][:3, :3]), 1.0)
        first = np.linalg.inv(trajectory.world_T_base[0])
        share.append(
            np.linalg.norm(
                (first @ trajectory.world_T_base[-1] - trajectory.odom_T_base[-1])[:3, 3]
            )
            / 550
        )
    assert 0.002 < np.median(share) < 0.012
    assert max(share) < 0.03


def test_perfect_odometry_follows_the_truth() -> None:
    line = smooth_line(np.array([[0.0, 0], [60, 0], [60, 50]]))
    truth = drive(line, lambda x, y: 0.02 * x, np.random.default_rng(1), start_ns=0).world_T_base
    np.testing.assert_allclose(
        drifting_odometry(truth, np.random.default_rng(0), drift=0.0),
        np.linalg.inv(truth[0]) @ truth,
        atol=1e-9,
    )


def test_drives_are_as_fast_as_asked_and_slow_down_in_bends() -> None:
    line = smooth_line(np.array([[0.0, 0], [150, 0], [150, 150]]))
    trajectory = drive(line, lambda x, y: 0 * x, np.random.default_rng(3), start_ns=0, speed=8.0)
    step = np.linalg.norm(np.diff(trajectory.world_T_base[:, :2, 3], axis=0), axis=1) * 20
    corner = np.linalg.norm(trajectory.world_T_base[:-1, :2, 3] - [149, 1], axis=1) < 3
    assert step[corner].max() < 5.5
    assert np.median(step) == pytest.approx(8.0, abs=1.5)


def test_traffic_keeps_off_the_own_vehicle(network: RoadNetwork) -> None:
    ground = street_ground(network, 4)
    line = smooth_line(lane_path(network, random_route(np.random.default_rng(0), network, 150)))
    traffic = random_traffic(np.random.default_rng(1), ground, [line], 5.0)
    assert len(traffic.vehicles) > 2
    _, _, start, _ = traffic.vehicles[0]
    pose = poses_along(
        line, np.array([start]), ground.slope_height, np.random.default_rng(0), shake=0.0
    )[0]
    scene = traffic.scene(0.0, pose)
    assert scene is not None
    down = np.array([[0, 0, -1]], np.float32)
    assert np.isinf(scene.cast((pose[:3, 3] + [0, 0, 5]).astype(np.float32)[None], down)[0]).all()


def test_halls_are_closed_and_walked_inside() -> None:
    for seed in (5, 11):
        world = build_hall(seed)
        assert same(world, build_hall(seed))
        path = smooth_line(hall_walk(seed, 60.0), 0.8)[5:-5:10]
        rng = np.random.default_rng(0)
        directions = rng.normal(size=(2000, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        origins = np.column_stack([path[rng.integers(0, len(path), 2000)], np.full(2000, 1.5)])
        distance, _, _ = Scene(world).cast(
            origins.astype(np.float32), directions.astype(np.float32)
        )
        assert np.isinf(distance).mean() < 0.01
        assert distance[np.isfinite(distance)].max() < 80


def test_snow_lies_where_nobody_drives(network: RoadNetwork) -> None:
    summer = build_street(network, 4)
    snow = build_street(network, 4, Condition(0, "snow"))
    route = random_route(np.random.default_rng(0), network, 150)
    line = smooth_line(lane_path(network, route))
    poses = poses_along(
        line,
        np.arange(3.0, 140.0),
        street_ground(network, 4).slope_height,
        np.random.default_rng(0),
        shake=0.0,
    )
    road = poses[:, :3, 3] + [0, 0, 0.5]
    down = np.tile(np.array([0, 0, -1], np.float32), (len(road), 1))
    distance, triangle, _ = Scene(snow).cast(road.astype(np.float32), down)
    assert (snow.labels[triangle] == ROAD).all()
    assert np.abs(distance - 0.48).max() < 0.03
    ground = street_ground(network, 4)
    cells = np.argwhere((ground.kind == TERRAIN) & (ground.beside > 3))[::200]
    above = np.column_stack(
        [ground.corner + 0.5 * (cells + 0.5), np.full(len(cells), 100.0)]
    ).astype(np.float32)
    rays = np.tile(np.array([0, 0, -1], np.float32), (len(above), 1))
    before, after = (Scene(world).cast(above, rays) for world in (summer, snow))
    same = (summer.labels[before[1]] == TERRAIN) & (snow.labels[after[1]] == TERRAIN)
    rise = (before[0] - after[0])[same]
    assert same.sum() > 50
    assert 0.05 < rise.min() < rise.max() < 0.5
    roofs = (summer.labels[before[1]] == BUILDING) & (snow.labels[after[1]] == BUILDING)
    assert 0.09 < np.median((before[0] - after[0])[roofs]) < 0.31


def test_houses_and_trunks_are_the_same_in_every_season(network: RoadNetwork) -> None:
    houses = [
        {
            face
            for face in faces(build_street(network, 4, Condition(0, season)))
            if face[-1] in (BUILDING, POLE, TRAFFIC_SIGN)
        }
        for season in ("summer", "autumn", "winter", "snow")
    ]
    assert houses[0] == houses[1] == houses[2]
    assert houses[0] < houses[3]


def test_roadworks_close_a_side_and_leave_the_lane_open() -> None:
    network = grid_network(np.random.default_rng(6), 2, 2, 58.0)
    before = build_street(network, 6)
    after = build_street(network, 6, Condition(0, roadworks=40.0))
    added = faces(after) - faces(before)
    assert {FENCE, TERRAIN, 255} <= {face[-1] for face in added}
    # bins on posts and planters, which people move, make way
    assert {f for f in faces(before) - faces(after) if f[-1] in (BUILDING, TRAFFIC_SIGN)} == set()
    line = smooth_line(lane_path(network, random_route(np.random.default_rng(0), network, 300)))
    poses = poses_along(
        line,
        np.arange(3.0, 280.0, 0.5),
        street_ground(network, 6).slope_height,
        np.random.default_rng(0),
        shake=0.0,
    )
    down = np.tile(np.array([0, 0, -1], np.float32), (len(poses), 1))
    distance, triangle, _ = Scene(after).cast(
        (poses[:, :3, 3] + [0, 0, 0.25]).astype(np.float32), down
    )
    assert (after.labels[triangle] == ROAD).all()
    assert np.abs(distance - 0.25).max() < 0.03


def test_rebuilt_houses_are_other_houses_and_nothing_else_changes(
    network: RoadNetwork, world: World
) -> None:
    rebuilt = build_street(network, 4, Condition(0, rebuilt=0.4))
    first = faces(world)
    second = faces(rebuilt)
    assert {face[-1] for face in first - second} == {BUILDING}
    assert {face[-1] for face in second - first} <= {BUILDING, FENCE}
    kept = {f for f in first & second if f[-1] == BUILDING}
    assert 0.3 < len(kept) / sum(f[-1] == BUILDING for f in first) < 0.95


@pytest.mark.parametrize("seed", range(4))
def test_nothing_stands_in_the_lanes(seed: int) -> None:
    network = grid_network(np.random.default_rng(seed), 2, 2, 60.0)
    scene = Scene(build_street(network, seed, Condition(1, roadworks=20.0, rebuilt=0.2)))
    ground = street_ground(network, seed)
    for route in ([(k, forwards)] for k in range(len(network.roads)) for forwards in (True, False)):
        line = smooth_line(lane_path(network, route))
        poses = poses_along(
            line,
            np.arange(2.0, 0.5 * len(line) - 3, 0.6),
            ground.slope_height,
            np.random.default_rng(0),
            shake=0.0,
        )
        for height in (0.3, 0.9, 1.6):
            for side in (-1.1, 1.1):
                origins = poses[:, :3, 3] + height * poses[:, :3, 2]
                distance, _, _ = scene.cast(
                    origins.astype(np.float32), (side * poses[:, :3, 1]).astype(np.float32)
                )
                assert (distance > 1).all()


def test_routes_stay_on_the_road_and_keep_islands_to_their_left() -> None:
    rounded = 0
    for seed in range(12):
        network = grid_network(np.random.default_rng(seed), 3, 3, 80.0)
        ground = street_ground(network, seed)
        line = smooth_line(
            lane_path(network, random_route(np.random.default_rng(seed), network, 600))
        )
        assert ground.beside[ground.cell(*line.T)].max() < 0
        for circle in network.roundabouts.values():
            arm = line - [circle.x, circle.y]
            in_circle = np.flatnonzero(np.linalg.norm(arm[:-1], axis=1) < circle.lane + 0.6)
            assert np.linalg.norm(arm, axis=1).min() > circle.inner + 1.0
            step = np.diff(line, axis=0)[in_circle]
            assert (arm[in_circle, 0] * step[:, 1] - arm[in_circle, 1] * step[:, 0] > 0).all()
            rounded += len(in_circle)
    assert rounded > 100


def test_blind_alleys_and_refuges_are_drawn_and_no_route_takes_them() -> None:
    networks = [grid_network(np.random.default_rng(seed), 3, 3, 85.0) for seed in range(20)]
    assert sum(len(n.stubs) for n in networks) > 20
    assert sum(c.inner < 1.5 and c.outer == 0 for n in networks for c in n.circles) > 8
    for network in networks:
        ground = street_ground(network, 0)
        for stub in network.stubs:
            assert ground.beside[ground.cell(*stub.path.T)].max() < -0.5
        for circle in network.circles:
            inside = ground.kind[ground.cell(np.array([circle.x]), np.array([circle.y]))][0]
            assert inside == (
                ROAD if not circle.inner else TERRAIN if circle.inner > 1.5 else SIDEWALK
            )


def test_blocks_of_a_repeating_town_are_copies() -> None:
    network = repeating_network(np.random.default_rng(3), 3, 3, 60.0)
    world = build_street(network, 3)
    assert same(world, build_street(network, 3))
    shift = network.crossings[3] - network.crossings[0]
    x, y = np.meshgrid(np.arange(6.0, shift[0] - 6, 0.9), np.arange(6.0, 54.0, 0.9))
    down = np.tile(np.array([0, 0, -1], np.float32), (x.size, 1))
    views = []
    for block in (0, 1):
        origins = np.column_stack([x.ravel() + block * shift[0], y.ravel(), np.full(x.size, 60.0)])
        distance, triangle, _ = Scene(world).cast(origins.astype(np.float32), down)
        views.append((distance, world.labels[triangle]))
    fixed = np.isin(views[0][1], (BUILDING, SIDEWALK, TERRAIN)) & np.isin(
        views[1][1], (BUILDING, SIDEWALK, TERRAIN)
    )
    assert (views[0][1] == BUILDING).mean() > 0.05
    assert (np.abs(views[0][0] - views[1][0])[fixed] < 0.05).mean() > 0.97


def test_towns_are_hilly_and_never_steeper_than_they_may_be() -> None:
    network = grid_network(np.random.default_rng(0), 2, 2, 80.0)
    steepest = []
    for seed in range(30):
        ground = street_ground(network, seed)
        x, y = np.meshgrid(np.arange(-200.0, 200.0, 7), np.arange(-200.0, 200.0, 7))
        rise = ground.slope_height(x.ravel() + 1, y.ravel()) - ground.slope_height(
            x.ravel(), y.ravel()
        )
        steepest.append(np.abs(rise).max())
    assert max(steepest) < 0.081
    assert max(steepest) > 0.045
    assert min(steepest) < 0.02


def test_people_walk_beside_the_road(network: RoadNetwork) -> None:
    ground = street_ground(network, 4)
    line = smooth_line(lane_path(network, random_route(np.random.default_rng(0), network, 150)))
    way = pavement(ground, line)
    assert (ground.beside[ground.cell(*way.T)] > 0).mean() > 0.75
    assert np.linalg.norm(way - line, axis=1).min() > 1.4
    traffic = random_traffic(np.random.default_rng(1), ground, [line], 4.0)
    labels = {label for parts, *_ in traffic.vehicles for _, label in parts}
    assert PERSON in labels
    assert CAR in labels
