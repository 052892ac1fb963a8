"""Streets along recorded drives: where it was driven again it is the same street, and the road lies
under every pose.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from semloc_logs.arrays import F64
from semloc_logs.errors import LogError, SettingsError
from semloc_logs.simulation.drive_plan import Route, Town, plan_sessions
from semloc_logs.simulation.drives.trajectory import poses_along
from semloc_logs.simulation.meshes.world import ROAD, Scene
from semloc_logs.simulation.sensors.sensor import Sensor
from semloc_logs.simulation.sessions import simulate_sessions
from semloc_logs.simulation.town.road_network import RoadNetwork
from semloc_logs.simulation.town.road_survey import drive_network, opposite_lane, read_drive
from semloc_logs.simulation.town.street import build_street, street_ground


def eight(radius: float = 50.0, slope: float = 0.0) -> F64:
    """Two circles through the origin, driven over it twice at a right angle."""
    t = np.linspace(0, 2 * np.pi, int(2 * np.pi * radius * 1.3))
    plan = np.column_stack([np.sin(t), np.sin(2 * t)]) * radius
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(plan, axis=0), axis=1))])
    metres = np.arange(0.0, along[-1])
    plan = np.column_stack([np.interp(metres, along, plan[:, k]) for k in (0, 1)])
    return np.column_stack([plan, slope * plan[:, 0]])


def out_and_back(length: float = 150.0) -> F64:
    """A straight road, a loop at its end, and back in the other lane."""
    u = np.arange(length)
    turn = np.linspace(-np.pi / 2, np.pi * 0.99 / 2, int(np.pi * 16))
    loop = np.column_stack([length + 16 * np.cos(turn), 16 + 16 * np.sin(turn)])
    middle = np.column_stack([np.linspace(length, length - 30, 31), np.linspace(32, 3.5, 31)])
    back = np.column_stack([u[: int(length) - 31][::-1], np.full(int(length) - 31, 3.5)])
    plan = np.concatenate([np.column_stack([u, 0 * u]), loop, middle, back])
    return np.column_stack([plan, 0 * plan[:, 0]])


def write_kitti(path: Path, drive: F64) -> Path:
    """Positions with z up as the poses of a camera: x right, y down, z ahead."""
    rows = [f"1 0 0 {-y:.6f} 0 1 0 {-z:.6f} 0 0 1 {x:.6f}" for x, y, z in drive]
    path.write_text("\n".join(rows) + "\n")
    return path


def length(network: RoadNetwork) -> float:
    return sum(
        float(np.linalg.norm(np.diff(road.path, axis=0), axis=1).sum()) for road in network.roads
    )


def test_kitti_poses_are_those_of_a_camera_and_tum_poses_have_z_up(tmp_path: Path) -> None:
    drive = eight(slope=0.05)
    kitti = read_drive(write_kitti(tmp_path / "a.txt", drive))
    (tmp_path / "a.tum").write_text(
        "".join(f"{i} {x} {y} {z} 0 0 0 1\n" for i, (x, y, z) in enumerate(drive))
    )
    tum = read_drive(tmp_path / "a.tum")
    np.testing.assert_allclose(kitti, tum, atol=1e-4)
    assert len(tum) == pytest.approx(len(drive), abs=4)
    middle = tum[20:-20]
    np.testing.assert_allclose(middle[:, 2], 0.05 * middle[:, 0], atol=0.1)


def test_standing_and_trembling_make_no_street(tmp_path: Path) -> None:
    drive = out_and_back()
    noise = np.random.default_rng(0).normal(size=(300, 3)) * 0.05
    still = np.concatenate([drive[:60], drive[60] + noise, drive[60:]])
    np.testing.assert_allclose(
        read_drive(write_kitti(tmp_path / "b.txt", still))[:50],
        read_drive(write_kitti(tmp_path / "a.txt", drive))[:50],
        atol=0.3,
    )


def test_crossing_oneself_makes_a_crossing() -> None:
    drive = eight()
    network = drive_network(np.random.default_rng(0), drive)
    assert length(network) == pytest.approx(len(drive), rel=0.06)
    degree = np.bincount([c for road in network.roads for c in (road.a, road.b)])
    assert (degree == 4).sum() == 1
    assert np.linalg.norm(network.crossings[degree.argmax()]) < 4


@pytest.mark.parametrize("again", ["opposite", "same"])
def test_a_street_that_is_driven_again_is_the_same_street(again: str) -> None:
    if again == "opposite":
        drive = out_and_back()
        expected = 150 + 50 + 42 + 10
    else:
        t = np.linspace(0, 3 * np.pi, 600)
        plan = np.column_stack([60 * np.cos(t), 60 * np.sin(t)])
        drive = np.column_stack([plan, 0 * t])[::1]
        expected = int(2 * np.pi * 60)
    network = drive_network(np.random.default_rng(0), drive)
    assert length(network) == pytest.approx(expected, rel=0.12)
    assert length(network) < 0.85 * np.linalg.norm(np.diff(drive, axis=0), axis=1).sum()


def test_heights_of_two_passes_agree_and_rises_stay() -> None:
    t = np.linspace(0, 4 * np.pi, 800)
    drift = np.linspace(0, 3.0, 800)
    drive = np.column_stack([60 * np.cos(t), 60 * np.sin(t), 2 * np.sin(t) + drift])
    survey = drive_network(np.random.default_rng(0), drive).survey
    assert survey is not None
    z = survey[:800, 2]
    assert np.abs(z[:400] - z[400:]).max() < 0.35
    assert np.abs(np.diff(z) - np.diff(2 * np.sin(t))).max() < 0.03


@pytest.mark.parametrize("seed", range(4))
def test_the_road_lies_under_every_pose_and_nothing_stands_in_the_lane(seed: int) -> None:
    drive = [eight(slope=0.06), out_and_back()][seed % 2]
    network = drive_network(np.random.default_rng(seed), drive)
    ground = street_ground(network, seed)
    world = build_street(network, seed)
    scene = Scene(world)
    for line in (drive[:, :2], opposite_lane(drive[:, :2])[::-1]):
        poses = poses_along(
            line,
            np.arange(2.0, len(line) - 4.0, 0.7),
            ground.slope_height,
            np.random.default_rng(0),
            shake=0.0,
        )
        for across in (-1.0, 0.0, 1.0):
            origins = poses[:, :3, 3] + across * poses[:, :3, 1] + [0, 0, 0.2]
            down = np.tile(np.array([0, 0, -1], np.float32), (len(origins), 1))
            distance, triangle, _ = scene.cast(origins.astype(np.float32), down)
            assert (world.labels[triangle] == ROAD).all()
            assert np.abs(distance - 0.2).max() < 0.06
        for height in (0.3, 0.8, 1.4, 1.9):
            for side in (-1.2, 1.2):
                origins = poses[:, :3, 3] + height * poses[:, :3, 2]
                distance, _, _ = scene.cast(
                    origins.astype(np.float32), (side * poses[:, :3, 1]).astype(np.float32)
                )
                assert (distance > 1).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no poses"),
        ("1 2 3\n", "3 numbers"),
        ("".join(f"{k} {0.1 * k} 0 0 0 0 0 1\n" for k in range(100)), "shorter"),
        ("".join(f"{k} {k + 500 * (k > 50)} 0 0 0 0 0 1\n" for k in range(100)), "leaps"),
        ("".join(f"{k} {9000 * k} {9000 * k} 0 0 0 0 1\n" for k in range(100)), "spreads"),
        ("".join(f"{k} nan 0 0 0 0 0 1\n" for k in range(100)), "line 1"),
    ],
)
def test_what_is_no_drive_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.tum").write_text(text)
    with pytest.raises(LogError, match=message):
        read_drive(tmp_path / "a.tum")


def test_sessions_drive_the_same_part_there_and_back(tmp_path: Path) -> None:
    path = write_kitti(tmp_path / "a.txt", eight(30.0))
    simulate_sessions(
        tmp_path / "s",
        Town(seasons=("summer", "snow")),
        Route(2, trajectory=path, part_m=(20, 90), there_and_back=True),
        Sensor("vlp16", 0.2),
    )
    there, back = (np.loadtxt(tmp_path / "s" / f"session_{k}.tum")[:, 1:4] for k in (0, 1))
    for way in (there, back):
        assert np.linalg.norm(np.diff(way, axis=0), axis=1).sum() == pytest.approx(70, abs=9)
    assert 2.5 < np.linalg.norm(there[0] - back[-1]) < 5
    assert 2.5 < np.linalg.norm(there[-1] - back[0]) < 5
    with pytest.raises(SettingsError, match="give a part"):
        plan_sessions(Town(), Route(trajectory=path, part_m=(5000, 6000)))
    with pytest.raises(SettingsError, match="cannot go"):
        plan_sessions(Town(), Route(trajectory=path, part_m=(10, float("nan"))))


def test_a_drive_of_kitti_becomes_a_network(shared: Callable[[str], Path]) -> None:
    path = shared("trajectories/kitti_07.txt")
    drive = read_drive(path)
    assert len(drive) == pytest.approx(694, abs=10)
    network = drive_network(np.random.default_rng(0), drive)
    assert 600 < length(network) < 700
    z = street_ground(network, 0).slope_height(*drive[:, :2].T)
    assert np.abs((z - z.mean()) - (drive[:, 2] - drive[:, 2].mean())).max() < 0.5
