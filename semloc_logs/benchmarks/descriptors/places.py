"""Places to describe: maps of streets and queries, as the benchmarks keep them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from semloc_logs.arrays import F64, I64, U8
from semloc_logs.errors import WorkspaceError
from semloc_logs.numerics.transforms import apply, inverse, yaw_transform
from semloc_logs.settings import Resolved
from semloc_logs.subvolumes.cut import turn
from semloc_logs.tables.table import read_table, write_table
from semloc_logs.voxels.grid import BlockMap

HEADINGS = 18  # of the paper: a query comes turned by the nearest of them


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """A map: voxel states ``state`` (x, y, z) whose corner is voxel ``low`` (3,) of its frame,
    height of the ground there (m), the sensor's places ``track`` (n, 3) in it (m), and its frame in
    the common one, ``common_T_map`` (4, 4).
    """

    state: U8
    low: I64
    ground_z: float
    track: F64
    common_T_map: F64


@dataclass(frozen=True, slots=True, eq=False)
class Street:
    """The maps of one street, by name of the database that they belong to, and the queries of each
    scenario.
    """

    database: list[tuple[str, Place]]
    queries: dict[str, list[Place]]


def map_place(blocks: BlockMap, track: F64, ground_z: float, common_T_map: F64) -> Place:
    """A map for a database."""
    low, high = blocks.bounds()
    return Place(
        blocks.dense(low, tuple((high - low).tolist())),
        low.astype(np.int64),
        ground_z,
        track,
        common_T_map,
    )


def turned_place(
    blocks: BlockMap, track: F64, ground_z: float, common_T_query: F64, settings: Resolved
) -> Place:
    """A query map about the origin of its level frame, turned by the paper's heading nearest to the
    true one.

    ``track`` (n, 3) and ``ground_z`` are in the query's frame, metres.
    """
    step = 2 * np.pi / HEADINGS
    yaw = step * round(float(np.arctan2(common_T_query[1, 0], common_T_query[0, 0])) / step)
    low, high = blocks.bounds()
    half = -(-int(settings.query.radius / settings.fusion.voxel_size + 16) // 8) * 8
    box = np.empty((2 * half, 2 * half, int(high[2] - low[2])), np.uint8)
    state = blocks.dense(low, tuple((high - low).tolist()))
    turn(state, low.astype(np.int64), -yaw, np.array([0.0, 0.0, (low[2] + high[2]) / 2]), box)
    turned = yaw_transform(yaw)
    return Place(
        box,
        np.array([-half, -half, low[2]], np.int64),
        ground_z,
        apply(turned, track),
        common_T_query @ inverse(turned),
    )


def write_street(path: Path, street: Street, metadata: dict[str, Any]) -> None:
    """A Parquet file with a row for each map."""
    rows = [("database", kind, place) for kind, place in street.database]
    rows += [("query", name, place) for name, places in street.queries.items() for place in places]
    columns = {
        "part": pa.array([r[0] for r in rows]),
        "kind": pa.array([r[1] for r in rows]),
        "shape": pa.array([list(r[2].state.shape) for r in rows], pa.list_(pa.int64())),
        "low": pa.array([r[2].low.tolist() for r in rows], pa.list_(pa.int64())),
        "ground_z": pa.array([r[2].ground_z for r in rows]),
        "track": pa.array([r[2].track.ravel().tolist() for r in rows], pa.list_(pa.float64())),
        "common_T_map": pa.array(
            [r[2].common_T_map.ravel().tolist() for r in rows], pa.list_(pa.float64())
        ),
        "state": pa.array([r[2].state.tobytes() for r in rows], pa.large_binary()),
    }
    write_table(path, pa.table(columns), metadata)


def read_street(path: Path) -> Street:
    """What :func:`write_street` wrote; WorkspaceError when it is missing or damaged."""
    database: list[tuple[str, Place]] = []
    queries: dict[str, list[Place]] = {}
    try:
        for row in read_table(path).to_pylist():
            place = Place(
                np.frombuffer(row["state"], np.uint8).reshape(row["shape"]),
                np.array(row["low"], np.int64),
                float(row["ground_z"]),
                np.array(row["track"], np.float64).reshape(-1, 3),
                np.array(row["common_T_map"], np.float64).reshape(4, 4),
            )
            if row["part"] == "database":
                database.append((row["kind"], place))
            else:
                queries.setdefault(row["kind"], []).append(place)
        return Street(database, queries)
    except (KeyError, ValueError, TypeError, OverflowError):
        raise WorkspaceError(
            f"{path} is not a street of the retrieval benchmark: "
            "remove it, and it is simulated again."
        ) from None
