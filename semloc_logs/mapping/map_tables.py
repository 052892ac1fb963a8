"""The tables of a session's map: keyframes, submaps, voxels and ground, written in one pass.

A chain of iterators that holds a few keyframes and the submaps that are being driven through.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from semloc_logs import progress
from semloc_logs.arrays import F64
from semloc_logs.labels.camera_labels import PointLabels
from semloc_logs.labels.space import SKY
from semloc_logs.labels.sweep_ground import GroundSurface, ground_surface
from semloc_logs.mapping.ground import GroundMapper, ground_height, write_ground
from semloc_logs.mapping.keyframes import Collected
from semloc_logs.mapping.selection import road_distance, submap_ranges
from semloc_logs.mapping.submap_fusion import fuse_ranges
from semloc_logs.numerics.prefetch import prefetched
from semloc_logs.numerics.transforms import apply
from semloc_logs.settings import STREET_VOXEL, ResolvedFusion
from semloc_logs.tables import contracts
from semloc_logs.tables.atomic_files import replacing_folder
from semloc_logs.tables.table import write_table
from semloc_logs.voxels.grid import BlockMap, empty_map
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
PROGRESS_EVERY = 50  # keyframes


class LabelGiver(Protocol):
    """Gives the points of keyframes their classes, as a ``Labeller`` does."""

    @property
    def source(self) -> str: ...

    def labels(
        self,
        keyframe: int,
        points: NDArray[np.floating],
        origin: NDArray[np.floating],
        labels: PointLabels | None,
        scale: float,
        ground: GroundSurface | None = None,
    ) -> NDArray[np.uint8]: ...


@dataclass(frozen=True, slots=True, eq=False)
class LevelSession:
    """The keyframes of session ``name``, with the pose of each in its map.

    ``map_T_base`` is (n, 4, 4); ``metadata`` goes into every table.
    """

    name: str
    collected: Collected
    labeller: LabelGiver
    map_T_base: F64
    fusion: ResolvedFusion
    metadata: dict[str, Any]

    @property
    def posed(self) -> bool:
        """Whether the log has poses. Without them there is no map: keyframes are queries only."""
        return self.collected.poses[0] is not None

    @property
    def scale(self) -> float:
        """The voxel size over the voxel size of streets."""
        return self.fusion.voxel_size / STREET_VOXEL

    def distances(self) -> F64:
        """Road travelled up to each keyframe (n,), metres; zeros without poses."""
        return road_distance(self.map_T_base) if self.posed else np.zeros(len(self.collected))


@dataclass(slots=True, eq=False)
class MapFacts:
    """What becomes known keyframe by keyframe, and submap by submap.

    ``ground_z`` (n,) below the sensor in the map, metres; ``points`` (n,) how many; ``views`` (n,
    3) the mean of the points around the sensor, in the base frame; ``submaps`` as in session.json.
    """

    ground_z: list[float] = field(default_factory=list)
    points: list[int] = field(default_factory=list)
    views: list[F64] = field(default_factory=list)
    submaps: list[dict[str, Any]] = field(default_factory=list)


def write_map(session: LevelSession, folder: SessionFolder) -> dict[str, Any]:
    """Write every table but the trajectory; returns what session.json holds of them."""
    fusion = session.fusion
    metadata = session.metadata
    distance = session.distances()
    ranges: list[tuple[int, int]] = []
    if session.posed:
        ranges = submap_ranges(distance, fusion.submap_length, fusion.submap_overlap)
    facts = MapFacts()
    ground = GroundMapper(session.scale)
    stamps_ns = [h.stamp_ns for h in session.collected.headers]
    labelled = labelled_keyframes(session, ground, facts)
    with (
        replacing_folder(folder.keyframes) as keyframes,
        replacing_folder(folder.blocks) as blocks,
        # whatever happens, the other threads end before their folders are renamed or removed
        closing(prefetched(keep_keyframes(keyframes, stamps_ns, labelled, metadata))) as kept,
        closing(
            prefetched(_kept_submaps(session, kept, ranges, facts, blocks), depth=1)
        ) as submaps,
    ):
        voxels = write_voxels(folder.voxels, submaps, metadata, fusion.clamp)
        if not ranges:
            write_blocks(blocks_path(blocks, 0), empty_map(), metadata)
    frames = contracts.table("frames", _frame_columns(session, facts, distance))
    write_table(folder.frames, frames, metadata, ("keyframe",))
    write_ground(folder.ground, ground.finish(), metadata)
    return {
        "posed": session.posed,
        "keyframes": len(session.collected),
        "submaps": facts.submaps,
        "voxels": voxels,
    }


def labelled_keyframes(
    session: LevelSession, ground: GroundMapper, facts: MapFacts
) -> Iterator[Keyframe]:
    """All keyframes with their classes, without sky; ``ground`` and ``facts`` are filled."""
    collected = session.collected
    scale = session.scale
    count = len(collected)
    for i, map_T_base in enumerate(session.map_T_base):
        points, ids, sigma = collected.load(i)
        level_points = apply(map_T_base, points)
        origin = apply(map_T_base, collected.origins[i][None])[0]
        facts.ground_z.append(ground_height(level_points, origin, scale))

        # the surface of the ground, where the map or the labels need it
        is_mapped = collected.poses[i] is not None and ground.wants(origin)
        surface = None
        if is_mapped or session.labeller.source == "geometry":
            surface = ground_surface(level_points, origin, scale)
        if is_mapped and surface is not None:
            ground.add(surface, origin)

        label = session.labeller.labels(i, level_points, origin, ids, scale, surface)
        keep = label != SKY
        facts.points.append(int(keep.sum()))
        facts.views.append(_view(points[keep], collected.origins[i], VIEW * scale))
        if (i + 1) % PROGRESS_EVERY == 0 or i + 1 == count:
            progress.report("fuse", session.name, i + 1, count, "keyframes")
        yield Keyframe(points[keep], label[keep], None if sigma is None else sigma[keep])


def _view(points: NDArray[np.floating], origin: NDArray[np.floating], radius: float) -> F64:
    """Mean (3,) of the points within ``radius`` metres of the sensor; its centre without any."""
    inside = points[np.linalg.norm(points - origin, axis=1) < radius]
    return np.asarray(inside.mean(0, dtype=float) if len(inside) else origin, float)


def _kept_submaps(
    session: LevelSession,
    keyframes: Iterable[Keyframe],
    ranges: Sequence[tuple[int, int]],
    facts: MapFacts,
    folder: Path,
) -> Iterator[BlockMap]:
    """Every submap, once it is written to ``folder`` and entered in ``facts``."""
    origins = session.collected.origins
    fused = fuse_ranges(keyframes, ranges, session.map_T_base, origins, session.fusion)
    for i, ((first, end), blocks) in enumerate(zip(ranges, fused, strict=True)):
        write_blocks(blocks_path(folder, i), blocks, {**session.metadata, "submap": i})
        facts.submaps.append(
            {
                "id": i,
                "first": first,
                "last": end - 1,
                "ground_z": float(np.median(facts.ground_z[first:end])),
                "blocks": len(blocks.keys),
            }
        )
        progress.report("fuse", session.name, i + 1, len(ranges), "submaps")
        yield blocks


def _frame_columns(session: LevelSession, facts: MapFacts, distance: F64) -> dict[str, Any]:
    """Columns of the table ``frames``, a row a keyframe."""
    headers = session.collected.headers
    count = len(headers)
    vectors: dict[str, Sequence[NDArray[np.floating]]] = {
        "origin": session.collected.origins,
        "view": facts.views,
    }
    return {
        "keyframe": np.arange(count),
        "stamp_ns": [h.stamp_ns for h in headers],
        "log_time_ns": [h.log_time_ns for h in headers],
        "topic": [h.topic for h in headers],
        "posed": [session.posed] * count,
        "distance": distance,
        "ground_z": facts.ground_z,
        "points": facts.points,
        **{
            f"{name}_{c}": np.array([v[k] for v in values], np.float32)
            for name, values in vectors.items()
            for k, c in enumerate("xyz")
        },
        **pose_columns(session.map_T_base),
    }
