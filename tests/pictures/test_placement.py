"""Where sessions lie in the picture: by the tree of closures, by optimised poses, side by side."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from semloc_logs.arrays import F64
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import inverse, yaw_transform
from semloc_logs.pictures.placement import Tie, fitted, keyframe_near, place_sessions
from semloc_logs.tables import contracts
from semloc_logs.tables.table import write_table
from semloc_logs.voxels.store import pose_columns
from semloc_logs.workspace import SessionFolder, Workspace

SECOND = 1_000_000_000


class Drive(SessionMap):
    """A session with the poses of its keyframes, a second apart, without any file."""

    def __init__(self, name: str, poses: F64, start: int = 0, posed: bool = True) -> None:
        super().__init__(SessionFolder(Path(name)))
        self.map_T_base = poses
        self.stamps_ns = (np.arange(len(poses)) + start) * SECOND
        self.json = {"voxel_size": 0.3}
        self._posed = posed

    @property
    def posed(self) -> bool:
        return self._posed


def straight(count: int, step: float = 10.0) -> F64:
    """A drive along x."""
    return np.stack([yaw_transform(0.0, (step * k, 0.0, 0.0)) for k in range(count)])


def closure(query: tuple[str, int], target: tuple[str, int], pose: F64, probability: float) -> Tie:
    """A closure between seconds of two drives."""
    stamps = query[1] * SECOND, target[1] * SECOND
    return Tie(query[0], target[0], *stamps, pose, probability, 0.5)


def test_a_session_lies_where_its_closure_puts_it(tmp_path: Path) -> None:
    maps = {"a": Drive("a", straight(4)), "b": Drive("b", straight(3), start=100)}
    # at its second keyframe, b looks against a's third one, 2 m to the left of it
    opposite = yaw_transform(np.pi, (0.0, 2.0, 0.0))
    rows = [closure(("b", 101), ("a", 2), opposite, 0.99)]
    placement = place_sessions(Workspace(tmp_path), maps, rows)
    places = placement.common_T_base["b"][:, :2, 3]
    np.testing.assert_allclose(places, [[30, 2], [20, 2], [10, 2]], atol=1e-9)
    assert placement.groups == [["a", "b"]]


def test_the_most_probable_closure_of_a_pair_counts(tmp_path: Path) -> None:
    maps = {"a": Drive("a", straight(4)), "b": Drive("b", straight(3), start=100)}
    rows = [
        closure(("b", 100), ("a", 0), yaw_transform(1.0, (5.0, 5.0, 0.0)), 0.991),
        closure(("b", 101), ("a", 1), np.eye(4), 0.999),
    ]
    placement = place_sessions(Workspace(tmp_path), maps, rows)
    np.testing.assert_allclose(placement.common_T_base["b"][0, :3, 3], [0, 0, 0], atol=1e-9)


def test_a_chain_is_placed_through_the_sessions_between(tmp_path: Path) -> None:
    maps = {name: Drive(name, straight(2), start=10 * k) for k, name in enumerate("abc")}
    ahead = yaw_transform(0.0, (1.0, 0.0, 0.0))
    # c is known by b, and b by a; the second link is found first, as it is more probable
    rows = [closure(("c", 20), ("b", 10), ahead, 0.999), closure(("b", 10), ("a", 0), ahead, 0.99)]
    placement = place_sessions(Workspace(tmp_path), maps, rows)
    assert [placement.common_T_base[n][0, 0, 3] for n in "abc"] == pytest.approx([0, 1, 2])


def test_groups_lie_240_voxels_apart(tmp_path: Path) -> None:
    maps = {f"s{k}": Drive(f"s{k}", straight(5 + k), start=100 * k) for k in range(6)}
    placement = place_sessions(Workspace(tmp_path), maps, [])
    assert placement.groups == [[f"s{k}"] for k in range(6)]
    places = [poses[:, :2, 3] for poses in placement.common_T_base.values()]
    boxes = [(p.min(0), p.max(0)) for p in places]
    for k, (low, high) in enumerate(boxes):
        for other_low, other_high in boxes[k + 1 :]:
            gaps = np.maximum(other_low - high, low - other_high)
            assert gaps.max() >= 240 * 0.3 - 1e-9


def test_optimised_poses_are_used_and_the_others_are_laid_on_them(tmp_path: Path) -> None:
    maps = {"a": Drive("a", straight(3)), "b": Drive("b", straight(2), start=50)}
    turned = yaw_transform(np.pi / 2, (100.0, 0.0, 0.0))
    columns = {"stamp_ns": maps["a"].stamps_ns, **pose_columns(turned @ straight(3))}
    path = tmp_path / "optimized" / "a.parquet"
    write_table(path, contracts.table("trajectory", columns), {"frame": "a"})
    rows = [closure(("b", 50), ("a", 1), np.eye(4), 0.99)]
    placement = place_sessions(Workspace(tmp_path), maps, rows)
    assert placement.optimised == {"a": "a"}
    np.testing.assert_allclose(placement.common_T_base["a"][2, :2, 3], [100, 20], atol=1e-9)
    np.testing.assert_allclose(placement.common_T_base["b"][1, :2, 3], [100, 20], atol=1e-9)


def test_optimised_frames_stay_apart_whatever_closures_tell(tmp_path: Path) -> None:
    maps = {name: Drive(name, straight(3), start=10 * k) for k, name in enumerate("abcd")}
    for name, frame in zip("abc", "aac", strict=True):
        columns = {"stamp_ns": maps[name].stamps_ns, **pose_columns(straight(3))}
        path = tmp_path / "optimized" / f"{name}.parquet"
        write_table(path, contracts.table("trajectory", columns), {"frame": frame})
    # the optimisation refused the closure of c in a; d is new, and better linked with c
    rows = [
        closure(("c", 20), ("a", 0), np.eye(4), 0.999),
        closure(("d", 30), ("c", 20), np.eye(4), 0.998),
        closure(("d", 30), ("b", 10), np.eye(4), 0.99),
    ]
    placement = place_sessions(Workspace(tmp_path), maps, rows)
    assert placement.groups == [["a", "b"], ["c", "d"]]


def test_optimised_poses_of_an_earlier_log_are_not_used(tmp_path: Path) -> None:
    maps = {"a": Drive("a", straight(3), start=1000)}
    columns = {"stamp_ns": np.arange(3) * SECOND, **pose_columns(straight(3))}
    path = tmp_path / "optimized" / "a.parquet"
    write_table(path, contracts.table("trajectory", columns), {})
    assert place_sessions(Workspace(tmp_path), maps, []).optimised == {}


def test_frames_without_poses_lie_where_their_closures_are(tmp_path: Path) -> None:
    maps = {
        "a": Drive("a", straight(4)),
        "frames": Drive("frames", np.stack([np.eye(4)] * 3), start=50, posed=False),
    }
    rows = [closure(("frames", 51), ("a", 3), yaw_transform(0.0, (0.0, 4.0, 0.0)), 0.99)]
    placement = place_sessions(Workspace(tmp_path), maps, rows)
    np.testing.assert_allclose(placement.common_T_base["frames"][1, :2, 3], [30, 4], atol=1e-9)
    assert np.isnan(placement.common_T_base["frames"][[0, 2]]).all()
    assert placement.groups == [["a"]]


def test_a_map_is_fitted_to_moved_poses() -> None:
    rng = np.random.default_rng(0)
    poses = np.stack([yaw_transform(0.0, rng.uniform(-50, 50, 3)) for _ in range(20)])
    moved = yaw_transform(0.7, (3.0, -4.0, 5.0))
    np.testing.assert_allclose(fitted(poses, moved @ poses), moved, atol=1e-9)
    # of one place the heading tells
    np.testing.assert_allclose(fitted(poses[:1], moved @ poses[:1]), moved, atol=1e-9)
    np.testing.assert_allclose(inverse(fitted(poses, poses)), np.eye(4), atol=1e-12)


def test_the_nearest_keyframe() -> None:
    drive = Drive("a", straight(3), start=10)
    stamps = [0, 10 * SECOND, 10 * SECOND + 400_000_000, 11 * SECOND + 600_000_000, 99 * SECOND]
    assert [keyframe_near(drive, stamp) for stamp in stamps] == [0, 0, 0, 2, 2]
