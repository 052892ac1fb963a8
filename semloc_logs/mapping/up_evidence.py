"""How well each direction of the whole sphere fits as up, whatever the axes of the frames mean.

Sensors stand above the ground: they see its upper side, and little lies below it. Walls are
perpendicular to up. Vehicles and hands move mostly on the level, and turn mostly about up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from scipy.spatial.transform import Rotation

from semloc_logs.arrays import F64
from semloc_logs.mapping.up_direction import LEAST_NORMALS, FlatPlaces, refined

# chosen by hand on real and simulated drives, for the lead of up on them. A floor counts whole,
# because a map without one is rare; the others decide between a floor and a wall or a ceiling.
CEILING, WALLS, GROUND, BELOW, MOTION, TURNS = 0.5, 0.3, 0.5, 0.5, 0.5, 0.3
SPREAD = 0.1  # rad, of the normals of a floor or of walls: streets rise and fall
MOST_NORMALS = 6000  # that a direction is compared with
MOST_CANDIDATES = 300  # normals that are tried as up and as down
APART = np.radians(20.0)  # directions nearer than this are one
OTHERS = 6  # directions that are compared in full

# whether a ceiling may be taken for the ground
BEYOND = 0.1  # share of points beyond what would be the ground: the sky is there
TALL = 4.0  # m that things rise above the ground, where no ceiling is seen
WIDE = 12.0  # m to which the ground is seen, where all of it is not a ceiling of a room
NEARER = 0.7  # of the distance to the ceiling: sensors are nearer to the floor
HIGH = 95  # percentile of the heights above the ground

# of the ground below a sensor, at street scale (m)
LAYER = 0.3  # points this near to the height of the ground are on it
MARGIN = 0.5  # and so far below it lies what cannot be there
FLOOR = np.radians(8.0)  # normals this near to up may belong to the ground
LOWEST = 90  # percentile of the depths of flat places below the sensor, and of their distances
LEAST_FLOOR = 20  # flat places that show the ground
MOST_POINTS = 1500  # of a keyframe, that may lie below the ground
UNSEEN = 0.3  # share below the ground, where no ground is seen

# the way (m at street scale) and the turning (rad) at which motion counts half
HALF_WAY = 3.0
HALF_TURN = 1.0
MOST_STEPS = 5.0  # median steps; a longer one is a jump and counts like this


class Sky(Enum):
    """What is above a ground that would be the ceiling of the other way round."""

    OPEN = "open"
    CEILING = "ceiling"  # farther from the sensor than the ground
    UNKNOWN = "unknown"  # either may be the ceiling


@dataclass(frozen=True, slots=True)
class _Ground:
    """The ground of a direction: shares of points ``on`` and ``below`` it.

    It is ``depth`` metres below the sensor and ``reach`` wide around it, things ``rise`` above it.
    """

    is_seen: bool
    on: float
    below: float
    depth: float
    rise: float
    reach: float


class UpEvidence:
    """What the ``places`` of keyframes and the ``poses`` (n, 4, 4) of all show of up.

    All are in one frame; a log without poses has n = 0. ``scale`` is the voxel size over 0.30 m.
    """

    def __init__(self, places: Sequence[FlatPlaces], poses: F64, scale: float) -> None:
        self._places = places
        self._scale = scale
        normals = np.concatenate([p.normals for p in places])
        weights = np.concatenate([p.weights for p in places])
        self._rng = np.random.default_rng(0)
        some = self._rng.choice(len(normals), min(MOST_NORMALS, len(normals)), replace=False)
        self._normals = normals[some]
        self._weights = weights[some] / max(float(weights[some].sum()), 1e-12)
        steps = np.diff(poses[:, :3, 3], axis=0) / scale
        turns = Rotation.from_matrix(
            poses[1:, :3, :3] @ np.swapaxes(poses[:-1, :3, :3], 1, 2)
        ).as_rotvec()
        self._motion = _directions(steps, HALF_WAY)
        self._turns = _directions(turns, HALF_TURN)

    @property
    def is_enough(self) -> bool:
        """Whether there are surfaces at all."""
        return bool(len(self._normals) >= LEAST_NORMALS and self._weights.sum() > 0)

    def scores(self, directions: F64) -> F64:
        """How well ``directions`` (k, 3) fit as up (k,): about 0.2 is bad, above 0.4 good."""
        grounds = [self._ground(u) for u in directions]
        ground = np.array([GROUND * g.on - BELOW * g.below for g in grounds])
        return np.asarray(self._quick_scores(directions) + ground)

    def sky(self, up: F64) -> Sky:
        """What is above the ground, if down is ``up`` (3,) in truth: the other way round."""
        ceiling, ground = self._ground(up), self._ground(-up)
        if not ground.is_seen:
            return Sky.UNKNOWN
        if not ceiling.is_seen:
            return Sky.OPEN if ground.rise > TALL or ground.reach > WIDE else Sky.UNKNOWN
        if ceiling.below > BEYOND:
            return Sky.OPEN
        if ground.depth < NEARER * ceiling.depth:
            return Sky.CEILING
        return Sky.UNKNOWN

    def others(self, up: F64) -> F64:
        """The directions (k, 3) that fit best besides ``up`` (3,); the direction down is one."""
        n = self._normals
        count = min(MOST_CANDIDATES, int(np.count_nonzero(self._weights)))
        some = self._rng.choice(len(n), count, replace=False, p=self._weights)
        candidates = np.concatenate([n[some], -n[some]])
        order = np.argsort(-self._quick_scores(candidates), kind="stable")
        directions = [up, -up]
        for c in candidates[order]:
            if any(float(c @ other) > np.cos(APART) for other in directions):
                continue
            direction = refined(n, self._weights, c, c)
            if float(direction @ up) < np.cos(APART):
                directions.append(direction)
            if len(directions) > OTHERS:
                break
        return np.array(directions[1:])

    def _quick_scores(self, directions: F64) -> F64:
        """Of ``directions`` (k, 3), without what lies below the ground."""
        dot = directions @ self._normals.T
        wide = 2 * SPREAD**2
        # 1 - cos(angle) is half of the angle squared
        floor = np.exp((dot - 1) * 2 / wide) @ self._weights
        ceiling = np.exp((-dot - 1) * 2 / wide) @ self._weights
        walls = np.exp(-(dot**2) / wide) @ self._weights
        motion, turns = (
            ((directions @ m) * directions).sum(1) for m in (self._motion, self._turns)
        )
        return np.asarray(
            floor - CEILING * ceiling + WALLS * walls - MOTION * motion + TURNS * turns
        )

    def _ground(self, up: F64) -> _Ground:
        """The ground that each keyframe sees, if ``up`` (3,) is up."""
        sizes = []
        count, on, below = 0, 0, 0
        for p in self._places:
            floor = p.normals @ up > np.cos(FLOOR)
            if np.count_nonzero(floor) < LEAST_FLOOR:
                continue
            ground = float(np.percentile(-p.centres[floor] @ up, LOWEST))
            height = p.points[:: len(p.points) // MOST_POINTS + 1] @ up + ground
            away = np.linalg.norm(np.cross(p.centres[floor], up), axis=1)
            sizes.append((ground, np.percentile(height, HIGH), np.percentile(away, LOWEST)))
            count += len(height)
            on += int(np.count_nonzero(np.abs(height) < LAYER * self._scale))
            below += int(np.count_nonzero(height < -MARGIN * self._scale))
        if not count:
            return _Ground(False, 0.0, UNSEEN, 0.0, 0.0, 0.0)
        depth, rise, reach = np.median(sizes, axis=0).tolist()
        return _Ground(True, on / count, below / count, depth, rise, reach)


def _directions(vectors: F64, half: float) -> F64:
    """Mean outer product (3, 3) of the directions of ``vectors`` (n, 3), weighted by length.

    Its trace is 1 for infinite length, 1/2 at a length of ``half`` in all.
    """
    length = np.linalg.norm(vectors, axis=1)
    if not length.any():
        return np.zeros((3, 3))
    counted = np.minimum(length, MOST_STEPS * np.median(length[length > 0]))
    unit = vectors / np.maximum(length, 1e-12)[:, None]
    return np.asarray((unit * counted[:, None]).T @ unit / (counted.sum() + half))
