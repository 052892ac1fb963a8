"""A workspace of tables without logs: many drives on one road, their closures and rejections.

What reads tables alone can be tried on a hundred sessions in seconds. The maps are a road between
two rows of walls; odometry drifts; closures are the true poses with noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

import semloc_logs
from semloc_logs.arrays import F64
from semloc_logs.closures.alignment_tables import alignment_table
from semloc_logs.closures.closure import (
    Agreement,
    Alignment,
    Closure,
    Decision,
    Features,
    Reason,
    Rejected,
)
from semloc_logs.closures.closure_tables import write_closures, write_rejected
from semloc_logs.numerics.transforms import exp_se3, inverse
from semloc_logs.settings import Settings
from semloc_logs.simulation.drives.trajectory import DAY_NS, START_NS
from semloc_logs.tables import contracts
from semloc_logs.tables.metadata import map_metadata
from semloc_logs.tables.table import write_json, write_table
from semloc_logs.voxels.store import pose_columns
from semloc_logs.workspace import Workspace

VOXEL = 0.3  # m
SPEED = 8.0  # m/s
EVERY = 1.0  # m between keyframes
QUERY_EVERY = 20  # keyframes
ROAD, WALL, TREE = 0, 2, 8  # train ids
HALF_ROAD, WALL_AT, WALL_HEIGHT = 7.5, 11.0, 12  # m, m, voxels
TURN_NOISE = 2e-4  # rad a metre: the drift of odometry
SIGMA = (0.05, 0.002)  # m and rad, of closures


@dataclass(frozen=True, slots=True)
class TablesPlan:
    """So many ``sessions`` of ``road`` metres each, ``closures`` in all.

    ``groups`` drive on roads of their own, so that nothing connects them.
    """

    sessions: int = 3
    closures: int = 40
    road: float = 300.0
    groups: int = 1
    seed: int = 0


@dataclass(eq=False)
class _Drive:
    """A session: the true poses of its keyframes, and its map by drifting odometry."""

    name: str
    group: int
    start_ns: int
    world_T_base: F64
    map_T_base: F64

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        steps = np.arange(len(self.world_T_base)) * EVERY / SPEED
        return self.start_ns + (steps * 1e9).astype(np.int64)

    @cached_property
    def places(self) -> F64:
        """True positions (n, 2)."""
        return np.asarray(self.world_T_base[:, :2, 3])


def write_tables(work: Workspace, plan: TablesPlan, names: tuple[str, ...] = ()) -> None:
    """The tables of a workspace; ``names`` of the first sessions, the others have numbers."""
    rng = np.random.default_rng(plan.seed)
    drives = []
    for number in range(plan.sessions):
        name = names[number] if number < len(names) else f"drive_{number:03d}"
        drives.append(_drive(name, number, plan, rng))
    for drive in drives:
        _write_session(work, drive, rng)
    closures, rejected = _results(drives, plan, rng)
    _write_alignments(work, closures, rejected)
    settings = Settings().resolved()
    metadata = _metadata() | {
        "queries": sum(len(d.stamps_ns) // QUERY_EVERY for d in drives),
        "fingerprint": "simulated",
        "settings": settings.tables("fusion", "labels", "descriptor", "query", "closures"),
    }
    write_rejected(work.rejected, rejected, metadata)
    write_closures(work.closures, closures, metadata)
    seconds = {"fuse": 1.0 * plan.sessions, "describe": 2.0 * plan.sessions, "close": 3.0}
    content = {"seconds": seconds, "skipped": [], "failed": [], "closures": len(closures)}
    write_json(work.summary, content | {"version": semloc_logs.__version__})


def _metadata() -> dict[str, object]:
    return map_metadata(VOXEL, np.eye(4), "log")


# -- sessions


def _drive(name: str, number: int, plan: TablesPlan, rng: np.random.Generator) -> _Drive:
    """A drive of ``plan.road`` metres from a random place of a closed road."""
    group = number % plan.groups
    angle = np.linspace(0, 2 * np.pi, 20_000)
    shape = 1 + 0.25 * np.sin(3 * angle + group) + 0.12 * np.cos(5 * angle)
    ring = shape[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    around = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(ring, axis=0), axis=1))]
    whole = 1.2 * plan.road  # metres of the closed road
    forward = 1 if rng.random() < 0.7 else -1
    way = rng.uniform(0, whole) + forward * np.arange(int(plan.road / EVERY) + 1) * EVERY
    scale = whole / around[-1]
    x, y = (np.interp(way % whole, around * scale, ring[:, k] * scale) for k in (0, 1))
    heading = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
    lane = 1.75
    x, y = x + lane * np.sin(heading), y - lane * np.cos(heading)
    world = _poses(x, y, heading)

    turns = np.cumsum(rng.normal(0, TURN_NOISE * np.sqrt(EVERY), len(x)))
    steps = inverse(world[:-1]) @ world[1:]
    drifted = heading - heading[0] + turns - turns[0]
    moved = _poses(np.zeros_like(x), np.zeros_like(x), drifted)[:-1, :3, :3] @ steps[:, :3, 3:]
    there = np.vstack([np.zeros((1, 3)), np.cumsum(moved[..., 0], axis=0)])
    start_ns = START_NS + number * DAY_NS
    return _Drive(name, group, start_ns, world, _poses(there[:, 0], there[:, 1], drifted))


def _poses(x: F64, y: F64, yaw: F64) -> F64:
    out = np.tile(np.eye(4), (len(x), 1, 1))
    c = np.cos(yaw)
    s = np.sin(yaw)
    out[:, 0, 0] = out[:, 1, 1] = c
    out[:, 0, 1] = -s
    out[:, 1, 0] = s
    out[:, 0, 3] = x
    out[:, 1, 3] = y
    return out


def _write_session(work: Workspace, drive: _Drive, rng: np.random.Generator) -> None:
    folder = work.session(drive.name)
    n = len(drive.stamps_ns)
    distance = np.arange(n) * EVERY
    frames: dict[str, object] = {
        "keyframe": np.arange(n, dtype=np.int32),
        "stamp_ns": drive.stamps_ns,
        "log_time_ns": drive.stamps_ns,
        "topic": ["/lidar/points"] * n,
        "posed": np.ones(n, bool),
        "distance": distance,
        "ground_z": np.zeros(n),
        "points": np.zeros(n, np.int32),
        **{f"{a}_{c}": np.zeros(n, np.float32) for a in ("origin", "view") for c in "xyz"},
        **pose_columns(drive.map_T_base),
    }
    metadata = _metadata()
    write_table(folder.frames, contracts.table("frames", frames), metadata)
    poses = {"stamp_ns": drive.stamps_ns, **pose_columns(drive.map_T_base)}
    write_table(folder.trajectory, contracts.table("trajectory", poses), metadata)
    voxels = _voxels(drive, rng)
    tile = folder.voxels / "x+0000_y+0000.parquet"
    write_table(tile, contracts.table("voxels", voxels), metadata)
    log = {
        "path": f"/logs/{drive.name}.mcap",
        "format": "mcap",
        "encoding": "ros2",
        "start_ns": int(drive.stamps_ns[0]),
        "end_ns": int(drive.stamps_ns[-1]),
    }
    stream = {"role": "lidar", "topic": "/lidar/points", "type": "sensor_msgs/msg/PointCloud2"}
    length = float(distance[-1])
    write_json(
        folder.session_json,
        {
            **metadata,
            "name": drive.name,
            "logs": [log],
            "streams": [{**stream, "count": n}],
            "posed": True,
            "poses": {"count": n, "gaps": [], "length_m": length},
            "pose_source": {"kind": "log"},
            "submaps": [{"id": 0, "first": 0, "last": n - 1, "ground_z": 0.0, "blocks": 0}],
            "keyframes": n,
            "voxels": len(voxels["ix"]),
            "base_frame": "base_link",
            "session_frame": "odom",
            "vehicle_root": {"frame": "base_link", "base_T_root": np.eye(4).tolist()},
            "skipped": [],
        },
    )


def _voxels(drive: _Drive, rng: np.random.Generator) -> dict[str, NDArray[np.generic]]:
    """Road, walls with gaps and trees beside the drive, in its own map."""
    across = np.arange(-HALF_ROAD, HALF_ROAD, 2 * VOXEL)
    walls = np.arange(0, EVERY, VOXEL)
    n = len(drive.map_T_base)
    seen = (np.sin(np.arange(n) / 7.0 + drive.group) > -0.5)[:, None]
    parts: list[tuple[F64, NDArray[Any], NDArray[Any], NDArray[Any]]] = []
    road = np.stack(np.broadcast_arrays(np.zeros((n, 1)), across[None]), -1)
    parts.append((road, np.zeros(road.shape[:2]), np.full(road.shape[:2], ROAD), np.ones((n, 1))))
    for side in (-1, 1):
        wall = np.stack(np.broadcast_arrays(walls[None], np.full((n, 1), side * WALL_AT)), -1)
        top = np.full(wall.shape[:2], WALL_HEIGHT)
        parts.append((wall, top, np.full(wall.shape[:2], WALL), seen))
        beside = np.array([0.0, side * (HALF_ROAD + 1.5)])
        tree = beside + rng.normal(0, 0.8, (n, 6, 2))
        grows = (np.arange(n) % 17 == 0)[:, None]
        parts.append((tree, np.full((n, 6), 8), np.full((n, 6), TREE), grows))
    ijk, labels = [], []
    for offset, height, label, shown in parts:
        turned = np.einsum("nij,nkj->nki", drive.map_T_base[:, :2, :2], offset)
        xy = turned + drive.map_T_base[:, None, :2, 3]
        kept = np.broadcast_to(shown > 0, label.shape)
        cells = np.concatenate([np.floor(xy / VOXEL), height[..., None]], -1)
        ijk.append(cells[kept].astype(np.int32))
        labels.append(label[kept].astype(np.uint8))
    cells, first = np.unique(np.concatenate(ijk), axis=0, return_index=True)
    return {
        **{f"i{c}": cells[:, k] for k, c in enumerate("xyz")},
        "label": np.concatenate(labels)[first],
        "occupancy": np.full(len(cells), 3.5, np.float32),
        "hits": np.full(len(cells), 9, np.uint16),
    }


# -- closures and rejections


def _results(
    drives: list[_Drive], plan: TablesPlan, rng: np.random.Generator
) -> tuple[list[Closure], list[Rejected]]:
    """Closures where a later drive is near an earlier one; other queries are rejected."""
    closures: list[Closure] = []
    rejected: list[Rejected] = []
    queries = [(q, k) for q in range(1, len(drives)) for k in _query_keyframes(drives[q])]
    rng.shuffle(queries)
    closed = set()
    while len(closures) < plan.closures:
        before = len(closures)
        for q, k in queries:
            earlier = [t for t in range(q) if drives[t].group == drives[q].group]
            if not earlier or len(closures) == plan.closures:
                continue
            target = drives[int(rng.choice(earlier))]
            nearest = _nearest(target, drives[q].places[k])
            if nearest is None or (q, k, target.name) in closed:
                continue
            closed |= {(q, k, target.name), (q, k)}
            closures.append(_closure(drives[q], int(k), target, nearest, rng))
        if len(closures) == before:
            break
    for q, k in queries:
        if (q, k) not in closed:
            target = drives[int(rng.integers(q))]
            rejected.append(_rejected(drives[q], int(k), target, rng))
    closures.sort(key=lambda c: (c.alignment.query_session, c.alignment.query_stamp_ns))
    return closures, rejected


def _query_keyframes(drive: _Drive) -> range:
    return range(0, len(drive.places), QUERY_EVERY)


def _nearest(target: _Drive, place: F64) -> int | None:
    """The keyframe of ``target`` nearest to a place, within 6 m."""
    off = np.linalg.norm(target.places - place, axis=1)
    nearest = int(np.argmin(off))
    return nearest if off[nearest] < 6 else None


def _closure(
    query: _Drive, k: int, target: _Drive, nearest: int, rng: np.random.Generator
) -> Closure:
    noise = exp_se3(rng.normal(0, SIGMA[0], 3), rng.normal(0, SIGMA[1], 3))
    pose = inverse(target.world_T_base[nearest]) @ query.world_T_base[k] @ noise
    probability = float(1 - 10 ** -rng.uniform(2, 5))
    features = Features(*map(float, (rng.uniform(0.6, 0.98), 0.9, 0.03, 0.7, 3.6, 2.2, 0.0)))
    alignment = _alignment((query, k), (target, nearest), pose, features, rng)
    return Closure(alignment, _decision(probability, rng))


def _rejected(query: _Drive, k: int, target: _Drive, rng: np.random.Generator) -> Rejected:
    nearest = int(rng.integers(len(target.places)))
    features = Features(
        *map(float, (rng.uniform(0.1, 0.6), 0.5, 0.2, 0.3, 2.1, rng.uniform(0, 2), 0.0))
    )
    probability = float(rng.uniform(0, 0.6))
    alignment = _alignment((query, k), (target, nearest), np.eye(4), features, rng)
    reasons = (Reason.FREE_SPACE, Reason.RIVAL_PLACE, Reason.AMBIGUOUS_PLACE)
    reason = reasons[int(rng.integers(len(reasons)))]
    return Rejected(alignment, _decision(probability, rng), reason)


def _alignment(
    query: tuple[_Drive, int],
    target: tuple[_Drive, int],
    pose: F64,
    features: Features[float],
    rng: np.random.Generator,
) -> Alignment:
    sigma = np.r_[SIGMA[0] * rng.uniform(0.5, 3, 3), np.full(3, SIGMA[1])]
    (query_drive, query_keyframe), (target_drive, target_keyframe) = query, target
    return Alignment(
        query_session=query_drive.name,
        target_session=target_drive.name,
        query_keyframe=query_keyframe,
        target_keyframe=target_keyframe,
        query_stamp_ns=int(query_drive.stamps_ns[query_keyframe]),
        target_stamp_ns=int(target_drive.stamps_ns[target_keyframe]),
        target_T_query=pose,
        covariance=np.diag(sigma**2),
        overlap=float(rng.uniform(0.4, 0.9)),
        inliers=int(rng.integers(500, 9000)),
        words=int(rng.integers(3, 200)),
        features=features,
    )


def _decision(probability: float, rng: np.random.Generator) -> Decision:
    votes = [probability, *rng.uniform(0, 5, 5), rng.uniform(0, 0.3)]
    agreement = Agreement(*(float(v) for v in votes))
    return Decision(frozenset(), probability, 1.0, 1.0, agreement, 0.99)


def _write_alignments(work: Workspace, closures: list[Closure], rejected: list[Rejected]) -> None:
    pairs: dict[tuple[str, str], list[Alignment]] = {}
    for a in [*(row.alignment for row in closures), *(row.alignment for row in rejected)]:
        pairs.setdefault((a.query_session, a.target_session), []).append(a)
    for (query, target), alignments in sorted(pairs.items()):
        alignments.sort(key=lambda a: a.query_keyframe)
        metadata = _metadata() | {"fingerprint": "simulated", "queries": len(alignments)}
        path = work.alignments(query, target)
        write_table(path, alignment_table(alignments), metadata, ("query_keyframe",))
