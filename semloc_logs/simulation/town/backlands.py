"""What lies behind the plots, or over them: trees, sheds, sidings, bridges."""

from __future__ import annotations

import numpy as np

from semloc_logs.simulation.meshes import objects
from semloc_logs.simulation.meshes.bridges import bridge, footprint
from semloc_logs.simulation.meshes.buildings import building
from semloc_logs.simulation.meshes.world import place
from semloc_logs.simulation.town.setting import Setting
from semloc_logs.simulation.town.sides import Side


def put_bridge(setting: Setting, side: Side) -> None:
    """Now and then a bridge over the middle of a road, if there is room for its ends."""
    rng = setting.rng
    ground = setting.ground
    middle = rng.uniform(0.35, 0.65) * side.length
    wanted = rng.random() < 0.08 and side.length > 70
    half = side.road.half_width + side.road.sidewalk + rng.uniform(0.4, 3.0)
    x, y, yaw = side.at(middle, -side.road.half_width)
    c = np.cos(yaw)
    s = np.sin(yaw)
    cells = footprint(half) @ np.array([[c, s], [-s, c]]) + [x, y]
    if wanted and ground.allowed(cells):
        setting.put(bridge(rng, half), x, y, yaw)
        ground.take(cells)
        over = np.stack(
            np.meshgrid(np.arange(-8, 8.1, 0.4), np.arange(-half - 1, half + 1.1, 0.4)), -1
        ).reshape(-1, 2)
        ground.cover(over @ np.array([[c, s], [-s, c]]) + [x, y])


def islands(setting: Setting) -> None:
    """What stands on roundabouts and refuges."""
    rng = setting.rng
    for circle in setting.ground.network.circles:
        if circle.inner > 1.5:
            setting.put_tree(circle.x, circle.y, rng.uniform(0.3, 0.8))
            for angle in np.arange(0, 2 * np.pi, rng.uniform(0.6, 2.0)):
                x = circle.x + 0.6 * circle.inner * np.cos(angle)
                y = circle.y + 0.6 * circle.inner * np.sin(angle)
                setting.put(
                    objects.bush(rng, bare=setting.condition.bare),
                    float(x),
                    float(y),
                    float(angle),
                    aside=True,
                )
        elif circle.inner and rng.random() < 0.5:
            setting.put(
                objects.pole(rng, "sign"), circle.x, circle.y, rng.uniform(0, 6.3), aside=True
            )


def railway(setting: Setting) -> None:
    """Wagons on a siding, in one town of three, where there is room for it."""
    rng = setting.rng
    ground = setting.ground
    i, j = np.nonzero(ground.free & (ground.beside > 8))
    if rng.random() > 0.35 or not len(i):
        return
    for k in rng.integers(0, len(i), 60):
        x, y = ground.corner + 0.5 * (np.array([i[k], j[k]]) + 0.5)
        yaw = rng.uniform(0, np.pi)
        count = int(rng.integers(1, 4))
        gx, gy = np.meshgrid(np.arange(-13.0, 26.0 * count - 13, 0.5), np.arange(-2.5, 2.6, 0.5))
        along = np.array([np.cos(yaw), np.sin(yaw)])
        cells = (
            gx.reshape(-1, 1) * along + gy.reshape(-1, 1) * np.array([-along[1], along[0]]) + [x, y]
        )
        if ground.allowed(cells):
            ground.take(cells)
            for n in range(count):
                setting.put(
                    objects.railway_wagon(rng),
                    x + 26.0 * n * along[0],
                    y + 26.0 * n * along[1],
                    yaw,
                    aside=True,
                )
            return


def backlands(setting: Setting) -> None:
    """Trees, sheds and houses in the space behind the plots."""
    rng = setting.rng
    ground = setting.ground
    i, j = np.nonzero(ground.free & (ground.beside > 5))
    for k in rng.integers(0, max(1, len(i)), int(len(i) * 0.25 / 80) if len(i) else 0):
        x, y = ground.corner + 0.5 * (np.array([i[k], j[k]]) + 0.5)
        size = rng.uniform(3, 11, 2)
        g = np.stack(
            np.meshgrid(np.arange(-0.5, 0.51, 0.1), np.arange(-0.5, 0.51, 0.1)), -1
        ).reshape(-1, 2)
        yaw = rng.uniform(0, np.pi)
        cells = (g * size) @ np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]]) + [
            x,
            y,
        ]
        if rng.random() < 0.35 and ground.allowed(cells):
            shape = building(
                rng,
                float(size[0]),
                float(size[1]),
                rng.uniform(2.3, 7),
                str(rng.choice(["flat", "gable", "hip"])),
            )
            setting.put([(place(m, 0, -size[1] / 2), label) for m, label in shape], x, y, yaw)
            ground.take(cells)
        elif ground.allowed(np.array([[x, y]])):
            setting.put_tree(x, y, rng.uniform(0.4, 1.2))
