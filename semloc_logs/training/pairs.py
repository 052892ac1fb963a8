"""Training pairs: incomplete subvolumes from one frame, five, or 20 m of them beside complete ones
from the fused map of all (paper 3.2).

A pair is wider than a subvolume: the encoder run over it gives 3 x 3 descriptors, 8 voxels apart,
so that each pair brings nine examples, eight of them hard. Pairs are packed into Parquet shards,
one for each scene, so that training starts, stops and resumes without making them again.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import U8
from semloc_logs.numerics import transforms
from semloc_logs.settings import STREET_VOXEL, ResolvedFusion, Training
from semloc_logs.subvolumes.cut import SIZE, WIDE, turn
from semloc_logs.tables.atomic_files import replacing_file
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE, BlockMap, Fuser

Pair = tuple[U8, U8, U8]
PER_FRAME = 12  # pairs that are tried
MIN_OCCUPIED = 40  # voxels of a subvolume that is worth describing
# m at 0.30 m voxels: subvolumes are so near to their frame; a long stretch
REACH, LONG = 30.0, 20.0
ROW_GROUP = 32  # pairs that are read together
BROAD = WIDE + 16  # edge of a pair in x and y (voxels)


@dataclass(frozen=True, slots=True, eq=False)
class SceneFrame:
    """Points (n, 3) and sensor centre (3,) in the base frame, classes (n,), and the pose of the
    base in the level map frame.
    """

    points: NDArray[np.float32]
    origin: NDArray[np.float32]
    label: U8
    map_T_base: NDArray[np.float64]
    sigma: NDArray[np.float32] | None = None  # of the points along their rays (m)


def fuse(frames: Iterable[SceneFrame], fusion: ResolvedFusion) -> BlockMap:
    """The semantic map of some frames."""
    fuser = Fuser(fusion)
    for f in frames:
        fuser.add(f.points, f.label, f.origin, f.sigma, f.map_T_base)
    return fuser.finish()


def _dense(blocks: BlockMap) -> tuple[U8, NDArray[np.int64]]:
    low, high = blocks.bounds()
    return blocks.dense(low, tuple((high - low).tolist())), low.astype(np.int64)


def occupied(state: U8) -> NDArray[np.bool_]:
    """Where voxel states are occupied, of whatever class."""
    return np.asarray((state != FREE_STATE) & (state != UNOBSERVED_STATE))


def cut_pairs(
    frames: Sequence[SceneFrame],
    fusion: ResolvedFusion,
    training: Training,
    rng: np.random.Generator,
    queries: Sequence[SceneFrame] | None = None,
) -> list[Pair]:
    """Voxel states: incomplete (64, 64, 32), complete (32, 32, 32), and complete, a little shifted
    and turned, (64, 64, 32).

    ``frames`` are fused to the complete map; the incomplete views are of single frames, five in a
    row, or 20 m of the frames ``queries``, by default the same. The middle subvolume of an
    incomplete view, at least, has ``MIN_OCCUPIED`` occupied voxels.
    """
    v = fusion.voxel_size
    scale = v / STREET_VOXEL
    whole, whole_low = _dense(fuse(frames, fusion))
    surface = np.argwhere(occupied(whole)) + whole_low
    queries = frames if queries is None else queries
    out = []
    for i in range(len(queries)):
        part, part_low = _dense(fuse(_stretch(queries, i, scale, training.tilt, rng), fusion))
        seen = np.argwhere(occupied(part)) + part_low
        position = queries[i].map_T_base[:2, 3] / v
        seen = seen[np.linalg.norm(seen[:, :2] - position, axis=1) < REACH * scale / v]
        if not len(seen):
            continue
        for _ in range(PER_FRAME):
            centre = _centre(seen, surface, rng)
            if centre is None:
                continue
            yaw = rng.uniform(0, 2 * np.pi)
            incomplete = _cut(part, part_low, yaw, centre, BROAD)
            if occupied(incomplete[16:-16, 16:-16]).sum() < MIN_OCCUPIED:
                continue
            complete = _cut(whole, whole_low, yaw, centre, SIZE)
            shift = (
                training.shift
                / STREET_VOXEL
                * np.array([*rng.uniform(-1, 1, 2), rng.uniform(-0.8, 0.8)])
            )
            turned = yaw + rng.uniform(-training.turn, training.turn)
            other = _cut(whole, whole_low, turned, centre + shift, BROAD)
            if occupied(other).sum() >= MIN_OCCUPIED:
                out.append((incomplete, complete, other))
    return out


def _centre(
    seen: NDArray[np.int64], surface: NDArray[np.int64], rng: np.random.Generator
) -> NDArray[np.float64] | None:
    """The centre of a subvolume near a random voxel that was ``seen``; None where the map has too
    little ``surface``.
    """
    xy = seen[rng.integers(len(seen)), :2] + rng.uniform(-12, 12, 2)
    column = surface[(np.abs(surface[:, :2] - xy) < SIZE / 2).all(1), 2]
    if len(column) < MIN_OCCUPIED:
        return None
    # the map's layers are 8 voxels apart: the lowest surface lies anywhere in the lowest eight
    # voxels, or a little above
    bottom = np.percentile(column, 5) - rng.uniform(0, 9)
    return np.array([*xy, np.floor(bottom) + SIZE / 2])


def _cut(
    state: U8, low: NDArray[np.int64], yaw: float, centre: NDArray[np.float64], width: int
) -> U8:
    """The box (width, width, 32) of a map about ``centre``, turned by ``yaw``."""
    box = np.empty((width, width, SIZE), np.uint8)
    turn(state, low, yaw, centre, box)
    return box


def _stretch(
    frames: Sequence[SceneFrame], i: int, scale: float, tilt: float, rng: np.random.Generator
) -> list[SceneFrame]:
    """Frame ``i`` alone, with its neighbours, or 20 m of them, their common vertical wrong by
    ``tilt`` radians.
    """
    kind = rng.random()
    some = list(frames[i : i + 1] if kind < 0.5 else frames[max(0, i - 2) : i + 3])
    here = frames[i].map_T_base[:3, 3]
    if kind > 0.8:
        some = [f for f in frames if np.linalg.norm(f.map_T_base[:3, 3] - here) < LONG / 2 * scale]
    turned = np.eye(4)
    centred = np.eye(4)
    turned[:3, :3] = Rotation.from_rotvec([*rng.normal(0.0, tilt, 2), 0.0]).as_matrix()
    centred[:3, 3] = here
    around = centred @ turned @ transforms.inverse(centred)
    return [replace(f, map_T_base=around @ f.map_T_base) for f in some]


def write_shard(path: Path, pairs: Sequence[tuple[U8, U8, U8]]) -> None:
    """One Parquet file with a row for each pair."""
    names = ("incomplete", "complete", "other")
    columns = {
        n: pa.array([p[k].tobytes() for p in pairs], pa.binary()) for k, n in enumerate(names)
    }
    with replacing_file(path) as temporary:
        pq.write_table(
            pa.table(columns),
            temporary,
            compression="zstd",
            use_dictionary=False,
            row_group_size=ROW_GROUP,
        )


def rows_of(path: Path) -> int:
    """Pairs in a shard."""
    return int(pq.read_metadata(path).num_rows)


def read_shard(path: Path, draw: int | None = None) -> tuple[U8, U8, U8]:
    """Arrays (n, 64, 64, 32), (n, 32, 32, 32) and (n, 64, 64, 32) of a shard, or of its row group
    number ``draw`` modulo their count.
    """
    shard = pq.ParquetFile(path)
    table = shard.read() if draw is None else shard.read_row_group(draw % shard.num_row_groups)
    shapes = ((BROAD, BROAD, SIZE), (SIZE, SIZE, SIZE), (BROAD, BROAD, SIZE))
    a, b, c = (
        np.frombuffer(b"".join(table[k].to_pylist()), np.uint8).reshape(-1, *s)
        for k, s in enumerate(shapes)
    )
    return a, b, c
