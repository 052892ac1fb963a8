from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from semloc_logs.alignment.covariance import SPREAD_SHARE
from semloc_logs.closures.closure_tables import keyframe_at
from semloc_logs.closures.query import (
    build_query,
    query_keyframes,
    query_members,
    stretch,
)
from semloc_logs.errors import SettingsError, WorkspaceError
from semloc_logs.mapping.selection import road_distance
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import apply, yaw_transform
from semloc_logs.settings import Resolved, Settings
from semloc_logs.tables import contracts
from semloc_logs.tables.table import read_table, write_json, write_table
from semloc_logs.voxels.store import Keyframe, keep_keyframes, pose_columns
from semloc_logs.workspace import SessionFolder


def session(
    folder: Path,
    poses: NDArray[np.float64],
    clouds: list[NDArray[np.float32]] | None = None,
    posed: bool = True,
) -> SessionMap:
    """A fused session of these keyframes, with what queries read."""
    n = len(poses)
    clouds = clouds or [np.zeros((1, 3), np.float32)] * n
    frames: dict[str, Any] = {
        "keyframe": np.arange(n),
        "stamp_ns": np.arange(n) * 10**8,
        "log_time_ns": np.arange(n) * 10**8,
        "topic": ["/points"] * n,
        "posed": [posed] * n,
        "distance": road_distance(poses) if posed else np.zeros(n),
        "ground_z": np.zeros(n),
        "points": [len(c) for c in clouds],
        **{
            f"origin_{c}": np.full(n, value)
            for c, value in zip("xyz", (0.5, 0.0, 1.5), strict=True)
        },
        **{f"view_{c}": np.zeros(n) for c in "xyz"},
        **pose_columns(poses),
    }
    write_table(folder / "frames.parquet", contracts.table("frames", frames), {})
    (folder / "keyframes").mkdir()
    list(
        keep_keyframes(
            folder / "keyframes",
            range(n),
            [Keyframe(c, np.full(len(c), 2, np.uint8)) for c in clouds],
            {},
        )
    )
    write_json(folder / "session.json", {"posed": posed, "label_source": "log", "submaps": []})
    return SessionMap(SessionFolder(folder))


def straight(n: int, step: float = 0.6) -> NDArray[np.float64]:
    return np.array([yaw_transform(0.0, (step * i, 0.0, 0.0)) for i in range(n)])


def settings(**query: Any) -> Resolved:
    return Settings.model_validate({"query": query}).resolved()


def test_queries_every_two_metres_and_at_turns(tmp_path: Path) -> None:
    s = session(tmp_path, straight(12))
    assert query_keyframes(s, settings()) == [0, 4, 8]  # 2.4 m
    assert query_keyframes(s, settings(every=0.1)) == list(range(12))
    turning = np.array([yaw_transform(0.1 * i, (0.01 * i, 0.0, 0.0)) for i in range(12)])
    (tmp_path / "turning").mkdir()
    assert query_keyframes(session(tmp_path / "turning", turning), settings()) == [0, 4, 8]
    (tmp_path / "unposed").mkdir()
    assert query_keyframes(
        session(tmp_path / "unposed", np.repeat(np.eye(4)[None], 3, 0), posed=False), settings()
    ) == [0, 1, 2]


def test_members_of_a_query(tmp_path: Path) -> None:
    s = session(tmp_path, straight(12))
    assert query_members(s, 6, settings()) == [4, 5, 6, 7, 8]
    assert query_members(s, 0, settings()) == [0, 1, 2, 3, 4]
    assert query_members(s, 11, settings()) == [7, 8, 9, 10, 11]
    assert query_members(s, 5, settings(frames=1)) == [5]
    assert query_members(s, 5, settings(frames=50)) == list(range(12))
    assert query_members(s, 6, settings(length=3.0)) == [4, 5, 6, 7, 8]
    assert query_members(s, 0, settings(length=3.0)) == [0, 1, 2]
    (tmp_path / "unposed").mkdir()
    assert query_members(
        session(tmp_path / "unposed", straight(3), posed=False), 1, settings()
    ) == [1]


def test_members_beyond_a_jump_are_left_out(tmp_path: Path) -> None:
    """Two logs back to back, or positions that came back: a map of both ends would be kilometres
    wide.
    """
    poses = straight(10)
    poses[5:, 0, 3] += 2000
    s = session(tmp_path, poses)
    assert query_members(s, 4, settings()) == [2, 3, 4]
    assert query_members(s, 5, settings()) == [5, 6, 7]


