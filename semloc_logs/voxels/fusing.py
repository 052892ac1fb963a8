"""Fusing one session: log -> keyframes, submaps and the session map (paper 3.1). One pass over the log, bounded memory."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import semloc_logs
from semloc_logs import contracts
from semloc_logs.errors import LogError
from semloc_logs.frames import PosedCloud
from semloc_logs.geometry import apply, inverse, rotation_between
from semloc_logs.labels.labeller import Labeller
from semloc_logs.labels.shape import shape
from semloc_logs.labels.space import SKY
from semloc_logs.logs.depth import RangeNoise
from semloc_logs.logs.session import Session, open_session
from semloc_logs.logs.trajectory_file import TrajectoryFile
from semloc_logs.settings import STREET_VOXEL, Settings
from semloc_logs.tables import replacing_folder, write_json, write_table
from semloc_logs.voxels.gravity import find_up, ground_height
from semloc_logs.voxels.grid import BlockMap, Fuser, empty_map
from semloc_logs.voxels.picture import Caption, draw_map
from semloc_logs.voxels.selection import KeyframeSelector, road_distance, submap_ranges, thin
from semloc_logs.voxels.store import (
    PART,
    Keyframe,
    blocks_path,
    part_path,
    pose_columns,
    read_blocks,
    read_keyframe,
    write_blocks,
    write_keyframes,
    write_voxels,
)
from semloc_logs.workspace import SessionFolder

F64 = NDArray[np.float64]
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True)
class FuseTask:
    """One session to fuse; picklable."""

    logs: tuple[Path, ...]
    folder: SessionFolder
    settings: Settings  # resolved
    topics: dict[str, str] = field(default_factory=dict)
    fingerprint: str = ""
    poses: TrajectoryFile | None = None


@dataclass(slots=True, eq=False)
class _Raw:
    """A keyframe before labels: what is known during the pass."""

    header: Any
    pose: F64 | None  # session_T_base
    origin: NDArray[np.float32]


@dataclass(slots=True, eq=False)
class _Normals:
    """Normals of a bounded number of keyframes, evenly spread over the log, for the direction of gravity."""

    every: int = 1
    seen: int = 0
    kept: list[tuple[int, F64, F64]] = field(default_factory=list)

    def add(self, cloud: PosedCloud, points: NDArray[np.float32], cell: float) -> None:
        if self.seen % self.every == 0:
            if cloud.sigma is not None:  # the normal of points that lie nearer to each other than their noise means nothing
                cell = max(cell, 2 * float(np.median(cloud.sigma)))
            some = points[thin(points, cell)][:12_000]
            s = shape(some, 12)
            weight = np.where((s.planar > 0.5) & (s.scattered < 0.15), s.planar, 0.0).astype(float)
            turned = s.normal.astype(float) if cloud.session_T_base is None else s.normal @ cloud.session_T_base[:3, :3].T
            keep = weight > 0
            self.kept.append((self.seen, turned[keep], weight[keep]))
            if len(self.kept) > 60:
                self.every *= 2
                self.kept = [k for k in self.kept if k[0] % self.every == 0]
        self.seen += 1


def fuse_session(task: FuseTask, on_progress: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Write keyframes/, blocks/, voxels/, frames.parquet, trajectory.parquet, map.png and, last, session.json; returns the latter.

    Raises LogError when the log has nothing to fuse, RoleError when its streams leave open what to use.
    """
    settings = task.settings
    fusion = settings.fusion
    scale = fusion.voxel_size / STREET_VOXEL
    session = open_session(
        [*task.logs],
        task.topics,
        min_range=fusion.min_range or 0.0,
        max_range=2.0 * (fusion.max_range or 50.0),
        noise=RangeNoise(fusion.depth_noise, fusion.disparity_noise),
        poses=task.poses,
        odometry=fusion.odometry,
    )
    try:
        with tempfile.TemporaryDirectory(prefix="semloc-") as scratch:
            labeller = Labeller(settings.labels, session)
            raws, normals = _collect(session, task, labeller, Path(scratch), on_progress)
            if not raws:
                raise LogError(f"{session.name} gave no usable points: {'; '.join(session.problems) or 'its sensor streams are empty'}")
            posed = raws[0].pose is not None
            session_T_map, level = _level(session, raws, normals, posed)
            poses = np.array([inverse(session_T_map) @ r.pose if r.pose is not None else level(i) for i, r in enumerate(raws)])
            labeller.conclude()
            metadata = {
                "schema_version": 1,
                "voxel_size": fusion.voxel_size,
                "session_T_map": session_T_map.tolist(),
                "label_space": "cityscapes",
                "label_source": labeller.source,
                "version": semloc_logs.__version__,
            }
            grounds: list[float] = []
            counts: list[int] = []

            def labelled(first: int) -> Iterator[Keyframe]:
                for i in range(first, min(first + PART, len(raws))):
                    points, ids = _load_raw(Path(scratch), i)
                    points_level = apply(poses[i], points)
                    origin = apply(poses[i], raws[i].origin[None])[0]
                    ground = ground_height(points_level - np.r_[poses[i][:2, 3], 0.0], float(origin[2]), scale)
                    label = labeller.labels(i, points_level, origin, ids, scale)
                    keep = label != SKY
                    grounds.append(ground)
                    counts.append(int(keep.sum()))
                    sigma = Path(scratch) / f"{i}-sigma.npy"
                    yield Keyframe(points[keep], label[keep], np.load(sigma)[keep] if sigma.exists() else None)

            with replacing_folder(task.folder.keyframes) as folder:
                for first in range(0, len(raws), PART):
                    stamps = [r.header.stamp_ns for r in raws[first : first + PART]]
                    write_keyframes(part_path(folder, first), first, stamps, labelled(first), metadata)
                    on_progress(f"labelled {min(first + PART, len(raws))} of {len(raws)} keyframes")
        distance = road_distance(poses) if posed else np.zeros(len(poses))
        frames = {
            "keyframe": np.arange(len(raws)),
            "stamp_ns": [r.header.stamp_ns for r in raws],
            "log_time_ns": [r.header.log_time_ns for r in raws],
            "topic": [r.header.topic for r in raws],
            "posed": [posed] * len(raws),
            "distance": distance,
            "ground_z": grounds,
            "points": counts,
            **{f"origin_{c}": np.array([r.origin[k] for r in raws], np.float32) for k, c in enumerate("xyz")},
            **pose_columns(poses),
        }
        write_table(task.folder.frames, contracts.table("frames", frames), metadata, ("keyframe",))
        stamps_ns, track = session.trajectory()
        write_table(
            task.folder.trajectory, contracts.table("trajectory", {"stamp_ns": stamps_ns, **pose_columns(track)}), metadata, ("stamp_ns",)
        )
        origins = np.array([r.origin for r in raws])
        submaps = _submaps(task, poses, origins, np.array(grounds), distance, posed, metadata, on_progress)
        ids = range(len(submaps))
        voxels = write_voxels(task.folder.voxels, (read_blocks(blocks_path(task.folder.blocks, i)) for i in ids), metadata, fusion.clamp)
        caption = Caption(task.folder.name, labeller.source, fusion.voxel_size)
        draw_map(task.folder.voxels, poses[:, :3, 3] if posed else np.zeros((0, 3)), caption, task.folder.picture)
        for note in labeller.notes:
            on_progress(note)
        content = {
            **session.to_json(),
            "problems": [*session.problems, *labeller.notes],
            "labels": labeller.to_json(),
            "name": task.folder.name,
            "fingerprint": task.fingerprint,
            "settings": settings.model_dump(mode="json", include={"fusion", "labels"}),
            **metadata,
            "posed": posed,
            "keyframes": len(raws),
            "submaps": submaps,
            "voxels": voxels,
            "skipped": session.skipped,
        }
        write_json(task.folder.session_json, content)
        return content
    finally:
        session.close()


