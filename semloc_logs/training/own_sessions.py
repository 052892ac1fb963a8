"""Training pairs from fused sessions of one's own: self-supervised, the map of a stretch of road
completes its single frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semloc_logs.mapping.selection import submap_ranges
from semloc_logs.settings import STREET_VOXEL, Resolved
from semloc_logs.tables.table import read_table
from semloc_logs.training.pairs import SceneFrame, cut_pairs, write_shard
from semloc_logs.voxels.store import poses_of, read_keyframe
from semloc_logs.workspace import SessionFolder

# road in a shard (m at 0.30 m voxels): the dense map of a stretch has to fit into memory
STRETCH = 60.0
MIN_FRAMES = 10


@dataclass(frozen=True, slots=True)
class StretchTask:
    """Keyframes ``first`` .. ``last`` - 1 of a session to cut into a shard; picklable."""

    folder: SessionFolder
    first: int
    last: int
    shard: Path
    settings: Resolved


def session_frames(
    folder: SessionFolder, first: int = 0, last: int | None = None
) -> list[SceneFrame]:
    """Keyframes ``first`` .. ``last`` - 1 of a fused session (all by default); none of a session
    without poses, whose frames share no map.

    Raises WorkspaceError when the session is not there or damaged.
    """
    table = read_table(folder.frames)
    if not table.num_rows or not table["posed"][0].as_py():
        return []
    poses = poses_of(table)
    origins = np.stack([table[f"origin_{c}"].to_numpy() for c in "xyz"], 1).astype(np.float32)
    out = []
    for i in range(first, table.num_rows if last is None else min(last, table.num_rows)):
        keyframe = read_keyframe(folder.keyframes, i)
        out.append(SceneFrame(keyframe.points, origins[i], keyframe.label, poses[i]))
    return out


def stretch_tasks(
    shards: Path, sessions: Sequence[SessionFolder], settings: Resolved
) -> list[StretchTask]:
    """Tasks for every stretch of every session with poses, with shards in the folder ``shards``."""
    length = STRETCH * settings.fusion.voxel_size / STREET_VOXEL
    tasks = []
    for session in sessions:
        table = read_table(session.frames, ["posed", "distance"])
        if not table.num_rows or not table["posed"][0].as_py():
            continue
        for first, last in submap_ranges(table["distance"].to_numpy(), length, 0.0):
            if last - first >= MIN_FRAMES:
                tasks.append(
                    StretchTask(
                        session,
                        first,
                        last,
                        shards / f"{session.name}-{first:06d}.parquet",
                        settings,
                    )
                )
    return tasks


def cut_stretch(task: StretchTask) -> Path:
    """Write the pairs of a stretch, unless they are there already."""
    if not task.shard.exists():
        settings = task.settings
        rng = np.random.default_rng((settings.training.seed, 4, task.first))
        write_shard(
            task.shard,
            cut_pairs(
                session_frames(task.folder, task.first, task.last),
                settings.fusion,
                settings.training,
                rng,
            ),
        )
    return task.shard
