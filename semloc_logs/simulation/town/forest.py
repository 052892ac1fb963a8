"""A road or a track through a forest: trunks, undergrowth and rough ground, and hardly a wall
anywhere.
"""

from __future__ import annotations

import numpy as np

from semloc_logs.simulation.conditions import Condition
from semloc_logs.simulation.meshes import objects
from semloc_logs.simulation.meshes.world import World, join_worlds
from semloc_logs.simulation.town.road_network import RoadNetwork
from semloc_logs.simulation.town.setting import Setting
from semloc_logs.simulation.town.street import street_ground

DEPTH = 28.0  # m of forest on either side of the road
MAX_TREES = 900


def build_forest(network: RoadNetwork, seed: int, condition: Condition) -> World:
    """A forest along the roads of ``network``; the ground is the one of ``street_ground(network,
    seed)``.

    A stand has one or two species of trees of a similar age. The same arguments give the same
    bytes.
    """
    ground = street_ground(network, seed)
    setting = Setting(ground, seed, condition)
    setting.turn_to(0, 5)
    rng = setting.rng
    clearance = rng.uniform(1.0, 5.0)
    near_i, near_j = np.nonzero((ground.beside > clearance) & (ground.beside < DEPTH) & ground.free)
    area = 0.25 * len(near_i)
    kinds = [str(kind) for kind in rng.choice(["round", "cone", "pine", "birch", "lime"], size=2)]
    age = rng.uniform(0.35, 1.1)
    count = min(MAX_TREES, int(area / rng.uniform(9.0, 45.0)))
    cells = rng.integers(0, max(1, len(near_i)), count if len(near_i) else 0)
    jitter = rng.uniform(0.0, 1.0, (len(cells), 2))
    places = ground.corner + 0.5 * (np.column_stack([near_i[cells], near_j[cells]]) + jitter)
    for x, y in places:
        kind = kinds[int(rng.random() < 0.2)]
        setting.put_tree(float(x), float(y), float(age * rng.uniform(0.6, 1.2)), kind)
    undergrowth = rng.uniform(0.0, 0.6)
    for x, y in places[: int(undergrowth * len(places))] + rng.normal(
        0.0, 2.0, (int(undergrowth * len(places)), 2)
    ):
        plant = objects.bush(rng, bare=condition.bare) if rng.random() < 0.6 else objects.tufts(rng)
        setting.put(plant, float(x), float(y), float(rng.uniform(0, 6.3)), aside=True)
    mesh, labels = ground.mesh(setting.snow)
    setting.static.add(mesh, labels, ground="none")
    return join_worlds(setting.static.build(), setting.moving.build())