def _collect(
    session: Session, task: FuseTask, labeller: Labeller, scratch: Path, on_progress: Callable[[str], None]
) -> tuple[list[_Raw], _Normals]:
    """The one pass over the log: keyframes' thinned points into ``scratch``, their poses and a sample of normals."""
    fusion = task.settings.fusion
    cell = fusion.keyframe_resolution or 0.1
    selector, normals, raws = KeyframeSelector(fusion), _Normals(), list[_Raw]()
    for cloud in session.clouds(labeller.on_image, labeller.images):
        if not selector.wants(cloud.header.topic, cloud.header.stamp_ns, cloud.session_T_base):
            continue
        keep = thin(cloud.points, cell)
        points = cloud.points[keep]
        np.save(scratch / f"{len(raws)}.npy", points)
        label = labeller.take(cloud, keep)
        if label is not None:
            np.save(scratch / f"{len(raws)}-label.npy", label)
        if cloud.sigma is not None:
            np.save(scratch / f"{len(raws)}-sigma.npy", cloud.sigma[keep])
        raws.append(_Raw(cloud.header, cloud.session_T_base, cloud.origin))
        normals.add(cloud, points, 2 * cell)
        if len(raws) % 50 == 0:
            on_progress(f"read {len(raws)} keyframes")
    return raws, normals


