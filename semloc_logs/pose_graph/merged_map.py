"""The voxels of all sessions of a frame in one map, and where sessions contradict each other.

A voxel counts as seen free only where the session has no occupied one beside it: walls of two
sessions are a voxel apart easily. Tile by tile, so memory does not grow with the map.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from semloc_logs.arrays import F64, I64, U8, Bools
from semloc_logs.labels.space import UNLABELLED
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import inverse
from semloc_logs.pose_graph.carried_poses import SolvedPoses
from semloc_logs.pose_graph.placed_submaps import PlacedSubmap
from semloc_logs.tables import contracts
from semloc_logs.tables.atomic_files import replacing_folder
from semloc_logs.tables.table import read_table, write_table
from semloc_logs.voxels.grid import FREE_STATE, UNOBSERVED_STATE
from semloc_logs.voxels.keys import morton, pack, unpack
from semloc_logs.voxels.store import TILE, poses_of
from semloc_logs.workspace import Workspace

Tile = tuple[int, int]
NONE = -1
NEIGHBOURS = np.array([d for d in product((-1, 0, 1), repeat=3) if any(d)], np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Voxels (n,) that a session saw occupied: packed keys, ascending, classes and stamps."""

    keys: I64
    label: U8
    stamps_ns: I64


def keyframe_poses(work: Workspace, session: SessionMap) -> F64:
    """Poses (n, 4, 4) of all keyframes in the frame of optimized/SESSION.parquet."""
    solved = read_table(work.optimized_trajectory(session.folder.name))
    recorded = read_table(session.folder.trajectory)
    stamps_ns = np.asarray(recorded["stamp_ns"].to_numpy())
    known_ns, rows = np.unique(stamps_ns, return_index=True)
    map_T_session = inverse(np.array(session.json["session_T_map"], float))
    place = (known_ns - known_ns[0]) * 1e-9
    odometry = map_T_session @ poses_of(recorded)[rows]
    known = SolvedPoses(place, odometry, poses_of(solved)[rows])
    return known.carried((session.stamps_ns - known_ns[0]) * 1e-9, session.map_T_base)


def write_merged_map(
    work: Workspace, frame: str, sessions: Sequence[SessionMap], metadata: Mapping[str, Any]
) -> tuple[int, int]:
    """The map of the sessions of ``frame``, and its changes; numbers of voxels of both.

    Sessions count in the order of their recording; those without poses are left out.
    """
    posed = sorted((s for s in sessions if s.posed), key=lambda s: int(s.stamps_ns[0]))
    submaps = [_placed(work, session) for session in posed]
    names = [session.folder.name for session in posed]
    changes = [contracts.schema("changed_voxels").empty_table()]
    total = 0
    with (
        replacing_folder(work.merged_map(frame)) as folder,
        tempfile.TemporaryDirectory(prefix=".scratch.", dir=work.optimized) as name,
    ):
        scratch = Path(name)
        tiles: dict[Tile, list[int]] = {}
        for k, own in enumerate(submaps):
            for tile in _spread(own, scratch, k):
                tiles.setdefault(tile, []).append(k)
        bounds = [[submap.bounds() for submap in own] for own in submaps]
        for tile, numbers in sorted(tiles.items()):
            seen = {k: _load(_scratch_file(scratch, tile, k)) for k in numbers}
            voxels = _Tile(tile, seen, len(posed))
            for k, own in enumerate(submaps):
                if len(voxels.keys):
                    meeting = [s for s, b in zip(own, bounds[k], strict=True) if voxels.meets(s, b)]
                    voxels.observe(k, meeting)
            table = voxels.merged(names)
            changes.append(voxels.changed(names))
            total += table.num_rows
            if table.num_rows:
                write_table(
                    folder / f"tile={tile[0]}_{tile[1]}/part-0.parquet", table, {**metadata}
                )
        if not total:
            empty = contracts.schema("merged_voxels").empty_table()
            write_table(folder / "tile=0_0" / "part-0.parquet", empty, {**metadata})
    changed = pa.concat_tables(changes).combine_chunks()
    write_table(work.changed_voxels(frame), changed, {**metadata})
    return total, changed.num_rows


def _placed(work: Workspace, session: SessionMap) -> list[PlacedSubmap]:
    poses = keyframe_poses(work, session)
    return [PlacedSubmap(session, s["id"], s["first"], s["last"], poses) for s in session.submaps]


# -- occupied voxels of a session by tile


def _scratch_file(scratch: Path, tile: Tile, session: int) -> Path:
    return scratch / f"{tile[0]}_{tile[1]}.{session}.npy"


def _spread(submaps: Sequence[PlacedSubmap], scratch: Path, session: int) -> list[Tile]:
    """Write the occupied voxels of a session tile by tile, with those beside the tile."""
    parts = [(pack(ijk), label, stamps) for ijk, label, stamps in (s.occupied() for s in submaps)]
    if not parts:
        return []
    keys, label, stamps_ns = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    order = np.lexsort((stamps_ns, keys))  # the latest of a voxel last
    last = order[np.flatnonzero(np.diff(keys[order], append=np.iinfo(np.int64).max))]
    keys, label, stamps_ns = keys[last], label[last], stamps_ns[last]
    ijk = unpack(keys).astype(np.int64)
    tiles: list[Tile] = []
    own = ijk[:, :2] // TILE
    for x, y in np.unique(own, axis=0).tolist():
        low = np.array([x, y]) * TILE - 1
        inside = ((ijk[:, :2] >= low) & (ijk[:, :2] <= low + TILE + 1)).all(1)
        rows = np.stack([keys[inside], label[inside].astype(np.int64), stamps_ns[inside]])
        np.save(_scratch_file(scratch, (x, y), session), rows)
        tiles.append((x, y))
    return tiles


