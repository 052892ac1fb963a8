"""The database of a search: the words of the target sessions' submaps and, on demand, their maps
and surfaces.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Hashable
from copy import copy
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from semloc_logs.alignment.surface import Surface
from semloc_logs.alignment.verify import Target, is_uncertain, looked_at, points_surface
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.numerics.transforms import apply, inverse
from semloc_logs.settings import Resolved
from semloc_logs.voxels.grid import Fuser
from semloc_logs.voxels.store import Keyframe, blocks_path, read_blocks, read_keyframe
from semloc_logs.words.catalogue import read_words, segments
from semloc_logs.words.index import Allowed, Index, Part
from semloc_logs.words.vocabulary import load_vocabulary
from semloc_logs.workspace import Workspace

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
KEPT_TARGETS, KEPT_SURFACES, KEPT_SQUARES, KEPT_KEYFRAMES = 16, 24, 48, 32  # in memory at once
SURFACE_KEYFRAMES = 9  # for each query radius of a query's length
# voxels: words of a submap are left out by squares, keyframes by stretches of this length
UNIT = 16
# voxels that a word may lie nearer to keyframes that are left out than to others: lanes lie apart,
# and odometry drifts
AMBIGUOUS = 32


@dataclass(frozen=True, slots=True)
class Place:
    """A submap of the database: number ``group`` in the search, session and submap id."""

    session: str
    submap: int


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
    """Submaps of ``targets`` in the order of their names; submap ``group`` is number g of
    :attr:`places`.
    """

    def __init__(self, workspace: Workspace, targets: tuple[str, ...], settings: Resolved) -> None:
        self._workspace = workspace
        self.sessions = {name: SessionMap(workspace.session(name)) for name in targets}
        self.settings = settings
        self.places = [
            Place(name, s["id"]) for name, session in self.sessions.items() for s in session.submaps
        ]
        self.has_classes = np.array(
            [self.sessions[place.session].has_classes for place in self.places], bool
        )
        self._words: dict[str, Index] = {}
        self._hidden: dict[str, NDArray[np.bool_]] = {}
        self._asking = np.zeros(3)
        self._targets, self._surfaces = _Recent(KEPT_TARGETS), _Recent(KEPT_SURFACES)
        self._squares, self._keyframes = _Recent(KEPT_SQUARES), _Recent(KEPT_KEYFRAMES)

    def words(self, variant: str) -> Index:
        """All words of ``variant``; groups of its matches are numbers of :attr:`places`."""
        if variant not in self._words:
            numbers = {(place.session, place.submap): g for g, place in enumerate(self.places)}
            parts = [
                Part(segment, segment.numbered(numbers, served))
                for segment, served in segments(self._workspace, variant, tuple(self.sessions))
            ]
            self._words[variant] = Index(
                load_vocabulary(variant, self.settings.descriptor.vocabulary), parts
            )
        return self._words[variant]

    # -- what a query of one of the sessions may see of that session

    def asked_by(self, session: SessionMap, keyframe: int) -> Database:
        """This database as the query at ``keyframe`` sees it: without the keyframes of its own
        session that are near it in time or road.

        Submaps that hold a revisit beside such keyframes stay, less these. What is kept in memory
        is shared.
        """
        view = copy(self)
        closures = self.settings.closures
        name = session.folder.name
        near = (
            np.abs(session.stamps_ns - session.stamps_ns[keyframe]) < closures.exclude_seconds * 1e9
        )
        near |= np.abs(session.distance - session.distance[keyframe]) < (closures.exclude_distance)
        near[keyframe] = True
        # several queries share what is made without it
        stretch = session.distance // (UNIT * self.settings.fusion.voxel_size)
        view._hidden = (
            {name: np.isin(stretch, stretch[near]) | (not session.posed)}
            if name in self.sessions
            else {}
        )
        view._asking = session.map_T_base[keyframe][:3, 3]
        return view

    def seen(self) -> NDArray[np.bool_]:
        """Which submaps (g,) have keyframes that the query may see."""
        return np.array(
            [
                place.session not in self._hidden or len(self.keyframes(g)) > 0
                for g, place in enumerate(self.places)
            ],
            bool,
        )

    def keyframes(self, group: int) -> I64:
        """The keyframes of a submap that the query may see, ascending."""
        return self._shown(group, self._submap_ids(group))

    def _shown(self, group: int, ids: I64) -> I64:
        """Those of the keyframes ``ids`` (n,) of a submap's session that the query may see."""
        hidden = self._hidden.get(self.places[group].session)
        return ids if hidden is None else ids[~hidden[ids]]

    def _submap_ids(self, group: int) -> I64:
        submap = self.sessions[self.places[group].session].submaps[self.places[group].submap]
        return np.arange(submap["first"], submap["last"] + 1)

    def _beside(self, group: int) -> I64:
        """The keyframes of a submap, and of as much road before and behind it as a query sees, that
        the query may see, ascending.
        """
        ids = self._submap_ids(group)
        session = self.sessions[self.places[group].session]
        if session.posed:
            first, last = session.distance[ids[[0, -1]]] + np.array([-1.0, 1.0]) * self._reach
            ids = np.arange(*np.searchsorted(session.distance, [first, np.nextafter(last, np.inf)]))
        return self._shown(group, ids)

    @property
    def _reach(self) -> float:
        """How far from its origin a query may see, metres, and a fifth more."""
        return 1.2 * self.settings.query.radius

    def allowed(self, variant: str, groups: NDArray[np.bool_]) -> Allowed:
        """Which words of submaps ``groups`` (g,) may answer: in squares near keyframes that the
        query may see, not near hidden ones.
        """
        rows: dict[int, NDArray[np.bool_]] = {}
        for g in (
            g for g in np.flatnonzero(groups).tolist() if self.places[g].session in self._hidden
        ):
            session = self.sessions[self.places[g].session]
            hidden = self._hidden[self.places[g].session][self._submap_ids(g)]
            if hidden.any():
                (square, middle), road = (
                    self._squares_of(variant, g),
                    session.road(session.submaps[self.places[g].submap]),
                )
                to_seen, to_hidden = (
                    cKDTree(road[which]).query(middle)[0] for which in (~hidden, hidden)
                )
                rows[g] = (to_seen < to_hidden + AMBIGUOUS * self.settings.fusion.voxel_size)[
                    square
                ]
        return Allowed(groups, rows)

    def _squares_of(self, variant: str, group: int) -> tuple[I64, F64]:
        """The square (n,) that each word of a submap lies in, and the squares' middles (s, 2),
        metres in the map frame.
        """
        place = self.places[group]

        def make() -> tuple[I64, F64]:
            edge = UNIT * self.settings.fusion.voxel_size
            table = read_words(self.sessions[place.session].folder, place.submap, variant)
            square, number = np.unique(
                np.floor(np.stack([table[c].to_numpy() for c in "xy"], 1) / edge),
                axis=0,
                return_inverse=True,
            )
            return number.ravel(), (square + 0.5) * edge

        found: tuple[I64, F64] = self._squares.get((variant, group), make)
        return found

    def target(self, group: int) -> Target:
        """The map of a submap: fused anew without what the query may not see, where that came near
        the rest of it.
        """
        place = self.places[group]
        seen = self.keyframes(group)
        session = self.sessions[place.session]
        apart = np.linalg.norm(session.map_T_base[seen, :3, 3] - self._asking, axis=1)
        is_whole = (
            len(seen) == len(self._submap_ids(group))
            or not (apart < 1.5 * self.settings.query.radius).any()
        )

        def make() -> Target:
            if is_whole:
                return Target(
                    read_blocks(blocks_path(session.folder.blocks, place.submap), states_only=True),
                    self.settings.fusion.voxel_size,
                )
            fuser = Fuser(self.settings.fusion)
            for i in seen.tolist():
                frame = read_keyframe(session.folder.keyframes, i)
                fuser.add(
                    frame.points,
                    frame.label,
                    session.origins[i],
                    frame.sigma,
                    session.map_T_base[i],
                )
            return Target(fuser.finish(), self.settings.fusion.voxel_size)

        found: Target = self._targets.get((group, None if is_whole else seen.tobytes()), make)
        return found

    def nearest_keyframe(self, group: int, position: F64) -> int:
        """The keyframe of a submap or beside it, of those that the query may see, that is nearest
        to ``position`` (3,) in the map frame.
        """
        seen = self._beside(group)
        track = self.sessions[self.places[group].session].map_T_base[seen, :3, 3]
        return int(seen[np.argmin(np.linalg.norm(track - position, axis=1))])

    def looking_keyframe(self, group: int, position: F64) -> int:
        """The keyframe of a submap or beside it, of those that the query may see, that looks at
        ``position`` (3,) in the map frame, on average; of a sensor that looks all around the one
        that is there.
        """
        seen = self._beside(group)
        views = self._views(group, seen)
        return int(seen[np.argmin(np.linalg.norm(views - position, axis=1))])

    def _views(self, group: int, keyframes: I64) -> F64:
        """What keyframes (n,) of a submap's session look at (n, 3), metres in the map frame."""
        session = self.sessions[self.places[group].session]
        return looked_at(
            session.map_T_base[keyframes, :3, 3],
            session.views[keyframes],
            self.settings.fusion.voxel_size,
        )

    def surface(self, group: int, position: F64) -> Surface:
        """What a submap's keyframes, and those beside it, saw around ``position`` (3,) in the map
        frame: of the one that looks there, and of those about it, as far along as a query is long.
        In the map frame, to align with.
        """
        place = self.places[group]
        seen = self._beside(group)
        keyframe = self.looking_keyframe(group, position)
        session = self.sessions[place.session]
        query = self.settings.query
        v = self.settings.fusion.voxel_size
        radius = query.radius
        stretch = session.distance[seen] // (UNIT * v)
        topic = session.topics[seen]
        at = np.searchsorted(seen, keyframe)
        together = seen[(stretch == stretch[at]) & (topic == topic[at])]  # share one surface
        middle = int(together[len(together) // 2])
        beyond = None
        if (
            np.linalg.norm(position - self._views(group, together[[len(together) // 2]])[0])
            > radius / 2
        ):
            # where no keyframe came, what they saw from afar: queries that lie in one cell share it
            beyond = (np.floor(position / (UNIT * v)) + 0.5) * UNIT * v

        def near(i: int) -> tuple[Keyframe, F64]:
            # surfaces of neighbouring stretches share most of their keyframes
            frame: Keyframe = self._keyframes.get(
                (place.session, i), lambda: read_keyframe(session.folder.keyframes, i)
            )
            centre = (
                session.origins[i]
                if beyond is None
                else apply(inverse(session.map_T_base[i]), beyond[None])[0]
            )
            return frame.near(centre, self._reach), session.origins[i]

        def make() -> Surface:
            away = np.linalg.norm(
                session.map_T_base[seen, :3, 3] - session.map_T_base[middle, :3, 3], axis=1
            )
            order = np.argsort(away, kind="stable")
            sigma = near(middle)[0].sigma
            if sigma is not None and len(sigma) and is_uncertain(float(np.median(sigma)), v):
                # uncertain ranges are less so nearby: of a stretch that is twice as long every
                # second keyframe of each sensor
                some = np.sort(order[: 2 * SURFACE_KEYFRAMES])
                odd = np.zeros(len(some), bool)
                for name in np.unique(topic[some]):
                    odd[np.flatnonzero(topic[some] == name)[1::2]] = True
                chosen = seen[some[~odd]]
            else:
                chosen = np.sort(seen[order[:SURFACE_KEYFRAMES]])
            along = seen[away <= (query.length or 0.0) / 2]
            if len(along) > len(chosen):
                count = math.ceil(SURFACE_KEYFRAMES * max(1.0, (query.length or 0.0) / radius))
                chosen = along[np.unique(np.linspace(0, len(along) - 1, count).astype(int))]
            clouds = []
            spreads = []
            for i in chosen.tolist():
                frame, origin = near(i)
                clouds.append(apply(session.map_T_base[i], frame.points))
                spreads.append(frame.spread(origin) @ session.map_T_base[i][:3, :3].T)
            return points_surface(np.concatenate(clouds), np.concatenate(spreads), v)

        where = None if beyond is None else beyond.tobytes()
        found: Surface = self._surfaces.get((group, middle, where, seen.tobytes()), make)
        return found


@lru_cache(maxsize=2)
def open_database(work: Path, targets: tuple[str, ...], settings: Resolved) -> Database:
    """The database of a worker process, kept between its tasks."""
    return Database(Workspace(work), targets, settings)
