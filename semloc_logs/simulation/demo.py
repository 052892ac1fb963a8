"""The two short sessions of `semloc demo`: once round a block, and on another day half round it the
other way, then back.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from semloc_logs.simulation.conditions import Condition
from semloc_logs.simulation.drive_plan import Plan, Session
from semloc_logs.simulation.drives.trajectory import smooth_line
from semloc_logs.simulation.sensors.sensor import Sensor
from semloc_logs.simulation.sessions import write_sessions
from semloc_logs.simulation.town.road_network import RoadNetwork, grid_network, lane_path


def simulate_demo(directory: Path | str, seed: int = 0) -> list[Path]:
    """Write ``monday.mcap`` and ``tuesday.bag``, drives of about a minute through one street loop,
    with their truth; all files written.
    """
    network = grid_network(np.random.default_rng([seed, 71]), 2, 2, 62.0)
    around = _loop(network)
    monday = [*around, around[0]]
    other = [(road, not forwards) for road, forwards in around[::-1]]
    half = [*other[:2], *around[-2:], around[0]]
    sessions = [
        Session("monday.mcap", smooth_line(lane_path(network, monday)), Condition(0)),
        Session("tuesday.bag", smooth_line(lane_path(network, half)), Condition(1)),
    ]
    sensor = Sensor("hdl32", rate_hz=1.6, columns=1100)
    truth = write_sessions(directory, Plan(network, sessions, seed), sensor, overwrite=True)
    folder = Path(directory)
    return [
        folder / "monday.mcap",
        folder / "tuesday.bag",
        folder / "monday.tum",
        folder / "tuesday.tum",
        truth,
    ]


def _loop(network: RoadNetwork) -> list[tuple[int, bool]]:
    """The roads once round a network that is a single loop."""
    route = [(0, True)]
    while len(route) < len(network.roads):
        road, forwards = route[-1]
        here = network.roads[road].b if forwards else network.roads[road].a
        following = next(k for k, _ in network.neighbours(here) if k != road)
        route.append((following, network.roads[following].a == here))
    return route
