"""What a query may see of a database: everything but its own drive near it in time or road."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from semloc_logs.alignment.query_map import view_centres
from semloc_logs.alignment.target_map import Target
from semloc_logs.arrays import F64, I64, Bools
from semloc_logs.closures.database import SQUARE_VOXELS, Database
from semloc_logs.mapping.session_map import SessionMap
from semloc_logs.voxels.grid import Fuser
from semloc_logs.voxels.store import blocks_path, read_blocks, read_keyframe
from semloc_logs.words.index import Allowed

# voxels that a word may lie nearer to hidden keyframes than to visible ones: lanes lie apart, and
# odometry drifts
AMBIGUOUS_VOXELS = 32
REACH = 1.2  # query radii that keyframes may be away from what a query sees
SEES_QUERY = 1.5  # query radii: a submap farther from the query has nothing that is hidden from it


@dataclass(frozen=True, slots=True, eq=False)
class Visibility:
    """A database without the keyframes ``hidden`` (n,) of some of its sessions.

    ``origin`` (3,) is the query's position in its own map, metres. Submaps that hold a revisit
    beside hidden keyframes stay, less these. The caches are the database's.
    """

    database: Database
    hidden: Mapping[str, Bools]
    origin: F64

    def submaps(self) -> Bools:
        """Which submaps (g,) have visible keyframes."""
        return np.array(
            [
                place.session not in self.hidden or len(self.keyframes(group)) > 0
                for group, place in enumerate(self.database.places)
            ],
            bool,
        )

    def keyframes(self, group: int) -> I64:
        """The visible keyframes of a submap, ascending."""
        return self._visible(group, self.database.submap_keyframes(group))

    def keyframes_around(self, group: int) -> I64:
        """The visible keyframes of a submap and of the road before and behind it, ascending.

        The road reaches as far as a query sees.
        """
        ids = self.database.submap_keyframes(group)
        session = self.database.session(group)
        if session.posed:
            reach = REACH * self.database.settings.query.radius
            first, last = session.distance[ids[[0, -1]]] + np.array([-1.0, 1.0]) * reach
            ids = np.arange(*np.searchsorted(session.distance, [first, np.nextafter(last, np.inf)]))
        return self._visible(group, ids)

    def _visible(self, group: int, ids: I64) -> I64:
        hidden = self.hidden.get(self.database.places[group].session)
        return ids if hidden is None else ids[~hidden[ids]]

    def allowed_words(self, variant: str, groups: Bools) -> Allowed:
        """Which words of the submaps ``groups`` (g,) may match.

        Of submaps with hidden keyframes they are the words in squares near visible ones.
        """
        rows: dict[int, Bools] = {}
        for group in np.flatnonzero(groups).tolist():
            place = self.database.places[group]
            if place.session not in self.hidden:
                continue
            hidden = self.hidden[place.session][self.database.submap_keyframes(group)]
            if hidden.any():
                rows[group] = self._words_near_visible(variant, group, hidden)
        return Allowed(groups, rows)

    def _words_near_visible(self, variant: str, group: int, hidden: Bools) -> Bools:
        """Which words (n,) of a submap lie near its keyframes that are not ``hidden`` (k,)."""
        square, centres = self.database.word_squares(variant, group)
        road = self.database.session(group).road(self.database.submap(group))
        to_visible, to_hidden = (
            cKDTree(road[which]).query(centres)[0] for which in (~hidden, hidden)
        )
        slack = AMBIGUOUS_VOXELS * self.database.settings.fusion.voxel_size
        return np.asarray((to_visible < to_hidden + slack)[square])

    def target(self, group: int) -> Target:
        """The map of a submap.

        It is fused anew without hidden keyframes, where the rest of it comes near the query.
        """
        ids = self.keyframes(group)
        position = self.database.session(group).map_T_base[ids, :3, 3]
        far = SEES_QUERY * self.database.settings.query.radius
        is_whole = (
            len(ids) == len(self.database.submap_keyframes(group))
            or not (np.linalg.norm(position - self.origin, axis=1) < far).any()
        )
        key = (self.database.key, group, None if is_whole else ids.tobytes())
        return self.database.caches.targets.get(
            key, lambda: self._stored(group) if is_whole else self._fused(group, ids)
        )

    def _stored(self, group: int) -> Target:
        path = blocks_path(
            self.database.session(group).folder.blocks, self.database.places[group].submap
        )
        return Target(read_blocks(path, states_only=True), self.database.settings.fusion.voxel_size)

    def _fused(self, group: int, ids: I64) -> Target:
        session = self.database.session(group)
        fusion = self.database.settings.fusion
        fuser = Fuser(fusion)
        for i in ids.tolist():
            frame = read_keyframe(session.folder.keyframes, i)
            fuser.add(
                frame.points, frame.label, session.origins[i], frame.sigma, session.map_T_base[i]
            )
        return Target(fuser.finish(), fusion.voxel_size)

    def nearest_keyframe(self, group: int, position: F64) -> int:
        """The visible keyframe of a submap, or beside it, nearest to ``position`` (3,).

        Positions are in the map frame, metres.
        """
        ids = self.keyframes_around(group)
        track = self.database.session(group).map_T_base[ids, :3, 3]
        return int(ids[np.argmin(np.linalg.norm(track - position, axis=1))])

    def viewing_keyframe(self, group: int, position: F64) -> int:
        """The visible keyframe of a submap, or beside it, that looks at ``position`` (3,).

        Of a sensor that looks all around it is the one at the position.
        """
        ids = self.keyframes_around(group)
        views = self.views(group, ids)
        return int(ids[np.argmin(np.linalg.norm(views - position, axis=1))])

    def views(self, group: int, ids: I64) -> F64:
        """Where keyframes (n,) of a submap's session look (n, 3), metres in the map frame."""
        session = self.database.session(group)
        return view_centres(
            session.map_T_base[ids, :3, 3],
            session.views[ids],
            self.database.settings.fusion.voxel_size,
        )


def everything(database: Database) -> Visibility:
    """All of a database."""
    return Visibility(database, {}, np.zeros(3))


def visible_to(database: Database, session: SessionMap, keyframe: int) -> Visibility:
    """What the query at ``keyframe`` of ``session`` may see.

    Hidden are the keyframes of its own session that are near it in time or road; all of them where
    the session has no poses.
    """
    origin = session.map_T_base[keyframe][:3, 3]
    name = session.folder.name
    if name not in database.sessions:
        return Visibility(database, {}, origin)

    closures = database.settings.closures
    time_ns = np.abs(session.stamps_ns - session.stamps_ns[keyframe])
    road = np.abs(session.distance - session.distance[keyframe])
    is_excluded = (time_ns < closures.exclude_seconds * 1e9) | (road < closures.exclude_distance)
    is_excluded[keyframe] = True

    # whole stretches, so that several queries share maps without them
    stretch = session.distance // (SQUARE_VOXELS * database.settings.fusion.voxel_size)
    hidden = np.isin(stretch, stretch[is_excluded]) | (not session.posed)
    return Visibility(database, {name: hidden}, origin)
