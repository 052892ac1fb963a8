"""The database of a search: the words of the target sessions' submaps, and caches of their maps."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from semloc_logs.alignment.surface import Surface
from semloc_logs.alignment.target_map import Target
from semloc_logs.arrays import F64, I64
from semloc_logs.closures.recent import Recent
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.settings import Resolved
from semloc_logs.voxels.store import Keyframe, read_keyframe
from semloc_logs.words.index import Index, Part
from semloc_logs.words.segment_catalogue import read_words, session_segment
from semloc_logs.words.vocabulary import load_vocabulary
from semloc_logs.workspace import Workspace

# bytes in memory at once
TARGETS = 256 << 20  # 36 MB a submap of sparse sweeps
SURFACES = 128 << 20
SQUARES = 32 << 20
KEYFRAMES = 32 << 20
OPEN_DATABASES = 64  # 3 MB each for a kilometre
# voxels: words of a submap are hidden by squares, keyframes by stretches of road of this length
SQUARE_VOXELS = 16


@dataclass(frozen=True, slots=True)
class Place:
    """A submap of the database: session and submap id."""

    session: str
    submap: int


@dataclass(frozen=True, slots=True, eq=False)
class TargetSurface:
    """A ``surface`` in the map frame, and the ``keyframes`` (n,) that it is made from."""

    surface: Surface
    keyframes: I64


class Caches:
    """What was read and made last, of one database or of all that a process has open.

    ``targets`` and ``surfaces`` are made by :mod:`.visibility` and :mod:`.target_surface`.
    """

    def __init__(self) -> None:
        self.targets: Recent[Target] = Recent(TARGETS)
        self.surfaces: Recent[TargetSurface] = Recent(SURFACES)
        self.squares: Recent[tuple[I64, F64]] = Recent(SQUARES)
        self.keyframes: Recent[Keyframe] = Recent(KEYFRAMES)


class Database:
    """Submaps of target sessions; the ``group`` of a submap is its number in :attr:`places`.

    ``key`` tells it from others that share its ``caches``.
    """

    def __init__(
        self,
        workspace: Workspace,
        targets: tuple[str, ...],
        settings: Resolved,
        caches: Caches | None = None,
        key: Hashable = None,
    ) -> None:
        self._workspace = workspace
        self.caches = caches or Caches()
        self.key = key
        self.sessions = {name: SessionMap(workspace.session(name)) for name in targets}
        self.settings = settings
        self.places = [
            Place(name, s["id"]) for name, session in self.sessions.items() for s in session.submaps
        ]
        self.has_classes = np.array(
            [self.sessions[place.session].has_classes for place in self.places], bool
        )
        self._words: dict[str, Index] = {}

    def words(self, variant: str) -> Index:
        """All words of ``variant``; groups of its matches are numbers of :attr:`places`."""
        if variant not in self._words:
            numbers = {(place.session, place.submap): g for g, place in enumerate(self.places)}
            held = [session_segment(s.folder, variant) for s in self.sessions.values()]
            parts = [
                Part(segment, segment.numbered(numbers, self.sessions))
                for segment in held
                if segment is not None
            ]
            vocabulary = load_vocabulary(variant, self.settings.descriptor.vocabulary)
            self._words[variant] = Index(vocabulary, parts)
        return self._words[variant]

    def session(self, group: int) -> SessionMap:
        """The session of a submap."""
        return self.sessions[self.places[group].session]

    def submap(self, group: int) -> dict[str, Any]:
        """A submap as session.json has it."""
        return self.session(group).submaps[self.places[group].submap]

    def submap_keyframes(self, group: int) -> I64:
        """All keyframes of a submap, ascending."""
        submap = self.submap(group)
        return np.arange(submap["first"], submap["last"] + 1)

    def keyframe(self, group: int, number: int) -> Keyframe:
        """A keyframe of a submap's session."""
        place = self.places[group]
        folder = self.session(group).folder.keyframes
        key = (self.key, place.session, number)
        return self.caches.keyframes.get(key, lambda: read_keyframe(folder, number))

    def word_squares(self, variant: str, group: int) -> tuple[I64, F64]:
        """The square (n,) that each word of a submap lies in, and the squares' centres (s, 2).

        The centres are in metres, in the map frame.
        """
        key = (self.key, variant, group)
        return self.caches.squares.get(key, lambda: self._squares_of(variant, group))

    def _squares_of(self, variant: str, group: int) -> tuple[I64, F64]:
        edge = SQUARE_VOXELS * self.settings.fusion.voxel_size
        table = read_words(self.session(group).folder, self.places[group].submap, variant)
        xy = np.stack([table[c].to_numpy() for c in "xy"], 1)
        square, number = np.unique(np.floor(xy / edge), axis=0, return_inverse=True)
        return number.ravel(), (square + 0.5) * edge


_OPEN = Caches()  # of the databases of this process


@lru_cache(maxsize=OPEN_DATABASES)
def open_database(work: Path, target: str, words: str, settings: Resolved) -> Database:
    """The database of one session, kept between the tasks of a process.

    ``words`` is the fingerprint of its words and its map.
    """
    of_settings = settings.fingerprint("descriptor", "fusion", "query", "closures")
    return Database(Workspace(work), (target,), settings, _OPEN, (work, target, words, of_settings))
