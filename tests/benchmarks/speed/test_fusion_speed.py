"""What fusion is measured with, how its limits are counted, and the peers beside it."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from semloc_logs.benchmarks.peers import peer_process
from semloc_logs.benchmarks.peers.peer_process import Peer, runner, write_scans
from semloc_logs.benchmarks.scans import Scan, depth_images, log_sweeps, street_sweeps
from semloc_logs.benchmarks.speed.fusion_speed import Case, clock_rate, measure, walk_all
from semloc_logs.errors import LogError, SemlocError, SettingsError
from semloc_logs.numerics.transforms import apply
from semloc_logs.settings import Settings

# answers as a peer does: one free voxel more a round
FAKE = """
import json, sys
from pathlib import Path
import numpy as np
count = len(np.load(Path(sys.argv[1]) / "poses.npy"))
for free, _ in enumerate(sys.stdin):
    times = {"ms": [5.0] * count, "cpu_ms": [4.0] * count, "finish_ms": 1.0}
    print(json.dumps({**times, "free": free, "occupied": 7}), flush=True)
"""


@pytest.fixture(scope="module")
def scans() -> list[Scan]:
    return depth_images(3, (24, 32))


def test_one_ray_is_walked_voxel_by_voxel() -> None:
    """Between the middles of voxels 0 and 3 along x: three free, one occupied, four steps."""
    assert walk_all(np.array([[3.5, 0.5, 0.5]]), np.array([0.5, 0.5, 0.5]), 1.0, 50.0) == (4, 3, 1)


def test_a_far_point_carves_and_does_not_hit() -> None:
    assert walk_all(np.array([[9.5, 0.5, 0.5]]), np.array([0.5, 0.5, 0.5]), 1.0, 4.0) == (5, 5, 0)


def test_steps_count_every_ray_and_voxels_count_once() -> None:
    points = np.array([[3.5, 0.5, 0.5], [3.5, 0.5, 0.5], [0.5, -2.5, 0.5]])
    assert walk_all(points, np.array([0.5, 0.5, 0.5]), 1.0, 50.0) == (4 + 4 + 4, 3 + 2, 2)


def test_walked_voxels_are_those_that_a_dense_sampling_of_the_rays_meets() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-6, 6, (40, 3))
    origin = np.array([0.13, 0.21, 0.37])
    _, free, occupied = walk_all(points, origin, 0.5, 50.0)
    along = origin + (points - origin)[:, None] * np.linspace(0, 1, 20_001)[:, None]
    seen = {tuple(v) for v in np.unique(np.floor(along.reshape(-1, 3) / 0.5).astype(int), axis=0)}
    hit = {tuple(v) for v in np.floor(points / 0.5).astype(int)}
    assert occupied == len(hit)
    # a corner that is cut by less than the sampling's step
    assert len(seen - hit) <= free <= len(seen - hit) + 3


def test_clock_is_that_of_a_processor() -> None:
    assert 2e8 < clock_rate(1_000_000) < 1e10


def test_sweeps_are_like_real_ones() -> None:
    first, second = street_sweeps(2, 20_000)
    reach = np.linalg.norm(first.points, axis=1)
    assert len(first.points) == len(first.label) == 20_000
    assert 8.0 < reach.mean() < 13.0
    assert (reach < 50.0).mean() > 0.97
    assert np.linalg.norm(second.map_T_sensor[:3, 3] - first.map_T_sensor[:3, 3]) == pytest.approx(
        1.2, abs=0.1
    )
    assert len(np.unique(first.label)) > 4


def test_depth_images_have_a_point_for_every_pixel_inside_the_room(scans: list[Scan]) -> None:
    for scan in scans:
        assert len(scan.points) == 24 * 32
        placed = apply(scan.map_T_sensor, scan.points)
        assert (np.abs(placed) < [3.9, 2.9, 3.1]).all()
        assert scan.points[:, 2].min() > 0.3
        assert np.linalg.det(scan.map_T_sensor[:3, :3]) == pytest.approx(1.0)
    assert placed[:, 2].min() < 0.15  # the floor is seen, so down is down


def test_sweep_of_a_log_is_seen_from_further_on(shared: Callable[[str], Path]) -> None:
    seen = log_sweeps(shared("logs/kitti00_000052.mcap"), 3)
    positions = np.array([s.map_T_sensor[:3, 3] for s in seen])
    assert np.linalg.norm(np.diff(positions, axis=0), axis=1) == pytest.approx([1.2, 1.2])
    assert len(seen[0].points) > 100_000
    assert len(np.unique(seen[0].label)) > 3


def test_log_without_clouds_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError):
        log_sweeps(tmp_path / "no.mcap")


def test_ours_and_peers_are_measured_in_turn(
    scans: list[Scan], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    script = tmp_path / "fake_runner.py"
    script.write_text(FAKE)
    monkeypatch.setattr(peer_process, "runner", lambda name: script)
    figures = measure(
        Case("depth", scans, 0.05, 8.0, 2, "a small image"),
        Settings().resolved(),
        {"fake": sys.executable},
    )
    assert figures["depth_ms"]["fake"] == 5.0
    assert figures["depth_cpu_ms"]["fake"] == 4.0
    # the third round: one to warm up and two that count
    assert figures["depth_free"]["fake"] == 2.0
    assert float(figures["depth_ms"]["ours"]) > 0
    assert float(figures["depth_occupied"]["ours"]) > 300
    assert all("unit" in row for row in figures.values())


def test_peer_that_fails_is_named_with_what_it_said(
    scans: list[Scan], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    script = tmp_path / "broken_runner.py"
    script.write_text("import this_is_not_installed")
    monkeypatch.setattr(peer_process, "runner", lambda name: script)
    write_scans(tmp_path, scans)
    with (
        Peer("broken", sys.executable, tmp_path, 0.05, 8.0, 1) as peer,
        pytest.raises(SemlocError, match=r"broken.*this_is_not_installed"),
    ):
        peer.round()


def test_peer_without_python_or_script_is_wrong_usage(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with pytest.raises(SettingsError, match="Unknown peer 'nobody'"):
        runner("nobody")
    monkeypatch.setattr(peer_process, "runner", lambda name: tmp_path / "x.py")
    with pytest.raises(SettingsError, match="cannot be started"):
        Peer("x", str(tmp_path / "no-python"), tmp_path, 0.3, 50.0, 1)


def test_every_peer_of_the_documentation_has_a_runner(repository: Path) -> None:
    text = (repository / "benchmarks" / "README.md").read_text()
    for script in sorted((repository / "benchmarks" / "peers").glob("*_runner.py")):
        assert f"--peer {script.name.removesuffix('_runner.py')}=" in text
