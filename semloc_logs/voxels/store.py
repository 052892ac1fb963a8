"""Keyframes, blocks and voxels as Parquet: what fusion keeps (docs/reference/tables.md)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from semloc_logs.errors import WorkspaceError
from semloc_logs.numerics.transforms import transform, translation_quaternion
from semloc_logs.tables import contracts
from semloc_logs.tables.atomic_files import replacing_folder
from semloc_logs.tables.table import read_table, write_table
from semloc_logs.voxels.evidence import Tiles, Voxels, resolve
from semloc_logs.voxels.grid import SCALE, BlockMap, empty_map
from semloc_logs.voxels.keys import pack, unpack

PART = 64  # keyframes in a file; a row group each
TILE = 256  # voxels along the edge of a tile of the session map
# of a row group: in Morton order a compact box, so that readers of a bounding box skip most by
# their statistics
VOXEL_ROWS = 16_384
POSE = ("t_x", "t_y", "t_z", "q_x", "q_y", "q_z", "q_w")


def pose_columns(poses: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Columns t_x .. q_w of transforms (n, 4, 4)."""
    poses = np.asarray(poses, float).reshape(-1, 4, 4)
    values = (
        np.concatenate(translation_quaternion(poses), axis=1) if len(poses) else np.zeros((0, 7))
    )
    return dict(zip(POSE, values.T, strict=True))


def poses_of(table: pa.Table) -> NDArray[np.float64]:
    """Transforms (n, 4, 4) of the columns t_x .. q_w."""
    if not table.num_rows:
        return np.zeros((0, 4, 4))
    values = np.stack([table[c].to_numpy() for c in POSE], 1)
    return transform(values[:, :3], values[:, 3:])


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """Points (n, 3) in the base frame with classes (n,).

    ``sigma`` (n,) is the standard deviation of their range, metres, where it is not small.
    """

    points: NDArray[np.float32]
    label: NDArray[np.uint8]
    sigma: NDArray[np.float32] | None = None

    def near(self, origin: NDArray[np.floating], radius: float) -> Keyframe:
        """The points within ``radius`` metres of ``origin`` (3,)."""
        off = self.points - np.asarray(origin, np.float32)
        kept = np.einsum("ij,ij->i", off, off) < radius**2
        return Keyframe(
            self.points[kept], self.label[kept], None if self.sigma is None else self.sigma[kept]
        )

    def spread(self, origin: NDArray[np.floating]) -> NDArray[np.float64]:
        """One standard deviation (n, 3) of each point along its ray from ``origin`` (3,), metres.

        Zeros where it is small.
        """
        if self.sigma is None:
            return np.zeros((len(self.points), 3))
        ray = self.points - np.asarray(origin, float)
        return np.asarray(
            ray * (self.sigma / np.maximum(np.linalg.norm(ray, axis=1), 1e-6))[:, None]
        )


def part_path(folder: Path, keyframe: int) -> Path:
    """The file that holds ``keyframe``."""
    return folder / f"part-{keyframe // PART:05d}.parquet"


def keep_keyframes(
    folder: Path, stamps_ns: Sequence[int], keyframes: Iterable[Keyframe], metadata: dict[str, Any]
) -> Iterator[Keyframe]:
    """Write keyframes to parts in ``folder`` and pass them on as they will be read back.

    Each has a row group of its own. ``folder`` is renamed later; it is complete when the iterator
    is exhausted.
    """
    schema = contracts.schema("keyframes").with_metadata({"semloc": _json(metadata)})
    coming = iter(keyframes)
    for first in range(0, len(stamps_ns), PART):
        with pq.ParquetWriter(
            part_path(folder, first),
            schema,
            compression="zstd",
            use_byte_stream_split=["x", "y", "z"],
            use_dictionary=["keyframe", "stamp_ns", "label", "sigma"],
        ) as writer:
            for k, frame in zip(
                range(first, min(first + PART, len(stamps_ns))), coming, strict=False
            ):
                n = len(frame.points)
                # 2 mm: below any sensor's noise, and packs well
                points = (np.round(frame.points * 512) / 512).astype(np.float32)
                sigma = (
                    None
                    if frame.sigma is None
                    else frame.sigma.astype(np.float16).astype(np.float32)
                )
                columns = {
                    "keyframe": np.full(n, k, np.int32),
                    "stamp_ns": np.full(n, stamps_ns[k], np.int64),
                    **{c: points[:, i] for i, c in enumerate("xyz")},
                    "label": frame.label,
                    "sigma": np.zeros(n, np.float32) if sigma is None else sigma,
                }
                writer.write_table(contracts.table("keyframes", columns), row_group_size=max(n, 1))
                yield Keyframe(points, frame.label, sigma)


def _json(metadata: dict[str, Any]) -> str:
    import json

    return json.dumps(metadata, sort_keys=True)


def read_keyframe(folder: Path, keyframe: int) -> Keyframe:
    """WorkspaceError when the part is missing or damaged."""
    path = part_path(folder, keyframe)
    try:
        table = pq.ParquetFile(path).read_row_group(
            keyframe % PART, columns=["x", "y", "z", "label", "sigma"]
        )
    except (OSError, pa.ArrowException) as problem:
        raise WorkspaceError(
            f"{path} cannot be read ({str(problem).splitlines()[0]}): fuse the session again with "
            "--overwrite."
        ) from None
    points = np.stack([table[c].to_numpy() for c in "xyz"], 1)
    sigma = table["sigma"].to_numpy()
    return Keyframe(points, table["label"].to_numpy(), sigma if sigma.any() else None)