def _load(path: Path) -> Seen:
    keys, label, stamps_ns = np.load(path)
    return Seen(keys, label.astype(np.uint8), stamps_ns)


# -- a tile


class _Tile:
    """The voxels of a tile that any session saw occupied, and what each session saw of them."""

    def __init__(self, tile: Tile, seen: Mapping[int, Seen], sessions: int) -> None:
        self._seen = seen
        every = np.unique(np.concatenate([s.keys for s in seen.values()]))
        ijk = unpack(every).astype(np.int64)
        own = (ijk[:, :2] // TILE == tile).all(1)
        self.keys = every[own]
        self._ijk = ijk[own]
        n = len(self.keys)
        self._is_occupied = np.zeros(n, bool)
        self._count = np.zeros(n, np.int32)
        self._label = np.full(n, UNLABELLED, np.uint8)
        # number and stamp of the last session that saw it occupied, and of the free one that counts
        self._last = np.full((2, n), NONE, np.int64)
        self._free = np.full((2, n), NONE, np.int64)
        self._was_free = np.zeros(n, bool)

    def meets(self, submap: PlacedSubmap, bounds: tuple[F64, F64]) -> bool:
        """Whether a submap with these bounds may hold any of the voxels."""
        low = self._ijk.min(0) * submap.voxel_size
        high = (self._ijk.max(0) + 1) * submap.voxel_size
        return bool((low <= bounds[1]).all() and (high >= bounds[0]).all())

    def observe(self, session: int, submaps: Sequence[PlacedSubmap]) -> None:
        """Add what the next recorded session saw."""
        occupied, is_near = self._occupied_by(session)
        free, stamps_ns = self._free_by(submaps, ~occupied)
        if session in self._seen:
            seen = self._seen[session]
            rows = np.searchsorted(seen.keys, self.keys[occupied])
            first = self._last[0, occupied] == NONE
            self._was_free[occupied] |= first & (self._free[0, occupied] != NONE)
            self._last[0, occupied] = session
            self._last[1, occupied] = seen.stamps_ns[rows]
            self._label[occupied] = seen.label[rows]
            self._count[occupied] += 1
        self._is_occupied[occupied] = True
        self._is_occupied[free] = False
        # gone: the first free one after it was seen; appeared: the last free one before
        counts = free & ~is_near
        before = self._last[0] == NONE
        later = ~before & (self._free[0] < self._last[0])
        chosen = counts & (before | later)
        self._free[0, chosen] = session
        self._free[1, chosen] = stamps_ns[chosen]

    def _occupied_by(self, session: int) -> tuple[Bools, Bools]:
        """Which voxels the session saw occupied, and beside which it saw an occupied one."""
        if session not in self._seen:
            return np.zeros(len(self.keys), bool), np.zeros(len(self.keys), bool)
        keys = self._seen[session].keys
        is_near = np.zeros(len(self.keys), bool)
        for step in NEIGHBOURS:
            is_near |= np.isin(pack(self._ijk + step), keys)
        return np.isin(self.keys, keys), is_near

    def _free_by(self, submaps: Sequence[PlacedSubmap], wanted: Bools) -> tuple[Bools, I64]:
        """Which of the ``wanted`` voxels submaps saw free, and none occupied; with stamps."""
        free = np.zeros(len(self.keys), bool)
        other = np.zeros(len(self.keys), bool)
        stamps = np.zeros(len(self.keys), np.int64)
        for submap in submaps:
            state, stamps_ns = submap.state(self._ijk[wanted])
            rows = np.flatnonzero(wanted)
            is_free = state == FREE_STATE
            free[rows[is_free]] = True
            stamps[rows[is_free]] = np.maximum(stamps[rows[is_free]], stamps_ns[is_free])
            other[rows[~is_free & (state != UNOBSERVED_STATE)]] = True
        return free & ~other, stamps

    def merged(self, names: Sequence[str]) -> pa.Table:
        """Rows of the map: voxels that the last session which observed them saw occupied."""
        rows = np.flatnonzero(self._is_occupied)
        rows = rows[np.argsort(morton(self._ijk[rows]), kind="stable")]
        columns: dict[str, Any] = dict(zip(("ix", "iy", "iz"), self._ijk[rows].T, strict=True))
        columns |= {
            "label": self._label[rows],
            "sessions": self._count[rows],
            "session": [names[k] for k in self._last[0, rows]],
            "stamp_ns": self._last[1, rows],
        }
        return contracts.table("merged_voxels", columns)

    def changed(self, names: Sequence[str]) -> pa.Table:
        """Rows of the changes, in the order of the keys."""
        is_gone = ~self._is_occupied & (self._free[0] > self._last[0])
        is_new = self._is_occupied & self._was_free & (self._free[0] < self._last[0])
        rows = np.flatnonzero(is_gone | is_new)
        columns: dict[str, Any] = dict(zip(("ix", "iy", "iz"), self._ijk[rows].T, strict=True))
        columns |= {
            "label": self._label[rows],
            "change": ["gone" if gone else "appeared" for gone in is_gone[rows]],
            "occupied_session": [names[k] for k in self._last[0, rows]],
            "occupied_stamp_ns": self._last[1, rows],
            "free_session": [names[k] for k in self._free[0, rows]],
            "free_stamp_ns": self._free[1, rows],
        }
        return contracts.table("changed_voxels", columns)
