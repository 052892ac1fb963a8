"""Which drives a simulation makes: a town with what changes in it, and the routes through it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semloc_logs.arrays import F64
from semloc_logs.errors import SettingsError
from semloc_logs.simulation.conditions import Condition
from semloc_logs.simulation.drives.trajectory import smooth_line
from semloc_logs.simulation.meshes.objects import resample
from semloc_logs.simulation.output.drive_log import FORMATS
from semloc_logs.simulation.town.road_network import (
    RoadNetwork,
    grid_network,
    lane_path,
    random_route,
    repeating_network,
)
from semloc_logs.simulation.town.road_survey import drive_network, opposite_lane, read_drive

LENGTHS_M = 50, 100_000  # of a session, least and most
_BLOCK = 85.0  # m between crossings
_STEP = 0.5  # m between the points of a driven line
_SPARE = 30.0  # m that a route is longer than its drive: the ends are rounded off


@dataclass(frozen=True, slots=True)
class Town:
    """A random town and what changes in it from drive to drive.

    ``repeating``: its blocks are copies of one another. Parked cars, people and a few trees always
    change; ``seasons`` and ``daytimes`` (see :class:`Condition`) are taken in turn; from the second
    session on there are ``roadworks`` (sites a kilometre) and a share of ``rebuilt`` houses.
    """

    seed: int = 0
    repeating: bool = False
    seasons: Sequence[str] = ("summer",)
    daytimes: Sequence[str] = ("noon",)
    roadworks: float = 0.0
    rebuilt: float = 0.0

    def conditions(self, sessions: int) -> list[Condition]:
        """The conditions of so many sessions. SettingsError for impossible ones."""
        if not self.seasons or not self.daytimes:
            raise SettingsError(
                "simulated sessions need a season and a time of day: give at least one of each"
            )
        return [
            Condition(
                k,
                self.seasons[k % len(self.seasons)],
                self.roadworks if k else 0.0,
                self.rebuilt if k else 0.0,
                self.daytimes[k % len(self.daytimes)],
            )
            for k in range(sessions)
        ]


@dataclass(frozen=True, slots=True)
class Route:
    """How often and how far the town is driven through; SettingsError for impossible values.

    Without a ``trajectory`` every session drives another route of about ``length_m`` metres. With
    one (a TUM or KITTI file) the streets lie along that recorded drive, and every session drives
    the part of it between the two lengths ``part_m`` in metres; every other one, if
    ``there_and_back``, the other way in the other lane.
    """

    sessions: int = 2
    length_m: float = 500.0
    trajectory: Path | None = None
    part_m: tuple[float, float] = (0.0, math.inf)
    there_and_back: bool = False

    def __post_init__(self) -> None:
        if self.sessions < 1:
            raise SettingsError(f"{self.sessions} sessions cannot be simulated: give at least 1")
        least, most = LENGTHS_M
        if self.trajectory is None and not least <= self.length_m <= most:
            raise SettingsError(
                f"a simulated session cannot be {self.length_m} m long: "
                f"give between {least} and {most} m"
            )


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """A session to simulate: file name, driven lane line (n, 2) and its conditions."""

    file: str
    line: F64
    condition: Condition


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """The roads of a town, its ``seed``, and the sessions to drive through it."""

    network: RoadNetwork
    sessions: Sequence[Session]
    seed: int = 0


def plan_sessions(town: Town, route: Route, format: str = "mcap") -> Plan:
    """The sessions ``session_0``, ``session_1``... with the ending of ``format``.

    SettingsError for impossible values, LogError for a trajectory that cannot be read.
    """
    if format not in FORMATS:
        raise SettingsError(
            f"logs cannot be simulated as {format!r}: choose one of {', '.join(FORMATS)}"
        )
    conditions = town.conditions(route.sessions)
    if route.trajectory is None:
        network, lines = _drawn_lines(town, route)
    else:
        network, lines = _recorded_lines(town, route, route.trajectory)
    sessions = [
        Session(f"session_{k}{FORMATS[format]}", line, conditions[k])
        for k, line in enumerate(lines)
    ]
    return Plan(network, sessions, town.seed)


def _drawn_lines(town: Town, route: Route) -> tuple[RoadNetwork, list[F64]]:
    """A grid of streets, and another route through it for every session."""
    side = max(2, math.ceil(math.sqrt(route.length_m / _BLOCK / 2.5)))
    make_network = repeating_network if town.repeating else grid_network
    rng = np.random.default_rng([town.seed, 61])
    network = make_network(rng, side, side + int(side < 3), _BLOCK)
    routes = [
        random_route(np.random.default_rng([town.seed, 62, k]), network, route.length_m + _SPARE)
        for k in range(route.sessions)
    ]
    points = int(route.length_m / _STEP)
    return network, [smooth_line(lane_path(network, roads))[:points] for roads in routes]


def _recorded_lines(town: Town, route: Route, path: Path) -> tuple[RoadNetwork, list[F64]]:
    """Streets along a recorded drive, and its part for every session."""
    recorded = read_drive(path)
    network = drive_network(np.random.default_rng([town.seed, 64]), recorded)
    plan = resample(recorded[:, :2], _STEP)

    start, end = route.part_m
    if not 0 <= start < end:
        raise SettingsError(
            f"a drive cannot go from {start} m to {end} m: "
            f"give two lengths along {path}, the first one smaller"
        )
    first, last = (int(np.clip(m / _STEP, 0, len(plan))) for m in (start, end))
    shortest = LENGTHS_M[0]
    if last - first < shortest / _STEP:
        raise SettingsError(
            f"{path} is {len(plan) * _STEP:.0f} m long: "
            f"give a part of at least {shortest} m, not {start} to {end} m"
        )

    there = plan[first:last]
    back = opposite_lane(plan)[first:last][::-1]
    return network, [
        back if route.there_and_back and k % 2 else there for k in range(route.sessions)
    ]
