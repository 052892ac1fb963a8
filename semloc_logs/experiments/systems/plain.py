"""The paper's method as written, section 3 and nothing beyond it, as a system.

Every occupied subvolume of the query is described in every heading, and each of its nearest words
gives one hypothesis. Hypotheses are verified by tau, the best are refined by iterative closest
points on aligned voxels, and ranked by tau. Equal hypotheses, of one heading and one shift, are
verified once.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load_file, save_file

from semloc_logs.alignment.cell_masks import OverlapMap, overlap_map
from semloc_logs.alignment.overlaps import (
    Shifts,
    Voxels,
    aligned_pairs,
    best_overlaps,
    query_voxels,
)
from semloc_logs.arrays import F64
from semloc_logs.experiments.kept_files import kept_file
from semloc_logs.experiments.system import MOST_POSES, Query, RankedPose, View
from semloc_logs.experiments.system_version import module_version
from semloc_logs.experiments.view_sessions import sensor_centre
from semloc_logs.labels.space import SKY
from semloc_logs.mapping.selection import thin
from semloc_logs.numerics.transforms import inverse
from semloc_logs.settings import STREET_VOXEL, Resolved, load
from semloc_logs.subvolumes.cut import turned_map
from semloc_logs.subvolumes.plain_describe import (
    describe_blocks,
    describe_box,
    load_plain_encoder,
)
from semloc_logs.subvolumes.plain_network import PlainEncoder
from semloc_logs.voxels.grid import BlockMap, Fuser
from semloc_logs.words.index import Allowed, Index
from semloc_logs.words.plain_vocabulary import (
    PlainVocabulary,
    load_plain_vocabulary,
)

Variant = Literal["semantic", "geometric"]
METHOD = "paper"
SINGLE_LABEL = 2  # of all voxels, in the geometric variant
PROBES = 1  # the tree is traversed to one cell
# the code that the words of a map depend on
_DESCRIBED_BY = tuple(
    f"semloc_logs.{name}"
    for name in ("subvolumes.plain_describe", "subvolumes.plain_network", "words.plain_vocabulary")
)
CONVERGED = 1e-3  # voxels and radians


@dataclass(frozen=True, slots=True, eq=False)
class _Map:
    """A fused map, and the places (m, 2) it was seen from, in voxels."""

    blocks: BlockMap
    road: F64


@dataclass(frozen=True, slots=True, eq=False)
class _Database:
    """``origin`` (3,) of the map in the world, metres; its voxels, and the subvolumes' words with
    their ``centre`` (n, 3) in voxels.
    """

    origin: F64
    target: OverlapMap
    index: Index
    centre: NDArray[np.float32]


@dataclass(eq=False)
class Plain:
    """The method of ``settings`` (schemas/methods/paper.yaml), in one of the ``variant``s of 4.4.

    The geometric one gives all voxels one label. A query of five views is the paper's *acc.* An
    ``encoder`` and ``words`` may replace the files that the settings name, or the shipped ones. A
    folder ``kept`` has the words of databases, so that each is described once.
    """

    variant: Variant = "semantic"
    settings: Resolved = field(default_factory=lambda: load(method=METHOD).resolved())
    encoder: PlainEncoder | None = None
    words: PlainVocabulary | None = None
    name: str = ""
    kept: Path | None = None

    def __post_init__(self) -> None:
        self.name = self.name or f"paper ({self.variant})"
        self._database: _Database | None = None

    # -- parts

    def _encoder(self) -> PlainEncoder:
        if self.encoder is None:
            self.encoder = load_plain_encoder(self.variant, self.settings.descriptor.weights)
        return self.encoder

    def _vocabulary(self) -> PlainVocabulary:
        if self.words is None:
            path = self.settings.descriptor.vocabulary
            self.words = load_plain_vocabulary(self.variant, path)
        return self.words

    def _words_of(self, fused: _Map) -> dict[str, NDArray[Any]]:
        """``word`` and ``code`` (n,) of all occupied subvolumes of a map, and their ``centre`` (n,
        3) in voxels.
        """
        if self.kept is None:
            return self._describe(fused)
        path = self.kept / f"{self._key(fused)}.safetensors"
        return load_file(kept_file(path, lambda new: save_file(self._describe(fused), new)))

    def _describe(self, fused: _Map) -> dict[str, NDArray[Any]]:
        plain = self.settings.plain
        described = describe_blocks(
            fused.blocks,
            plain.stride,
            plain.min_occupied,
            self._encoder(),
            (fused.road, self.settings.descriptor.reach / self.settings.fusion.voxel_size),
        )
        words = self._vocabulary()
        word, code = words.vocabulary.words(words.lifted(described.descriptor))
        return {"word": word, "code": code, "centre": described.centre}

    def _key(self, fused: _Map) -> str:
        """What the words of a map depend on, as a name."""
        vocabulary = self._vocabulary()
        parts = [
            *(value.detach().numpy() for value in self._encoder().state_dict().values()),
            vocabulary.vocabulary.cells,
            vocabulary.vocabulary.projection,
            vocabulary.vocabulary.thresholds,
            vocabulary.vocabulary.children,
            fused.blocks.keys,
            fused.blocks.state,
            fused.road,
        ]
        settings = self.settings.tables("fusion", "descriptor", "plain")
        code = [module_version(module) for module in _DESCRIBED_BY]
        key = hashlib.sha256(repr((settings, vocabulary.scale, code)).encode())
        for part in parts:
            key.update(np.ascontiguousarray(part).tobytes())
        return key.hexdigest()[:16]

    def _fused(self, posed: Iterable[tuple[View, F64]], radius: float) -> _Map:
        """Views fused by their poses (4, 4) in the map, with points within ``radius`` metres."""
        fusion = self.settings.fusion
        fuser = Fuser(fusion)
        road = []
        for view, pose in posed:
            centre = sensor_centre(view)
            kept = thin(view.points, fusion.keyframe_resolution)
            off = view.points[kept] - centre
            is_inside = (view.label[kept] != SKY) & (np.einsum("ij,ij->i", off, off) < radius**2)
            kept = kept[is_inside]
            label = view.label[kept]
            if self.variant == "geometric":
                label = np.full_like(label, SINGLE_LABEL)
            fuser.add(view.points[kept], label, centre, None, pose)
            road.append(pose[:2, 3] / fusion.voxel_size)
        return _Map(fuser.finish(), np.array(road).reshape(-1, 2))

    # -- protocol

    def fit(self, database: Sequence[View]) -> None:
        """Fuse the views in their world, describe all occupied subvolumes, and index them."""
        settings = self.settings
        plain = settings.plain
        world_T_map = np.eye(4)
        world_T_map[:3, 3] = database[0].world_T_base[:3, 3]
        fused = self._fused(
            ((view, inverse(world_T_map) @ view.world_T_base) for view in database),
            settings.fusion.max_range,
        )
        words = self._words_of(fused)
        submap = np.zeros(len(words["word"]), np.int64)
        index = Index.of_words(self._vocabulary().vocabulary, words["word"], words["code"], submap)
        index.shortlist = plain.neighbours  # the nearest in Hamming space
        self._database = _Database(
            world_T_map[:3, 3],
            overlap_map(fused.blocks, plain.kappa / STREET_VOXEL, free=plain.closest == "observed"),
            index,
            words["centre"],
        )

    def localise(self, query: Query) -> list[RankedPose]:
        """The poses of highest tau."""
        if self._database is None:
            raise ValueError("a system is fitted before it localises")
        database = self._database
        plain = self.settings.plain
        v = self.settings.fusion.voxel_size
        odom_T_query = np.eye(4)
        odom_T_query[:3, 3] = query.views[-1].odom_T_base[:3, 3]
        poses = [inverse(odom_T_query) @ view.odom_T_base for view in query.views]
        fused = self._fused(zip(query.views, poses, strict=True), self.settings.query.radius)
        occupied = fused.blocks.occupied()
        if not len(occupied[0]):
            return []
        voxels = query_voxels(occupied)
        groups = self.hypotheses(fused.blocks)
        ranked = best_overlaps(
            database.target, voxels, groups, min(plain.refined, MOST_POSES), plain.min_tau
        )
        answers = []
        for hypothesis in ranked:
            group = groups[hypothesis.group]
            start = np.eye(4)
            start[:3, :3] = group.rotation
            start[:3, 3] = group.part + group.whole[hypothesis.row]
            pose, tau = refined(database.target, voxels, start, plain.iterations)
            world_T_query = pose.copy()
            world_T_query[:3, 3] = v * pose[:3, 3] + database.origin
            answers.append(RankedPose(world_T_query @ poses[-1], tau))
        return sorted(answers, key=lambda pose: -pose.score)

    def hypotheses(self, blocks: BlockMap) -> list[Shifts]:
        """One for each match of a word of the query map, in voxels, equal ones once."""
        if self._database is None:
            raise ValueError("a system is fitted before it localises")
        database = self._database
        plain = self.settings.plain
        words = self._vocabulary()
        low, high = blocks.bounds()
        state = blocks.dense(low, tuple((high - low).tolist()))
        out = []
        for heading in range(plain.headings):
            turned = turned_map(state, low, 2 * np.pi * heading / plain.headings)
            described = describe_box(
                turned.state, turned.low, plain.query_stride, plain.min_occupied, self._encoder()
            )
            matches = database.index.search(
                words.lifted(described.descriptor),
                plain.neighbours,
                PROBES,
                Allowed(np.ones(1, bool)),
            )
            # subvolumes of both maps lie on whole voxels
            shift = np.round(
                database.centre[matches.entry] - described.centre[matches.query]
            ).astype(np.int64)
            c = np.cos(turned.yaw)
            s = np.sin(turned.yaw)
            turned_R_map = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
            part = -turned_R_map @ np.array([*turned.middle, 0.0])
            out.append(Shifts(turned_R_map, part, np.unique(shift, axis=0).reshape(-1, 3)))
        return out


def refined(target: OverlapMap, query: Voxels, start: F64, iterations: int) -> tuple[F64, float]:
    """The pose after iterative closest points, and its tau; the best one that was met.

    Closest points are the aligned voxels of the pose before. Translations are in voxels.
    """
    pose = start
    best = (start, -1.0)
    for iteration in range(iterations + 1):
        ours, theirs = aligned_pairs(target, query, pose)
        tau = len(ours) / max(1, len(query.bits))
        if tau > best[1]:
            best = (pose, tau)
        if iteration == iterations or len(ours) < 3:
            break
        moved = rigid_fit(ours, theirs)
        change = inverse(pose) @ moved
        if max(np.abs(change[:3, 3]).max(), np.abs(change[:3, :3] - np.eye(3)).max()) < CONVERGED:
            break
        pose = moved
    return best


def rigid_fit(source: F64, target: F64) -> F64:
    """The transform (4, 4) of ``source`` (n, 3) to ``target`` with least squares (Kabsch 1976)."""
    a = source.mean(0)
    b = target.mean(0)
    u, _, vt = np.linalg.svd((source - a).T @ (target - b))
    sign = np.sign(np.linalg.det(u @ vt)) or 1.0
    rotation = vt.T @ np.diag([1.0, 1.0, sign]) @ u.T
    out = np.eye(4)
    out[:3, :3] = rotation
    out[:3, 3] = b - rotation @ a
    return out
