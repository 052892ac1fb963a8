"""Drives around a square block whose odometry drifts in a known way, as tables of a workspace."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semloc_logs.arrays import F64
from semloc_logs.logs.poses.navsat import LocalFrame
from semloc_logs.numerics.transforms import apply, exp_se3, inverse, yaw_transform
from semloc_logs.tables import contracts
from semloc_logs.tables.table import write_json, write_table
from semloc_logs.voxels.store import Keyframe, keep_keyframes, pose_columns
from semloc_logs.workspace import Workspace

SECOND = 1_000_000_000
METADATA = {"schema_version": 1, "voxel_size": 0.3}
SIDE_M = 100
DATUM = (47.37, 8.54, 410.0)  # WGS 84 degrees, m
# how a map lies in its session frame: a shift, and a tilt of the sensor's odometry
SESSION_T_MAP = exp_se3(np.array([3.0, -2.0, 1.0]), np.radians([4.0, -3.0, 50.0]))

# query session, its second, target session, its second, and a wrong shift of the pose, or None
Match = tuple[str, int, str, int, F64 | None]


def square(laps: int = 1) -> F64:
    """Poses (n, 4, 4) around a block of 100 m, 1 m and 1 s apart, to the left."""
    poses = []
    for k in range(laps * 4 * SIDE_M + 1):
        side, along = divmod(k, SIDE_M)
        corner = [(0, 0), (SIDE_M, 0), (SIDE_M, SIDE_M), (0, SIDE_M)][side % 4]
        heading = side % 4 * np.pi / 2
        x = corner[0] + along * np.cos(heading)
        y = corner[1] + along * np.sin(heading)
        poses.append(yaw_transform(heading, (x, y, 0.0)))
    return np.array(poses)


def drifted(common_T_base: F64, turn_deg_per_m: float, scale: float) -> F64:
    """Odometry that starts at identity: each step is ``scale`` as long and turns too much."""
    steps = inverse(common_T_base[:-1]) @ common_T_base[1:]
    steps[:, :3, 3] *= scale
    steps = steps @ yaw_transform(np.radians(turn_deg_per_m))
    out = [np.eye(4)]
    for step in steps:
        out.append(out[-1] @ step)
    return np.array(out)


def _write_session(work: Workspace, name: str, start_s: int, map_T_base: F64) -> None:
    """A keyframe each second; poses between them in trajectory.parquet, in a tilted frame."""
    folder = work.session(name)
    n = len(map_T_base)
    stamps_ns = (start_s + np.arange(n)) * SECOND
    steps = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(map_T_base[:, :3, 3], axis=0), axis=1))]
    trajectory = {"stamp_ns": stamps_ns, **pose_columns(SESSION_T_MAP @ map_T_base)}
    write_table(folder.trajectory, contracts.table("trajectory", trajectory), METADATA)
    frames = {
        "stamp_ns": stamps_ns,
        **pose_columns(map_T_base),
        "keyframe": np.arange(n),
        "log_time_ns": stamps_ns,
        "topic": ["/points"] * n,
        "posed": [True] * n,
        "distance": steps,
        "ground_z": np.zeros(n),
        "points": np.zeros(n, int),
        **{f"{name}_{c}": np.zeros(n, np.float32) for name in ("origin", "view") for c in "xyz"},
    }
    write_table(folder.frames, contracts.table("frames", frames), METADATA)
    content = {
        "posed": True,
        "session_T_map": SESSION_T_MAP.tolist(),
        "voxel_size": 0.3,
        "gravity": {"assumed": False},
    }
    write_json(folder.session_json, content)


class Drives:
    """A workspace of drives with known poses; ``start_s`` of each is a thousand after the last."""

    def __init__(self, folder: Path) -> None:
        self.work = Workspace(folder / "work")
        self.truth_file = folder / "truth.json"
        self.true: dict[str, F64] = {}
        self.start_s: dict[str, int] = {}

    def add(self, name: str, common_T_base: F64, turn_deg_per_m: float, scale: float) -> None:
        self.start_s[name] = 1000 * (1 + len(self.true))
        self.true[name] = common_T_base
        odometry = drifted(common_T_base, turn_deg_per_m, scale)
        _write_session(self.work, name, self.start_s[name], odometry)
        truth = {}
        for session, poses in self.true.items():
            columns = pose_columns(poses)
            lines = [
                " ".join(str(v) for v in (self.start_s[session] + k, *row))
                for k, row in enumerate(np.stack([*columns.values()], 1))
            ]
            (self.truth_file.parent / f"{session}.tum").write_text("\n".join(lines) + "\n")
            truth[session] = {"trajectory": f"{session}.tum"}
        self.truth_file.write_text(json.dumps(truth))

    def see(self, world: F64) -> None:
        """Keyframes of points (n, 3) of the ``world`` within 12 m of where a drive truly was."""
        for name, poses in self.true.items():
            folder = self.work.session(name).keyframes
            folder.mkdir()
            clouds = []
            for pose in poses:
                in_view = world[np.linalg.norm(world - pose[:3, 3], axis=1) < 12.0]
                points = apply(inverse(pose), in_view).astype(np.float32)
                clouds.append(Keyframe(points, np.zeros(len(points), np.uint8)))
            stamps_ns = (self.start_s[name] + np.arange(len(poses))) * SECOND
            list(keep_keyframes(folder, stamps_ns.tolist(), clouds, METADATA))

    def locate(
        self, name: str, enu_T_common: F64, wrong: Sequence[int] = (), every: int = 5
    ) -> None:
        """fixes.parquet: each fifth second, 1 m off at most; the ``wrong`` ones by 80 m."""
        rng = np.random.default_rng(len(self.true))
        rows = np.arange(0, len(self.true[name]), every)
        local = LocalFrame(*DATUM)
        placed = (enu_T_common @ self.true[name][rows])[:, :3, 3]
        placed += rng.uniform(-0.5, 0.5, placed.shape)
        placed[np.isin(rows, wrong), 0] += 80.0
        places = local.geodetic(placed)
        columns: dict[str, Any] = {
            "stamp_ns": (self.start_s[name] + rows) * SECOND,
            **dict(zip(("latitude_deg", "longitude_deg", "height"), places.T, strict=True)),
            **{f"sigma_{axis}": np.full(len(rows), 0.5) for axis in ("east", "north", "up")},
            **{f"antenna_{axis}": np.zeros(len(rows)) for axis in "xyz"},
        }
        table = contracts.table("fixes", columns)
        write_table(self.work.session(name).fixes, table, METADATA)

    def close(self, matches: Sequence[Match]) -> None:
        """closures.parquet with these closures, of 5 cm and 0.3 degrees."""
        poses = []
        for query, i, target, j, wrong in matches:
            truly = inverse(self.true[target][j]) @ self.true[query][i]
            poses.append(truly if wrong is None else wrong @ truly)
        sigma = np.repeat([0.05, np.radians(0.3)], 3)
        n = len(matches)
        columns: dict[str, Any] = {
            "query_session": [m[0] for m in matches],
            "query_stamp_ns": [(self.start_s[m[0]] + m[1]) * SECOND for m in matches],
            "target_session": [m[2] for m in matches],
            "target_stamp_ns": [(self.start_s[m[2]] + m[3]) * SECOND for m in matches],
            **pose_columns(np.array(poses)),
            "covariance": [np.diag(sigma**2).ravel().tolist()] * n,
            "overlap": [0.5] * n,
            "probability": [0.99] * n,
            "inliers": [1] * n,
            "words": [1] * n,
        }
        write_table(self.work.closures, contracts.table("closures", columns), METADATA)


@pytest.fixture
def drives(tmp_path: Path) -> Drives:
    return Drives(tmp_path)


@pytest.fixture
def square_of() -> Callable[[int], F64]:
    """The poses of laps around the block."""
    return square


@pytest.fixture
def datum() -> tuple[float, float, float]:
    """The point that fixes are made about."""
    return DATUM
