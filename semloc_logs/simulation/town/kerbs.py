"""What stands between the carriageway and the plots: lamps, signs, street trees, bins, parked
vehicles, people.
"""

from __future__ import annotations

import numpy as np

from semloc_logs.simulation.meshes import objects
from semloc_logs.simulation.town.setting import Setting
from semloc_logs.simulation.town.sides import Side, Style


def kerbside(setting: Setting, side: Side, style: Style) -> None:
    """Lamps, signs, street trees, bins, parked cars and people between the carriageway and the
    plots.
    """
    rng = setting.rng
    edge = side.road.half_width + 5.0
    walk = side.road.sidewalk + (0.2 if side.road.sidewalk else 1.0)
    if side.road.parking:
        for u in np.arange(edge + 6, side.length - edge - 6, 6.2):
            setting.parked(side, u + rng.normal() * 0.3, -1.05, style.parked)
    kerb = 0.5
    lamp = str(rng.choice(["lamp", "lamp", "double", "park"]))
    state = int(rng.integers(2**31))
    for u in np.arange(edge + rng.uniform(0, 15), side.length - edge, style.lamp_pitch):
        x, y, yaw = side.at(u, kerb)
        setting.put(objects.pole(np.random.default_rng(state), lamp), x, y, yaw, aside=True)
    if walk > 2.0 or rng.random() < 0.4:
        for u in np.arange(
            edge + 3 + rng.uniform(0, style.tree_pitch), side.length - edge, style.tree_pitch
        ):
            x, y, _ = side.at(u + rng.normal(), 0.9 if walk > 2 else walk + 1.0)
            setting.put_tree(x, y, style.tree_size * rng.uniform(0.7, 1.2))
    for kind, rate in (
        ("sign", 45.0),
        ("parking", 130.0),
        ("street", 130.0),
        ("mast", 260.0),
        ("bollard", 140.0),
        ("gantry", 900.0),
        ("flag", 400.0),
    ):
        for u in rng.uniform(
            edge - 3, max(edge, side.length - edge + 3), rng.poisson(side.length / rate)
        ):
            x, y, yaw = side.at(float(u), kerb)
            setting.put(objects.pole(rng, kind), x, y, yaw, aside=True)
    if rng.random() < 0.35:
        x, y, yaw = side.at(side.length - edge + 2.5 if side.sign > 0 else edge - 2.5, kerb)
        setting.put(objects.pole(rng, "signals"), x, y, yaw, aside=True)
    for _ in range(rng.poisson(side.length / 30)):
        x, y, yaw = side.at(
            rng.uniform(edge, max(edge + 1, side.length - edge)), max(kerb, walk - 0.5)
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
    for _ in range(setting.change.poisson(side.length / 80)):
        x, y, yaw = side.at(
            setting.change.uniform(0, side.length), setting.change.uniform(0.4, max(0.6, walk))
        )
        passer = objects.person if setting.change.random() < 0.7 else objects.two_wheeler
        setting.put(
            passer(setting.change), x, y, setting.change.uniform(0, 6.3), moving=True, aside=True
        )
    for _ in range(setting.change.poisson(side.length / 150)):
        x, y, yaw = side.at(
            setting.change.uniform(edge, max(edge + 1, side.length - edge)),
            0.4 if side.road.parking else -0.4,
        )
        setting.put(objects.rider(setting.change), x, y, yaw, moving=True)
