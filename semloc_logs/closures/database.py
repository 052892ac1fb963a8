"""The database of a search: the words of the target sessions' submaps and, on demand, their maps and surfaces."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semloc_logs.alignment.icp import Surface
from semloc_logs.alignment.verify import Target, surface_of, thin_points
from semloc_logs.closures.queries import SessionMap
from semloc_logs.geometry import apply
from semloc_logs.settings import Settings
from semloc_logs.tables import read_table
from semloc_logs.voxels.store import blocks_path, read_blocks, read_keyframe
from semloc_logs.words.index import Index
from semloc_logs.words.vocabulary import load_vocabulary
from semloc_logs.workspace import Workspace

F64 = NDArray[np.float64]
KEPT_TARGETS, KEPT_SURFACES = 12, 24  # in memory at once
SURFACE_KEYFRAMES = 9


@dataclass(frozen=True, slots=True)
class Place:
    """A submap of the database: number ``group`` in the search, session and submap id."""

    session: str
    submap: int


@dataclass(eq=False)
class Words:
    """The index of one variant and the centres (n, 3), metres in the map frame, and groups (n,) of its entries."""

    index: Index
    centre: F64
    group: NDArray[np.int64]


class _Recent:
    """The most recently used values, at most ``size``."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._kept: OrderedDict[Hashable, Any] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], Any]) -> Any:
        if key not in self._kept:
            self._kept[key] = make()
            if len(self._kept) > self._size:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]


class Database:
    """Submaps of ``targets`` in the order of their names; submap ``group`` is number g of :attr:`places`."""

    def __init__(self, workspace: Workspace, targets: tuple[str, ...], settings: Settings) -> None:
        self.sessions = {name: SessionMap(workspace.session(name)) for name in targets}
        self.settings = settings
        self.places = [Place(name, s["id"]) for name, session in self.sessions.items() for s in session.submaps]
        self._words: dict[str, Words] = {}
        self._targets, self._surfaces = _Recent(KEPT_TARGETS), _Recent(KEPT_SURFACES)

    def words(self, variant: str) -> Words:
        """All words of ``variant``."""
        if variant not in self._words:
            parts: list[tuple[NDArray[Any], ...]] = []
            for g, place in enumerate(self.places):
                table = read_table(blocks_path(self.sessions[place.session].folder.words, place.submap))
                mine = np.flatnonzero(np.array(table["variant"].to_pylist(), dtype=object) == variant)
                centre = np.stack([table[c].to_numpy()[mine] for c in "xyz"], 1).astype(float)
                parts.append((centre, table["word"].to_numpy()[mine], table["code"].to_numpy()[mine], np.full(len(mine), g)))
            centre, word, code, group = (
                np.concatenate([p[k] for p in parts]) if parts else np.zeros((0, 3) if k == 0 else 0) for k in range(4)
            )
            vocabulary = load_vocabulary(variant, self.settings.descriptor.vocabulary)
            self._words[variant] = Words(
                Index(vocabulary, word.astype(np.uint16), code.astype(np.uint64), group.astype(np.int64)), centre, group.astype(np.int64)
            )
        return self._words[variant]

    def target(self, group: int) -> Target:
        """The map of a submap."""
        place = self.places[group]

        def make() -> Target:
            folder = self.sessions[place.session].folder.blocks
            return Target(read_blocks(blocks_path(folder, place.submap), with_votes=False), self.settings.fusion.voxel_size)

        found: Target = self._targets.get(group, make)
        return found

    def nearest_keyframe(self, group: int, position: F64) -> int:
        """The keyframe of a submap that is nearest to ``position`` (3,) in the map frame."""
        place = self.places[group]
        session = self.sessions[place.session]
        submap = session.submaps[place.submap]
        track = session.map_T_base[submap["first"] : submap["last"] + 1, :3, 3]
        return int(submap["first"] + np.argmin(np.linalg.norm(track - position, axis=1)))

    def surface(self, group: int, keyframe: int) -> Surface:
        """Tangent planes of what the submap's keyframes nearest to ``keyframe`` saw, in the map frame."""
        place = self.places[group]
        session = self.sessions[place.session]
        submap = session.submaps[place.submap]

        def make() -> Surface:
            ids = np.arange(submap["first"], submap["last"] + 1)
            away = np.linalg.norm(session.map_T_base[ids, :3, 3] - session.map_T_base[keyframe, :3, 3], axis=1)
            radius = 1.2 * (self.settings.query.radius or 24.0)
            clouds = []
            for i in np.sort(ids[np.argsort(away, kind="stable")[:SURFACE_KEYFRAMES]]):
                frame = read_keyframe(session.folder.keyframes, int(i)).near(session.origins[i], radius)
                clouds.append(apply(session.map_T_base[i], frame.points))
            return surface_of(thin_points(np.concatenate(clouds), self.settings.fusion.voxel_size / 2.5))

        found: Surface = self._surfaces.get((place.session, keyframe, submap["id"]), make)
        return found


@lru_cache(maxsize=2)
def open_database(work: Path, targets: tuple[str, ...], settings_json: str) -> Database:
    """The database of a worker process, kept between its tasks."""
    return Database(Workspace(work), targets, Settings.model_validate_json(settings_json))
