"""The points of a session, batch by batch: its occupied voxels, or the points of its keyframes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import date, timedelta
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from semloc_logs.arrays import F64, U8
from semloc_logs.errors import WorkspaceError
from semloc_logs.exports.common_frame import CommonFrame
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import apply
from semloc_logs.voxels.store import read_keyframe

# x from, y from, x to, y to; metres, the upper ones excluded
Bounds = tuple[float, float, float, float]
FLOAT32_FINENESS = 16  # steps of 32-bit coordinates in a voxel, at least


@dataclass(eq=False)
class SessionPoints:
    """Points of one session.

    ``what`` is "voxels" (centres) or "keyframes", ``frame`` "session" or "map", or "common" or
    "utm" with ``common``; ``bounds`` are in that frame.
    """

    session: SessionMap
    what: str
    frame: str
    bounds: Bounds | None
    common: CommonFrame | None = None

    def __post_init__(self) -> None:
        if self.what == "keyframes" and not self.session.posed:
            raise WorkspaceError(
                f"Session {self.session.folder.name} has no poses: its keyframes cannot be put "
                "into one cloud."
            )

    @property
    def voxel_size(self) -> float:
        """Metres."""
        return float(self.session.json["voxel_size"])

    @cached_property
    def frame_T_map(self) -> F64:
        """From the map into the chosen frame (4, 4)."""
        if self.frame == "map":
            return np.eye(4)
        return np.array(self.session.json["session_T_map"], float)

    @property
    def day(self) -> date:
        """The day of the first keyframe, UTC."""
        first = max(0, int(self.session.stamps_ns[0])) if len(self.session.stamps_ns) else 0
        return date(1970, 1, 1) + timedelta(seconds=first // 10**9)

    @property
    def origin(self) -> F64:
        """Whole metres (3,) close to the points: the map's origin in the chosen frame."""
        if self.common is not None:
            return np.asarray(np.floor(self.common.positions[0]))
        return np.asarray(np.floor(self.frame_T_map[:3, 3]))

    @cached_property
    def float32_step(self) -> float:
        """The distance between neighbouring 32-bit floats at the trajectory, in metres."""
        positions = apply(self.frame_T_map, self.session.map_T_base[:, :3, 3])
        if self.common is not None:
            positions = self.common.positions
        return float(np.spacing(np.float32(np.abs(positions).max(initial=1.0))))

    @property
    def fits_float32(self) -> bool:
        """Whether 32-bit coordinates are finer than a sixteenth of a voxel."""
        return self.float32_step <= self.voxel_size / FLOAT32_FINENESS

    def count(self) -> int:
        """How many points :meth:`batches` gives; reads only footers without bounds."""
        if self.bounds is not None:
            return sum(len(label) for _, label in self.batches())
        if self.what == "keyframes":
            return int(self.session.frames["points"].to_numpy().sum())
        return sum(int(_open(path).metadata.num_rows) for path in self._tiles())

    def batches(self) -> Iterator[tuple[F64, U8]]:
        """Points (n, 3) in metres with train ids (n,); a row group or a keyframe at a time."""
        for placed, label in self._voxels() if self.what == "voxels" else self._keyframes():
            if self.bounds is not None:
                x0, y0, x1, y1 = self.bounds
                x = placed[:, 0]
                y = placed[:, 1]
                keep = (x >= x0) & (x < x1) & (y >= y0) & (y < y1)
                placed = placed[keep]
                label = label[keep]
            if len(label):
                yield placed, label

    def _tiles(self) -> list[Path]:
        return sorted(self.session.folder.voxels.rglob("*.parquet"))

    def _voxels(self) -> Iterator[tuple[F64, U8]]:
        for path in self._tiles():
            file = _open(path)
            for group in range(file.num_row_groups):
                if not self._may_hold(file.metadata.row_group(group)):
                    continue
                try:
                    table = file.read_row_group(group, columns=["ix", "iy", "iz", "label"])
                except (OSError, pa.ArrowException) as problem:
                    raise _damaged(path, problem) from None
                ijk = np.stack([table[c].to_numpy() for c in ("ix", "iy", "iz")], 1)
                points = (ijk + 0.5) * self.voxel_size
                label = table["label"].to_numpy()
                if self.common is not None:
                    yield self.common.points(points), label
                else:
                    yield apply(self.frame_T_map, points), label

    def _may_hold(self, group: Any) -> bool:
        """Whether any point of a row group can lie within the bounds, by its statistics."""
        ranges = [group.column(k).statistics for k in range(3)]
        if (
            self.bounds is None
            or self.common is not None
            or any(r is None or not r.has_min_max for r in ranges)
        ):
            return True
        corners = np.array(list(product(*((r.min, r.max) for r in ranges))))
        placed = apply(self.frame_T_map, (corners + 0.5) * self.voxel_size)
        low_x, low_y = placed[:, :2].min(0)
        high_x, high_y = placed[:, :2].max(0)
        x0, y0, x1, y1 = self.bounds
        return bool(low_x < x1 and high_x >= x0 and low_y < y1 and high_y >= y0)

    def _keyframes(self) -> Iterator[tuple[F64, U8]]:
        for number, map_T_base in enumerate(self.session.map_T_base):
            keyframe = read_keyframe(self.session.folder.keyframes, number)
            points = apply(map_T_base, keyframe.points.astype(float))
            if self.common is not None:
                yield self.common.points_of(points, number), keyframe.label
            else:
                yield apply(self.frame_T_map, points), keyframe.label


def _open(path: Path) -> pq.ParquetFile:
    try:
        return pq.ParquetFile(path)
    except (OSError, pa.ArrowException) as problem:
        raise _damaged(path, problem) from None


def _damaged(path: Path, problem: Exception) -> WorkspaceError:
    reason = str(problem).splitlines()[0]
    return WorkspaceError(f"{path} cannot be read ({reason}): run 'semloc fuse' with --overwrite.")