def blocks_path(folder: Path, submap: int) -> Path:
    """The file of a submap in ``blocks/`` or ``words/``."""
    return folder / f"submap-{submap:05d}.parquet"


def write_blocks(path: Path, blocks: BlockMap, metadata: dict[str, Any]) -> None:
    """The full observed state of one submap."""
    schema = contracts.schema("blocks")
    b = unpack(blocks.keys)
    columns: dict[str, Any] = {
        name: pa.array(b[:, i], pa.int32()) for i, name in enumerate(("bx", "by", "bz"))
    }
    for name, values in (("state", blocks.state), ("log_odds", blocks.log_odds)):
        columns[name] = pa.FixedSizeBinaryArray.from_buffers(
            pa.binary(values.shape[1]), len(b), [None, pa.py_buffer(np.ascontiguousarray(values))]
        )
    kind = schema.field("votes").type
    first = np.searchsorted(blocks.ballots, np.arange(len(b) + 1) * (4096 * 256))
    ballot_columns = {
        "cell": blocks.ballots // 256 % 4096,
        "label": blocks.ballots % 256,
        "count": blocks.votes,
    }
    fields = [kind.value_type.field(i) for i in range(kind.value_type.num_fields)]
    ballots = pa.StructArray.from_arrays(
        [pa.array(ballot_columns[f.name].astype(f.type.to_pandas_dtype())) for f in fields],
        fields=fields,
    )
    columns["votes"] = pa.ListArray.from_arrays(pa.array(first, pa.int32()), ballots, type=kind)
    write_table(
        path,
        pa.table([columns[n] for n in schema.names], schema=schema),
        metadata,
        ("bx", "by", "bz"),
    )


def read_blocks(path: Path, states_only: bool = False) -> BlockMap:
    """Inverse of :func:`write_blocks`.

    With ``states_only`` without log-odds (0, 4096) and votes, which search and verification do not
    need.
    """
    names = ["bx", "by", "bz", "state", *([] if states_only else ["log_odds", "votes"])]
    table = read_table(path, names).combine_chunks()
    nothing = np.zeros(0, np.int64)
    if not table.num_rows:
        return empty_map()
    keys = pack(np.stack([table[c].to_numpy() for c in ("bx", "by", "bz")], 1))

    def values(name: str, dtype: type) -> NDArray[Any]:
        array = table[name].chunk(0)
        flat: NDArray[Any] = np.frombuffer(array.buffers()[1], dtype)
        return flat[array.offset * 4096 : (array.offset + len(array)) * 4096].reshape(-1, 4096)

    if states_only:
        return BlockMap(
            keys, np.zeros((0, 4096), np.int8), values("state", np.uint8), nothing, nothing
        )
    array = table["votes"].chunk(0)
    row = np.repeat(np.arange(len(array)), np.diff(array.offsets.to_numpy()))
    cell, label, votes = (
        array.flatten().field(c).to_numpy().astype(np.int64) for c in ("cell", "label", "count")
    )
    return BlockMap(
        keys,
        values("log_odds", np.int8),
        values("state", np.uint8),
        (row * 4096 + cell) * 256 + label,
        votes,
    )


def write_voxels(
    folder: Path, submaps: Iterable[BlockMap], metadata: dict[str, Any], clamp: tuple[float, float]
) -> int:
    """Write the session map: occupied voxels of all ``submaps``, in tiles; returns their number.

    Tiles are 256 voxels wide. Where submaps overlap their evidence adds up
    (:mod:`semloc_logs.voxels.evidence`), clamped to ``clamp`` (log-odds) at the end. Memory holds a
    submap and the tiles that it touches, whatever the length of the log and however often it comes
    back.
    """
    total = 0
    low, high = (round(SCALE * c) for c in clamp)
    with replacing_folder(folder) as temporary:
        scratch = temporary / ".scratch"
        scratch.mkdir()
        tiles = Tiles(scratch, TILE)
        for blocks in submaps:
            tiles.add(blocks)
        for x, y in sorted(tiles.names()):
            voxels = resolve(tiles.take((x, y)), low, high)
            if len(voxels.ijk):
                _write_tile(temporary / f"tile={x}_{y}" / "part-0.parquet", voxels, metadata)
                total += len(voxels.ijk)
        scratch.rmdir()
        if not total:
            nothing = np.zeros(0, np.int64)
            empty = Voxels(
                np.zeros((0, 3), np.int32),
                nothing.astype(np.uint8),
                nothing.astype(np.int32),
                nothing,
            )
            _write_tile(temporary / "tile=0_0" / "part-0.parquet", empty, metadata)
    return total


def _write_tile(path: Path, voxels: Voxels, metadata: dict[str, Any]) -> None:
    columns: dict[str, Any] = dict(zip(("ix", "iy", "iz"), voxels.ijk.T, strict=True))
    columns |= {
        "label": voxels.label,
        "occupancy": (voxels.log_odds / SCALE).astype(np.float32),
        "hits": np.minimum(voxels.hits, 65535).astype(np.uint16),
    }
    write_table(path, contracts.table("voxels", columns), metadata, row_group=VOXEL_ROWS)
