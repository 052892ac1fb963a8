"""Views as a fused session of a workspace: what our pipeline works on."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from semloc_logs.arrays import F64, U8
from semloc_logs.experiments.system import View
from semloc_logs.frames import Header, PosedCloud
from semloc_logs.labels.camera_labels import PointLabels
from semloc_logs.labels.sweep_ground import GroundSurface
from semloc_logs.mapping.keyframes import Collected
from semloc_logs.mapping.map_tables import LevelSession, write_map
from semloc_logs.mapping.selection import thin
from semloc_logs.numerics.transforms import inverse
from semloc_logs.settings import Resolved
from semloc_logs.tables.metadata import map_metadata
from semloc_logs.tables.table import write_json
from semloc_logs.workspace import SessionFolder

TOPIC = "view"


@dataclass(frozen=True, slots=True)
class _GivenLabels:
    """The classes that come with the views."""

    source: str = "log"

    def labels(
        self,
        keyframe: int,
        points: NDArray[np.floating],
        origin: NDArray[np.floating],
        labels: PointLabels | None,
        scale: float,
        ground: GroundSurface | None = None,
    ) -> U8:
        """Classes (n,) of the points of a keyframe."""
        if labels is None:
            raise ValueError(f"view {keyframe} has no classes")
        return np.asarray(labels, np.uint8)


def sensor_centre(view: View) -> NDArray[np.float32]:
    """The centre (3,) of the sensors of a view, base frame."""
    return np.asarray(np.mean(np.reshape(view.origin, (-1, 3)), axis=0), np.float32)


def fuse_views(
    views: Iterable[View],
    folder: SessionFolder,
    settings: Resolved,
    poses: Literal["truth", "odometry"],
) -> F64:
    """Write the tables of a session whose keyframes are ``views``; returns ``world_T_map`` (4, 4).

    The world is the frame of the truth, or of the odometry. It is level: the map is the world moved
    to its first view. Views are loaded one at a time.
    """
    folder.path.mkdir(parents=True, exist_ok=True)
    fusion = settings.fusion
    with tempfile.TemporaryDirectory(prefix=".scratch.", dir=folder.path) as scratch:
        collected = Collected(Path(scratch), fusion.keyframe_resolution)
        for view in views:
            kept = thin(view.points, collected.cell)
            pose = view.world_T_base if poses == "truth" else view.odom_T_base
            header = Header(TOPIC, view.stamp_ns, view.stamp_ns, "base")
            cloud = PosedCloud(header, view.points, sensor_centre(view), pose)
            collected.add(cloud, kept, view.label[kept])
        world_T_base = np.array([pose for pose in collected.poses if pose is not None])
        world_T_map = np.eye(4)
        world_T_map[:3, 3] = world_T_base[0, :3, 3]
        metadata = map_metadata(fusion.voxel_size, world_T_map, "log")
        session = LevelSession(
            folder.name,
            collected,
            _GivenLabels(),
            inverse(world_T_map) @ world_T_base,
            fusion,
            metadata,
        )
        tables = write_map(session, folder)
    content = {
        **metadata,
        **tables,
        "name": folder.name,
        "fingerprint": folder.name,
        "settings": settings.tables("logs", "fusion", "labels"),
    }
    write_json(folder.session_json, content)
    return world_T_map
