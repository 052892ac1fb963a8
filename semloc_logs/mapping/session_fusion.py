"""Fusing one session: log -> keyframes, submaps and the session map (paper 3.1). One pass over the
log, bounded memory.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import semloc_logs
from semloc_logs.errors import LogError
from semloc_logs.labels.labeller import Labeller
from semloc_logs.labels.space import SKY
from semloc_logs.labels.sweep_ground import ground_surface
from semloc_logs.logs.poses.trajectory_file import TrajectoryFile
from semloc_logs.logs.problems import Problem, lost, sentences
from semloc_logs.logs.sensors.depth import RangeNoise
from semloc_logs.logs.session.session import SessionOptions, open_session
from semloc_logs.mapping.ground import GroundMapper, write_ground
from semloc_logs.mapping.keyframes import Collected, collect
from semloc_logs.mapping.levelling import check_reach, level
from semloc_logs.mapping.selection import road_distance, submap_ranges
from semloc_logs.mapping.up_direction import ground_height
from semloc_logs.numerics.prefetch import ahead
from semloc_logs.numerics.transforms import apply
from semloc_logs.settings import STREET_VOXEL, Resolved, ResolvedFusion
from semloc_logs.tables import contracts
from semloc_logs.tables.table import replacing_folder, write_json, write_table
from semloc_logs.voxels.carve import Carver
from semloc_logs.voxels.grid import BlockMap, Fuser, empty_map
from semloc_logs.voxels.store import (
    Keyframe,
    blocks_path,
    keep_keyframes,
    pose_columns,
    write_blocks,
    write_voxels,
)
from semloc_logs.workspace import SessionFolder

VIEW = 24.0  # m at voxels of 0.30 m: as far as a query looks

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class FuseTask:
    """One session to fuse; picklable."""

    logs: tuple[Path, ...]
    folder: SessionFolder
    settings: Resolved
    topics: dict[str, str] = field(default_factory=dict)
    fingerprint: str = ""
    poses: TrajectoryFile | None = None


@dataclass(frozen=True, slots=True)
class FusedSession:
    """The ``content`` of session.json, and the ``problems`` that it lists as sentences."""

    content: dict[str, Any]
    problems: tuple[Problem, ...]


def fuse_session(
    task: FuseTask,
    on_progress: Callable[[str], None] = lambda _: None,
    on_tables: Callable[[dict[str, Any]], None] = lambda _: None,
) -> FusedSession:
    """Writes every table and, last, session.json.

    ``on_tables`` is called with the content of session.json just before that, when all tables are
    there.

    Raises LogError when the log has nothing to fuse, RoleError when its streams leave open what to
    use.
    """
    fusion = task.settings.fusion
    options = SessionOptions(
        topics=task.topics,
        min_range=fusion.min_range,
        max_range=2.0 * fusion.max_range,
        noise=RangeNoise(fusion.depth_noise, fusion.disparity_noise),
        poses=task.poses,
        odometry=fusion.odometry,
    )
    session = open_session([*task.logs], options)
    try:
        with _scratch(task.folder) as scratch:
            labeller = Labeller(task.settings.labels, session)
            collected = collect(session, labeller, fusion, scratch, on_progress)
            if not len(collected):
                reasons = "; ".join(sentences(session.problems)) or "its sensor streams are empty"
                raise LogError(f"{session.name} gave no usable points: {reasons}")
            check_reach(session, collected, fusion.voxel_size)
            labeller.conclude()
            session_T_map, poses = level(session, collected)
            metadata = {
                "schema_version": 1,
                "voxel_size": fusion.voxel_size,
                "session_T_map": session_T_map.tolist(),
                "label_space": "cityscapes",
                "label_source": labeller.source,
                "version": semloc_logs.__version__,
            }
            fused = _Fused(task, collected, labeller, poses, metadata, on_progress)
            content = fused.write()
        stamps_ns, track = session.trajectory()
        trajectory = contracts.table("trajectory", {"stamp_ns": stamps_ns, **pose_columns(track)})
        write_table(task.folder.trajectory, trajectory, metadata, ("stamp_ns",))
        problems = [*session.problems, *labeller.problems]
        for text in sentences(labeller.problems):
            on_progress(text)
        content = {
            **session.to_json(),
            "problems": sentences(problems),
            "labels": labeller.to_json(),
            "name": task.folder.name,
            "fingerprint": task.fingerprint,
            "settings": task.settings.model_dump(mode="json", include={"fusion", "labels"}),
            **metadata,
            **content,
            "skipped": sentences(lost(problems)),
        }
        on_tables(content)
        write_json(task.folder.session_json, content)
        return FusedSession(content, tuple(problems))
    finally:
        session.close()


@contextmanager
def _scratch(folder: SessionFolder) -> Iterator[Path]:
    """A folder for the keyframes of the pass, beside the results: temporary folders of the system
    may be memory.
    """
    folder.path.mkdir(parents=True, exist_ok=True)
    for stale in folder.path.glob(".scratch.*"):  # of a run that was killed
        shutil.rmtree(stale, ignore_errors=True)
    with tempfile.TemporaryDirectory(prefix=".scratch.", dir=folder.path) as name:
        yield Path(name)


@dataclass(slots=True, eq=False)
class _Fused:
    """The second half: labelled keyframes, submaps, the session map, as a chain of iterators that
    holds a few keyframes and the submaps that are being driven through.
    """

    task: FuseTask
    collected: Collected
    labeller: Labeller
    poses: F64  # map_T_base (n, 4, 4)
    metadata: dict[str, Any]
    on_progress: Callable[[str], None]
    grounds: list[float] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    views: list[F64] = field(default_factory=list)
    submaps: list[dict[str, Any]] = field(default_factory=list)

    def write(self) -> dict[str, Any]:
        """Write every table but the trajectory; returns what session.json says of them."""
        folder = self.task.folder
        fusion = self.task.settings.fusion
        n = len(self.collected)
        posed = self.collected.poses[0] is not None
        distance = road_distance(self.poses) if posed else np.zeros(n)
        # without poses there is no map: the keyframes only ask
        ranges = (
            submap_ranges(distance, fusion.submap_length, fusion.submap_overlap) if posed else []
        )
        stamps = [h.stamp_ns for h in self.collected.headers]
        ground = GroundMapper(fusion.voxel_size / STREET_VOXEL)
        with (
            replacing_folder(folder.keyframes) as keyframes,
            replacing_folder(folder.blocks) as blocks,
            # whatever happens, the other threads end before their folders are renamed or removed
            closing(
                ahead(keep_keyframes(keyframes, stamps, self._labelled(ground), self.metadata))
            ) as kept,
            closing(ahead(self._kept_submaps(blocks, kept, ranges), depth=1)) as submaps,
        ):
            voxels = write_voxels(folder.voxels, submaps, self.metadata, fusion.clamp)
            if not ranges:
                write_blocks(blocks_path(blocks, 0), empty_map(), self.metadata)
        frames = {
            "keyframe": np.arange(n),
            "stamp_ns": stamps,
            "log_time_ns": [h.log_time_ns for h in self.collected.headers],
            "topic": [h.topic for h in self.collected.headers],
            "posed": [posed] * n,
            "distance": distance,
            "ground_z": self.grounds,
            "points": self.counts,
            **{
                f"{name}_{c}": np.array([p[k] for p in found], np.float32)
                for name, found in (("origin", self.collected.origins), ("view", self.views))
                for k, c in enumerate("xyz")
            },
            **pose_columns(self.poses),
        }
        write_table(folder.frames, contracts.table("frames", frames), self.metadata, ("keyframe",))
        write_ground(folder.ground, ground.finish(), self.metadata)
        return {"posed": posed, "keyframes": n, "submaps": self.submaps, "voxels": voxels}

    def _labelled(self, ground: GroundMapper) -> Iterator[Keyframe]:
        """All keyframes with their classes, without sky; ``ground`` learns what they see of it."""
        scale = self.task.settings.fusion.voxel_size / STREET_VOXEL
        for i, pose in enumerate(self.poses):
            points, ids, sigma = self.collected.load(i)
            level_points = apply(pose, points)
            origin = apply(pose, self.collected.origins[i][None])[0]
            self.grounds.append(ground_height(level_points, origin, scale))
            is_mapped = self.collected.poses[i] is not None and ground.wants(origin)
            surface = (
                ground_surface(level_points, origin, scale)
                if is_mapped or self.labeller.source == "geometry"
                else None
            )
            if is_mapped and surface is not None:
                ground.add(surface, origin)
            label = self.labeller.labels(i, level_points, origin, ids, scale, surface)
            keep = label != SKY
            self.counts.append(int(keep.sum()))
            self.views.append(_view(points[keep], self.collected.origins[i], VIEW * scale))
            if (i + 1) % 50 == 0 or i + 1 == len(self.poses):
                self.on_progress(f"labelled {i + 1} of {len(self.poses)} keyframes")
            yield Keyframe(points[keep], label[keep], None if sigma is None else sigma[keep])

    def _kept_submaps(
        self, folder: Path, keyframes: Iterable[Keyframe], ranges: list[tuple[int, int]]
    ) -> Iterator[BlockMap]:
        """Every submap, once it is written to ``folder``."""
        for i, blocks in enumerate(
            fuse_ranges(
                keyframes, ranges, self.poses, self.collected.origins, self.task.settings.fusion
            )
        ):
            write_blocks(blocks_path(folder, i), blocks, {**self.metadata, "submap": i})
            first, last = ranges[i]
            ground = float(np.median(self.grounds[first:last]))
            self.submaps.append(
                {
                    "id": i,
                    "first": first,
                    "last": last - 1,
                    "ground_z": ground,
                    "blocks": len(blocks.keys),
                }
            )
            self.on_progress(f"fused submap {i + 1} of {len(ranges)}")
            yield blocks


def _view(points: NDArray[np.floating], origin: NDArray[np.floating], radius: float) -> F64:
    """Mean (3,) of the points within ``radius`` metres of the sensor, its centre where there are
    none.
    """
    near = points[np.linalg.norm(points - origin, axis=1) < radius]
    return np.asarray(near.mean(0, dtype=float) if len(near) else origin, float)


def fuse_ranges(
    keyframes: Iterable[Keyframe],
    ranges: list[tuple[int, int]],
    poses: F64,
    origins: Sequence[NDArray[np.floating]],
    fusion: ResolvedFusion,
) -> Iterator[BlockMap]:
    """The map of each of ``ranges`` [first, last) of ``keyframes``, which come one by one; both
    bounds never decrease.

    Only the ranges that hold the current keyframe are in memory: the others are not begun, or done.
    """
    carver = Carver(fusion)
    active = dict[int, Fuser]()
    begun = 0
    for i, keyframe in enumerate(keyframes):
        while begun < len(ranges) and ranges[begun][0] <= i:
            active[begun] = Fuser(fusion)
            begun += 1
        if active:
            marks = carver.marks(
                keyframe.points, keyframe.label, origins[i], keyframe.sigma, poses[i]
            )
            for fuser in active.values():
                fuser.take(marks)
        for number in [n for n in active if ranges[n][1] == i + 1]:
            yield active.pop(number).finish()
