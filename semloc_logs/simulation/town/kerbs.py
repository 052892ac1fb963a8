"""Objects at the kerb: lamps, signs, street trees, bins, parked vehicles, people."""

from __future__ import annotations

import numpy as np

from semloc_logs.simulation.meshes import objects
from semloc_logs.simulation.town.setting import Setting
from semloc_logs.simulation.town.sides import Side, Style

EDGE = 5.0  # m beside a crossing that stay empty
KERB = 0.5  # m beside the carriageway: poles
POLES = (  # kinds, and metres of kerb for one of them
    ("sign", 45.0),
    ("parking", 130.0),
    ("street", 130.0),
    ("mast", 260.0),
    ("bollard", 140.0),
    ("gantry", 900.0),
    ("flag", 400.0),
)


def kerbside(setting: Setting, side: Side, style: Style) -> None:
    """Lamps, signs, street trees, bins, parked cars and people between the carriageway and the
    plots.
    """
    edge = side.road.half_width + EDGE
    walk = side.road.sidewalk + (0.2 if side.road.sidewalk else 1.0)
    _lamps_and_trees(setting, side, style, edge, walk)
    _poles(setting, side, edge)
    _clutter(setting, side, edge, walk)
    _people(setting, side, edge, walk)


def _lamps_and_trees(setting: Setting, side: Side, style: Style, edge: float, walk: float) -> None:
    """Parked cars, lamps and trees, all in rows."""
    rng = setting.rng
    if side.road.parking:
        for u in np.arange(edge + 6, side.length - edge - 6, 6.2):
            setting.parked(side, u + rng.normal() * 0.3, -1.05, style.parked)
    lamp = str(rng.choice(["lamp", "lamp", "double", "park"]))
    state = int(rng.integers(2**31))
    for u in np.arange(edge + rng.uniform(0, 15), side.length - edge, style.lamp_pitch):
        x, y, yaw = side.at(u, KERB)
        setting.put(objects.pole(np.random.default_rng(state), lamp), x, y, yaw, aside=True)
    if walk > 2.0 or rng.random() < 0.4:
        for u in np.arange(
            edge + 3 + rng.uniform(0, style.tree_pitch), side.length - edge, style.tree_pitch
        ):
            x, y, _ = side.at(u + rng.normal(), 0.9 if walk > 2 else walk + 1.0)
            setting.put_tree(x, y, style.tree_size * rng.uniform(0.7, 1.2))


def _poles(setting: Setting, side: Side, edge: float) -> None:
    """Signs and other poles, and perhaps signals at the crossing."""
    rng = setting.rng
    for kind, pitch in POLES:
        for u in rng.uniform(
            edge - 3, max(edge, side.length - edge + 3), rng.poisson(side.length / pitch)
        ):
            x, y, yaw = side.at(float(u), KERB)
            setting.put(objects.pole(rng, kind), x, y, yaw, aside=True)
    if rng.random() < 0.35:
        x, y, yaw = side.at(side.length - edge + 2.5 if side.sign > 0 else edge - 2.5, KERB)
        setting.put(objects.pole(rng, "signals"), x, y, yaw, aside=True)


def _clutter(setting: Setting, side: Side, edge: float, walk: float) -> None:
    """Bins and the like, which move from drive to drive, stands for bicycles and shelters."""
    rng = setting.rng
    for _ in range(rng.poisson(side.length / 30)):
        x, y, yaw = side.at(
            rng.uniform(edge, max(edge + 1, side.length - edge)), max(KERB, walk - 0.5)
        )
        setting.put(
            objects.street_clutter(setting.change), x, y, yaw + np.pi, moving=True, aside=True
        )
    for make, pitch in ((objects.bicycle_stand, 120.0), (objects.shelter, 250.0)):
        for u in rng.uniform(
            edge,
            max(edge + 1, side.length - edge - 8),
            rng.poisson(side.length / pitch if walk > 2.0 else 0.0),
        ):
            x, y, yaw = side.at(float(u), walk - 1.1)
            setting.put(make(rng), x, y, yaw, aside=True)


def _people(setting: Setting, side: Side, edge: float, walk: float) -> None:
    """People and two-wheelers on the pavement, riders beside it."""
    rng = setting.change
    for _ in range(rng.poisson(side.length / 80)):
        x, y, yaw = side.at(rng.uniform(0, side.length), rng.uniform(0.4, max(0.6, walk)))
        passer = objects.person if rng.random() < 0.7 else objects.two_wheeler
        setting.put(passer(rng), x, y, rng.uniform(0, 6.3), moving=True, aside=True)
    for _ in range(rng.poisson(side.length / 150)):
        x, y, yaw = side.at(
            rng.uniform(edge, max(edge + 1, side.length - edge)),
            0.4 if side.road.parking else -0.4,
        )
        setting.put(objects.rider(rng), x, y, yaw, moving=True)
