"""The surface of a target around a place, which a fine fit aligns a query's points with."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from semloc_logs.alignment.target_map import is_uncertain, point_surface
from semloc_logs.arrays import F64, I64
from semloc_logs.closures.database import SQUARE_VOXELS, TargetSurface
from semloc_logs.closures.visibility import REACH, Visibility
from semloc_logs.numerics.transforms import apply, inverse
from semloc_logs.voxels.store import Keyframe

FAR_VIEW = 0.5  # query radii between a place and the nearest view, above which it is seen from afar


@dataclass(frozen=True, slots=True, eq=False)
class _Surroundings:
    """The keyframes ``ids`` (n,) around a submap, of which ``middle`` looks at the place.

    ``afar`` (3,) is the centre of the place, metres in the map frame, where no keyframe came.
    """

    visible: Visibility
    group: int
    ids: I64
    middle: int
    afar: F64 | None

    def near(self, number: int) -> tuple[Keyframe, F64]:
        """What a keyframe saw near itself, or near the place; and its sensor's origin (3,)."""
        database = self.visible.database
        session = database.session(self.group)
        origin = session.origins[number]
        centre = origin
        if self.afar is not None:
            centre = apply(inverse(session.map_T_base[number]), self.afar[None])[0]
        radius = REACH * database.settings.query.radius
        return database.keyframe(self.group, number).near(centre, radius), origin


def target_surface(visible: Visibility, group: int, position: F64) -> TargetSurface:
    """The surface around ``position`` (3,).

    It is made from the keyframe of a submap, or beside it, that looks there, and from those about
    it, as far along the road as a query is long.
    """
    ids = visible.keyframes_around(group)
    middle = _middle(visible, group, ids, position)
    query = visible.database.settings.query
    view = visible.views(group, np.array([middle]))[0]
    afar = None
    if np.linalg.norm(position - view) > FAR_VIEW * query.radius:
        # seen from afar only: queries in one cell share a surface
        edge = SQUARE_VOXELS * visible.database.settings.fusion.voxel_size
        afar = (np.floor(position / edge) + 0.5) * edge
    surroundings = _Surroundings(visible, group, ids, middle, afar)
    seen_from = None if afar is None else afar.tobytes()
    key = (visible.database.key, group, middle, seen_from, ids.tobytes())
    return visible.database.caches.surfaces.get(key, lambda: _surface(surroundings))


def _middle(visible: Visibility, group: int, ids: I64, position: F64) -> int:
    """The middle one of the keyframes that share the surface: of one stretch and sensor."""
    session = visible.database.session(group)
    edge = SQUARE_VOXELS * visible.database.settings.fusion.voxel_size
    stretch = session.distance[ids] // edge
    topic = session.topics[ids]
    viewing = np.searchsorted(ids, visible.viewing_keyframe(group, position))
    together = ids[(stretch == stretch[viewing]) & (topic == topic[viewing])]
    return int(together[len(together) // 2])


def _surface(surroundings: _Surroundings) -> TargetSurface:
    session = surroundings.visible.database.session(surroundings.group)
    clouds = []
    spreads = []
    keyframes = _chosen(surroundings)
    for i in keyframes.tolist():
        frame, origin = surroundings.near(i)
        clouds.append(apply(session.map_T_base[i], frame.points))
        spreads.append(frame.spread(origin) @ session.map_T_base[i][:3, :3].T)
    voxel_size = surroundings.visible.database.settings.fusion.voxel_size
    surface = point_surface(np.concatenate(clouds), np.concatenate(spreads), voxel_size)
    return TargetSurface(surface, keyframes)


def _chosen(surroundings: _Surroundings) -> I64:
    """The keyframes that the surface is made from, ascending."""
    database = surroundings.visible.database
    settings = database.settings
    count = settings.closures.surface_keyframes
    position = database.session(surroundings.group).map_T_base[:, :3, 3]
    ids = surroundings.ids
    distance = np.linalg.norm(position[ids] - position[surroundings.middle], axis=1)
    nearest = np.argsort(distance, kind="stable")

    sigma = surroundings.near(surroundings.middle)[0].sigma
    if (
        sigma is not None
        and len(sigma)
        and is_uncertain(float(np.median(sigma)), settings.fusion.voxel_size)
    ):
        # uncertain ranges are less so nearby: of a stretch that is twice as long every second one
        chosen = _every_second(surroundings, np.sort(nearest[: 2 * count]))
    else:
        chosen = np.sort(ids[nearest[:count]])

    # of a long query's road so many for each radius
    length = settings.query.length or 0.0
    along = ids[distance <= length / 2]
    if len(along) > len(chosen):
        more = math.ceil(count * max(1.0, length / settings.query.radius))
        chosen = along[np.unique(np.linspace(0, len(along) - 1, more).astype(int))]
    return chosen


def _every_second(surroundings: _Surroundings, some: I64) -> I64:
    """Of the surroundings' keyframes with numbers ``some`` every second one of each sensor."""
    session = surroundings.visible.database.session(surroundings.group)
    topic = session.topics[surroundings.ids][some]
    odd = np.zeros(len(some), bool)
    for name in np.unique(topic):
        odd[np.flatnonzero(topic == name)[1::2]] = True
    return surroundings.ids[some[~odd]]
