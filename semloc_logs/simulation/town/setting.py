"""The parts of a street world: the ground, permanent things on it, and things that differ
between sessions.
"""

from __future__ import annotations

import numpy as np

from semloc_logs.simulation.conditions import Condition
from semloc_logs.simulation.meshes import objects
from semloc_logs.simulation.meshes.objects import Parts
from semloc_logs.simulation.meshes.world import Mesh, MeshBuilder, place
from semloc_logs.simulation.town.sides import Side
from semloc_logs.simulation.town.terrain import CLEAR, Ground

Rng = np.random.Generator


class Setting:
    """Puts things on the ground; ``moving`` collects what differs between sessions.

    ``rng`` draws things common to all sessions, ``change`` things that their number changes,
    ``works`` things dug up, gone or new.
    """

    def __init__(self, ground: Ground, seed: int, condition: Condition) -> None:
        self.ground, self.seed, self.condition = ground, seed, condition
        self.snow = (
            float(np.random.default_rng([seed, 14]).uniform(0.1, 0.3))
            if condition.season == "snow"
            else 0.0
        )
        self.static, self.moving = MeshBuilder(ground.height), MeshBuilder(ground.height)
        self.turn_to(0, 0)

    def turn_to(self, place: int, part: int, look: int | None = None) -> None:
        """Draw from now on what belongs to a place; places of the same ``look`` are alike in what
        stays.
        """
        number = self.condition.number
        self.rng = np.random.default_rng(
            [self.seed, 11, part, 1000 + look]
            if look is not None
            else [self.seed, 11, part, place, 1]
        )
        self.change = np.random.default_rng([self.seed, 12, number, part, place])
        self.works = np.random.default_rng([self.seed, 13, number, part, place])

    def put(
        self,
        parts: Parts,
        x: float,
        y: float,
        yaw: float,
        *,
        moving: bool = False,
        aside: bool = False,
    ) -> bool:
        """Set a thing up at a place, if it does not stand in a lane, in a site or, where it has to
        keep ``aside``, on a carriageway.
        """
        placed = [(place(mesh, x, y, 0.0, yaw), label) for mesh, label in parts]
        kept_out = (aside and self.ground.on_road(x, y)) or (moving and self.ground.is_closed(x, y))
        if kept_out or not self.ground.passable(placed):
            return False
        lift = np.array([0.0, 0.0, float(self.ground.height(np.array([x]), np.array([y]))[0])])
        for mesh, label in objects.snow_cover(placed, self.snow) if self.snow else placed:
            (self.moving if moving else self.static).add(
                Mesh(mesh.vertices + lift, mesh.triangles), label, ground="none"
            )
        return True

    def put_line(self, parts: Parts) -> None:
        """Drape a thing over the ground, unless it would stand in a lane."""
        if self.ground.passable(parts):
            for mesh, label in parts:
                self.static.add(mesh, label, ground="drape")

    def put_tree(self, x: float, y: float, size: float, kind: str | None = None) -> None:
        """A tree, that is missing in three sessions of a hundred."""
        leafy = 0.4 if self.condition.season == "autumn" else 1.0
        parts = objects.tree(self.rng, size, kind, bare=self.condition.bare, leafy=leafy)
        yaw = self.rng.uniform(0, 6.3)
        if self.change.random() >= 0.03:
            self.put(parts, x, y, yaw, aside=True)

    def parked(self, side: Side, u: float, v: float, share: float, *, across: bool = False) -> None:
        """A parking place, taken with probability ``share`` in each session by another vehicle."""
        if self.change.random() > share:
            return
        parts = objects.parked_vehicle(self.change)
        # at the kerb where the lane leaves room for it, or else partly on the pavement
        if not across:
            wide = max(float(mesh.vertices[:, 1].max()) for mesh, _ in parts)
            v = max(-wide - 0.2, wide - (side.road.half_width - side.road.lane - CLEAR - 0.5))
        x, y, yaw = side.at(u, v)
        turn = (
            (np.pi / 2 if across else 0.0)
            + (np.pi if self.change.random() < 0.2 else 0.0)
            + self.change.normal() * 0.04
        )
        shift = self.change.normal(size=2) * [0.3, 0.06]
        self.put(parts, x + shift[0], y + shift[1], yaw + turn, moving=True)