def test_the_query_map_lies_around_its_keyframe(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    poses = np.array([yaw_transform(0.5, (1000.0 + 0.5 * i, 50.0, 3.0)) for i in range(5)])
    clouds = [
        rng.uniform(-40, 40, (400, 3)).astype(np.float32) * np.array([1, 1, 0.1], np.float32)
        for _ in range(5)
    ]
    s = session(tmp_path, poses, clouds)
    query, query_T_base = build_query(s, 2, settings(radius=20.0))
    np.testing.assert_allclose(query_T_base, yaw_transform(0.5), atol=1e-12)
    origin = np.array([0.5, 0.0, 1.5])
    expected = []
    for i in range(5):
        kept = np.round(clouds[i] * 512) / 512
        kept = kept[np.linalg.norm(kept - origin, axis=1) < 20]
        expected.append(apply(yaw_transform(0.0, (-1001.0, -50.0, -3.0)) @ poses[i], kept))
    every = np.concatenate(expected)
    distance = np.linalg.norm(query.points[:, None] - every[None], axis=2).min(1)
    assert distance.max() < 1e-5  # nothing but seen points, thinned
    assert len(query.points) > 0.5 * len(every)
    assert len(np.unique(np.floor(query.points / 0.15).astype(int), axis=0)) >= 0.99 * len(
        query.points
    )
    voxels = {tuple(v) for v in query.blocks.occupied()[0].tolist()}
    assert voxels <= {tuple(v) for v in np.floor(every / 0.3).astype(int).tolist()}
    assert len(voxels) > 0.5 * len(every)


@pytest.mark.parametrize(("length", "reach"), [(None, 22.0), (20.0, 30.0), (90.0, 65.0)])
def test_a_long_query_is_whole(tmp_path: Path, length: float | None, reach: float) -> None:
    """Each keyframe of a drive of 120 m saw a wall 20 m ahead of it; the wall of the last member is
    in the query's map.
    """
    wall = np.stack(
        np.broadcast_arrays(20.0, np.linspace(-3, 3, 21)[:, None], np.linspace(0.1, 2, 9)), -1
    ).reshape(-1, 3)
    poses = straight(61, 2.0)
    s = session(tmp_path, poses, [wall.astype(np.float32)] * 61)
    query, _ = build_query(s, 30, settings(length=length, frames=3))
    farthest = query.points[:, 0].max()
    np.testing.assert_allclose(farthest, reach, atol=1.1)  # the members are 2 m apart
    assert query.reach * 0.3 == pytest.approx(np.hypot(farthest, 3), abs=0.5)


def test_a_query_may_not_be_so_long_that_its_map_has_no_bounds() -> None:
    assert settings(length=200.0).query.length == 200.0
    with pytest.raises(SettingsError, match=r"query\.length"):
        settings(length=201.0)
    with pytest.raises(SettingsError, match=r"33\.|34"):
        Settings.model_validate(
            {"query": {"length": 34.0}, "fusion": {"voxel_size": 0.05}}
        ).resolved()


def test_the_keyframe_at_a_stamp(tmp_path: Path) -> None:
    s = session(tmp_path, straight(5))
    assert [keyframe_at(s, t) for t in (-5, 0, 10**8, 149_999_999, 150_000_001, 10**12)] == [
        0,
        0,
        1,
        1,
        2,
        4,
    ]


def test_a_session_of_an_earlier_version_is_named(tmp_path: Path) -> None:
    s = session(tmp_path, straight(3))
    np.testing.assert_allclose(s.views, s.map_T_base[:, :3, 3])
    frames = read_table(s.folder.frames)
    write_table(s.folder.frames, frames.drop_columns(["view_x", "view_y", "view_z"]), {})
    with pytest.raises(
        WorkspaceError,
        match=r"frames\.parquet is of an earlier version: fuse session .* again with --overwrite",
    ):
        _ = SessionMap(s.folder).views


def test_points_of_a_camera_keep_their_spread(tmp_path: Path) -> None:
    """A point 4 m ahead of an eye at (0.5, 0, 1.5), known to 0.2 m along its ray, in a keyframe
    that looks along the map's y.
    """
    poses = np.array([yaw_transform(np.pi / 2, (3.0, 2.0, 0.0))])
    s = session(tmp_path, poses, [np.array([[4.5, 0.0, 1.5]], np.float32)])
    cloud = Keyframe(
        np.array([[4.5, 0.0, 1.5]], np.float32),
        np.full(1, 2, np.uint8),
        np.full(1, 0.2, np.float32),
    )
    list(keep_keyframes(s.folder.keyframes, [0], [cloud], {}))
    query, _ = build_query(s, 0, settings())
    assert query.spread is not None
    np.testing.assert_allclose(query.spread, [[0.0, 0.2, 0.0]], atol=1e-4)
    assert query.sigma == pytest.approx(0.2, abs=1e-4)


def test_a_stretch_leads_from_a_pose_to_what_its_map_is_made_from(tmp_path: Path) -> None:
    """Keyframes 1 m apart: two on either side; all four ahead; three of them 5 to 7 m ahead."""
    s = session(tmp_path, straight(12, 1.0))
    assert stretch(s, 6, [4, 5, 6, 7, 8]).road == pytest.approx(np.sqrt(SPREAD_SHARE * 2.0))
    ahead = stretch(s, 0, [0, 1, 2, 3, 4])
    assert ahead.road == pytest.approx(np.sqrt(2.0**2 + SPREAD_SHARE * 2.0))
    seen = stretch(s, 2, np.array([7, 8, 9]))
    assert seen.road == pytest.approx(np.sqrt(6.0**2 + SPREAD_SHARE * 2.0 / 3.0))
    assert stretch(s, 8, [8]).road == 0.0