def _load_raw(scratch: Path, i: int) -> tuple[NDArray[np.float32], NDArray[np.uint32] | None]:
    label = scratch / f"{i}-label.npy"
    return np.load(scratch / f"{i}.npy"), np.load(label) if label.exists() else None


def _level(session: Session, raws: list[_Raw], normals: _Normals, posed: bool) -> tuple[F64, Callable[[int], F64]]:
    """``session_T_map`` (4, 4), level and with its origin at the first keyframe, because poses may be in UTM and voxels, words and
    surfaces want small numbers; and for a log without poses the level pose of each keyframe by its number."""
    optical = session.base_frame.endswith("_optical") or session.base_frame in {c.header.frame_id for c in session.cameras.values()}
    up_in_base = np.array([0.0, -1.0, 0.0]) if optical else UP
    if posed:
        prior = session.imu_up_in_session()
        if prior is None:
            rotations = np.array([r.pose[:3, :3] for r in raws if r.pose is not None])
            # a vehicle's frames follow REP 103, and so does its odometry; a camera's world may be any of its frames
            prior = (rotations @ up_in_base).mean(0) if optical else UP
        kept = normals.kept
        up = find_up(np.concatenate([k[1] for k in kept]), np.concatenate([k[2] for k in kept]), prior)
        session_T_map = np.eye(4)
        session_T_map[:3, :3] = rotation_between(UP, up)
        if raws[0].pose is not None:
            session_T_map[:3, 3] = raws[0].pose[:3, 3]
        return session_T_map, lambda _: np.eye(4)
    found = {k[0]: find_up(k[1], k[2], up_in_base) for k in normals.kept}
    keys = np.array(sorted(found))

    def level(i: int) -> F64:
        out = np.eye(4)
        out[:3, :3] = rotation_between(found[int(keys[np.argmin(np.abs(keys - i))])], UP)
        return out

    return np.eye(4), level


def fuse_keyframes(
    folder: SessionFolder,
    keyframes: range | list[int],
    poses: F64,
    origins: NDArray[np.floating],
    settings: Settings,
    radius: float | None = None,
) -> BlockMap:
    """The map of some keyframes at ``poses`` (n, 4, 4) map_T_base by keyframe; points beyond ``radius`` of the sensor are left out."""
    fuser = Fuser(settings.fusion)
    for i in keyframes:
        frame = read_keyframe(folder.keyframes, i)
        if radius is not None:
            frame = frame.near(origins[i], radius)
        fuser.add(apply(poses[i], frame.points), frame.label, apply(poses[i], origins[i][None])[0], frame.sigma)
    return fuser.finish()


def _submaps(
    task: FuseTask,
    poses: F64,
    origins: NDArray[np.floating],
    grounds: F64,
    distance: F64,
    posed: bool,
    metadata: dict[str, Any],
    on_progress: Callable[[str], None],
) -> list[dict[str, Any]]:
    """Fuse and write every submap; returns what session.json says of them."""
    fusion = task.settings.fusion
    # without poses there is no map: the keyframes only ask
    ranges = submap_ranges(distance, fusion.submap_length or 100.0, fusion.submap_overlap) if posed else []
    out = []
    with replacing_folder(task.folder.blocks) as folder:
        for i, (first, last) in enumerate(ranges):
            blocks = fuse_keyframes(task.folder, range(first, last), poses, origins, task.settings)
            write_blocks(blocks_path(folder, i), blocks, {**metadata, "submap": i})
            out.append(
                {"id": i, "first": first, "last": last - 1, "ground_z": float(np.median(grounds[first:last])), "blocks": len(blocks.keys)}
            )
            on_progress(f"fused submap {i + 1} of {len(ranges)}")
        if not ranges:
            write_blocks(blocks_path(folder, 0), empty_map(), metadata)
    return out
