"""A street world along a road network: static things follow from the seed, changes between
sessions from the condition.
"""

from __future__ import annotations

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.simulation.conditions import Condition
from semloc_logs.simulation.meshes.world import World, join_worlds
from semloc_logs.simulation.town.backlands import backlands, islands, put_bridge, railway
from semloc_logs.simulation.town.kerbs import kerbside
from semloc_logs.simulation.town.plots import plots
from semloc_logs.simulation.town.road_network import RoadNetwork, path_network
from semloc_logs.simulation.town.setting import Setting
from semloc_logs.simulation.town.sides import Side, drawn_style
from semloc_logs.simulation.town.terrain import Ground
from semloc_logs.simulation.town.works import put_roadworks


def street_ground(network: RoadNetwork, seed: int) -> Ground:
    """The ground alone of the world that :func:`build_street` makes of the same network and seed;
    trajectories take heights from it.
    """
    return Ground(network, np.random.default_rng([seed, 10]))


def build_street(path: F64 | RoadNetwork, seed: int, condition: Condition | int = 0) -> World:
    """A street world along a driven path (n, 2 or 3) in metres or a road network.

    The same seed and condition give the same bytes; the condition's number changes parked cars,
    people, bins and a few trees, and is enough where nothing else differs. In other seasons the
    same houses and trunks stand in the same places.
    """
    condition = condition if isinstance(condition, Condition) else Condition(condition)
    network = (
        path
        if isinstance(path, RoadNetwork)
        else path_network(np.random.default_rng([seed, 9]), path)
    )
    ground = street_ground(network, seed)
    setting = Setting(ground, seed, condition)
    for k, road in enumerate(network.roads):
        setting.turn_to(k, 1, road.look)
        put_bridge(setting, Side(road, 1))
    for k, road in enumerate((*network.roads, *network.stubs)):
        for sign in (1, -1):
            side = Side(road, sign)
            setting.turn_to(k, 2 + (sign > 0), road.look)
            put_roadworks(setting, side)
            style = drawn_style(setting.rng, np.random.default_rng([seed, 15]))
            plots(setting, side, style)
            kerbside(setting, side, style)
    setting.turn_to(0, 4)
    islands(setting)
    if not network.level:
        railway(setting)
        backlands(setting)
    mesh, labels = ground.mesh(setting.snow)
    setting.static.add(mesh, labels, ground="none")
    return join_worlds(setting.static.build(), setting.moving.build())
